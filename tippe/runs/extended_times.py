"""Inversion time extended smoothly past the horizon, for use in a loss function."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from nonholonomic.compilation.xla_cpu import greatest, least
from nonholonomic.derivatives import VariationalProblem, differentiable_solve, in_groups, tangents_by
from nonholonomic.integration import Lanes, Settings, crossing_time, traced_solve_ensemble
from nonholonomic.integration.settings import MOST_STEPS
from nonholonomic.integration.status import CROSSED, FAILED
from nonholonomic.progress import status_line
from nonholonomic.runs import EventTime
from nonholonomic.validation import as_number

from ..model.launch import Launch
from ..model.scene import Scene
from ..model.state import inclination, parts
from ..modes.inversion_problem import InversionProblem
from .checks import check_event, check_run, check_smooth
from .model import TopModel

#: The least angle [rad] distinguished from 0 in the penalty for a top that does not invert.
LEAST_ANGLE = 1e-6


@status_line("simulating")
def extended_inversion_time(
    scene: Scene,
    launch: Launch,
    t1: float | Float[Array, ""],
    angle: Float[ArrayLike, ""] = 0.95 * math.pi,
    tolerance: float | Float[Array, ""] = 1e-8,
) -> Float[Array, ""]:
    """Inversion time, continued beyond the horizon, for loss functions: the result is finite everywhere, and its slope
    leads back to inversion.

    If a top has not inverted, and is at theta at `t1` or when it loses contact, the result is
    t1 (1 + log(angle / theta) / C) with C = log(angle / theta at the launch), at least 1. This is a penalty, not a
    prediction. Where theta grows as exp(s t), as it does from small angles, the penalty is linear in the rate s. It then
    continues the time C / s with the same value and slope at `t1`.

    The function works under `jit`, `vmap`, `grad`, `jvp` and their compositions. The derivatives of the time (implicit
    function theorem) and of the penalty are with respect to every number except `t1` and `tolerance`.

    **Arguments:**

    - `scene`, `launch`, `t1`, `angle`: as for `inversion_time`; all numbers must be scalars.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].

    **Returns:** the time [s]; NaN where the integration failed or numbers inside a transformation are out of range.

    **Raises:** `ValueError` for arguments out of range, and for a scene with `contact="hybrid"` or `SetValuedCoulomb`.

    **Example:** this top does not invert by 3 s, so the result is a later time.

    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=3.0e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> print(3.0 < tippe.extended_inversion_time(scene, tippe.Launch(0.2, 60.0), t1=3.0) < 10.0)
    True
    """
    check_run(scene, launch, t1, tolerance)
    check_event(angle, "first")
    check_smooth(scene, "extended_inversion_time")
    # A fit may try parameters that are far off.
    settings = Settings(as_number(tolerance), max_steps=MOST_STEPS)
    return time_of_inversion(TopModel.timed(scene, launch, as_number(angle)), t1, settings)


def time_of_inversion(model: TopModel, t1: Any, settings: Settings) -> Float[Array, ""]:
    """The extended time of a smooth model until its angle, for checked arguments."""
    return differentiable_solve(*ExtendedTime.of(model, t1, settings, False))


class ExtendedTime(EventTime):
    """Extended inversion times of cells."""

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        # Every run has a time. A select on NaN would make the derivative of a failed run zero.
        return jnp.zeros(jnp.shape(value), bool)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> Float[Array, " cells"]:
        return self._extended((), self.model(leaves).problem(cells, ()), leaves, cells)[0]

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        def build(floats: tuple[Array, ...], cells: int | None) -> Any:
            return self.model((*floats, *leaves[self.movable :])).problem(cells, ())

        problem, tangents, gather = tangents_by(build, active, leaves[: self.movable], cells)
        times, slopes = in_groups(lambda group: self._extended(group, problem, leaves, cells, nested), tangents)
        return times, gather(slopes)

    def _extended(
        self, tangents: tuple[Any, ...], problem: Any, leaves: tuple[Array, ...], cells: int, nested: bool = False
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        """The extended times of every cell, and their derivatives along tangents (as of `VariationalProblem`)."""
        is_legal, t1, settings = self.permitted(leaves)
        variational = VariationalProblem(problem, tangents, True)
        outcome, _ = traced_solve_ensemble(
            variational, t1, jnp.asarray(cells), settings, one_kernel=not nested, n_blocks=1 + len(tangents)
        )
        state, *variations = variational.parts(outcome.state)
        has_crossed = outcome.status == CROSSED

        def extended(problem: InversionProblem, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
            # A cell that starts beyond the angle has reached it at time 0.
            time = jnp.where(outcome.end_time > 0.0, crossing_time(problem, outcome.end_time, state), 0.0)
            end, start = (inclination(parts(states).axis) for states in (state, problem.states))
            return jnp.where(has_crossed, time, beyond_horizon(end, start, jnp.arccos(problem.cos_angle), t1))

        is_good = is_legal & (outcome.status != FAILED)
        times = jnp.where(is_good, extended(problem, state), jnp.nan)
        slopes = [
            jnp.where(is_good, eqx.filter_jvp(extended, (problem, state), direction)[1], jnp.nan)
            for direction in zip(tangents, variations, strict=True)
        ]
        return times, slopes


def beyond_horizon(end: Lanes, start: Lanes, angle: Any, t1: Any) -> Lanes:
    """The time [s] of a top that has not inverted by `t1`, with theta at the end and at the start of the run [rad]; see
    `extended_inversion_time`."""

    def e_folds(theta: Lanes) -> Lanes:
        """Number of e-folds by which theta must still grow to reach the angle."""
        return jnp.log(angle / least(greatest(theta, LEAST_ANGLE), angle))

    return t1 * (1.0 + e_folds(end) / greatest(e_folds(start), 1.0))
