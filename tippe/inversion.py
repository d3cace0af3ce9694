"""Inversion: when the axis first reaches an angle, for one launch or for every cell of a grid."""

import math
from collections.abc import Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from nonholonomic.derivatives import AbstractQuestion, ask, directions_by, traced_march_with_slopes
from nonholonomic.integration import (
    CROSSED,
    FAILED,
    REACHED_END,
    AbstractProblem,
    Journey,
    Outcome,
    Settings,
    explicit_tableau,
    traced_march,
)
from nonholonomic.parameters import numbers
from nonholonomic.validation import Bound, all_bounds, as_number, is_traced, legal, require_all
from nonholonomic.xla_cpu import compiled_setup

from .dynamics import Dynamics
from .launch import Launch
from .phases import Kind, StickSlip
from .scene import Scene
from .state import COS_THETA

#: The greatest relative tolerance that is accepted.
LOOSEST = 1e-2


class InversionProblem(AbstractProblem):
    """Launches that end when theta reaches an angle or the contact is lost or jams."""

    dynamics: Dynamics | StickSlip | Kind
    cos_angle: Float[Array, "..."]
    states: Float[Array, "components cells"]
    scales: Float[Array, "components cells"]

    @classmethod
    def of(cls, scene: Scene, launch: Launch, angle: Float[ArrayLike, "..."], cells: int) -> "InversionProblem":
        """The problem of the given number of cells; the numbers of scene and launch are scalars or one per cell."""
        return _problem(scene, launch, jnp.asarray(angle), cells)

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        return self.states, self.scales

    def field(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
        return self.dynamics.field(state)

    def crossing(self, state: Float[Array, "components lanes"]) -> Float[Array, " lanes"]:
        return state[COS_THETA] - self.cos_angle

    def guard(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Float[Array, " lanes"]:
        return self.dynamics.contact_margin(state)


@compiled_setup
def _problem(scene: Scene, launch: Launch, angle: Float[Array, "..."], cells: int) -> InversionProblem:
    states = scene.state(launch)
    shape = (states.shape[0], cells)
    states = jnp.broadcast_to(states.reshape(shape[0], -1), shape)
    scales = jnp.broadcast_to(scene.scales(launch).reshape(shape[0], -1), shape)
    return InversionProblem(scene.dynamics, jnp.cos(angle), states, scales)


def inversion_time(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: Float[ArrayLike, ""] = 0.95 * math.pi,
    tolerance: float = 1e-9,
    crossing: str = "first",
    solver: diffrax.AbstractERK | None = None,
) -> Float[Array, ""]:
    """Time at which theta reaches an angle; works under `jit`, `vmap`, `grad`, `jvp` and their compositions.

    The derivative is that of the event's time by the implicit function theorem; it is 0 where the result is infinite.
    Differentiating by one parameter costs about as much again as the time itself, by any number of them four to seven
    times as much (`nonholonomic/derivatives/slopes.py`); second derivatives take forward-mode passes.

    **Arguments:**

    - `scene`, `launch`: as for `simulate`, every number a scalar.
    - `t1`: horizon [s], positive.
    - `angle`: angle [rad] to be reached, in (0, pi].
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `crossing`: "first" for the first time theta reaches the angle, "last" for the up-crossing after which theta stays
      above it until `t1`.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, `Dopri8()` by default.

    **Returns:** the time [s]; infinite if the top has not inverted by `t1`, or has lost contact or jammed before; NaN
    if the integration failed, or if numbers inside a transformation are out of range.

    **Raises:** `ValueError` for arguments outside these ranges, and for a scene with `contact="hybrid"` or
    `SetValuedCoulomb`: the derivative does not go through impacts, nor through stick and slip. `inversion_table` gives the
    time.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> time = tippe.inversion_time(scene, tippe.Launch(0.1, 155.0), t1=8.0, tolerance=1e-6)
    >>> print(f"{time:.2f} s")
    5.97 s

    ```
    """
    solver = diffrax.Dopri8() if solver is None else solver
    check_run(scene, launch, t1, tolerance)
    check_event(angle, crossing)
    check_smooth(scene, "inversion_time")
    explicit_tableau(solver)
    leaves, structure = jax.tree.flatten((scene, launch, as_number(angle), as_number(t1), as_number(tolerance)))
    unchecked = any(is_traced(leaf) for leaf in leaves)
    # The last two leaves, horizon and tolerance, do not move the event.
    return ask(InversionQuestion(len(leaves) - 2, structure, solver, crossing == "last", unchecked), *leaves)


class InversionQuestion(AbstractQuestion):
    """When cells invert; the leaves are those of scene and launch, the angle, the horizon, the tolerance."""

    movable: int
    # JAX's PyTreeDef, which type checkers take for a variable.
    structure: Any = eqx.field(static=True)
    solver: diffrax.AbstractERK
    last: bool = eqx.field(static=True)
    # Whether some numbers were traced, so that the checks could not see them.
    unchecked: bool = eqx.field(static=True)

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isinf(value)

    def problem(self, leaves: tuple[Array, ...], cells: int | None) -> InversionProblem:
        """The launches of some cells."""
        # The leaves that do not move the event are not needed here.
        unused = (None,) * (self.structure.num_leaves - len(leaves))
        scene, launch, angle, *_ = jax.tree.unflatten(self.structure, (*leaves, *unused))
        assert cells is not None
        return InversionProblem.of(scene, launch, angle, cells)

    def answer(self, cells: int, *leaves: Float[Array, "..."]) -> Float[Array, " cells"]:
        problem = self.problem(leaves[: self.movable], cells)
        may, t1, tolerance = permitted(self.structure, self.unchecked, leaves)
        outcome, _ = traced_march(
            problem,
            t1,
            jnp.asarray(cells),
            Settings(tolerance, self.solver),
            passes=self.last,
            one_kernel=True,
        )
        time = jnp.where(is_inverted(outcome, problem, self.last), outcome.crossing_time, jnp.inf)
        return jnp.where(may & (outcome.status != FAILED), time, jnp.nan)

    def with_slopes(
        self, active: tuple[int, ...], again: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        # Cells do not influence one another, so varying a parameter in all of them at once gives each its own derivative.
        problem, directions, gather = directions_by(self.problem, active, leaves[: self.movable], cells)
        may, t1, tolerance = permitted(self.structure, self.unchecked, leaves)
        outcome, slopes = traced_march_with_slopes(
            problem,
            directions,
            t1,
            jnp.asarray(cells),
            Settings(tolerance, self.solver, looped=True),
            passes=self.last,
            one_kernel=not again,
        )
        inverted, good = is_inverted(outcome, problem, self.last), may & (outcome.status != FAILED)
        time = jnp.where(good, jnp.where(inverted, outcome.crossing_time, jnp.inf), jnp.nan)
        return time, [jnp.where(good, jnp.where(inverted, slope, 0.0), jnp.nan) for slope in gather(slopes)]


@eqx.filter_jit
def permitted(
    structure: Any, unchecked: bool, leaves: tuple[Float[Array, "..."], ...]
) -> tuple[Bool[Array, "..."], Float[Array, "..."], Float[Array, ""]]:
    """Which cells have legal numbers; the horizons, 0 for the others; and the tolerance of the block.

    One tolerance serves a block: the smallest of a batch.

    **Arguments:** `structure`, `leaves`: of scene, launch, angle, horizon and tolerance; `unchecked`: whether some of them
    were traced when they were checked.
    """
    scene, launch, angle, t1, tolerance = jax.tree.unflatten(structure, leaves)
    may = jnp.asarray(True)
    if unchecked:
        bounds = (
            *all_bounds(scene),
            *all_bounds(launch),
            *scene.start_bounds(launch),
            *event_bounds(angle),
            *run_bounds(t1, tolerance),
        )
        may = legal(bounds)
        t1, tolerance = jnp.where(may, t1, 0.0), jnp.where(may, tolerance, LOOSEST)
    return may, t1, jnp.min(tolerance)


def is_inverted(outcome: Outcome | Journey, problem: InversionProblem, last: bool) -> Bool[Array, " cells"]:
    """Which cells count as inverted: those that reached the angle, or that end above it where the last crossing counts."""
    if not last:
        return outcome.status == CROSSED
    above = problem.crossing(jnp.asarray(outcome.state)) <= 0.0
    return (outcome.status == REACHED_END) & above & jnp.isfinite(outcome.crossing_time)


def check_run(scene: Any, launch: Any, t1: Any, tolerance: Any) -> None:
    """Raise `ValueError` unless these are a scene, a launch, a positive horizon and a tolerance in range."""
    if not isinstance(scene, Scene):
        raise ValueError(f"scene = {scene!r} must be a Scene")
    if not isinstance(launch, Launch):
        raise ValueError(f"launch = {launch!r} must be a Launch")
    require_all(run_bounds(t1, tolerance))
    values = numbers("scene", scene) | numbers("launch", launch) | {"t1": t1, "tolerance": tolerance}
    for name, value in values.items():
        if value is not None and np.ndim(value) != 0:
            raise ValueError(f"{name} must be one number, not of shape {np.shape(value)}; inversion_table takes lists")
    scene.check_start(launch)


def run_bounds(t1: Any, tolerance: Any) -> Iterator[Bound]:
    """The ranges of the horizon [s] and of the tolerance."""
    yield Bound(t1, "t1", above=0.0)
    yield Bound(tolerance, "tolerance", at_least=1e-14, at_most=LOOSEST)


def event_bounds(angle: Any) -> Iterator[Bound]:
    """The range of the angle [rad] to be reached."""
    yield Bound(angle, "angle", above=0.0, at_most=math.pi)


def check_smooth(scene: Scene, caller: str) -> None:
    """Raise `ValueError` for a scene whose runs have phases, which derivatives do not go through."""
    if scene.contact == "hybrid":
        raise ValueError(f"contact = 'hybrid' must be 'stop' for {caller}; inversion_table goes through flights")
    if scene.friction.set_valued:
        kind = type(scene.friction).__name__
        raise ValueError(f"friction = {kind} must be a law without phases for {caller}; inversion_table has them")


def check_event(angle: Any, crossing: Any, known: tuple[str, ...] = ("first", "last")) -> None:
    """Raise `ValueError` unless the angle is in (0, pi] and the crossing one of the known words."""
    require_all(event_bounds(angle))
    if np.ndim(angle) != 0:
        raise ValueError(f"angle must be one number, not of shape {np.shape(angle)}")
    if crossing not in known:
        raise ValueError(f"crossing = {crossing!r} must be {' or '.join(map(repr, known))}")
