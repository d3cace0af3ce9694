"""Periodic orbits as `runs/orbit.py` finds them, and their branches over a number, with special points
(`runs/continuation.py` follows them)."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from ..compilation.tracing import dependent_outputs, named_errors
from ..parameters import meant, of_all_modes, short_names
from ..sweeps import Table
from ..sweeps.grid import attributes_of
from ..terminal import status_line
from ..text import counted, shown
from ..validation import is_traced, require, require_outside, require_package, require_whole
from ..views.plot import new_figure
from . import continuation

# Only for type checkers: xarray is optional.
if TYPE_CHECKING:
    import xarray

#: A relative difference of periods that counts as none; states below this are no scale for the unknowns.
SAME_PERIOD, SMALLEST_SCALE = 1e-9, 1e-9

#: Multipliers nearer to the unit circle than this count as on it.
ON_CIRCLE = 1e-9


class Orbit(eqx.Module):
    """A periodic orbit, as `periodic_orbit` returns it.

    - `period` [s]; `state`: the state on the section, just after the reset if the section is at a reset.
    - `multipliers`: the eigenvalues of the derivative of the return map, the largest first; for a section without that of the
      direction along the motion.
    - `error`: bound of the errors of the components of the state.
    - `family`: number of directions in which neighbouring orbits lie, because a quantity is conserved or the motion can be
      shifted; the orbit is then one of a family near the guess.
    - `iterations`: number of Newton steps; `residual`: by how much the last return missed; `reason`: 0, or why there is no
      orbit, as an integer; the other numbers are then NaN or have no meaning.
    - `names`: those of the components; `leaves`, `search`: the numbers and the form of the search, for `branch`; `returns`:
      number of returns in a period.

    **Example:** as for `periodic_orbit`.

    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> none = jnp.array(0)
    >>> numbers = (jnp.array(2.0), jnp.array([1.0]), jnp.array([0.5 + 0.0j]), jnp.array(1e-12), jnp.array(1e-13))
    >>> print(nonholonomic.Orbit(*numbers, none, none + 3, none, ("y0",)))
    stable periodic orbit with a period of 2 s
      y0 = 1
      multipliers 0.5
      error below 1e-12, Newton steps 3
    """

    period: Float[Array, "..."]
    state: Float[Array, "... components"]
    multipliers: Complex[Array, "... multipliers"]
    error: Float[Array, "..."]
    residual: Float[Array, "..."]
    family: Int[Array, "..."]
    iterations: Int[Array, "..."]
    reason: Int[Array, "..."]
    names: tuple[str, ...] = eqx.field(static=True)
    leaves: tuple[Array, ...] = ()
    search: Any = eqx.field(static=True, default=None)
    returns: int = eqx.field(static=True, default=1)

    @property
    def stable(self) -> Bool[Array, "..."]:
        """Whether all multipliers lie inside the unit circle, apart from those of a family, which are 1: at most two
        for each direction. A pair on the circle, as of a conservative system, counts as not stable."""
        distances = jnp.abs(self.multipliers - 1.0)
        nearest = jnp.argsort(jnp.argsort(distances, axis=-1), axis=-1)
        # Round-off splits a double multiplier by the square root of its error.
        is_own = (nearest < 2 * jnp.asarray(self.family)[..., None]) & (distances < continuation.RANK**0.5)
        return jnp.all(is_own | (jnp.abs(self.multipliers) < 1.0 - ON_CIRCLE), axis=-1)

    @property
    def status(self) -> str:
        """How the search has ended: "completed", or "unresolved" or "illegal" without an orbit."""
        if np.ndim(self.reason):
            raise ValueError("status is that of a single orbit; the orbits of a batch have `reason`, an array")
        reason = int(self.reason)
        return "illegal" if reason == continuation.ILLEGAL else "unresolved" if reason else "completed"

    @status_line("following a branch")
    def branch(
        self, name: str, until: float, step: float | None = None, points: int = 500, period: Any = None
    ) -> "Branch":
        """Follow the orbit while a number changes, by pseudo-arclength continuation; runs on the host.

        The branch goes around folds, where the number turns back. Folds, period doublings, Neimark-Sacker points and branch
        points are located to 1e-8 of the number. The branch ends at `until`, back at the first value of the number, or where
        the orbit ceases to exist, such as where a reset grazes. One program is compiled for all points.

        **Arguments:**

        - `name`: the number, of the system or of its event, such as "mu" or "modes[0].mu"; a number of this name in all modes
          changes in all of them.
        - `until`: the last value of the number, on either side of the value at the orbit.
        - `step`: largest change of the number between neighbouring points, by default a fiftieth of the range. Where the
          state changes faster than the number, in units of its largest component, steps are shorter.
        - `points`: the most points.
        - `period`: if the number changes the period of a drive, the period [s] as a function of the number.

        **Returns:** a `Branch`.

        **Raises:** `ValueError` for an unknown number, arguments out of range, an orbit of a batch, and an orbit of a family;
        pass `free` to `periodic_orbit`, so that the orbit is the only one for a fixed number. The same inside transformations.

        **Example:** the limit cycle of van der Pol's oscillator up to mu = 2.

        ```
        >>> import jax.numpy as jnp
        >>> import nonholonomic
        >>> class Oscillator(nonholonomic.AbstractMode):
        ...     mu: float
        ...
        ...     def field(self, t, y):
        ...         return jnp.array([y[1], self.mu * (1.0 - y[0] ** 2) * y[1] - y[0]])
        >>> def section(t, y):
        ...     return y[1]
        >>> orbit = nonholonomic.periodic_orbit(nonholonomic.Hybrid([Oscillator(1.0)]), [2.0, 0.0], section)
        >>> branch = orbit.branch("mu", 2.0, step=0.25)
        >>> print(f"{branch.periods[0]:.8f} s, {branch.periods[-1]:.8f} s")
        6.66328686 s, 7.62987448 s
        >>> print(branch)
        branch of periodic orbits over mu, 7 points from 1 to 2
          stable from 1 to 2
          ended because the number reaches the end of the range

        ```
        """
        require_whole(points, "points", 2)
        if step is not None:
            require(step, "step", above=0.0)
        course, full = continuation_of(self, name, until, period)
        largest = 1.0 / continuation.STEPS if step is None else min(float(step) / abs(course.last - course.first), 0.5)
        visited, kinds, end = course.followed(largest, points)
        values = jnp.asarray([point.value for point in visited])
        orbits = jax.tree.map(lambda *parts: jnp.asarray(np.stack(parts)), *(point.orbit for point in visited))
        return Branch(full, values, orbits, tuple(kinds), end, period)

    def __repr__(self) -> str:
        if is_traced(self) or np.ndim(self.period):
            return f"Orbit(period={shown(self.period)}, state={shown(self.state)})"
        values = np.asarray(self.multipliers).tolist()
        multipliers = [f"{value.real:.8g}" + f"{value.imag:+.8g}j" * bool(value.imag) for value in values]
        pairs = zip(self.names, np.asarray(self.state).tolist(), strict=True)
        in_returns = f" in {self.returns} returns" if self.returns > 1 else ""
        stability = "stable" if self.stable else "unstable"
        # The guess; a point of a branch has none.
        start = [self.leaves[k] for k in self.search.starts] if self.search else self.state
        distance = np.max(np.abs(np.asarray(self.state) - np.asarray(start)))
        lines = [
            f"{stability} periodic orbit with a period of {float(self.period):.12g} s{in_returns}",
            ", ".join(f"{name} = {value:.12g}" for name, value in pairs),
            f"multipliers {', '.join(multipliers)}",
            f"error below {float(self.error):.1g}, Newton steps {int(self.iterations)}"
            + f", {distance:.2g} away from the guess" * bool(distance),
        ]
        if int(self.family):
            lines.append(f"one of a family of orbits, in {counted(int(self.family), 'direction')}")
        return "\n  ".join(lines)


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
    orbit: Orbit


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
    orbits: Orbit
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

    def orbit(self, k: int) -> Orbit:
        """The orbit at a point, counted from 0; negative numbers count from the end."""
        return jax.tree.map(lambda part: part[k], self.orbits)

    @property
    def special(self) -> list[SpecialPoint]:
        """The special points, in the order of the branch."""
        places = [k for k, kind in enumerate(self.kinds) if kind != continuation.REGULAR]
        return [SpecialPoint(self.kinds[k], float(self.values[k]), self.orbit(k)) for k in places]

    @status_line("looking for a branch")
    def switched(self, k: int | None = None) -> Orbit:
        """An orbit of the other branch through a special point: of twice the period at a period doubling.

        **Arguments:** `k`: which of `special`, a period doubling or a branch point; by default the first of these.

        **Returns:** an `Orbit` near the special point, whose `branch` follows the other branch.

        **Raises:** `ValueError` if there is no such point, and if no orbit of the other branch is found near it.
        """
        special = self.special
        switchable = continuation.DOUBLING, continuation.CROSSING
        allowed = [place for place, point in enumerate(special) if point.kind in switchable]
        k = allowed[0] if k is None and allowed else k
        if k not in allowed:
            kinds = ", ".join(point.kind for point in special) or "none"
            raise ValueError(
                f"k = {shown(k)} must be the place of a period doubling or a branch point among special: {kinds}"
            )
        kind, value, orbit = special[k]
        course, _ = continuation_of(orbit, self.name, value + float(np.ptp(self.values)), self.period)
        begin = course.begin
        try:
            old = course.corrected(begin, np.eye(len(begin))[-1])
        except continuation.NoPoint as error:
            raise ValueError(f"the special point is no orbit: {error}") from None
        if kind == continuation.DOUBLING:
            values, vectors = np.linalg.eig(old.jacobian)
            aside = np.append(np.real(vectors[list(orbit.search.free), np.argmin(np.abs(values + 1.0))]), 0.0)
            once, course = course, course._replace(returns=2 * course.returns)
        else:
            # In the plane of both branches, across this one.
            place = [j for j, word in enumerate(self.kinds) if word != continuation.REGULAR][k]
            states, values = (np.asarray(part[place + 1] - part[place - 1]) for part in (self.states, self.values))
            along = np.append(states[list(orbit.search.free)] / course.scale, values / (course.last - course.first))
            plane = np.linalg.svd(old.matrix)[2][-2:]
            aside = plane.T @ np.linalg.svd((plane @ along)[None])[2][-1]
        aside = aside / np.linalg.norm(aside)
        reason = ""
        for distance in continuation.ASIDE:
            try:
                point = course.corrected(begin + distance * aside, aside)
            except continuation.NoPoint as error:
                reason = str(error)
                continue
            if kind == continuation.DOUBLING:
                # Near the special point, a multiplier is near 1, and half of the returns lead to the other prong.
                half = once.evaluated(point.unknowns)
                is_near = np.min(np.abs(point.orbit.multipliers - 1.0)) < continuation.NEARLY_ONE
                if not is_near or np.abs(half.state - half.start).max() < distance * course.scale:
                    reason = "Newton's method leads to an orbit elsewhere"
                    continue
            return jax.tree.map(jnp.asarray, point.orbit)
        raise ValueError(f"no orbit of the other branch was found near {self.name} = {value:.10g}: {reason}")

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
        for begin, end in zip(starts, starts[1:], strict=False):
            label = "stable" if edges[begin] else "unstable"
            named = label in panel.get_legend_handles_labels()[1]
            part, style = slice(begin, end + 1), "-" if edges[begin] else "--"
            panel.plot(x[part], y[part], style, color="C0", label=None if named else label)
        for k, kind in enumerate(self.kinds):
            if kind != continuation.REGULAR:
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
        starts = [k - (k > 0 and self.kinds[k - 1] != continuation.REGULAR) for k in changes]
        for k, begin, end in zip(changes, starts, [*starts[1:], len(values) - 1], strict=True):
            lines.append(f"{'stable' if stable[k] else 'unstable'} from {values[begin]:.8g} to {values[end]:.8g}")
        for kind, value, orbit in self.special:
            lines.append(f"{kind} at {name} = {value:.10g}, period {float(orbit.period):.8g} s")
        return "\n  ".join([*lines, f"ended because {self.end}"])


def continuation_of(
    orbit: Orbit, name: str, until: float, period: Callable[[Array], Array] | None
) -> tuple[continuation.Continuation, str]:
    """The continuation of an orbit, checked, and the full name of the number. **Arguments:** as for `Orbit.branch`."""
    require_outside((orbit, until), "branch", "the derivatives of periodic_orbit")
    if np.ndim(orbit.reason):
        raise ValueError(
            "branch follows one orbit, not a batch; take one by jax.tree.map(lambda part: part[k], orbits)"
        )
    if orbit.search is None or int(orbit.reason):
        raise ValueError("branch needs an orbit that periodic_orbit has found in this process")
    if int(orbit.family) and len(orbit.search.free) == len(orbit.names):
        raise ValueError(continuation.OF_A_FAMILY)
    require(until, "until")
    search, model = orbit.search, orbit.search.model(orbit.leaves)
    known = [full for full in model.known if not full.startswith(("start", "launch"))]
    matches = meant(name, known)
    merged = {of_all_modes(match) for match in matches}
    # A number of all modes need not be named as such.
    full = merged.pop() if len(matches) > 1 and len(merged) == 1 else model.full_name("name", name)
    if full not in known:
        raise ValueError(
            f"name = {name!r} is a part of the start; pass a number of the system or of the event: {', '.join(known)}"
        )

    def numbers(value: Array) -> list[Array]:
        return jax.tree.leaves(eqx.filter(model.replaced({full: value}), eqx.is_inexact_array))

    depends = dependent_outputs(numbers, jnp.zeros(()))
    if len(depends) != len(jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array))):
        raise ValueError(f"name = {name!r} is left out in the scene, or 0; give it a value other than 0 there")
    others = tuple(k for k, is_number in enumerate(depends) if is_number)
    values = {float(orbit.leaves[k]) for k in others}
    if len(values) > 1:
        single = next(own for own in known if own != full and of_all_modes(own) == full)
        raise ValueError(f"name = {name!r} has different values in the modes; name one of them, such as {single!r}")
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
    course = continuation.Continuation(orbit, others, period, first, float(until), scale, orbit.returns)
    if search.is_driven and model.symmetry is None and not course.repeats():
        raise ValueError(
            f"period: where {name} = {until:.10g}, the drive does not repeat after "
            f"{'this period' if period else 'that of the orbit'}; pass period=, that of the drive as a function of the number"
        )
    new = course.evaluated(course.begin)
    return course._replace(in_motion=bool(new.in_motion)), full
