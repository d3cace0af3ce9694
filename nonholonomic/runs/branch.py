"""Branches of periodic orbits over a number, with their special points (`runs/continuation.py` follows them)."""

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ..compilation.tracing import named_errors
from ..parameters import meant, of_all_modes, short_names
from ..sweeps import Table
from ..sweeps.grid import attributes_of
from ..terminal import status_line
from ..text import counted, shown
from ..validation import require, require_outside, require_package, require_whole
from ..views.plot import new_figure
from .continuation import ASIDE, CROSSING, DIVERGES, DOUBLING, ENDS, OF_A_FAMILY, REGULAR, STEPS, Continuation, Point

# Only for type checkers: xarray is optional, and an orbit knows how to branch.
if TYPE_CHECKING:
    import xarray

    from .orbit import Orbit

#: A relative difference of periods that counts as none; states below this are no scale for the unknowns.
SAME_PERIOD, SMALLEST_SCALE = 1e-9, 1e-9


class SpecialPoint(NamedTuple):
    """A special point of a branch: its `kind`, the `value` of the number, and the `orbit`.

    `kind` is "fold", "period doubling", "Neimark-Sacker" (a complex pair of multipliers passes through the unit circle),
    "branch point" (another branch of orbits crosses), or "grazing" (a margin touches zero).

    **Example:** the multipliers at the period doublings of a branch are
    `[point.orbit.multipliers for point in branch.special if point.kind == "period doubling"]`.

    >>> import nonholonomic
    >>> nonholonomic.SpecialPoint("fold", 2.0, None)
    SpecialPoint(kind='fold', value=2.0, orbit=None)
    """

    kind: str
    value: float
    orbit: "Orbit"


class Branch(eqx.Module):
    """A branch of periodic orbits over a number, as `Orbit.branch` returns it.

    - `name`: full name of the number; `values`: its value at each point; `orbits`: the orbits, an `Orbit` whose arrays have the
      points first.
    - `kinds`: for each point "regular", or the kind of a special point; `end`: why the branch ends.
    - `period`: as for `Orbit.branch`.

    `branch.periods`, `branch.states`, `branch.multipliers` and `branch.stable` are arrays over the points, and `branch.special`
    lists the special points.

    **Example:** as for `Orbit.branch`.

    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> zeros, none = jnp.zeros(3), jnp.zeros(3, int)
    >>> numbers = (jnp.full(3, 2.0), jnp.ones((3, 1)), jnp.array([[0.5 + 0.0j], [1.0], [1.5]]), zeros, zeros)
    >>> orbits = nonholonomic.Orbit(*numbers, none, none, none, ("y0",))
    >>> kinds, end = ("regular", "fold", "regular"), "the number reaches its first value again"
    >>> print(nonholonomic.Branch("system.modes[0].mu", jnp.array([1.0, 2.0, 1.0]), orbits, kinds, end))
    branch of periodic orbits over mu, 3 points from 1 to 1
      stable from 1 to 2
      unstable from 2 to 1
      fold at mu = 2, period 2 s
      ended because the number reaches its first value again
    """

    name: str = eqx.field(static=True)
    values: Float[Array, " points"]
    orbits: Any
    kinds: tuple[str, ...] = eqx.field(static=True)
    end: str = eqx.field(static=True)
    period: Callable[[Array], Array] | None = eqx.field(static=True, default=None)

    @property
    def periods(self) -> Float[Array, " points"]:
        """The periods [s]."""
        return self.orbits.period

    @property
    def states(self) -> Float[Array, "points components"]:
        """The states on the section."""
        return self.orbits.state

    @property
    def multipliers(self) -> Complex[Array, "points multipliers"]:
        """The multipliers of each orbit, the largest first."""
        return self.orbits.multipliers

    @property
    def stable(self) -> Bool[Array, " points"]:
        """Whether each orbit is stable."""
        return self.orbits.stable

    def orbit(self, k: int) -> "Orbit":
        """The orbit at a point, counted from 0; negative numbers count from the end."""
        return jax.tree.map(lambda part: part[k], self.orbits)

    @property
    def special(self) -> list[SpecialPoint]:
        """The special points, in the order of the branch."""
        places = [k for k, kind in enumerate(self.kinds) if kind != REGULAR]
        return [SpecialPoint(self.kinds[k], float(self.values[k]), self.orbit(k)) for k in places]

    @status_line("looking for a branch")
    def switched(self, k: int | None = None) -> "Orbit":
        """An orbit of the other branch through a special point: of twice the period at a period doubling.

        **Arguments:** `k`: which of `special`, a period doubling or a branch point; by default the first of these.

        **Returns:** an `Orbit` near the special point, whose `branch` follows the other branch.

        **Raises:** `ValueError` if there is no such point, and if no orbit of the other branch is found near it.
        """
        special = self.special
        allowed = [place for place, point in enumerate(special) if point.kind in (DOUBLING, CROSSING)]
        k = allowed[0] if k is None and allowed else k
        if k not in allowed:
            kinds = ", ".join(point.kind for point in special) or "none"
            raise ValueError(
                f"k = {shown(k)} must be the place of a period doubling or a branch point among special: {kinds}"
            )
        kind, value, orbit = special[k]
        course, _ = continuation_of(orbit, self.name, value + float(np.ptp(self.values)), self.period)
        begin = course.begin
        old = course.corrected(begin, np.eye(len(begin))[-1])
        if isinstance(old, int):
            raise ValueError(f"the special point is no orbit: {ENDS[old]}")
        if kind == DOUBLING:
            values, vectors = np.linalg.eig(old.jacobian)
            aside = np.append(np.real(vectors[list(orbit.search.free), np.argmin(np.abs(values + 1.0))]), 0.0)
            course = course._replace(returns=2 * course.returns)
        else:
            # In the plane of both branches, across this one.
            place = [j for j, word in enumerate(self.kinds) if word != REGULAR][k]
            states, values = (np.asarray(part[place + 1] - part[place - 1]) for part in (self.states, self.values))
            along = np.append(states[list(orbit.search.free)] / course.scale, values / (course.last - course.first))
            plane = np.linalg.svd(old.matrix)[2][-2:]
            aside = plane.T @ np.linalg.svd((plane @ along)[None])[2][-1]
        aside = aside / np.linalg.norm(aside)
        new: Point | int = DIVERGES
        for distance in ASIDE:
            new = course.corrected(begin + distance * aside, aside)
            if not isinstance(new, int):
                return jax.tree.map(lambda part: part[0], course.orbits([new]))
        raise ValueError(f"no orbit of the other branch was found near {self.name} = {value:.10g}: {ENDS[int(new)]}")

    def to_table(self) -> Table:
        """The branch as a `Table` over its points: `value`, `period` [s], the components of the state, the real and imaginary
        parts of the multipliers, `stable`, and `kind`, such as "period_doubling"."""
        multipliers, kinds = np.asarray(self.multipliers), [kind.replace(" ", "_") for kind in self.kinds]
        columns = {
            "value": self.values,
            "period": self.periods,
            **dict(zip(self.orbits.names, self.states.T, strict=True)),
            "multipliers_real": np.real(multipliers),
            "multipliers_imag": np.imag(multipliers),
            "stable": self.stable,
        }
        coords = {"point": np.arange(len(self.values)), "multiplier": np.arange(multipliers.shape[1])}
        variables = {name: np.asarray(column) for name, column in columns.items()} | {"kind": np.array(kinds)}
        inner = {"multipliers_real": ("multiplier",), "multipliers_imag": ("multiplier",)}
        attributes = attributes_of({"branch": self.name, "end": self.end}, ["point"])
        return Table(coords, variables, {"period": "s"}, attributes, {}, inner, {"value": self.name})

    def to_xarray(self) -> "xarray.Dataset":
        """The branch as an `xarray.Dataset` (needs xarray), with the contents of `to_table`."""
        return self.to_table().to_xarray()

    def save(self, path: object) -> None:
        """Write the branch to an HDF5 file that `Table.load` and xarray read.

        **Raises:** `OSError` that names the path if the file cannot be written.
        """
        self.to_table().save(path)

    def plot(self, quantity: str = "period", ax: Any = None) -> Any:
        """Draw a quantity over the number (needs matplotlib), with solid lines for stable orbits, dashed lines for unstable
        ones, and the names of the special points. A component is that of one state of each orbit, so that of the two prongs
        of a doubled orbit one is drawn; `bifurcation` draws both.

        **Arguments:** `quantity`: "period", or the name of a component; `ax`: matplotlib axes to draw in, instead of a new
        figure.

        **Returns:** the matplotlib figure, or `ax`.

        **Raises:** `ValueError` for an unknown quantity.
        """
        require_package("matplotlib", "plot", "plot")
        names = ("period", *self.orbits.names)
        if quantity not in names:
            raise ValueError(f"quantity = {shown(quantity)} must be one of {', '.join(names)}")
        table = self.to_table()
        figure: Any = new_figure() if ax is None else None
        panel: Any = ax if figure is None else figure.subplots()
        x, y, stable = table["value"], table[quantity], np.asarray(self.stable)
        # At the end of a stable stretch an orbit may count as unstable.
        edges = stable[:-1] | stable[1:]
        starts = [0, *(np.flatnonzero(np.diff(edges)) + 1), len(edges)]
        for begin, end in itertools.pairwise(starts):
            label = "stable" if edges[begin] else "unstable"
            named = label in panel.get_legend_handles_labels()[1]
            part, style = slice(begin, end + 1), "-" if edges[begin] else "--"
            panel.plot(x[part], y[part], style, color="C0", label=None if named else label)
        for k, kind in enumerate(self.kinds):
            if kind != REGULAR:
                panel.plot(x[k], y[k], "o", color="C3", markersize=4)
                # Beside the line, towards the middle of the picture.
                is_right, (old, new) = x[k] > np.mean(panel.get_xlim()), (max(k - 1, 0), min(k + 1, len(x) - 1))
                is_above = is_right == ((x[new] - x[old]) * (y[new] - y[old]) > 0.0)
                style = {"ha": "right" if is_right else "left", "fontsize": "small", "textcoords": "offset points"}
                panel.annotate(kind, (x[k], y[k]), (-5 if is_right else 5, 5 if is_above else -12), **style)
        panel.set_xlabel(short_names([self.name])[self.name])
        panel.set_ylabel(table.label(quantity))
        panel.legend()
        return figure or panel

    def __repr__(self) -> str:
        values, name = np.asarray(self.values), short_names([self.name])[self.name]
        stable = np.asarray(self.stable)
        count = counted(len(values), "point")
        lines = [f"branch of periodic orbits over {name}, {count} from {values[0]:.8g} to {values[-1]:.8g}"]
        changes = [0, *(np.flatnonzero(np.diff(stable)) + 1)]
        # At a special point, an orbit may count as either.
        starts = [k - (k > 0 and self.kinds[k - 1] != REGULAR) for k in changes]
        for k, begin, end in zip(changes, starts, [*starts[1:], len(values) - 1], strict=True):
            lines.append(f"{'stable' if stable[k] else 'unstable'} from {values[begin]:.8g} to {values[end]:.8g}")
        for kind, value, orbit in self.special:
            lines.append(f"{kind} at {name} = {value:.10g}, period {float(orbit.period):.8g} s")
        return "\n  ".join([*lines, f"ended because {self.end}"])


def continuation_of(
    orbit: Any, name: str, until: float, period: Callable[[Array], Array] | None
) -> tuple[Continuation, str]:
    """The continuation of an orbit, checked, and the full name of the number. **Arguments:** as for `Orbit.branch`."""
    require_outside((orbit, until), "branch", "the derivatives of periodic_orbit")
    if np.ndim(orbit.reason):
        raise ValueError(
            "branch follows one orbit, not a batch; take one by jax.tree.map(lambda part: part[k], orbits)"
        )
    if orbit.search is None or int(orbit.reason):
        raise ValueError("branch needs an orbit that periodic_orbit has found in this process")
    if int(orbit.family) and len(orbit.search.free) == len(orbit.names):
        raise ValueError(OF_A_FAMILY)
    require(until, "until")
    search, model = orbit.search, orbit.search.model(orbit.leaves)
    parameters = model.parameters
    known = [full for full in parameters.known if not full.startswith("start")]
    matches = meant(name, known)
    merged = {of_all_modes(match) for match in matches}
    # A number of all modes need not be named as such.
    full = merged.pop() if len(matches) > 1 and len(merged) == 1 else parameters.full_name("name", name)
    if full not in known:
        raise ValueError(
            f"name = {name!r} is a part of the start; pass a number of the system or of the event: {', '.join(known)}"
        )
    pairs = zip(parameters.names, parameters.values, strict=True)
    floats = [own for own, value in pairs if eqx.is_inexact_array(value)]
    others = tuple(k for k, own in enumerate(floats, 1) if full in (own, of_all_modes(own)))
    values = {float(orbit.leaves[k]) for k in others}
    if len(values) > 1:
        raise ValueError(
            f"name = {name!r} has different values in the modes; name one of them, such as {floats[others[0] - 1]!r}"
        )
    first = values.pop()
    if float(until) == first:
        raise ValueError(
            f"until = {until!r} is the value of {name} at the orbit; pass another, to which the branch leads"
        )
    model.require_values({full: float(until)})
    if period is not None:
        if not search.is_driven:
            raise ValueError("period= is that of a drive; the orbit is that of a section, so leave it out")
        with named_errors("period(value)", "a number"):
            horizon = float(period(jnp.asarray(first)))
        expected = float(orbit.period) / orbit.returns
        if not abs(horizon - expected) <= SAME_PERIOD * expected:
            raise ValueError(f"period({first:.10g}) = {horizon:.10g} s must be that of the drive, {expected:.10g} s")
    largest = float(np.abs(np.asarray(orbit.state)).max())
    scale = largest if largest > SMALLEST_SCALE else 1.0
    course = Continuation(orbit, others, period, first, float(until), scale, orbit.returns)
    new = course.evaluated(course.begin)
    return course._replace(in_motion=bool(new.in_motion)), full


@status_line("following a branch")
def branch_of(
    orbit: Any,
    name: str,
    until: float,
    step: float | None,
    points: int,
    period: Callable[[Array], Array] | None,
) -> Branch:
    """The branch of an orbit. **Arguments:** as for `Orbit.branch`."""
    require_whole(points, "points", 2)
    if step is not None:
        require(step, "step", above=0.0)
    course, full = continuation_of(orbit, name, until, period)
    span = abs(course.last - course.first)
    largest = 1.0 / STEPS if step is None else min(float(step) / span, 0.5)
    found, kinds, end = course.followed(largest, points)
    values = jnp.asarray([point.value for point in found])
    return Branch(full, values, course.orbits(found), tuple(kinds), end, period)
