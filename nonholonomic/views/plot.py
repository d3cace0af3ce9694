"""Plots of tables, of quantities over time, and of fits (needs matplotlib)."""

import io
import itertools
import math
import textwrap
from collections.abc import Container, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..parameters import meant, short_names
from ..text import UNITS, Unit, in_unit, likely, readable_unit, shown, with_unit
from ..validation import require
from .stage import COLOURS, Marks, css

# Only for type checkers: matplotlib is optional, and plots stand below tables and fits, which use them.
if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure, FigureBase
    from matplotlib.gridspec import SubplotSpec

    from ..identification import Identification
    from ..sweeps import Table

#: Colours of map cells without a finite value, one for each status.
GREYS = ("0.85", "0.7", "0.55", "0.4", "0.25")

#: The quantiles of the values at the ends of a map's colour scale.
QUANTILES = (0.02, 0.98)

#: Relative difference from a value of an axis that counts as none.
ROUND_OFF = 1e-9

#: An axis with at most this many values is drawn as one line per value; height of each line's marks of cells without a value,
#: as a part of the picture.
MOST_LINES, MARK = 8, 0.03

#: More points of a bifurcation diagram than this are drawn smaller.
MOST_POINTS = 2000

#: A map of whole numbers with at most this many values has a colour for each.
MOST_COLOURS = 10

#: Size of a panel [inches], and numbers of characters for which a legend or a title above it, and a label beside it, have room.
PANEL, WIDTH, HEIGHT = (7.0, 2.0), 90, 26

#: The ratio of the ranges of components named x, y and z below which they are a path, with one scale.
EQUAL = 4.0


def new_figure(width: float = 7.0, height: float = 4.5) -> "Figure":
    """An empty matplotlib figure of a size in inches. A notebook shows it even if figures are not displayed automatically."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(width, height), layout="constrained")

    def png() -> bytes:
        image = io.BytesIO()
        figure.savefig(image, format="png")
        return image.getvalue()

    figure._repr_png_ = png
    return figure


def coloured(panel: "Axes") -> "Axes":
    """Give axes the colours of a page, which stand out from white; lines beyond these colours are dashed.

    **Returns:** the axes.
    """
    from matplotlib.rcsetup import cycler

    panel.set_prop_cycle(cycler(linestyle=STYLES) * cycler(color=[css(colour) for colour in COLOURS]))
    return panel


def draw_title(figure: Any, text: str) -> None:
    """Write a title of as many lines as it needs above all of a figure."""
    width = int(figure.bbox_inches.width / PANEL[0] * WIDTH)
    figure.suptitle("\n".join(textwrap.fill(line, width) for line in text.splitlines()), fontsize="medium")


def draw_table(
    table: "Table",
    variable: str | None = None,
    at: dict[str, float] | None = None,
    log: bool = False,
    ax: "Axes | None" = None,
    x: str | None = None,
    y: str | None = None,
    label: str | None = None,
) -> "FigureBase | Axes":
    """Draw a variable over the grid of a table: lines over the first axis, or a map of the first two.

    Cells without a finite value are left out of lines and marked by their status in maps.

    **Arguments:** as for `Table.plot`.

    **Returns:** a matplotlib figure, or `ax`.

    **Raises:** `ValueError` as `Table.plot`.
    """
    names = [name for name, values in table.variables.items() if values.dtype.kind != "U"]
    if variable is None and not names:
        raise ValueError("the table has no numeric variable to draw")
    variable = names[0] if variable is None else variable
    if not isinstance(variable, str) or variable not in names:
        raise ValueError(
            f"variable = {shown(variable)} must be a numeric variable of the table: {', '.join(names)}{likely(variable, names)}"
        )
    dims = table.dims(variable)
    if not dims:
        raise ValueError("a table of one cell has nothing to draw")
    at = {_whole(dims, name): value for name, value in (at or {}).items()}
    x, y = (name if name is None else _whole(dims, name) for name in (x, y))
    if not isinstance(label, str | None):
        raise ValueError(f"label = {shown(label)} must be a text")
    names, cut = _drawn(table, variable, at, x, y)
    values = table.variables[variable]
    visible = _slice(np.where(np.isfinite(values), values, np.nan), dims, names, cut)
    # The statuses of the drawn cells, if each has one.
    has_status = "status" in table.variables and not table.inner.get(variable)
    words, (fallen, fell) = None, table.for_a_time
    if has_status:
        words, fell = (_slice(part, dims, names, cut) for part in (table["status"], fell))
        words = np.where(fell, fallen, words)
    drawing = coloured(new_figure().add_subplot()) if ax is None else ax
    cuts = [_cut_text(table, name, place, at.get(name)) for name, place in cut.items()]
    is_diagram = x is None and len(names) == 2 and names[0] == "crossing"
    is_map = len(names) == 2 and not is_diagram and (y is not None or len(table.coords[names[1]]) > MOST_LINES)
    drawing.set_ylabel(table.label(names[1] if is_map else variable))
    if has_status and np.any(marked := fell & np.isfinite(visible)):
        # Cells with a value whose event held only for a time.
        abscissa = np.broadcast_to(table.coords[names[0]], visible.T.shape).T
        ordinate = np.broadcast_to(table.coords[names[1]], visible.shape) if is_map else visible
        style = {"color": "white", "markeredgecolor": "0.2", "markersize": 6, "linestyle": "", "zorder": 3}
        drawing.plot(abscissa[marked], ordinate[marked], ".", label=fallen, **style)
    if is_map:
        cuts = [label, *cuts] if label else cuts
        _draw_map(drawing, table, names, visible, table.label(variable), log, values.dtype.kind in "iu")
        if words is not None:
            _mark_words(drawing, table, names, np.where(np.isnan(visible), words, ""))
    elif is_diagram:
        # All crossings over an axis: a bifurcation diagram.
        names, abscissa = names[1:], np.broadcast_to(table.coords[names[1]], visible.shape)
        size = 2.0 * math.sqrt(MOST_POINTS / max(visible.size, MOST_POINTS))
        drawing.plot(abscissa.ravel(), visible.ravel(), "o", markersize=size, mew=0.0, label=label, rasterized=True)
    else:
        _draw_lines(drawing, table, names, visible.reshape(len(visible), -1), label, words)
        if drawing.get_legend_handles_labels()[1]:
            # In a new figure there is room beside the lines.
            drawing.legend(**({"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)} if ax is None else {}))
    if log and not is_map:
        drawing.set_yscale("log")
        _plain_numbers(drawing.yaxis)
    drawing.set_xlabel(table.label(names[0]))
    drawing.set_title(textwrap.fill(", ".join(cuts), WIDTH // 2), fontsize="medium")
    return drawing.figure if ax is None else ax


def _whole(dims: tuple[str, ...], name: str) -> str:
    """The axis that ends with a name, as "launch.spin" does with "spin"; the name itself unless there is one such axis."""
    names = meant(name, dims)
    return names[0] if len(names) == 1 else name


def _drawn(
    table: "Table", variable: str, at: dict[str, float], x: str | None, y: str | None
) -> tuple[list[str], dict[str, int]]:
    """The one or two dimensions to draw over, and the indices at which the others are cut."""
    dims = table.dims(variable)
    wanted = {argument: name for argument, name in {"x": x, "y": y}.items() if name is not None}
    for argument, name in wanted.items():
        if name not in dims:
            raise ValueError(f"{argument} = {shown(name)} must be one of {', '.join(dims)}{likely(name, dims)}")
        if name in at or list(wanted.values()).count(name) > 1:
            raise ValueError(f"{argument} = {name!r} must not be named in at, nor be both x and y")
    cut = {name: _nearest(table, dims, name, value) for name, value in at.items()}
    cells = len(table.shape)
    # A quantity with its own dimension, such as time, is drawn over that dimension.
    left = [name for name in (*dims[cells:], *dims[:cells]) if name not in (*cut, x, y)]
    if not left and not wanted:
        raise ValueError(f"at = {shown(at)} leaves no axis to draw over")
    first = [x] if x is not None else left[:1]
    names = [*first, *([y] if y is not None else [name for name in left if name not in first][:1])]
    return names, cut | {name: 0 for name in left if name not in names}


def _nearest(table: "Table", dims: tuple[str, ...], name: str, value: float | str) -> int:
    """The index of the value of an axis that is nearest to a wanted value within the axis."""
    if name not in dims:
        raise ValueError(f"at: {name!r} must be one of {', '.join(dims)}{likely(name, dims)}")
    coordinate = table.coords[name]
    if coordinate.dtype.kind == "U":
        if value not in coordinate:
            raise ValueError(f"at: {name} = {shown(value)} must be one of {', '.join(coordinate)}")
        return int(np.flatnonzero(coordinate == value)[0])
    low, high = float(np.min(coordinate)), float(np.max(coordinate))
    require(value, f"at: {name}")
    if not low - ROUND_OFF * abs(low) <= float(value) <= high + ROUND_OFF * abs(high):
        unit = readable_unit(table.units.get(name, "1"))
        given, ends = (f"{text} {unit}".rstrip() for text in (f"{float(value):.6g}", f"{low:.6g} and {high:.6g}"))
        raise ValueError(
            f"at: {name} = {given} must be between the ends of the axis, {ends}; at has the unit of the table, not that of the "
            "picture"
        )
    return int(np.argmin(np.abs(coordinate - value)))


def _slice(values: np.ndarray, dims: tuple[str, ...], names: list[str], cut: dict[str, int]) -> np.ndarray:
    """The values over the drawn dimensions, in their order."""
    left = [name for name in dims if name not in cut]
    return values[tuple(cut.get(name, slice(None)) for name in dims)].transpose([left.index(name) for name in names])


def _cut_text(table: "Table", name: str, place: int, wanted: float | None = None) -> str:
    """A coordinate's value as text, "θ(0) = 0.1 rad", with the wanted value where it is another."""
    value = table.coords[name][place]
    text = str(value) if isinstance(value, str) else f"{value:.4g}"
    text = f"{table.long_names.get(name, name)} = {text} {readable_unit(table.units.get(name, '1'))}".rstrip()
    is_near = wanted is None or isinstance(value, str) or abs(value - wanted) <= ROUND_OFF * abs(value)
    return text if is_near else f"{text} (nearest to {wanted:.4g})"


def _draw_lines(
    drawing: "Axes", table: "Table", names: list[str], lines: np.ndarray, label: str | None, words: np.ndarray | None
) -> None:
    """Draw a line for each column, and in a strip above them the statuses of cells without a finite value."""
    # Nothing lies between two crossings.
    values, style = table.coords[names[0]], "" if names[0] == "crossing" else None
    marker = "o" if style == "" or len(lines) <= 100 else None
    has_number = np.isfinite(lines)
    lost = np.full(lines.shape, "") if words is None else np.where(has_number, "", words.reshape(lines.shape))
    marks = dict(zip(filter(None, np.unique(lost).tolist()), "x+1234", strict=False))
    # A row of the strip for each line that has such cells.
    rows = np.cumsum(np.any(lost != "", axis=0)) - 1
    strip, last = drawing, int(rows[-1])
    if marks:
        # Outside of the scale of the values, and above the strips of earlier plots in these axes.
        ends = [child.bbox.transformed(drawing.transAxes.inverted()).y1 for child in drawing.child_axes]
        place = 0.0, max([1.0, *ends]), 1.0, MARK * (2 + last)
        strip = drawing.inset_axes(place, sharex=drawing, facecolor="0.9", ylim=(-1.0, last + 1.0))
        strip.set_yticks([0.5 * last], ["\n".join(marks).replace("_", " ")], fontsize="small")
        strip.tick_params(length=0.0, labelbottom=False)
    for index, line in enumerate(lines.T):
        texts = [label or "", _cut_text(table, names[1], index) if len(names) > 1 else ""]
        text = ", ".join(filter(None, texts))
        (curve,) = drawing.plot(values, line, marker=marker, markersize=3, linestyle=style, label=text or None)
        for word, mark in marks.items():
            strip.plot(values, np.where(lost[:, index] == word, rows[index], np.nan), mark, color=curve.get_color())
    for word, mark in marks.items() if len(marks) > 1 else ():
        drawing.plot([], [], mark, color="0.35", label=word.replace("_", " "))
    if not np.any(has_number):
        drawing.text(0.5, 0.5, "nothing finite to draw", transform=drawing.transAxes, ha="center", va="center")


def _draw_map(
    drawing: "Axes", table: "Table", names: list[str], visible: np.ndarray, label: str, log: bool, is_whole: bool
) -> None:
    from matplotlib.colors import ListedColormap, LogNorm, Normalize

    values = visible[np.isfinite(visible) & (visible > 0.0)] if log else visible[np.isfinite(visible)]
    x, y = table.coords[names[0]], table.coords[names[1]]
    if is_whole and not log and len(kinds := np.unique(values)) <= MOST_COLOURS:
        # Numbers up to 0 count nothing: an attractor that is not reached, or no flights.
        greys = {0: GREYS[0], -1: GREYS[2]}
        colours = ListedColormap([greys.get(int(kind), f"C{number}") for number, kind in enumerate(kinds)])
        image = drawing.pcolormesh(x, y, np.searchsorted(kinds, visible.T), shading="nearest", cmap=colours)
        image.set_clim(-0.5, len(kinds) - 0.5)
        bar = drawing.figure.colorbar(image, ax=drawing, label=label, ticks=range(len(kinds)))
        bar.ax.set_yticklabels([f"{kind:.0f}" for kind in kinds])
        return
    low, high = np.quantile(values, QUANTILES) if values.size else (0.0, 1.0)
    scale = (LogNorm if log else Normalize)(low, high)
    image = drawing.pcolormesh(x, y, visible.T, shading="nearest", norm=scale)
    is_clipped = (bool(np.any(values < low)), bool(np.any(values > high)))
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(is_clipped, "neither")
    bar = drawing.figure.colorbar(image, ax=drawing, label=label, extend=extend)
    if log:
        _plain_numbers(bar.ax.yaxis)


def _plain_numbers(axis: "Axis") -> None:
    """Write the labels of a logarithmic axis as 12.5, not as 1.25 x 10^1, if none is very large or small."""
    low, high = axis.get_view_interval()
    if low >= 1e-4 and high <= 1e5:
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}" if high < 10.0 * low else "")


def _mark_words(drawing: "Axes", table: "Table", names: list[str], words: np.ndarray) -> None:
    """Paint cells without a value in the grey of their status."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    patches, (x, y) = [], (table.coords[name] for name in names)
    for word, grey in zip(filter(None, dict.fromkeys(words.ravel().tolist())), GREYS, strict=False):
        mask = np.where(words == word, 1.0, np.nan)
        drawing.pcolormesh(x, y, mask.T, shading="nearest", cmap=ListedColormap([grey]))
        patches.append(Patch(color=grey, label=word.replace("_", " ")))
    if patches := [*drawing.get_legend_handles_labels()[0], *patches]:
        # Below the label of the horizontal axis, where it covers no cell.
        place = {"loc": "upper left", "bbox_to_anchor": (0.0, 0.0), "borderaxespad": 4.2}
        drawing.legend(handles=patches, ncols=3, fontsize="small", **place)


def draw_portrait(table: "Table", x: str, y: str, ax: "Axes | None" = None) -> "FigureBase | Axes":
    """Draw one variable of a run's table against another, with a dot at the start.

    **Arguments:**

    - `table`: a `Table` over "time".
    - `x`, `y`: names of variables; for a component, such as "position.x".
    - `ax`: matplotlib axes to draw in, instead of a new figure.

    **Returns:** a matplotlib figure, or `ax`.

    **Raises:** `ValueError` for an unknown variable or component.
    """
    (x_values, x_label), (y_values, y_label) = column(table, "x", x), column(table, "y", y)
    drawing = coloured(new_figure(5.0, 4.5).add_subplot()) if ax is None else ax
    (line,) = drawing.plot(x_values, y_values, linewidth=1.0)
    drawing.plot(x_values[:1], y_values[:1], "o", color=line.get_color())
    drawing.set_xlabel(x_label)
    drawing.set_ylabel(y_label)
    low, high = sorted(float(np.nanmax(part) - np.nanmin(part)) for part in (x_values, y_values))
    # A path, seen from above.
    if {x, y} == {"position.x", "position.y"} or ({x, y} < {"x", "y", "z"} and high < EQUAL * low):
        drawing.set_aspect("equal", adjustable="datalim")
    return drawing.figure if ax is None else ax


def column(table: "Table", argument: str, name: object, vectors: bool = False) -> tuple[np.ndarray, str]:
    """A variable, or one of its components, with its label.

    **Arguments:** `argument`: name of the argument in a message; `vectors`: whether the message lists vectors, too.
    """
    if not isinstance(name, str):
        raise ValueError(f"{argument} = {shown(name)} must name a quantity, such as {next(iter(table.variables))!r}")
    variable, _, component = (name, "", "") if name in table.variables else name.partition(".")
    dims = table.inner.get(variable, ())
    if variable in table.variables and not component and not dims:
        return table[variable], table.label(variable)
    if variable in table.variables and len(dims) == 1 and component in table.coords[dims[0]]:
        place = int(np.flatnonzero(table.coords[dims[0]] == component)[0])
        name, bracket, unit = table.label(variable).rpartition(" [")
        return table[variable][:, place], f"{name}, {component}{bracket}{unit}" if bracket else f"{unit}, {component}"
    candidates = [variable_name for variable_name in table.variables if vectors or variable_name not in table.inner]
    candidates += [f"{owner}.{part}" for owner, dims in table.inner.items() for part in table.coords[dims[0]]]
    raise ValueError(f"{argument} = {name!r} must be one of {', '.join(candidates)}{likely(name, candidates)}")


# Plots of quantities of runs over time (needs matplotlib).

#: Relative range of values below which a panel draws them as constant.
LEAST_RANGE = 1e-3

#: Styles of the lines of a vector's components; marks of times are dotted.
STYLES = ("-", "--", "-.", ":")


def draw_series(
    tables: list["Table"], names: Sequence[str], labels: Sequence[str], marks: list[Marks], ax: "Axes | None" = None
) -> "Figure | Axes":
    """Draw quantities over time, with a panel for each quantity and a colour for each run.

    **Arguments:**

    - `tables`: for each run, a `Table` over "time".
    - `names`: names of variables, or of components, such as "position.x"; all components of a vector are drawn.
    - `labels`: names of the runs, for the legend; an empty label leaves a run out.
    - `marks`: for each run, the times that a dotted line marks, in the unit of the tables, and what they are.
    - `ax`: matplotlib axes to draw a single quantity in, instead of a new figure.

    **Returns:** a matplotlib figure, or `ax`.

    **Raises:** `ValueError` for an unknown name, and for several quantities in one `ax`.
    """
    if ax is not None and len(names) > 1:
        raise ValueError(f"ax takes one quantity, not {len(names)}: {', '.join(names)}")
    if ax is None:
        figure = new_figure(PANEL[0], 1.5 + PANEL[1] * len(names))
        panels = list(map(coloured, figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]))
    else:
        figure, panels = None, [ax]
    explained: set[str] = set()
    for panel, name in zip(panels, names, strict=True):
        for table, label, marked in zip(tables, labels, marks, strict=True):
            colour, dims = None, table.inner.get(name, ())
            if len(dims) == 1 and table[dims[0]].dtype.kind == "U":
                # All components of a vector.
                lines = [(str(part), table[name][:, k]) for k, part in enumerate(table[dims[0]])]
                quantity = table.label(name)
            else:
                values, quantity = column(table, "quantity", name, vectors=True)
                lines = [("", values)]
            for k, ((component, values), line_style) in enumerate(zip(lines, itertools.cycle(STYLES))):
                # Of several runs, colours and styles are explained apart, each once.
                text = ", ".join(filter(None, (label, component))) if len(tables) == 1 else "" if k else label
                style = {"color": colour, "linestyle": line_style} if k and len(tables) > 1 else {}
                # A line without a text stays out of the legend.
                (line,) = panel.plot(table["time"], values, linewidth=1.2, label=text or None, **style)
                colour = colour or line.get_color()
            for time, words in marked:
                panel.axvline(time, color=colour, linestyle=":", linewidth=1.2, label=words)
            parts = [quantity] if len(quantity) <= HEIGHT else quantity.rsplit(" [", 1)
            panel.set_ylabel("\n[".join(textwrap.fill(part, HEIGHT) for part in parts))
        for (component, _), style in zip(lines if len(tables) > 1 and lines[0][0] else (), itertools.cycle(STYLES)):
            panel.plot([], [], style, color="0.35", linewidth=1.2, label=component)
        panel.margins(x=0.0)
        # Draw values that are constant except for round-off as a constant.
        middle, least = np.mean(panel.get_ylim()), LEAST_RANGE * np.max(np.abs(panel.get_ylim()))
        if np.ptp(panel.get_ylim()) < least:
            panel.set_ylim(middle - least, middle + least)
        legend_above(panel, explained)
        explained.update(panel.get_legend_handles_labels()[1])
    panels[-1].set_xlabel(tables[0].label("time"))
    return figure or panels[0]


def legend_above(panel: "Axes", explained: Container[str] = ()) -> None:
    """Draw the legend of a panel, each text once, without what is explained, above it, where it covers no curve."""
    pairs = zip(*panel.get_legend_handles_labels(), strict=True)
    handles = {textwrap.fill(text, WIDTH): handle for handle, text in pairs if text not in explained}
    if texts := list(handles):
        columns = min(len(texts), max(1, WIDTH // (max(map(len, texts)) + 10)))
        panel.legend(
            handles.values(), texts, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, fontsize="small"
        )


# The picture of a fit: data and model, residuals, distributions and correlations.

#: Greatest number of drawn distributions, how far they are drawn in standard deviations of a normal one, and their bars.
MOST_DISTRIBUTIONS, DEVIATIONS, BARS = 6, 3.5, 30

#: With at most this many measurements without a time, their labels are drawn.
MOST_LABELS = 12

#: Room above and below the measured values, as a part of their range.
MARGIN = 0.08


class _Series(NamedTuple):
    """The measurements of one series, in the units of the picture.

    - `name`: their quantity with its unit, such as "1: theta [deg]", where the number is that of the data.
    - `has_time`: whether they are samples; `places`: their times [s], or else their numbers in the picture; `labels`.
    - `curve`: times and predictions, also between the samples, or `None`.
    - `rows`: the measurements, with the fields of a `ResidualRow`.
    """

    name: str
    colour: str
    has_time: bool
    places: np.ndarray
    labels: list[str]
    curve: tuple[np.ndarray, ...] | None
    rows: np.ndarray


def _series_of(fit: "Identification", labels: Sequence[str], unit: Unit) -> list[_Series]:
    """The measurements of a fit. **Arguments:** as for `draw_fit`."""
    measurements, (times_of_curves, curves) = fit.density.measurements, fit.curves
    numbers, times = np.asarray(measurements.series), np.asarray(measurements.time)
    rows, units, factors = zip(*fit.rows_in(unit), strict=True)
    rows, factors, all_series, without_time = np.rec.fromrecords(rows, names=rows[0]._fields), np.array(factors), [], 0
    # Draw an angle on the same turn as its prediction.
    turns = factors * np.asarray(measurements.whole_periods((rows["prediction"] - rows["value"]) / factors))
    turns[rows["upper"] > rows["value"]] = 0.0
    rows["value"] += turns
    rows["upper"] += turns
    for number in np.unique(numbers):
        indices = np.flatnonzero(numbers == number)
        quantity, has_name, _ = str(rows["label"][indices[0]]).partition("(")
        # A number in parentheses after a blank only tells equal launches apart.
        if not has_name or quantity.endswith(" "):
            quantity = "time" if units[indices[0]] in UNITS["s"] else "measured"
        places, curve = times[indices], None
        has_time = bool(np.any(places))
        if not has_time:
            places = without_time + np.arange(len(indices))
            without_time += len(indices)
        elif len(curves):
            curve = tuple(part[:, indices].T.ravel() for part in (times_of_curves, factors * curves))
        name, colour = with_unit(quantity, units[indices[0]]), css(COLOURS[len(all_series) % len(COLOURS)])
        texts = [labels[i] for i in indices.tolist()]
        all_series.append(_Series(name, colour, has_time, places, texts, curve, rows[indices]))
    return all_series


def draw_fit(fit: "Identification", labels: Sequence[str], unit: Unit) -> "Figure":
    """Draw a fit: measurements and predictions at the most likely values, with a panel for each quantity; residuals in standard
    errors; distributions of the determined parameters, with their estimates and intervals; and correlations. Samples over time
    and other measurements are side by side.

    **Arguments:** `labels`: (n,), short names of the measurements; `unit`: as for `in_unit`.

    **Returns:** a matplotlib figure.
    """
    names, panels_of_blocks = list(fit.estimates), {}
    for series in _series_of(fit, labels, unit):
        # Series of one quantity share a panel, whatever the number of the data.
        panels = panels_of_blocks.setdefault(series.has_time, {})
        panels.setdefault(series.name.rpartition(": ")[2], []).append(series)
    determined = [name for name in names if np.isfinite(fit.standard_errors[name])][:MOST_DISTRIBUTIONS]
    # The correlations of one number say nothing.
    correlated = len(names) > 1
    lower = len(determined) + correlated or 1
    most = max(map(len, panels_of_blocks.values()))
    figure = new_figure(max(9.0, 2.9 * lower, 6.5 * len(panels_of_blocks)), 6.5 + 2.0 * most)
    rows = figure.add_gridspec(2, 1, height_ratios=(1.0 + 2.0 * most, 1.6))
    columns = rows[0].subgridspec(1, len(panels_of_blocks))
    for column, has_time in enumerate(sorted(panels_of_blocks, reverse=True)):
        _draw_block(panels_of_blocks[has_time], figure, columns[column])
    grid = rows[1].subgridspec(1, lower)
    for k, name in enumerate(determined):
        _draw_distribution(fit, name, figure.add_subplot(grid[k]), unit)
    if correlated:
        axes, short = figure.add_subplot(grid[lower - 1]), list(short_names(names).values())
        image = axes.imshow(fit.correlation, vmin=-1.0, vmax=1.0, cmap="RdBu")
        axes.set_xticks(range(len(names)), short, rotation=90, fontsize=8)
        axes.set_yticks(range(len(names)), short, fontsize=8)
        axes.set_title("correlation", fontsize=9)
        figure.colorbar(image, ax=axes, shrink=0.8)
    draw_title(figure, str(fit.verdict))
    return figure


def _draw_block(panels: dict[str, list[_Series]], figure: "Figure", place: "SubplotSpec") -> None:
    """Draw series over their times, or over the numbers of their measurements: the data, in panels, and the residuals."""
    block, first = list(itertools.chain(*panels.values())), None
    grid = place.subgridspec(len(panels) + 1, 1, height_ratios=[2.0] * len(panels) + [1.0])
    for row, (name, series) in enumerate(panels.items()):
        axes = figure.add_subplot(grid[row], sharex=first)
        first = axes if first is None else first
        axes.tick_params(labelbottom=False)
        _draw_data(axes, series)
        axes.set_ylabel(name)
    residuals = figure.add_subplot(grid[len(panels)], sharex=first)
    for series in block:
        residuals.plot(series.places, series.rows["residual"], ".", color=series.colour)
    residuals.axhspan(-1.96, 1.96, color="0.9", zorder=0)
    residuals.set_ylabel("residual\n[standard errors]")
    labels = [label for series in block for label in series.labels]
    if block[0].has_time:
        residuals.set_xlabel("time since the first sample [s]")
    elif len(labels) <= MOST_LABELS:
        places = np.concatenate([series.places for series in block])
        residuals.set_xticks(places, labels, rotation=20, ha="right", fontsize=8)
    else:
        residuals.set_xlabel("measurement")


def _draw_data(axes: "Axes", panel: list[_Series]) -> None:
    """Draw the series of one panel with their predictions, as curves if they have times."""
    several = len(panel) > 1
    for series in panel:
        exact = series.rows["upper"] == series.rows["value"]
        places, rows = series.places[exact], series.rows[exact]
        text = series.name if several else "measured"
        axes.errorbar(places, rows["value"], rows["error"], fmt=".", color=series.colour, label=text)
        if series.curve is not None:
            text = None if several else "predicted"
            axes.plot(*series.curve, color="0.1", linewidth=2.0, zorder=3, label=text)
        else:
            text = "predicted" if series is panel[0] else None
            axes.plot(places, rows["prediction"], "x", color="0.3", label=text)
    places, rows = (np.concatenate([getattr(series, name) for series in panel]) for name in ("places", "rows"))
    is_limit = rows["upper"] > rows["value"]
    if not np.all(is_limit):
        # The measured values set the range, and the predictions as far as they are no farther than these.
        exact = rows[~is_limit]
        low, high = float(np.min(exact["value"] - exact["error"])), float(np.max(exact["value"] + exact["error"]))
        near = exact["prediction"][np.isfinite(exact["prediction"])]
        near = np.clip(near, low - 0.5 * (high - low), high + 0.5 * (high - low))
        low, high = min([low, *near]), max([high, *near])
        axes.set_ylim(low - MARGIN * (high - low), high + MARGIN * (high - low))
    _draw_limits(axes, places[is_limit], rows["value"][is_limit], rows["upper"][is_limit])
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


def _draw_distribution(fit: "Identification", name: str, axes: "Axes", unit: Unit) -> None:
    """The probability of the values of one parameter: of a linear model a normal distribution, otherwise that of the weighted
    points of the exploration."""
    shown, factor = in_unit(fit.units.get(name, "1"), unit or fit.density.unit)
    estimate, low, high = fit.rounded(name, factor)
    distribution = fit.distribution
    if distribution.kind == "weights":
        used = distribution.weights > 0.0
        values = fit.density.problem.unknowns.values(distribution.points[used])[:, list(fit.estimates).index(name)]
        edges = (factor * np.linspace(*fit.interval(name, DEVIATIONS), BARS + 1)).tolist()
        axes.hist(factor * np.asarray(values), edges, weights=distribution.weights[used], color="C0", alpha=0.7)
    else:
        # Normal in the coordinate of the fit, which may be a logarithm.
        deviations = np.linspace(0.0, DEVIATIONS, BARS)
        below, above = np.array([fit.interval(name, deviation) for deviation in deviations]).T
        heights = np.exp(-0.5 * deviations**2)
        axes.plot(factor * np.append(below[::-1], above), np.append(heights[::-1], heights), color="C0")
    axes.axvspan(*(factor * end for end in fit.interval(name)), color="0.92", zorder=0)
    axes.axvline(factor * fit.estimates[name], color="0.3", linewidth=1.0)
    axes.locator_params(axis="x", nbins=4)
    axes.set_ylim(0.0)
    axes.set_yticks([])
    axes.set_xlabel(with_unit(short_names(list(fit.estimates))[name], shown))
    axes.set_ylabel("probability")
    axes.set_title(f"{estimate} {readable_unit(shown)}".rstrip() + f"\n95 %: {low} to {high}", fontsize=9)
