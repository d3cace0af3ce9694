"""The quantities of a run over its times, as a table, and the methods that every run derives from this table."""

import abc
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

from ..progress import status_line
from ..text import likely, readable_unit, require_unit, shown, text_as_html
from ..validation import require_package
from ..views import draw_portrait, draw_series, require_others
from ._file import LONG_NAMES, table_path
from .layout import Values
from .table import Table
from .tasks import versions


class Quantity(NamedTuple):
    """A quantity of a run: its unit, a description, and the dimension of its components if it is a vector.

    `read` returns the values from a run; by default, they are the property with the name of the quantity. `needs` names
    what the quantity needs in addition to the state, in the terms of its model.

    **Example:**

    >>> from nonholonomic.sweeps import Quantity
    >>> Quantity("m", "height", read=lambda run: run["height"]).of("height", {"height": np.zeros(3)})
    array([0., 0., 0.])
    """

    unit: str
    long_name: str
    components: str | None = None
    read: Callable[[Any], Any] | None = None
    needs: frozenset[str] = frozenset()

    @property
    def label(self) -> str:
        """The description with the unit, for the axis of a plot."""
        return f"{self.long_name} [{readable_unit(self.unit) or '1'}]"

    def of(self, name: str, run: Any) -> Any:
        """The values of the quantity in a run."""
        return getattr(run, name) if self.read is None else self.read(run)


def chosen(quantities: dict[str, Quantity], names: Sequence[str]) -> dict[str, Quantity]:
    """The quantities that are named, alone or by a component, such as "position.x"; all of them if a name is unknown, or
    without names.

    **Example:**

    >>> from nonholonomic.sweeps import Quantity, chosen
    >>> list(chosen({"height": Quantity("m", "height"), "speed": Quantity("m s-1", "speed")}, ["speed"]))
    ['speed']
    """
    kept = {name.partition(".")[0] for name in names if isinstance(name, str)}
    if not names or not kept <= set(quantities):
        return quantities
    return {name: quantities[name] for name in quantities if name in kept}


def run_table(
    quantities: dict[str, Quantity],
    coords: dict[str, Values],
    values: dict[str, Values],
    axes: list[str],
    request: dict[str, Any],
) -> Table:
    """A table of quantities over time.

    **Arguments:**

    - `quantities`: name -> `Quantity`; `values`: name -> values.
    - `coords`: name -> values; the `axes` come first.
    - `request`: plain data that describes the run.

    **Returns:** the `Table`.

    **Example:**

    >>> from nonholonomic.sweeps import Quantity, run_table
    >>> times, heights = np.array([0.0, 0.1]), np.array([1.0, 0.95])
    >>> run_table({"height": Quantity("m", "height")}, {"time": times}, {"height": heights}, ["time"], {})
    Table over time (2)
      height [m]: 0.95 to 1
    """
    attributes = {
        "request": json.dumps(request, default=repr),
        "axes": json.dumps(axes),
        "versions": json.dumps(versions()),
        LONG_NAMES: json.dumps(
            {"time": "time"} | {name: quantity.long_name for name, quantity in quantities.items()}, sort_keys=True
        ),
    }
    units = {"time": "s"} | {name: quantity.unit for name, quantity in quantities.items()}
    inner = {name: (quantity.components,) for name, quantity in quantities.items() if quantity.components is not None}
    return Table(coords, values, units, attributes, inner=inner)


class Tabular(abc.ABC):
    """A run whose quantities over time are a table, which gives it `to_xarray`, `save` and `portrait`.

    **Example:**

    >>> from nonholonomic.sweeps import Table, Tabular
    >>> class Fall(Tabular):
    ...     portrait_axes = ("height", "speed")
    ...     def to_table(self):
    ...         return Table({"time": np.zeros(1)}, {"height": np.ones(1), "speed": np.zeros(1)}, {"time": "s"}, {})
    >>> Fall().to_xarray()["height"].dims
    ('time',)
    """

    #: The names that a message for an unknown attribute lists; empty for the ordinary message.
    readable: ClassVar[tuple[str, ...]] = ()

    #: The quantities that `run[name]` returns.
    quantities: ClassVar[Mapping[str, Quantity]] = MappingProxyType({})

    @property
    @abc.abstractmethod
    def portrait_axes(self) -> tuple[str, str]:
        """The variables that `portrait` draws by default."""

    @abc.abstractmethod
    def to_table(self) -> Table:
        """All quantities of the run, as a `Table` over its times.

        **Raises:** `ValueError` for a batch of runs.
        """

    def to_xarray(self) -> Any:
        """The run as an `xarray.Dataset` over "time" (needs xarray), with units and names.

        **Raises:** `ValueError` for a batch of runs.
        """
        require_package("xarray", "xarray", "to_xarray")
        return self.to_table().to_xarray()

    def save(self, path: Any) -> None:
        """Write the run to an HDF5 file that `Table.load` and xarray (`engine="h5netcdf"`) read.

        **Raises:** `OSError` that names the path if the file cannot be written; `ValueError` for a batch of runs.
        """
        file = table_path(path)
        self.to_table().save(file)

    def to_dataframe(self) -> Any:
        """The run as a `pandas.DataFrame` (needs pandas): a row for each time, a column for each quantity or component.

        **Raises:** `ValueError` for a batch of runs.
        """
        require_package("pandas", "pandas", "to_dataframe")
        return self.to_table().to_dataframe()

    def table_of(self, names: Sequence[str]) -> Table:
        """A table over the run's times with at least the named quantities, or with all if one of the names is unknown."""
        return self.to_table()

    def labels_of(self, runs: list[Any], unit: str | Sequence[str] | None) -> list[str]:
        """Labels that tell runs of this kind apart, in units as for `plot`; an empty one for a single run."""
        return [""] if len(runs) == 1 else [f"run {k + 1}" for k in range(len(runs))]

    def overview(self, runs: list[Any], labels: Sequence[str], unit: Any, ax: Any) -> Any:
        """Draw what is most important in this run and others; arguments as for `plot`."""
        names = [name for name, values in self.to_table().variables.items() if values.dtype.kind == "f"]
        return draw_series([run.to_table().drawn_in(unit, *names) for run in runs], names, labels, ax)

    @status_line("drawing")
    def plot(
        self,
        *quantities: Any,
        others: Sequence[Any] = (),
        unit: str | Sequence[str] | None = None,
        label: str | Sequence[str] | None = None,
        ax: Any = None,
    ) -> Any:
        """Draw quantities over time (needs matplotlib), with a panel for each quantity.

        **Arguments:**

        - `quantities`: variables of `to_table()`, such as "theta" or "position", or components, such as "position.x"; by
          default those that a page of the run shows, or all components of your own system.
        - `others`: other runs to draw in the same panels, a list.
        - `unit`: unit to draw in, such as "deg" for all angles, or several, such as ("deg", "ms").
        - `label`: text for the legend; with `others`, a list of one for each run. By default, labels name what differs.
        - `ax`: matplotlib axes to draw one quantity in, instead of a new figure.

        **Returns:** the matplotlib figure, or `ax`.

        **Raises:** `ValueError` for an unknown quantity or unit, and for a batch of runs.
        """
        require_package("matplotlib", "plot", "plot")
        require_unit(unit)
        if len(quantities) == 1 and not isinstance(quantities[0], str):
            # A list of names; or, as in earlier versions, a list of runs, or axes.
            (first,) = quantities
            if isinstance(first, list | tuple) and first and all(isinstance(name, str) for name in first):
                quantities = tuple(first)
            elif hasattr(first, "set_xlabel"):
                quantities, ax = (), first
            else:
                quantities, others = (), first
        runs = [self, *require_others(self, others, "to_table")]
        labels = self.labels_of(runs, unit) if label is None else [label] if isinstance(label, str) else label
        if not isinstance(labels, list | tuple) or [type(text) for text in labels] != [str] * len(runs):
            raise ValueError(f"label = {shown(label)} must have {len(runs)} texts, one for each run")
        if not quantities:
            return self.overview(runs, labels, unit, ax)
        return draw_series(
            [run.table_of(quantities).drawn_in(unit, *quantities) for run in runs], quantities, labels, ax
        )

    def portrait(self, x: str | None = None, y: str | None = None, ax: Any = None, unit: Any = None) -> Any:
        """Draw one quantity against another, a phase portrait (needs matplotlib).

        **Arguments:**

        - `x`, `y`: variables of `to_table()`, such as "theta" or "steering", or one component, such as "position.x". By
          default `portrait` draws theta and its rate, the steering angle and the yaw rate, or the first and the last
          component of your own system.
        - `ax`: matplotlib axes to draw in, instead of a new figure.
        - `unit`: unit to draw in, such as "deg" for all angles.

        **Returns:** the matplotlib figure, or `ax`.

        **Raises:** `ValueError` for an unknown variable or unit.
        """
        require_package("matplotlib", "plot", "portrait")
        require_unit(unit)
        x, y = x or self.portrait_axes[0], y or self.portrait_axes[1]
        return draw_portrait(self.table_of((x, y)).drawn_in(unit, x, y), x, y, ax)

    def __getitem__(self, name: str) -> Any:
        """A quantity by its name, also inside transformations.

        **Raises:** `KeyError` for an unknown quantity.
        """
        if name not in self.quantities:
            raise KeyError(f"{name!r} must be one of {', '.join(self.quantities)}{likely(name, self.quantities)}")
        return self.quantities[name].of(name, self)

    def __iter__(self) -> Iterator[str]:
        """The names of the quantities."""
        return iter(self.quantities)

    def __getattr__(self, name: str) -> Any:
        # Python calls this for unknown names, and for known names whose property raised an AttributeError, which is
        # raised again here.
        if name.startswith("_") or hasattr(type(self), name) or not self.readable:
            return object.__getattribute__(self, name)
        methods = [method for method in dir(type(self)) if not method.startswith("_")]
        hint = "; did you mean 't'?" if name in ("time", "times") else likely(name, [*self.readable, *methods]) or "."
        raise AttributeError(f"the run has no {name!r}{hint} It has {', '.join(['t', *self.readable])}")

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return text_as_html(str(self))
