"""The picture of a fit: data and model, residuals, profile likelihoods and correlations (needs matplotlib)."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..parameters import short_names
from ..text import Unit, in_unit, readable_unit
from .plot import new_figure

# Only for type checkers: matplotlib is optional, and plots stand below tables and fits, which use them.
if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

    from ..identification import Identification
    from ..identification.conclusions import Profile

#: Greatest number of drawn profiles, and the rise of -2 log likelihood at the end of a 95 % interval.
MOST_PROFILES, INTERVAL = 6, 3.84

#: With at most this many measurements without a time, their labels are drawn.
MOST_LABELS = 12

#: Room above and below the measured values, as a part of their range.
MARGIN = 0.08


class _Drawn(NamedTuple):
    """What is drawn of every measurement, in the units of the picture.

    - `series`: the indices of the measurements of each series; `names`: the quantity of each series with its unit, such as
      "1: theta [deg]", where the number is that of the data.
    - `value`, `upper`, `errors`, `predicted`: (n,); `is_limit`: (n,); `times`, `curves`: (slices, n), as `fit.curves`.
    """

    series: list[np.ndarray]
    names: list[str]
    value: np.ndarray
    upper: np.ndarray
    errors: np.ndarray
    predicted: np.ndarray
    is_limit: np.ndarray
    times: np.ndarray
    curves: np.ndarray

    @classmethod
    def of(cls, fit: "Identification", unit: Unit) -> "_Drawn":
        numbers, names = np.asarray(fit.measurements.series), []
        series, factors = [np.flatnonzero(numbers == number) for number in np.unique(numbers)], np.ones(len(numbers))
        for k, indices in enumerate(series):
            label = fit.residuals[indices[0]].label
            si = fit.series_units[k] if k < len(fit.series_units) else "1"
            quantity = label.partition("(")[0] if "(" in label else "time" if si == "s" else "measured"
            shown, factors[indices] = in_unit(si, unit)
            names.append(_with_unit(quantity, shown))
        value, upper, errors, predicted = (
            factors * np.array([getattr(row, name) for row in fit.residuals])
            for name in ("value", "upper", "error", "prediction")
        )
        is_limit = np.array([row.censored for row in fit.residuals])
        # Draw an angle on the same turn as its prediction.
        turns = factors * np.asarray(fit.measurements.whole_periods((predicted - value) / factors))
        value, (times, curves) = np.where(is_limit, value, value + turns), fit.curves
        curves = factors * curves if len(curves) else curves
        return cls(series, names, value, upper, errors, predicted, is_limit, times, curves)

    def panels(self, chosen: list[int]) -> dict[str, list[int]]:
        """The series among `chosen` that share a panel, by the quantity, whatever the number of the data."""
        panels: dict[str, list[int]] = {}
        for k in chosen:
            panels.setdefault(self.names[k].rpartition(": ")[2], []).append(k)
        return panels


def draw_fit(fit: "Identification", labels: Sequence[str], unit: Unit) -> "Figure":
    """Draw a fit: measurements and predictions at the most likely values, with a panel for each quantity; residuals in standard
    errors; profile likelihoods of the determined parameters (with their estimates and intervals, and the parabolas of their
    errors dashed); and correlations. Samples over time and other measurements are side by side.

    **Arguments:** `labels`: (n,), short names of the measurements; `unit`: as for `in_unit`.

    **Returns:** a matplotlib figure.
    """
    names, drawn, times = list(fit.estimates), _Drawn.of(fit, unit), np.asarray(fit.measurements.time)
    profiled = [name for name in names if np.isfinite(fit.standard_errors[name])][:MOST_PROFILES]
    # The correlations of one number say nothing.
    correlated = len(names) > 1
    lower = len(profiled) + correlated or 1
    has_time = [bool(np.any(times[indices])) for indices in drawn.series]
    blocks = [
        [k for k, timed in enumerate(has_time) if timed == wanted] for wanted in (True, False) if wanted in has_time
    ]
    most = max(len(drawn.panels(block)) for block in blocks)
    figure = new_figure(max(9.0, 2.9 * lower, 6.5 * len(blocks)), 6.5 + 2.0 * most)
    rows = figure.add_gridspec(2, 1, height_ratios=(1.0 + 2.0 * most, 1.6))
    columns = rows[0].subgridspec(1, len(blocks))
    for column, block in enumerate(blocks):
        _draw_block(fit, drawn, block, has_time[block[0]], labels, figure, columns[column])
    grid = rows[1].subgridspec(1, lower)
    concerns = [*fit.verdict.concerns]
    for k, name in enumerate(profiled):
        profile = fit.profile(name)
        _draw_profile(fit, name, profile, figure.add_subplot(grid[k]), unit)
        concerns += filter(None, [profile.concern(name)])
    if correlated:
        axes, short = figure.add_subplot(grid[lower - 1]), list(short_names(names).values())
        image = axes.imshow(fit.correlation, vmin=-1.0, vmax=1.0, cmap="RdBu")
        axes.set_xticks(range(len(names)), short, rotation=90, fontsize=8)
        axes.set_yticks(range(len(names)), short, fontsize=8)
        axes.set_title("correlation", fontsize=9)
        figure.colorbar(image, ax=axes, shrink=0.8)
    remarks = [*(concerns or ["no concerns about this fit"]), *(f"note: {note}" for note in fit.verdict.notes)]
    figure.suptitle("; ".join(remarks), fontsize=9, wrap=True)
    return figure


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{readable_unit(unit)}]" if readable_unit(unit) else name


def _draw_block(
    fit: "Identification",
    drawn: _Drawn,
    block: list[int],
    has_time: bool,
    labels: Sequence[str],
    figure: "Figure",
    place: "SubplotSpec",
) -> None:
    """Draw series over their times, or over the numbers of their measurements: the data and the residuals."""
    indices = np.concatenate([drawn.series[k] for k in block])
    abscissa = np.full(len(drawn.value), np.nan)
    abscissa[indices] = np.asarray(fit.measurements.time)[indices] if has_time else np.arange(len(indices))
    panels, first = drawn.panels(block), None
    grid = place.subgridspec(len(panels) + 1, 1, height_ratios=[2.0] * len(panels) + [1.0])
    for row, (name, series) in enumerate(panels.items()):
        axes = figure.add_subplot(grid[row], sharex=first)
        first = axes if first is None else first
        axes.tick_params(labelbottom=False)
        _draw_data(drawn, axes, series, abscissa, has_time)
        axes.set_ylabel(name)
    residuals = figure.add_subplot(grid[len(panels)], sharex=first)
    for k in block:
        residuals.plot(
            abscissa[drawn.series[k]], [fit.residuals[i].residual for i in drawn.series[k]], ".", color=f"C{k}"
        )
    residuals.axhspan(-1.96, 1.96, color="0.9", zorder=0)
    residuals.set_ylabel("residual\n[standard errors]")
    if has_time:
        residuals.set_xlabel("time since the first sample [s]")
    elif len(indices) <= MOST_LABELS:
        residuals.set_xticks(abscissa[indices], [str(labels[i]) for i in indices], rotation=20, ha="right", fontsize=8)
    else:
        residuals.set_xlabel("measurement")


def _draw_data(drawn: _Drawn, axes: "Axes", series: list[int], abscissa: np.ndarray, has_time: bool) -> None:
    """Draw the series of one panel with their predictions, as curves if they have times."""
    several = len(series) > 1
    for k in series:
        colour, indices = f"C{k}", drawn.series[k]
        exact = indices[~drawn.is_limit[indices]]
        text = drawn.names[k] if several else "measured"
        axes.errorbar(
            abscissa[exact], drawn.value[exact], drawn.errors[exact], fmt=".", color=colour, alpha=0.6, label=text
        )
        if has_time and len(drawn.curves):
            moments, curve = (part[:, indices].T.reshape(-1) for part in (drawn.times, drawn.curves))
            axes.plot(moments, curve, "-", color=colour, linewidth=1.2, label=None if several else "predicted")
        else:
            allowed = exact[np.isfinite(drawn.predicted[exact])]
            text = "predicted" if k == series[0] else None
            axes.plot(abscissa[allowed], drawn.predicted[allowed], "x", color="0.3", label=text)
    indices = np.concatenate([drawn.series[k] for k in series])
    exact, limits = indices[~drawn.is_limit[indices]], indices[drawn.is_limit[indices]]
    if len(exact):
        # The measured values set the range, and the predictions as far as they are no farther than these.
        value, error, predicted = drawn.value[exact], drawn.errors[exact], drawn.predicted[exact]
        low, high = float(np.min(value - error)), float(np.max(value + error))
        near = np.clip(predicted[np.isfinite(predicted)], low - 0.5 * (high - low), high + 0.5 * (high - low))
        low, high = min([low, *near]), max([high, *near])
        axes.set_ylim(low - MARGIN * (high - low), high + MARGIN * (high - low))
    _draw_limits(axes, abscissa[limits], drawn.value[limits], drawn.upper[limits])
    axes.legend(fontsize=8)


def _draw_limits(axes: "Axes", places: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
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
        shift = 5 if drawn < low + 0.1 * (high - low) else -11
        words = f"{'>' if is_lower else '<'} {limit:.4g}"
        axes.annotate(words, (place, drawn), (0, shift), textcoords="offset points", ha="center", fontsize=8)
        text = None
    axes.set_ylim(low, high)


def _draw_profile(fit: "Identification", name: str, profile: "Profile", axes: "Axes", unit: Unit) -> None:
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
