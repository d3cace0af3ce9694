"""The picture of a fit: data and model, residuals, profile likelihoods and correlations (needs matplotlib)."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..parameters import short_names
from ..text import in_unit, readable_unit
from .plot import new_figure

# Only for type checkers: plots stand below tables and fits, which use them.
if TYPE_CHECKING:
    from ..identification import Identification

#: Greatest number of drawn profiles, and the rise of -2 log likelihood at the end of a 95 % interval.
MOST_PROFILES, INTERVAL = 6, 3.84

#: With at most this many measurements without a time, their labels are drawn.
MOST_LABELS = 12

#: Room above and below the measured values, as a part of their range.
MARGIN = 0.08


def draw_fit(fit: "Identification", labels: Sequence[str], unit: Any) -> Any:
    """Draw a fit: measurements and predictions at the most likely values, residuals in standard errors, profile likelihoods of
    the determined parameters (with their estimates and intervals, and the parabolas of their errors dashed), and correlations.

    **Arguments:** `labels`: (n,), short names of the measurements; `unit`: as for `in_unit`.

    **Returns:** a matplotlib figure.
    """
    names = list(fit.estimates)
    profiled = [name for name in names if np.isfinite(fit.standard_errors[name])][:MOST_PROFILES]
    # The correlations of one number say nothing.
    correlated = len(names) > 1
    lower = len(profiled) + correlated or 1
    figure = new_figure(max(9.0, 2.9 * lower), 8.5)
    grid = figure.add_gridspec(3, lower, height_ratios=(2.0, 1.0, 1.6))
    data = figure.add_subplot(grid[0, :])
    _draw_data(fit, data, unit)
    residuals = figure.add_subplot(grid[1, :], sharex=data)
    _draw_residuals(fit, residuals)
    _label_abscissa(fit, data, residuals, labels)
    concerns = [*fit.verdict.concerns]
    for k, name in enumerate(profiled):
        profile = fit.profile(name)
        _draw_profile(fit, name, profile, figure.add_subplot(grid[2, k]), unit)
        concerns += filter(None, [profile.concern(name)])
    if correlated:
        _draw_correlation(fit, names, figure.add_subplot(grid[2, lower - 1]))
    remarks = [*(concerns or ["no concerns about this fit"]), *(f"note: {note}" for note in fit.verdict.notes)]
    figure.suptitle("; ".join(remarks), fontsize=9, wrap=True)
    return figure


def _series(fit: "Identification") -> list[np.ndarray]:
    """The indices of the measurements of each series."""
    numbers = np.asarray(fit.measurements.series)
    return [np.flatnonzero(numbers == number) for number in np.unique(numbers)]


def _named(fit: "Identification", unit: Any) -> list[tuple[str, float]]:
    """The quantity of each series with the unit in which it is drawn, such as "theta [deg]", and the factor that converts
    its values."""
    named = []
    for k, indices in enumerate(_series(fit)):
        label = fit.residuals[indices[0]].label
        si = fit.series_units[k] if k < len(fit.series_units) else "1"
        quantity = label.partition("(")[0] if "(" in label else "time" if si == "s" else "measured"
        shown, factor = in_unit(si, unit)
        named.append((_with_unit(quantity, shown), factor))
    return named


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{readable_unit(unit)}]" if readable_unit(unit) else name


def _has_times(fit: "Identification") -> bool:
    return bool(np.any(np.asarray(fit.measurements.time)))


def _places(fit: "Identification") -> np.ndarray:
    """The abscissa of every measurement: its time, if it has one, otherwise its number."""
    times = np.asarray(fit.measurements.time)
    return times if _has_times(fit) else np.arange(len(times))


def _label_abscissa(fit: "Identification", data: Any, residuals: Any, labels: Sequence[str]) -> None:
    """Label the common abscissa below the residuals."""
    data.tick_params(labelbottom=False)
    if _has_times(fit):
        residuals.set_xlabel("time since the first sample [s]")
    elif len(labels) <= MOST_LABELS:
        residuals.set_xticks(_places(fit), labels, rotation=20, ha="right", fontsize=8)
    else:
        residuals.set_xlabel("measurement")


def _draw_data(fit: "Identification", axes: Any, unit: Any) -> None:
    places, named, (times, curves) = _places(fit), _named(fit, unit), fit.curves
    factors = np.ones(len(places))
    for indices, (_, factor) in zip(_series(fit), named, strict=True):
        factors[indices] = factor
    value, upper, errors, predicted = (
        factors * np.array([getattr(row, name) for row in fit.residuals])
        for name in ("value", "upper", "error", "prediction")
    )
    is_limit = np.array([row.censored for row in fit.residuals])
    # Draw an angle on the same turn as its prediction.
    turns = fit.measurements.whole_periods((predicted - value) / factors)
    value = np.where(is_limit, value, value + factors * np.asarray(turns))
    several = len(named) > 1
    for k, indices in enumerate(_series(fit)):
        colour, exact = f"C{k}", indices[~is_limit[indices]]
        text = named[k][0] if several else "measured"
        axes.errorbar(places[exact], value[exact], errors[exact], fmt=".", color=colour, alpha=0.6, label=text)
        if len(curves):
            moments = times[:, indices].T.reshape(-1)
            drawn = named[k][1] * curves[:, indices].T.reshape(-1)
            axes.plot(moments, drawn, "-", color=colour, linewidth=1.2, label=None if several else "predicted")
        else:
            allowed = indices[np.isfinite(predicted[indices]) & ~is_limit[indices]]
            text = "predicted" if k == 0 else None
            axes.plot(places[allowed], predicted[allowed], "x", color="0.3", label=text)
    _keep_range(axes, value[~is_limit], errors[~is_limit], predicted[~is_limit])
    _draw_limits(axes, places[is_limit], value[is_limit], upper[is_limit])
    texts = [text for text, _ in named]
    axes.set_ylabel(texts[0] if len(set(texts)) == 1 else "measured")
    axes.legend(fontsize=8)


def _keep_range(axes: Any, value: np.ndarray, errors: np.ndarray, predicted: np.ndarray) -> None:
    """Let the measured values set the range, and the predictions as far as they are no farther than these."""
    if not len(value):
        return
    low, high = float(np.min(value - errors)), float(np.max(value + errors))
    near = np.clip(predicted[np.isfinite(predicted)], low - 0.5 * (high - low), high + 0.5 * (high - low))
    low, high = min([low, *near]), max([high, *near])
    axes.set_ylim(low - MARGIN * (high - low), high + MARGIN * (high - low))


def _draw_limits(axes: Any, places: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
    """Draw a lower limit as a triangle that points up, an upper limit as one that points down, and a pair of limits as a
    bar; with their values, at the edge of the picture where they lie outside."""
    low, high = axes.get_ylim()
    text = "limit"
    for place, first, last in zip(places, lower, upper, strict=True):
        if math.isfinite(first) and math.isfinite(last):
            ends = np.clip([first, last], low, high)
            axes.plot([place, place], ends, "-_", color="C0", alpha=0.6, linewidth=1.2)
            continue
        is_lower = math.isfinite(first)
        limit = first if is_lower else last
        drawn = min(max(limit, low + 0.03 * (high - low)), high - 0.03 * (high - low))
        axes.plot([place], [drawn], "^" if is_lower else "v", color="C1", label=text)
        below: Any = {"xytext": (0, -11), "textcoords": "offset points", "ha": "center", "fontsize": 8}
        axes.annotate(f"{'>' if is_lower else '<'} {limit:.4g}", (place, drawn), **below)
        text = None
    axes.set_ylim(low, high)


def _draw_residuals(fit: "Identification", axes: Any) -> None:
    places = _places(fit)
    residual = np.array([row.residual for row in fit.residuals])
    for k, indices in enumerate(_series(fit)):
        axes.plot(places[indices], residual[indices], ".", color=f"C{k}")
    axes.axhspan(-1.96, 1.96, color="0.9", zorder=0)
    axes.set_ylabel("residual\n[standard errors]")


def _draw_profile(fit: "Identification", name: str, profile: Any, axes: Any, unit: Any) -> None:
    shown, factor = in_unit(fit.units.get(name, "1"), unit)
    estimate, error = fit.estimates[name], fit.standard_errors[name]
    likely = fit.most_likely[name]
    values, deviance = np.append(profile.values, likely), np.append(profile.deviance, 0.0)
    order = np.argsort(values)
    axes.plot(factor * values[order], deviance[order], ".-", label="profile")
    axes.plot(
        factor * values[order], ((values[order] - estimate) / error) ** 2, "--", color="0.6", label="standard error"
    )
    axes.axhline(INTERVAL, color="0.6", linewidth=0.8)
    axes.axvspan(*(factor * end for end in fit.interval(name)), color="0.92", zorder=0, label="95 %")
    if name == next(iter(fit.estimates)):
        axes.legend(fontsize=7, loc="upper right")
    axes.locator_params(axis="x", nbins=4)
    axes.set_ylim(-0.5, 10.0)
    axes.set_xlabel(_with_unit(short_names(list(fit.estimates))[name], shown))
    axes.set_ylabel("-2 log likelihood, profiled")
    digits = max(0, 1 - math.floor(math.log10(factor * error)))
    value, spread, low, high = (f"{factor * part:.{digits}f}" for part in (estimate, error, *fit.interval(name)))
    axes.set_title(f"{value} ± {spread} {readable_unit(shown)}".rstrip() + f"\n95 %: {low} to {high}", fontsize=9)


def _draw_correlation(fit: "Identification", names: list[str], axes: Any) -> None:
    image = axes.imshow(fit.correlation, vmin=-1.0, vmax=1.0, cmap="RdBu")
    labels = list(short_names(names).values())
    axes.set_xticks(range(len(names)), labels, rotation=90, fontsize=8)
    axes.set_yticks(range(len(names)), labels, fontsize=8)
    axes.set_title("correlation", fontsize=9)
    axes.figure.colorbar(image, ax=axes, shrink=0.8)
