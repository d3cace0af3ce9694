"""The picture of a fit: data and model, residuals, profile likelihoods and correlations (needs matplotlib)."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ..text import readable_unit

#: Greatest number of drawn profiles, and the rise of -2 log likelihood at the end of a 95 % interval.
MOST_PROFILES, INTERVAL = 6, 3.84

#: With at most this many measurements without a time, their labels are drawn.
MOST_LABELS = 12


class Fit(Protocol):
    """The parts of an `identification.Identification` that its picture shows."""

    @property
    def estimates(self) -> Mapping[str, float]: ...

    @property
    def standard_errors(self) -> Mapping[str, float]: ...

    @property
    def measurements(self) -> Any: ...

    @property
    def residuals(self) -> Sequence[Any]: ...

    @property
    def correlation(self) -> np.ndarray: ...

    @property
    def curves(self) -> tuple[np.ndarray, np.ndarray]: ...

    @property
    def series_units(self) -> tuple[str, ...]: ...

    @property
    def verdict(self) -> Any: ...

    def profile(self, name: str) -> Any: ...


def draw_fit(fit: Fit) -> Any:
    """Draw a fit: measurements and predictions, residuals in units of the errors, profile likelihoods of the determined
    parameters (with their parabolas dashed), and correlations.

    **Returns:** a matplotlib figure.
    """
    from matplotlib.figure import Figure

    names = list(fit.estimates)
    profiled = [name for name in names if np.isfinite(fit.standard_errors[name])][:MOST_PROFILES]
    # The correlations of one number say nothing.
    correlated = len(names) > 1
    lower = len(profiled) + correlated or 1
    figure = Figure(figsize=(max(9.0, 2.6 * lower), 8.5), layout="constrained")
    grid = figure.add_gridspec(3, lower, height_ratios=(2.0, 1.0, 1.6))
    _draw_data(fit, figure.add_subplot(grid[0, :]))
    _draw_residuals(fit, figure.add_subplot(grid[1, :]))
    for k, name in enumerate(profiled):
        _draw_profile(fit, name, figure.add_subplot(grid[2, k]))
    if correlated:
        _draw_correlation(fit, names, figure.add_subplot(grid[2, lower - 1]))
    figure.suptitle("; ".join(fit.verdict.concerns) or "no concerns about this fit", fontsize=9, wrap=True)
    return figure


def _series(fit: Fit) -> list[np.ndarray]:
    """The indices of the measurements of each series."""
    numbers = np.asarray(fit.measurements.series)
    return [np.flatnonzero(numbers == number) for number in np.unique(numbers)]


def _names(fit: Fit) -> list[str]:
    """The quantity of each series with its unit, such as "theta [rad]"."""
    names = []
    for k, indices in enumerate(_series(fit)):
        label = fit.residuals[indices[0]].label
        unit = fit.series_units[k] if k < len(fit.series_units) else ""
        quantity = label.partition("(")[0] if "(" in label else "time" if unit == "s" else "measured"
        names.append(f"{quantity} [{readable_unit(unit)}]" if readable_unit(unit) else quantity)
    return names


def _abscissa(fit: Fit) -> tuple[np.ndarray, str]:
    """The abscissa of every measurement: its time, if it has one."""
    times = np.asarray(fit.measurements.time)
    return (times, "time since the first sample [s]") if np.any(times) else (np.arange(len(times)), "measurement")


def _draw_data(fit: Fit, axes: Any) -> None:
    places, label = _abscissa(fit)
    rows, names, (times, curves) = fit.residuals, _names(fit), fit.curves
    value = np.array([row.value if np.isfinite(row.value) else row.upper for row in rows])
    errors, predicted = (np.array([getattr(row, name) for row in rows]) for name in ("error", "prediction"))
    censored = np.array([row.censored for row in rows])
    # Draw an angle on the same turn as its prediction.
    value = value + np.asarray(fit.measurements.whole_periods(predicted - value))
    for k, indices in enumerate(_series(fit)):
        colour, exact, limits = f"C{k}", indices[~censored[indices]], indices[censored[indices]]
        axes.errorbar(places[exact], value[exact], errors[exact], fmt=".", color=colour, alpha=0.5, label=names[k])
        axes.plot(places[limits], value[limits], "^", color=colour, alpha=0.5)
        if len(curves):
            moments = times[:, indices].T.reshape(-1)
            axes.plot(moments, curves[:, indices].T.reshape(-1), "-", color=colour, linewidth=1.2)
        else:
            axes.plot(places[indices], predicted[indices], "x", color=colour)
    axes.set_xlabel(label)
    if not np.any(np.asarray(fit.measurements.time)) and len(rows) <= MOST_LABELS:
        axes.set_xticks(places, [row.label for row in rows], rotation=20, ha="right", fontsize=8)
        axes.set_xlabel("")
    drawn = "curve" if len(curves) else "crosses"
    axes.set_title(f"dots: measured; {drawn}: predicted", fontsize=9)
    axes.set_ylabel(names[0] if len(set(names)) == 1 else "measured")
    if len(set(names)) > 1:
        axes.legend(fontsize=8)


def _draw_residuals(fit: Fit, axes: Any) -> None:
    places, label = _abscissa(fit)
    residual = np.array([row.residual for row in fit.residuals])
    for k, indices in enumerate(_series(fit)):
        axes.plot(places[indices], residual[indices], ".", color=f"C{k}")
    axes.axhspan(-1.96, 1.96, color="0.9", zorder=0)
    axes.set_xlabel(label)
    axes.set_ylabel("residual / error")


def _draw_profile(fit: Fit, name: str, axes: Any) -> None:
    profile = fit.profile(name)
    deviations = (profile.values - fit.estimates[name]) / fit.standard_errors[name]
    axes.plot(profile.values, profile.deviance, ".-")
    axes.plot(profile.values, deviations**2, "--", color="0.6")
    axes.axhline(INTERVAL, color="0.6", linewidth=0.8)
    axes.set_ylim(-0.5, 10.0)
    axes.set_xlabel(name)
    axes.set_ylabel("-2 log likelihood, profiled")


def _draw_correlation(fit: Fit, names: list[str], axes: Any) -> None:
    image = axes.imshow(fit.correlation, vmin=-1.0, vmax=1.0, cmap="RdBu")
    labels = [name.rsplit(".", 1)[-1] for name in names]
    axes.set_xticks(range(len(names)), labels, rotation=90, fontsize=8)
    axes.set_yticks(range(len(names)), labels, fontsize=8)
    axes.set_title("correlation", fontsize=9)
    axes.figure.colorbar(image, ax=axes, shrink=0.8)
