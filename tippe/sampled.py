"""Runs sampled at given times, as functions for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.derivatives import (
    AbstractQuestion,
    VariationalProblem,
    ask,
    directions_by,
    in_groups,
    probed,
)
from nonholonomic.integration import (
    FAILED,
    GUARD_LOST,
    AbstractProblem,
    Settings,
    event_time,
    march_with_samples,
    sample,
)
from nonholonomic.validation import as_number

from .dynamics import Dynamics, stacked
from .launch import Launch
from .phases import Kind, StickSlip
from .scene import Scene


class TrajectoryProblem(AbstractProblem):
    """Launches with their cyclic coordinates: the state, the arena's path, the spin angle and the work of friction.

    `rest` are spin angle and work at the start, `None` where both are 0.
    """

    dynamics: Dynamics | StickSlip | Kind
    axial: Float[Array, "..."]
    state: Float[Array, "components ..."]
    cyclic: Float[Array, "components ..."]
    scales: Float[Array, "components ..."]
    rest: Float[Array, "2 ..."] | None = None

    @classmethod
    def of(cls, scene: Scene, launch: Launch, cells: int | None = None) -> "TrajectoryProblem":
        """The run of one launch, or the runs of some cells, whose numbers are scalars or one per cell."""
        radius, weight = scene.body.radius, scene.body.mass * scene.gravity
        cyclic = jnp.stack(scene.surface.cyclic(launch.eta))
        extra = jnp.stack(jnp.broadcast_arrays(*([radius] * len(cyclic)), jnp.ones(()), weight * radius))
        parts = (scene.state(launch), cyclic, scene.scales(launch), extra)
        if cells is not None:
            parts = tuple(jnp.broadcast_to(part.reshape(len(part), -1), (len(part), cells)) for part in parts)
        return cls(scene.dynamics, scene.body.I3, parts[0], parts[1], jnp.concatenate(parts[2:]))

    def start(self) -> tuple[Float[Array, "components ..."], Float[Array, "components ..."]]:
        rest = jnp.zeros((2, *self.state.shape[1:])) if self.rest is None else self.rest
        return jnp.concatenate([self.state, self.cyclic, rest]), self.scales

    def field(self, time: Float[Array, "..."], state: Float[Array, "components ..."]) -> Any:
        lean, cyclic = state[: len(self.state)], tuple(state[len(self.state) : -2])
        motion = self.dynamics.motion(lean)
        cyclic_rate = self.dynamics.parallel.cyclic_rate(cyclic, motion.velocity, motion.turning)
        return stacked((*motion.rate, *cyclic_rate, motion.spin_momentum / self.axial, motion.friction_power), state)

    def crossing(self, state: Float[Array, "components ..."]) -> None:
        return None

    def guard(self, time: Float[Array, "..."], state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        return self.dynamics.contact_margin(state[: len(self.state)])


#: From this many cells on two directions run along together: that takes 0.8 times as long, but 18 s more to compile.
MANY, TOGETHER = 64, 2

#: How a run can end; inside a transformation the index stands for the word.
STATUS = ("reached t1", "contact_lost", "failed", "jammed", "illegal")


def ended(
    run: TrajectoryProblem,
    state: Float[Array, "components ..."],
    guard_lost: Bool[Array, "..."],
    failed: Bool[Array, "..."],
) -> Int[Array, "..."]:
    """The code in `STATUS` of a run that ended in some state."""
    lost = jnp.where(run.dynamics.jams(state[: len(run.state)]), STATUS.index("jammed"), STATUS.index("contact_lost"))
    return jnp.where(guard_lost, lost, jnp.where(failed, STATUS.index("failed"), STATUS.index("reached t1")))


class Found(NamedTuple):
    """What is found of a run, all floats: `states` are NaN after the end, `status` a code in `STATUS`."""

    states: Float[Array, "*cells times components"]
    end_time: Float[Array, "*cells"]
    status: Float[Array, "*cells"]
    steps: Float[Array, "*cells"]
    rejected: Float[Array, "*cells"]


def sampled(
    scene: Scene,
    launch: Launch,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    tolerance: float,
    solver: diffrax.AbstractSolver,
) -> Found:
    """Run one launch inside a transformation and sample it.

    An explicit Runge-Kutta solver uses the block of lanes, one for each run of a batch; others run by Diffrax. In both, the
    variations take part in step control.

    **Arguments:** as for `simulate`.
    """
    numbers, rest = eqx.partition((scene, launch), eqx.is_array)
    leaves, structure = jax.tree.flatten(numbers)
    kind = BlockSampling if isinstance(solver, diffrax.AbstractERK) else SingleSampling
    question = kind(len(leaves), structure, rest, solver)
    found = ask(question, *leaves, jax.lax.stop_gradient(times), as_number(t1), as_number(tolerance))
    # A small delay moves the sample along the field.
    run = TrajectoryProblem.of(scene, launch)
    rates = jax.lax.stop_gradient(run.field(times, found.states.T).T)
    later = (times - jax.lax.stop_gradient(times))[:, None]
    return found._replace(states=found.states + jnp.where(jnp.isfinite(rates), rates * later, 0.0))


def sampled_by_diffrax(
    run: TrajectoryProblem,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    tolerance: float,
    solver: diffrax.AbstractSolver,
    adjoint: diffrax.AbstractAdjoint,
) -> Found:
    """Run one launch and let Diffrax differentiate its steps, which a probe keeps short enough for tangents."""
    size = len(run.scales)
    path = sample(probed(run), times, t1, Settings(tolerance, solver), adjoint)
    status = ended(run, path.end_state[:size], path.lost, path.end_time < t1)
    floats = [part.astype(float) for part in (status, path.accepted, path.rejected)]
    return Found(path.states[:size].T, path.end_time, *floats)


class BlockSampling(AbstractQuestion):
    """Samples by the block of lanes; the leaves are those of scene and launch, the times, the horizon, the tolerance."""

    movable: int
    # JAX's PyTreeDef, which type checkers take for a variable.
    structure: Any = eqx.field(static=True)
    rest: Any
    solver: diffrax.AbstractERK

    def run(self, leaves: tuple[Array, ...], cells: int) -> TrajectoryProblem:
        """The runs of some cells."""
        numbers = jax.tree.unflatten(self.structure, leaves)
        return TrajectoryProblem.of(*eqx.combine(numbers, self.rest), cells)

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isnan(value)

    def answer(self, cells: int, *leaves: Float[Array, "..."]) -> Found:
        problem = self.run(leaves[: self.movable], cells)
        return _march(VariationalProblem(problem, (), False), leaves[self.movable :], self.solver)[0]

    def with_slopes(
        self, active: tuple[int, ...], again: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Found, list[Found]]:
        problem, directions, gather = directions_by(self.run, active, leaves[: self.movable], cells)

        def run(some: tuple[Any, ...]) -> tuple[Found, list[Found]]:
            varied = VariationalProblem(problem, some, False)
            return _march(varied, leaves[self.movable :], self.solver, not again)

        found, slopes = in_groups(run, directions, TOGETHER if cells >= MANY else 1)
        return found, gather(slopes)


@eqx.filter_jit
def _march(
    varied: VariationalProblem,
    given: tuple[Array, Array, Array],
    solver: diffrax.AbstractERK,
    one_kernel: bool = True,
) -> tuple[Found, list[Found]]:
    """What is found of the cells, and its slope along each of the directions."""
    times, t1, tolerance = given
    cells = varied.problem.start()[0].shape[1]
    # One tolerance serves a block: the smallest of a batch.
    tolerance, parts = jnp.min(tolerance), 1 + len(varied.directions)
    outcome, samples = march_with_samples(
        varied,
        times if times.ndim == 1 else times.T,
        t1,
        jnp.asarray(cells),
        Settings(tolerance, solver),
        parts=parts,
        one_kernel=one_kernel,
    )
    ends = Ends(outcome.end_time, outcome.state, outcome.status == GUARD_LOST, outcome.status == FAILED)
    return _found(varied, samples, ends, outcome.steps - outcome.rejected, outcome.rejected)


class Ends(NamedTuple):
    """How runs ended: when, in what state, its variations behind it, and whether the guard was lost or the run failed."""

    time: Float[Array, "*cells"]
    state: Float[Array, "components *cells"]
    guard_lost: Bool[Array, "*cells"]
    failed: Bool[Array, "*cells"]


def _found(
    varied: VariationalProblem,
    samples: Float[Array, "*cells times components"],
    ends: Ends,
    accepted: Int[Array, "*cells"],
    rejected: Int[Array, "*cells"],
) -> tuple[Found, list[Found]]:
    """What is found, and its slope along each of the directions."""
    states, *variations = jnp.split(samples, 1 + len(varied.directions), axis=-1)
    end, *end_variations = varied.parts(ends.state)

    def end_time(problem: TrajectoryProblem, state: Float[Array, "components *cells"]) -> Float[Array, "*cells"]:
        return event_time(problem, lambda at: problem.guard(ends.time, at), ends.time, state)

    def slope(direction: Any, variation: Array, at_end: Array) -> Found:
        later = eqx.filter_jvp(end_time, (varied.problem, end), (direction, at_end))[1]
        moves = ends.guard_lost & (ends.time > 0.0)
        return Found(jnp.where(jnp.isnan(states), 0.0, variation), jnp.where(moves, later, 0.0), None, None, None)

    slopes = [slope(*one) for one in zip(varied.directions, variations, end_variations, strict=True)]
    status = ended(varied.problem, end, ends.guard_lost, ends.failed)
    return Found(states, ends.time, *(part.astype(float) for part in (status, accepted, rejected))), slopes


class SingleSampling(AbstractQuestion):
    """Samples by Diffrax, with any of its solvers; the leaves are those of `BlockSampling`."""

    in_blocks = False

    movable: int
    structure: Any = eqx.field(static=True)
    rest: Any
    solver: diffrax.AbstractSolver

    def run(self, leaves: tuple[Array, ...], cells: None) -> TrajectoryProblem:
        """The only run there is."""
        numbers = jax.tree.unflatten(self.structure, leaves)
        return TrajectoryProblem.of(*eqx.combine(numbers, self.rest))

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isnan(value)

    def answer(self, cells: int, *leaves: Float[Array, "..."]) -> Found:
        problem = self.run(leaves[: self.movable], None)
        found, _ = _follow(VariationalProblem(problem, (), False), leaves[self.movable :], self.solver)
        return jax.tree.map(lambda part: part[None], found)

    def with_slopes(
        self, active: tuple[int, ...], again: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Found, list[Found]]:
        problem, directions, gather = directions_by(self.run, active, leaves[: self.movable], None)

        def run(some: tuple[Any, ...]) -> tuple[Found, list[Found]]:
            return _follow(VariationalProblem(problem, some, False), leaves[self.movable :], self.solver)

        found, slopes = in_groups(run, directions)
        return jax.tree.map(lambda part: part[None], (found, gather(slopes)))


def _follow(
    varied: VariationalProblem, given: tuple[Array, Array, Array], solver: diffrax.AbstractSolver
) -> tuple[Found, list[Found]]:
    """What is found of a run, and its slope along each of the directions."""
    times, t1, tolerance = given
    path = sample(varied, times, t1, Settings(tolerance, solver))
    ends = Ends(path.end_time, path.end_state, path.lost, (path.end_time < t1) & ~path.lost)
    return _found(varied, path.states.T, ends, path.accepted, path.rejected)
