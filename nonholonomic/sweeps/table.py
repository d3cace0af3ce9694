"""A labelled result over a grid, and its file."""

import abc
import dataclasses
import json
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from ..integration.problem import TIGHTEST, TIGHTEST_IN_SINGLE
from ..terminal import status_line
from ..text import as_html, in_unit, likely, readable_unit, require_unit, require_unit_of, shown, text_as_html, unit_of
from ..validation import as_path, replacing, require_package
from ..views.pages import Viewable, require_labels, require_others
from ..views.plot import draw_portrait, draw_series, draw_table, draw_title
from ._store import Stored, contents_of, table_path, write_file
from .grid import FOR_A_TIME, PENDING, REMARK, SHOWN_IN, UNREACHED, Layout, Tabulated, Values, attributes_of, axes_of

if TYPE_CHECKING:
    import pandas
    import xarray

#: Number of cells per checksum in the file of a saved table.
CHUNK = 1 << 15


class Table(eqx.Module):
    """Variables over a grid of named coordinates. Get a variable by `table["time"]` or `table.time`.

    **Arguments:**

    - `coords`: name -> values, one for each axis of the grid, in order, followed by the additional dimensions of some
      variables, such as "time".
    - `variables`: name -> array over the grid; `status` is an array of words. If the file of a table has more than 128
      MB, the variables stay in the file: each is read, and its checksums are checked, when needed.
    - `units`: name of a coordinate or variable -> its unit.
    - `attributes`: the request and the versions, as plain data.
    - `words`: variable of words -> the words, in the order of their codes in a file.
    - `inner`: variable -> the names of its additional dimensions, which follow those of the grid.
    - `long_names`: name of a coordinate or variable -> its long name.

    **Example:**

    ```
    >>> import numpy as np
    >>> import tippe
    >>> speed = np.array([1.0, 2.0, 3.0])
    >>> table = tippe.Table({"speed": speed}, {"energy": 0.5 * speed**2}, {"speed": "m s-1", "energy": "J"}, {})
    >>> print(table)
    Table over speed (3)
      energy [J]: 0.5 to 4.5
    >>> table["energy"], table.label("speed"), "mass" in table
    (array([0.5, 2. , 4.5]), 'speed [m/s]', False)

    ```
    """

    coords: dict[str, Values]
    variables: Mapping[str, Tabulated]
    units: dict[str, str]
    attributes: dict[str, Any]
    words: dict[str, tuple[str, ...]] = eqx.field(default_factory=dict)
    inner: dict[str, tuple[str, ...]] = eqx.field(default_factory=dict)
    long_names: dict[str, str] = eqx.field(default_factory=dict)

    def __getattr__(self, name: str) -> Tabulated:
        # Python calls this only for names that are not fields.
        variables, coords = (object.__getattribute__(self, part) for part in ("variables", "coords"))
        for names in (variables, coords):
            if name in names:
                return names[name]
        raise AttributeError(f"the table has no {name!r}; it has {', '.join([*variables, *coords])}")

    def __getitem__(self, name: str) -> Tabulated:
        if not isinstance(name, str):
            names = ", ".join(self)
            raise ValueError(f"table[{name!r}]: {name!r} must be the name of a variable or an axis: {names}")
        if name not in list(self):
            raise KeyError(f"the table has no {name!r}; it has {', '.join(self)}")
        return (self.variables if name in self.variables else self.coords)[name]

    def __iter__(self) -> Iterator[str]:
        """The names of the variables, and then of the coordinates."""
        return iter([*self.variables, *self.coords])

    def _ipython_key_completions_(self) -> list[str]:
        return list(self)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self]

    @property
    def unit(self) -> tuple[str, ...]:
        """The units in which texts and pictures show the numbers: those of the launch, if it was stated in others."""
        return tuple(json.loads(self.attributes.get(SHOWN_IN, "[]")))

    @property
    def for_a_time(self) -> tuple[str, Values]:
        """The words for cells whose event happened and does not hold at the end, and whether each cell is one; only a table of
        both crossings tells."""
        words = json.loads(self.attributes.get(FOR_A_TIME, "[]"))
        if not words or not {"first_time", "status"} <= set(self.variables):
            return "", np.zeros(self.shape, bool)
        happened = np.isfinite(self.variables["first_time"])
        return f"{words[0]} for a time", happened & (self.variables["status"] == words[1])

    def label(self, name: str) -> str:
        """The label of a coordinate or variable for plots: its long name with its unit, "inversion time [s]"."""
        unit = readable_unit(self.units.get(name, "1"))
        return self.long_names.get(name, name) + (f" [{unit}]" if unit else "")

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid."""
        return tuple(len(self.coords[name]) for name in axes_of(self.coords, self.inner))

    def dims(self, variable: str) -> tuple[str, ...]:
        """The names of a variable's dimensions: the axes of the grid, and its additional dimensions."""
        return (*axes_of(self.coords, self.inner), *self.inner.get(variable, ()))

    def to_xarray(self, chunks: Any = None) -> "xarray.Dataset":
        """The table as an `xarray.Dataset` (needs xarray), with named dimensions, units, and statuses as words.

        **Arguments:** `chunks`: to read the numbers piece by piece when they are needed, the size of the pieces along
        each dimension, such as `{"theta": 100}`, or "auto". This needs dask; for a table that stays in its file, it
        also needs h5netcdf, and does not check the checksums.

        **Returns:** the dataset, with the same contents as the file of `Table.save` or a sweep.

        **Raises:** `ModuleNotFoundError`, with the command that installs it, for a missing package.
        """
        require_package("xarray", "xarray", "to_xarray")
        if chunks is not None:
            require_package("dask", "xarray", "to_xarray with chunks")
        import xarray

        if chunks is not None and isinstance(self.variables, Stored):
            dataset = xarray.open_dataset(self.variables.path, engine="h5netcdf", chunks=chunks)
            for name, words in self.words.items():
                meanings = np.array([*words, UNREACHED])
                dataset[name] = dataset[name].copy(
                    data=dataset[name].data.map_blocks(meanings.__getitem__, dtype=meanings.dtype)
                )
            return dataset

        variables, coords = {}, {}
        for name in self:
            dims = self.dims(name) if name in self.variables else (name,)
            described = {"long_name": self.long_names.get(name), "units": self.units.get(name)}
            described = {key: text for key, text in described.items() if text is not None}
            (variables if name in self.variables else coords)[name] = (dims, self[name], described)
        dataset = xarray.Dataset(variables, coords, self.attributes)
        return dataset if chunks is None else dataset.chunk(chunks)

    def to_dataframe(self, unit: str | Sequence[str] | None = None) -> "pandas.DataFrame":
        """The table as a `pandas.DataFrame` (needs pandas): one row per cell, one column per axis and variable.

        If variables have additional dimensions, such as "time", there is a row for each point along these dimensions,
        and the other variables are repeated. Each component of a vector is a column, such as "position.x".
        `attrs["units"]` contains the units.

        **Arguments:** `unit`: as for `plot`, such as ("deg", "rpm"); by default those of the launch, SI units for a plain
        `Launch`. Columns in other units have them in their names, such as "theta [deg]", as `read_recording` expects.

        **Raises:** `ModuleNotFoundError`, with the command that installs it, if pandas is missing; `ValueError` for an unknown
        unit.

        **Example:**

        ```
        >>> import numpy as np
        >>> import tippe
        >>> table = tippe.Table({"speed": np.array([1.0, 2.0])}, {"energy": np.array([0.5, 2.0])}, {"speed": "m s-1"}, {})
        >>> print(table.to_dataframe())
           speed  energy
        0    1.0     0.5
        1    2.0     2.0

        ```
        """
        require_package("pandas", "pandas", "to_dataframe")
        import pandas

        require_unit(unit)
        table = self.drawn_in(unit := unit or self.unit, *self.variables)
        inner = dict.fromkeys(dim for dims in self.inner.values() for dim in dims)
        component_dims = {dim for dim in inner if np.asarray(self.coords[dim]).dtype.kind == "U"}
        dims = [*axes_of(self.coords, self.inner), *(dim for dim in inner if dim not in component_dims)]
        shape = tuple(len(self.coords[dim]) for dim in dims)

        def column(values: Values, own_dims: tuple[str, ...]) -> Values:
            # The variable's dimensions are in the order of the table's.
            expanded = np.expand_dims(values, [k for k, dim in enumerate(dims) if dim not in own_dims])
            return np.broadcast_to(expanded, shape).reshape(-1)

        columns, units = {dim: column(table.coords[dim], (dim,)) for dim in dims}, dict(table.units)
        for name, whole in table.variables.items():
            own_dims = self.dims(name)
            components = [dim for dim in own_dims if dim in component_dims]
            for index in np.ndindex(*(len(self.coords[dim]) for dim in components)):
                place = dict(zip(components, index, strict=True))
                column_name = ".".join([name, *(str(self.coords[dim][k]) for dim, k in place.items())])
                values = whole[tuple(place.get(dim, slice(None)) for dim in own_dims)]
                columns[column_name] = column(values, tuple(dim for dim in own_dims if dim not in place))
                if name in units:
                    units[column_name] = units[name]
        frame = pandas.DataFrame(columns)
        frame.attrs["units"] = {name: units[name] for name in columns if name in units}
        if unit:
            frame.columns = [f"{name} [{units[name]}]" if units.get(name, "1") != "1" else name for name in columns]
        return frame

    def save(self, path: object) -> None:
        """Write the table to an HDF5 file that `xarray.open_dataset(path, engine="h5netcdf")` opens.

        **Raises:** `OSError` that names the path if the file cannot be written; `ValueError` for the ending of another
        format, such as .csv.
        """
        file = table_path(path)
        if isinstance(self.variables, Stored):
            with replacing(file) as scratch:
                shutil.copyfile(self.variables.path, scratch)
            return
        words, arrays = {}, {}
        for name, values in self.variables.items():
            arrays[name] = np.asarray(values)
            if arrays[name].dtype.kind == "U":
                # Words that are not listed follow those that are.
                used = dict.fromkeys([*self.words.get(name, ()), *arrays[name].ravel().tolist()])
                words[name] = tuple(word for word in used if word != UNREACHED)
                codes = {word: code for code, word in enumerate(words[name])} | {UNREACHED: PENDING}
                arrays[name] = np.vectorize(codes.__getitem__, otypes=[np.int8])(arrays[name])
        kinds = {name: values.dtype for name, values in arrays.items()}
        layout = Layout(self.coords, kinds, self.units, self.attributes, words, self.inner, CHUNK, self.long_names)
        flat = {name: values.reshape(-1, *layout.inner_shape(name)) for name, values in arrays.items()}
        ends = enumerate(map(layout.ends, range(layout.chunks)))
        cut = ((chunk, {name: values[first:end] for name, values in flat.items()}) for chunk, (first, end) in ends)
        write_file(file, layout, cut)

    @classmethod
    def load(cls, path: object) -> "Table":
        """Read a table from a file that `save` or a sweep wrote. You can read the file before the sweep has finished;
        cells that are not computed yet have the status `pending`.

        **Raises:** `OSError` that names the path if the file cannot be read or contains no table.
        """
        return cls.laid_out(*contents_of(as_path(path, "path")))

    @classmethod
    def laid_out(cls, layout: Layout, variables: Mapping[str, Tabulated]) -> "Table":
        """A table with a layout."""
        fields = layout.units, layout.attributes, layout.words, layout.inner, layout.long_names
        return cls(layout.coords, variables, *fields)

    def digits(self, variable: str = "time") -> Values:
        """A variable with its correct digits: "5.01142(3)" is 5.01142 with an error of 0.00003.

        **Arguments:** `variable`: name of a numeric variable whose error is also in the table, such as "time" with
        "time_error".

        **Returns:** an array of strings over the grid. For a cell without a number, the string is the cell's status,
        with a question mark if it is in doubt.

        **Raises:** `ValueError` if the table does not contain the variable and its error.
        """
        for name in (variable, f"{variable}_error"):
            if name not in self.variables:
                raise ValueError(
                    f"variable = {shown(variable)}: the table has no {name!r}; it has {', '.join(self.variables)}"
                )
        values, errors = self.variables[variable], self.variables[f"{variable}_error"]
        return np.vectorize(concise, otypes="U")(values, errors, self.variables.get("status", values))

    def plot(
        self,
        variable: str | None = None,
        *,
        at: dict[str, float] | None = None,
        log: bool = False,
        ax: Any = None,
        x: str | None = None,
        y: str | None = None,
        label: str | None = None,
        unit: str | Sequence[str] | None = None,
    ) -> Any:
        """Draw a variable over the grid (needs matplotlib): lines over the first axis, a map of the first two, or all crossings
        as points.

        For other axes, the plot uses the first value, or the value in `at`, and states the value in the title. The
        colours of a map range from the 2 % to the 98 % quantile.

        **Arguments:**

        - `variable`: name of a numeric variable, the first by default.
        - `at`: name of an axis -> its value in the plot, in the unit of the table. The plot uses the nearest value of
          the grid, and states where this is another one.
        - `log`: whether the variable's scale is logarithmic.
        - `ax`: axes of matplotlib to draw in, instead of a new figure.
        - `x`: name of the axis along the abscissa; `y`: name of the axis along the ordinate of a map.
        - `label`: text for the legend of lines, or above a map.
        - `unit`: unit to draw in, such as "deg" for all angles, or several, such as ("deg", "ms").

        **Returns:** the matplotlib figure, or `ax`.

        **Raises:** `ValueError` for a variable that is not numeric, an unknown axis, a value beyond its axis, an unknown
        unit, or a table of one cell.
        """
        require_package("matplotlib", "plot", "plot")
        if not isinstance(at, dict | None):
            raise ValueError(f"at = {shown(at)} must be a dictionary, name of an axis -> its value")
        require_unit(unit)
        if unit := unit or self.unit:
            at = {name: value * in_unit(self.units.get(name, "1"), unit)[1] for name, value in (at or {}).items()}
        return draw_table(self.drawn_in(unit, variable), variable, at, log, ax, x, y, label)

    def drawn_in(self, unit: str | Sequence[str] | None, *names: str | None) -> "Table":
        """The coordinates, the status and some variables in other units, for a plot.

        **Arguments:** `unit`: as for `plot`, checked; `names`: the variables, or `None` for the first.
        """
        # A component is named by its vector, but names may contain a dot.
        columns = [next(iter(self.variables)) if name is None else str(name) for name in names]
        chosen = [name if name in self.variables else name.partition(".")[0] for name in columns]
        if not unit or not all(name in self.variables for name in chosen):
            return self
        kept = [*dict.fromkeys(chosen), *self.coords]
        if unit != self.unit:
            require_unit_of(unit, {name: self.units.get(name, "1") for name in kept})
        units = {name: in_unit(si, unit) for name, si in self.units.items()}

        def converted(values: Mapping[str, Values], names: Sequence[str]) -> dict[str, Values]:
            factors = {name: units.get(name, ("", 1.0))[1] for name in names if name in values}
            return {name: values[name] if factor == 1.0 else values[name] * factor for name, factor in factors.items()}

        return dataclasses.replace(
            self,
            coords=converted(self.coords, list(self.coords)),
            variables=converted(self.variables, [*chosen, "status", "first_time"]),
            units={name: text for name, (text, _) in units.items()},
        )

    @property
    def _summaries(self) -> tuple[str, list[tuple[str, str, str]]]:
        """The axes; and a summary of each variable: its name with its dimensions, its range, and its long name."""
        axes = ", ".join(f"{name} ({len(self.coords[name])})" for name in axes_of(self.coords, self.inner))
        title = f"Table over {axes or 'one cell'}"
        if 0 in self.shape:
            return title, []
        if isinstance(self.variables, Stored):
            place = f"in {self.variables.path}"
            return title, [(name, place, self.long_names.get(name, "")) for name in self.variables]
        # Cells that have not been computed appear only in the status.
        computed = self.variables["status"] != UNREACHED if "status" in self.variables else ...
        rows, shown_table = [], self.drawn_in(self.unit, *self.variables)
        for name, values in shown_table.variables.items():
            unit = readable_unit(shown_table.units.get(name, "1"))
            dims = "".join(f" x {dim} ({len(self.coords[dim])})" for dim in self.inner.get(name, ()))
            summary = _summary(values if name == "status" else values[computed])
            if name == "status":
                (words, cells), remark = self.for_a_time, json.loads(self.attributes.get(REMARK, '""'))
                summary += f", of which {np.sum(cells)} {words}" if np.any(cells) else ""
                summary += f" ({remark})" if remark else ""
            rows.append((f"{name}{f' [{unit}]' if unit else ''}{dims}", summary, self.long_names.get(name, "")))
        return title, rows

    def __repr__(self) -> str:
        title, rows = self._summaries
        return "\n".join([title, *(f"  {name}: {summary}" for name, summary, _ in rows)])

    def _repr_html_(self) -> str:
        shown_table = dataclasses.replace(self, variables={}).drawn_in(self.unit)
        axes = [(name, _summary(values), shown_table.label(name)) for name, values in shown_table.coords.items()]
        title, rows = self._summaries
        return as_html(title, [*axes, *rows])


def _summary(values: Values) -> str:
    """A summary of a variable: the count of each word, or its range."""
    if values.dtype.kind == "U":
        words, counts = np.unique(values, return_counts=True)
        return ", ".join(f"{count} {word}" for word, count in zip(words, counts, strict=True))
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return "none finite"
    missing = values.size - finite.size
    return f"{finite.min():.6g} to {finite.max():.6g}" + (f", {missing} not finite" if missing else "")


def cells_with(table: Table, name: str, word: str) -> Int[np.ndarray, " cells"]:
    """The indices of the cells in which a variable of words has this word. A table in a file is read as codes, which need
    a byte for each cell."""
    words, variables = table.words.get(name, ()), table.variables
    if word not in words:
        return np.zeros(0, int)
    if isinstance(variables, Stored):
        return np.flatnonzero(variables.whole(name) == words.index(word))
    return np.flatnonzero(np.ravel(variables[name]) == word)


# Numbers with their correct digits in concise notation: 5.01142(3) is 5.01142 with an error of 0.00003.


def concise(value: float, error: float, word: object = "") -> str:
    """A number with its correct digits and, in parentheses, the error of the last digit, rounded up; a word without a number.

    **Arguments:**

    - `value`: the number; not finite if there is none.
    - `error`: at least 0; with an error of 0, the number is written in full; infinite if it is doubtful whether there is a
      number.
    - `word`: the word for a missing number, which gets a question mark if it is doubtful that the number is missing.
    """
    if np.isinf(error) or not np.isfinite(value):
        return f"{word}?" if np.isinf(error) else str(word)
    if error == 0.0:
        return repr(float(value))
    place = math.floor(math.log10(error))
    # The quotient may exceed a whole number because of rounding.
    digit = math.ceil(error / 10.0**place * (1.0 - 1e-12))
    if digit == 10:
        place, digit = place + 1, 1
    return f"{round(value, -place):.0f}({digit * 10**place})" if place > 0 else f"{value:.{-place}f}({digit})"


# Error bounds for a table, from two more runs of each cell at smaller tolerances.

#: Ratio of the tolerance of each run to that of the next. With a pair of eighth order, the second run costs 1.8 times as
#: much as the first, and the third 3.2 times. The error of the second run is mostly a hundredth of that of the first, so the
#: difference of the two is the error of the first. Where both errors happen to be alike, or where functions of events and
#: not the tolerance limit the steps, the third run differs from both. With two runs, 0.05 to 8 % of the bounds of the systems
#: in `tests/nonholonomic/runs/test_error_bounds.py` fail, with the errors of the location of events.
FINER = 100.0

#: Ratio of the bound to the largest difference of the runs. With a ratio of 3, twice as many errors exceed the bound.
SAFETY = 5.0

#: The ratio if the runs do not converge: they differ in the number of events, or the second and third run by more than
#: `CONVERGING` times what the first differs from them. Differences of chaotic runs are those of random histories, and up to
#: 90 times smaller than the error.
SAFETY_OF_HISTORIES, CONVERGING = 100.0, 1.0 / 3.0

#: Relative change of the initial states of the other runs, times their number. Impacts can amplify round-off, of which there is
#: as much in each run, by a factor of 10^7; where the tolerance does not limit the steps, the runs would share it.
NUDGE = 4.0 * float(np.finfo(float).eps)

#: Relative errors: of values that accumulate round-off over thousands of steps; of the ends of runs with events, which are
#: located with it whatever the tolerance; and of differences between runs that are not from the tolerance.
ROUND_OFF, LOCATED, NOISE = 1e-14, 4e-10, 1e-9


def other_tolerances(tolerance: float) -> list[float]:
    """Tolerances of the other runs: each a hundredth of the one before, as far as the integration allows. If it allows no
    smaller tolerance than the first, there is one other run, at a hundred times that tolerance, and the bound is up to a
    hundred times wider."""
    tightest = TIGHTEST if jnp.result_type(float) == jnp.float64 else TIGHTEST_IN_SINGLE
    # Because of rounding, the quotient of 1e-12 may be below the least tolerance.
    if tolerance / FINER <= 0.99 * tightest:
        return [tolerance * FINER]
    second, third = (max(tolerance / FINER**power, tightest) for power in (1, 2))
    return [second, third] if third < 0.2 * second else [second]


def error_bound(
    values: Float[np.ndarray, "runs cells"], agree: Bool[np.ndarray, " cells"], same_history: Bool[np.ndarray, " cells"]
) -> Float[np.ndarray, " cells"]:
    """A bound of the error of a number. `docs/validation.md` lists how often the bound fails and how wide it is.

    **Arguments:**

    - `values`: times [s], infinite if there is no event, or other numbers; from the first run and the others, of which
      there are one or two.
    - `agree`: mask of the cells in which all runs have the same status.
    - `same_history`: mask of the cells in which the numbers of all kinds of events agree.

    **Returns:** the bound, in units of the value: infinite if the runs disagree, 0 if none finds a time.
    """
    is_finite = np.isfinite(values)
    agree = agree & (is_finite == is_finite[0]).all(axis=0)
    first, second, third = np.where(is_finite.all(axis=0), values, 0.0)[[0, 1, -1]]
    gaps = np.abs([first - second, first - third, second - third])
    converges = same_history & (gaps[2] <= np.maximum(CONVERGING * np.min(gaps[:2], axis=0), NOISE * np.abs(first)))
    bound = np.where(converges, SAFETY, SAFETY_OF_HISTORIES) * np.max(gaps, axis=0)
    return np.where(agree, np.maximum(bound, ROUND_OFF * np.abs(first)), np.inf)


def errors_of(
    runs: Sequence[dict[str, Num[np.ndarray, " cells"]]],
    least: Mapping[str, float | Float[np.ndarray, " cells"]],
    counts: tuple[str, ...],
    silent: Sequence[int] | Int[np.ndarray, " codes"],
) -> dict[str, Num[np.ndarray, " cells"]]:
    """The additional variables of a table with errors; their names have the suffix "_error".

    **Arguments:**

    - `runs`: the variables of the first run of every cell and of the others.
    - `least`: name of a variable -> least bound of its error; `counts`: names of the variables that count events.
    - `silent`: status codes of runs without a result; such runs count as disagreeing.

    **Returns:** bounds; for each count the largest difference from the first run; and 1 as `status_error` if the runs
    disagree on the status or are silent.
    """
    stacked = {name: np.stack([run[name] for run in runs]) for name in ("status", *least, *counts)}
    status = runs[0]["status"]
    agree = (stacked["status"] == status).all(axis=0) & ~np.isin(status, silent)
    differences = {name: np.abs(stacked[name] - stacked[name][0]).max(axis=0) for name in counts}
    is_same = np.all([np.ones_like(agree), *(difference == 0 for difference in differences.values())], axis=0)
    bounds = {name: np.fmax(error_bound(stacked[name], agree, is_same), error) for name, error in least.items()}
    errors = bounds | {"status": (~agree).astype(np.int8)} | differences
    return {f"{name}_error": np.asarray(error) for name, error in errors.items()}


# The quantities of a run over its times, as a table, and the methods that every run derives from this table.


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


#: Name -> values.
Series = dict[str, Values]


def run_table(
    quantities: dict[str, Quantity], coords: Series, values: Series, axes: list[str], request: dict[str, object]
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
    long_names = {"time": "time"} | {name: quantity.long_name for name, quantity in quantities.items()}
    units = {"time": "s"} | {name: quantity.unit for name, quantity in quantities.items()}
    inner = {name: (quantity.components,) for name, quantity in quantities.items() if quantity.components is not None}
    attributes = attributes_of(request, axes, repr)
    return Table(coords, values, units, attributes, {}, inner, long_names)


class Tabular(Viewable, abc.ABC):
    """A run whose quantities over time are a table, which gives it `to_xarray`, `save`, `plot` and `portrait`.

    **Example:**

    >>> from nonholonomic.sweeps import Table, Tabular
    >>> class Fall(Tabular):
    ...     portrait_axes = ("height", "speed")
    ...     def to_table(self):
    ...         return Table({"time": np.zeros(1)}, {"height": np.ones(1), "speed": np.zeros(1)}, {"time": "s"}, {})
    >>> Fall().to_xarray()["height"].dims
    ('time',)
    """

    #: The names that a message for an unknown attribute lists before the quantities; the ordinary message lists none.
    readable: ClassVar[tuple[str, ...]] = ()

    #: The quantities that `run[name]` returns.
    quantities: ClassVar[Mapping[str, Quantity]] = MappingProxyType({})

    #: The variables that `portrait` draws by default, which every run has.
    portrait_axes: ClassVar[tuple[str, str]]

    @abc.abstractmethod
    def to_table(self) -> Table:
        """All quantities of the run, as a `Table` over its times.

        **Raises:** `ValueError` for a batch of runs.
        """

    def to_xarray(self) -> "xarray.Dataset":
        """The run as an `xarray.Dataset` over "time" (needs xarray), with units and names.

        **Raises:** `ValueError` for a batch of runs.
        """
        require_package("xarray", "xarray", "to_xarray")
        return self.to_table().to_xarray()

    def save(self, path: object) -> None:
        """Write the run to an HDF5 file that `Table.load` and xarray (`engine="h5netcdf"`) read.

        **Raises:** `OSError` that names the path if the file cannot be written; `ValueError` for a batch of runs.
        """
        file = table_path(path)
        self.to_table().save(file)

    def to_dataframe(self, unit: str | Sequence[str] | None = None) -> "pandas.DataFrame":
        """The run as a `pandas.DataFrame` (needs pandas): a row for each time, a column for each quantity or component.

        **Arguments:** `unit`: as for `Table.to_dataframe`.

        **Raises:** `ValueError` for a batch of runs, and for an unknown unit.
        """
        require_package("pandas", "pandas", "to_dataframe")
        return self.to_table().to_dataframe(unit)

    def table_of(self, names: Sequence[str]) -> Table:
        """A table over the run's times with at least the named quantities, or with all if one of the names is unknown."""
        return self.to_table()

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
          default those that a page of the run shows.
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
            # A list of names; or, as in earlier versions, a list of runs.
            (first,) = quantities
            if isinstance(first, list | tuple) and first and all(isinstance(name, str) for name in first):
                quantities = tuple(first)
            else:
                quantities, others = (), first
        runs, unit = [self, *require_others(self, others)], unit or unit_of(self)
        labels = self.labels_of(runs, unit) if label is None else require_labels(label, runs)
        title, labels = (labels[0], [""]) if label is None and len(runs) == 1 else ("", labels)
        if quantities:
            tables = [run.table_of(quantities).drawn_in(unit, *quantities) for run in runs]
        elif ax is None:
            shows = [show for stage in self.stages(runs[1:]) for show in stage.shows]
            units = {curve.name: curve.unit or "1" for show in shows for curve in show.curves}
            quantities, tables = tuple(units), []
            for show in shows:
                curves = dict.fromkeys(units, np.full(len(show.times), np.nan))
                curves |= {curve.name: curve.values for curve in show.curves}
                tables.append(Table({"time": show.times}, curves, units | {"time": "s"}, {}).drawn_in(unit, *units))
        else:
            raise ValueError(f"ax takes one quantity: name it, as in plot({next(iter(self))!r}, ax=ax)")
        factor = in_unit("s", unit)[1]
        marks = [tuple((factor * t, text) for t, text in run.marks if run.t[0] <= t <= run.t[-1]) for run in runs]
        drawing = draw_series(tables, quantities, labels, marks, ax)
        if ax is None:
            draw_title(drawing.figure, title)
        return drawing

    def portrait(self, x: str | None = None, y: str | None = None, ax: Any = None, unit: Any = None) -> Any:
        """Draw one quantity against another, a phase portrait (needs matplotlib).

        **Arguments:**

        - `x`, `y`: variables of `to_table()`, such as "theta" or "steering", or one component, such as "position.x". By
          default `portrait` draws theta and its rate, the steering angle and the yaw rate, or the first two components of
          your own system.
        - `ax`: matplotlib axes to draw in, instead of a new figure.
        - `unit`: unit to draw in, such as "deg" for all angles.

        **Returns:** the matplotlib figure, or `ax`.

        **Raises:** `ValueError` for an unknown variable or unit.
        """
        require_package("matplotlib", "plot", "portrait")
        require_unit(unit)
        x, y = x or self.portrait_axes[0], y or self.portrait_axes[1]
        return draw_portrait(self.table_of((x, y)).drawn_in(unit or unit_of(self), x, y), x, y, ax)

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
        is_known = name.startswith("_") or hasattr(type(self), name)
        readable = () if is_known else dict.fromkeys((*self.readable, *self.quantities))
        if not readable:
            return object.__getattribute__(self, name)
        if name in self.quantities:
            return self[name]
        methods = [method for method in dir(type(self)) if not method.startswith("_")]
        hint = "; did you mean 't'?" if name in ("time", "times") else likely(name, [*readable, *methods]) or "."
        hint = (
            "; files of other programs come from to_dataframe(), as to_dataframe().to_csv(path)."
            if name == "to_csv"
            else hint
        )
        raise AttributeError(f"the run has no {name!r}{hint} It has {', '.join(['t', *readable])}")

    def __repr__(self) -> str:
        return str(self)

    _repr_html_ = text_as_html
