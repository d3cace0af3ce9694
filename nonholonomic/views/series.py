"""Plots of quantities of runs over time (needs matplotlib)."""

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .plot import column, new_figure

# Only for type checkers: plots stand below tables and fits, which use them.
if TYPE_CHECKING:
    from ..sweeps import Table

#: Styles of the lines of a vector's components, and size of a panel [inches].
STYLES = ("-", "--", ":", "-.")
PANEL = (7.0, 2.0)


def draw_series(tables: Sequence["Table"], names: Sequence[str], labels: Sequence[str], ax: Any = None) -> Any:
    """Draw quantities over time, with a panel for each quantity and a colour for each run.

    **Arguments:**

    - `tables`: for each run, a `Table` over "time".
    - `names`: names of variables, or of components, such as "position.x"; all components of a vector are drawn.
    - `labels`: names of the runs, for the legend; an empty label leaves a run out.
    - `ax`: matplotlib axes to draw a single quantity in, instead of a new figure.

    **Returns:** a matplotlib figure, or `ax`.

    **Raises:** `ValueError` for an unknown name, and for several quantities in one `ax`.
    """
    if ax is not None and len(names) > 1:
        raise ValueError(f"ax takes one quantity, not {len(names)}: {', '.join(names)}")
    figure = None
    if ax is None:
        figure = new_figure(PANEL[0], 1.5 + PANEL[1] * len(names))
        panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    else:
        panels = [ax]
    for panel, name in zip(panels, names, strict=True):
        _draw_panel(panel, tables, name, labels)
    panels[-1].set_xlabel(tables[0].label("time"))
    return ax if figure is None else figure


def _draw_panel(panel: Any, tables: Sequence["Table"], name: str, labels: Sequence[str]) -> None:
    for table, label in zip(tables, labels, strict=True):
        lines, quantity = _lines(table, name)
        colour = None
        for (component, values), style in zip(lines, itertools.cycle(STYLES)):
            text = ", ".join(part for part in (label, component) if part)
            # A line without a text stays out of the legend.
            (line,) = panel.plot(table["time"], values, style, linewidth=1.2, color=colour, label=text or None)
            colour = line.get_color()
        panel.set_ylabel(quantity)
    panel.margins(x=0.0)
    if panel.get_legend_handles_labels()[0]:
        panel.legend(fontsize="small")


def _lines(table: "Table", name: str) -> tuple[list[tuple[str, Any]], str]:
    """The components of a quantity with their values, and the label of the quantity."""
    dims = table.inner.get(name, ())
    if len(dims) == 1 and table[dims[0]].dtype.kind == "U":
        return [(str(part), table[name][:, k]) for k, part in enumerate(table[dims[0]])], table.label(name)
    values, label = column(table, "quantity", name, vectors=True)
    return [("", values)], label
