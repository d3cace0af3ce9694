"""The quantities of a run over its times, as a table, and the methods that every run derives from this table."""

import abc
import json
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

from ..parameters import likely, readable_unit, text_as_html
from ..validation import require_package
from ..views import draw_portrait
from .layout import Values
from .table import Table
from .tasks import versions


class Quantity(NamedTuple):
    """A quantity of a run: its unit, a description, and the dimension of its components if it is a vector.

    `read` returns the values from a run; by default, they are the property with the name of the quantity.

    **Example:**

    >>> from nonholonomic.sweeps import Quantity
    >>> Quantity("m", "height", read=lambda run: run["height"]).of("height", {"height": np.zeros(3)})
    array([0., 0., 0.])
    """

    unit: str
    long_name: str
    components: str | None = None
    read: Callable[[Any], Any] | None = None

    @property
    def label(self) -> str:
        """The description with the unit, for the axis of a plot."""
        return f"{self.long_name} [{readable_unit(self.unit) or '1'}]"

    def of(self, name: str, run: Any) -> Any:
        """The values of the quantity in a run."""
        return getattr(run, name) if self.read is None else self.read(run)


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
        "long_names": json.dumps(
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
        self.to_table().save(path)

    def portrait(self, x: str | None = None, y: str | None = None, ax: Any = None) -> Any:
        """Draw one quantity against another, a phase portrait (needs matplotlib).

        **Arguments:**

        - `x`, `y`: variables of `to_table()`, such as "theta" or "steering", or one component, such as "position.x". By
          default `portrait` draws theta and its rate, the steering angle and the yaw rate, or the first and the last
          component of your own system.
        - `ax`: matplotlib axes to draw in, instead of a new figure.

        **Returns:** the matplotlib figure, or `ax`.

        **Raises:** `ValueError` for an unknown variable.
        """
        require_package("matplotlib", "plot", "portrait")
        x_name, y_name = self.portrait_axes
        return draw_portrait(self.to_table(), x_name if x is None else x, y_name if y is None else y, ax)

    def __getattr__(self, name: str) -> Any:
        # Python calls this for unknown names, and for known names whose property raised an AttributeError, which is
        # raised again here.
        if name.startswith("_") or hasattr(type(self), name) or not self.readable:
            return object.__getattribute__(self, name)
        raise AttributeError(f"the run has no {name!r}{likely(name, self.readable)} It has {', '.join(self.readable)}")

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return text_as_html(str(self))
