"""Pictures of tables (needs matplotlib)."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ..sweeps import Table

#: Colours of the cells of a map that have no finite value, one for each word of their status.
GREYS = ("0.85", "0.7", "0.55", "0.4", "0.25")


def draw_table(table: "Table", variable: str = "time") -> Any:
    """Draw a variable over the grid of a table: lines over the first axis, or a map of the first two.

    Cells without a finite value are left out of lines and marked by their status in maps. With three axes or more, the
    first value of the others is drawn.

    **Arguments:**

    - `table`: a `Table` with at least one axis.
    - `variable`: name of a numeric variable.

    **Returns:** a matplotlib figure.

    **Raises:** `ValueError` for a table without axes or for a variable that is not numeric.
    """
    from matplotlib.figure import Figure

    values = table.variables.get(variable)
    if values is None or values.dtype.kind == "U":
        raise ValueError(f"variable = {variable!r} must be a numeric variable of the table")
    dims = table.dims(variable)
    if not dims:
        raise ValueError("a table of one cell has nothing to draw")
    # What runs along a dimension of its own, such as time, is drawn over that.
    cells = len(table.shape)
    names = [*dims[cells:], *dims[:cells]]
    values = np.moveaxis(values, range(cells), range(-cells, 0))
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    drawing = figure.add_subplot()
    label = f"{variable} [{table.units.get(variable, '1')}]"
    drawing.set_xlabel(f"{names[0]} [{table.units.get(names[0], '1')}]")
    shown = np.where(np.isfinite(values), values, np.nan)
    if len(names) == 1 or len(table.coords[names[1]]) <= 8:
        _draw_lines(drawing, table, names, shown)
        drawing.set_ylabel(label)
        return figure
    first = (slice(None), slice(None), *([0] * (len(names) - 2)))
    drawing.set_ylabel(f"{names[1]} [{table.units.get(names[1], '1')}]")
    image = drawing.pcolormesh(table.coords[names[0]], table.coords[names[1]], shown[first].T, shading="nearest")
    figure.colorbar(image, label=label)
    if "status" in table.variables and len(dims) == cells:
        words = np.where(np.isnan(shown[first]), table.variables["status"][first], "")
        _mark_words(drawing, table, names, words)
    return figure


def _draw_lines(drawing: Any, table: "Table", names: list[str], shown: Any) -> None:
    lines = shown.reshape(shown.shape[0], shown.shape[1] if shown.ndim > 1 else 1, -1)[:, :, 0]
    for column, line in enumerate(lines.T):
        label = f"{names[1]} = {table.coords[names[1]][column]:.4g}" if len(names) > 1 else None
        drawing.plot(table.coords[names[0]], line, "o-", markersize=3, label=label)
    if len(names) > 1:
        drawing.legend()


def _mark_words(drawing: Any, table: "Table", names: list[str], words: Any) -> None:
    """Paint the cells that have a word in the grey of that word."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    patches = []
    for word, grey in zip(filter(None, dict.fromkeys(words.ravel().tolist())), GREYS, strict=False):
        mask = np.where(words == word, 1.0, np.nan)
        drawing.pcolormesh(
            table.coords[names[0]], table.coords[names[1]], mask.T, shading="nearest", cmap=ListedColormap([grey])
        )
        patches.append(Patch(color=grey, label=word))
    if patches:
        drawing.legend(handles=patches, loc="upper right")
