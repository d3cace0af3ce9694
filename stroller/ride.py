"""One ride integrated by Diffrax, with its own derivatives."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nonholonomic.derivatives import AbstractQuestion, VariationalProblem, ask, directions_by, in_groups, probed
from nonholonomic.validation import is_traced

from .crossings import Watch, watched
from .dynamics import State
from .input import Input, at_start
from .launch import Launch
from .scene import Scene
from .table import RideProblem
from .trajectory import Stats

#: Directions whose variations are integrated together with a ride.
TOGETHER = 4

#: Scene, launch and input.
Given = tuple[Scene, Launch, Input | None]


class Settings(NamedTuple):
    """How a ride is integrated: the solver, the maximum number of steps, and Diffrax's adjoint, if any."""

    solver: diffrax.AbstractSolver
    max_steps: int
    adjoint: diffrax.AbstractAdjoint | None


def is_closed(controls: Input | None, scene: Scene, launch: Launch) -> bool:
    """Whether an input is a module, or a function that holds no number that is being differentiated or batched."""
    if controls is None or isinstance(controls, eqx.Module):
        return True
    closed = jax.make_jaxpr(controls)(*at_start(scene, launch))
    return not any(is_traced(constant) for constant in closed.consts)


def opened(controls: Any, scene: Scene, launch: Launch) -> Input:
    """A function as a module, whose leaves are the numbers that the function holds."""
    return eqx.filter_closure_convert(controls, *at_start(scene, launch))


@eqx.filter_jit
def ride(
    given: Given,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    grid: Float[Array, " steps"] | None,
    tolerance: Float[Array, ""],
    settings: Settings,
) -> tuple[State, Watch, Stats]:
    """The states at `times`, what a `Watch` follows at every step, and statistics."""
    problem = RideProblem.single(*given)
    size = len(problem.states)
    adaptive = grid is None
    whole = problem if settings.adjoint is None or not adaptive else probed(problem)
    states, watch, stats = _follow(whole, problem, 1, times, t1, grid, tolerance, settings)
    return states[:size], watch, stats


def differentiable_ride(
    given: Given,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    grid: Float[Array, " steps"] | None,
    tolerance: Float[Array, ""],
    settings: Settings,
) -> tuple[State, Watch, Stats]:
    """What `ride` gives, as a function whose derivatives take part in step control."""
    numbers, rest = eqx.partition(given, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(numbers)
    question = RideQuestion(len(leaves), structure, rest, settings, grid)
    states, watch, counts = ask(question, *leaves, jax.lax.stop_gradient(times), t1, tolerance)
    steps, rejected, finished = counts
    # A small delay moves the state along the field.
    rates = jax.lax.stop_gradient(jax.vmap(RideProblem.single(*given).field, (0, 1), 1)(times, states))
    later = times - jax.lax.stop_gradient(times)
    states = states + jnp.where(jnp.isfinite(rates), rates * later, 0.0)
    return states, Watch(*watch), Stats(steps.astype(int), rejected.astype(int), finished > 0.0)


class RideQuestion(AbstractQuestion):
    """States and watch of a ride; the leaves are those of scene, launch and input, the times, the end, the tolerance."""

    in_blocks = False

    movable: int
    # JAX's PyTreeDef, which type checkers take for a variable.
    structure: Any = eqx.field(static=True)
    rest: Any
    settings: Settings
    grid: Float[Array, " steps"] | None

    def problem(self, leaves: tuple[Array, ...], cells: int) -> RideProblem:
        """The only ride there is."""
        numbers = jax.tree.unflatten(self.structure, leaves)
        return RideProblem.single(*eqx.combine(numbers, self.rest))

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isnan(value)

    def answer(self, cells: int, *leaves: Float[Array, "..."]) -> Any:
        problem = self.problem(leaves[: self.movable], 1)
        found, _ = self._found(VariationalProblem(problem, (), False), leaves[self.movable :])
        return jax.tree.map(lambda part: part[None], found)

    def with_slopes(self, active: tuple[int, ...], again: bool, cells: int, *leaves: Float[Array, "..."]) -> Any:
        problem, directions, gather = directions_by(self.problem, active, leaves[: self.movable], None)

        def run(some: tuple[Any, ...]) -> Any:
            return self._found(VariationalProblem(problem, some, False), leaves[self.movable :])

        found, slopes = in_groups(run, directions, TOGETHER)
        return jax.tree.map(lambda part: part[None], (found, gather(slopes)))

    def _found(self, varied: VariationalProblem, given: tuple[Array, Array, Array]) -> Any:
        """States, watch and statistics as floats, and their slopes in each direction."""
        parts = 1 + len(varied.directions)
        times, t1, tolerance = given
        states, watch, stats = _follow(varied, varied.problem, parts, times, t1, self.grid, tolerance, self.settings)
        states, *variations = varied.parts(states)
        rest = (tuple(watch), tuple(jnp.asarray(count, float) for count in stats))
        slopes = [(variation, *jax.tree.map(lambda _: None, rest)) for variation in variations]
        return (states, *rest), slopes


@eqx.filter_jit
def _follow(
    whole: Any,
    problem: RideProblem,
    parts: int,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    grid: Float[Array, " steps"] | None,
    tolerance: Float[Array, ""],
    settings: Settings,
) -> tuple[State, Watch, Stats]:
    """Integrate a problem, or one whose state continues its own; of equal `parts` the one with the largest error counts."""
    start, scales = whole.start()
    size = len(problem.states)

    def norm(error: Float[Array, " components"]) -> Float[Array, ""]:
        return jnp.max(jnp.sqrt(jnp.mean(error.reshape(parts, -1) ** 2, axis=1)))

    if grid is None:
        controller = diffrax.PIDController(rtol=tolerance, atol=tolerance * jax.lax.stop_gradient(scales), norm=norm)
        # Steps end on the times of output, where interpolation would lose a digit or two.
        controller = diffrax.ClipStepSizeController(controller, step_ts=times)
    else:
        controller = diffrax.StepTo(grid)
    subs = (
        diffrax.SubSaveAt(ts=times),
        diffrax.SubSaveAt(t0=True, steps=1, fn=lambda t, y, args: (y[:size], *watched(problem.dynamics, y[:size]))),
    )
    solution: Any = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: whole.field(t, y)),
        settings.solver,
        t0=jnp.zeros_like(t1),
        t1=t1,
        dt0=None,
        y0=start,
        saveat=diffrax.SaveAt(subs=subs),
        stepsize_controller=controller,
        max_steps=settings.max_steps,
        adjoint=diffrax.ForwardMode() if settings.adjoint is None else settings.adjoint,
        throw=False,
    )
    counts, finished = solution.stats, solution.result == diffrax.RESULTS.successful
    stats = Stats(counts["num_accepted_steps"], counts["num_rejected_steps"], finished)
    states, followed = solution.ys
    return states.T, Watch(solution.ts[1], *followed), stats
