"""Steps along motions of tops and strollers, and the errors of a pair in these steps."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scenes import ANGLE, TOP, Case, of_top, scenes

import tippe
from nonholonomic.integration import AbstractProblem, Settings, solve_ensemble

from .family import STAGES, Unknowns, pair_of, unknowns_of

#: The tolerance whose steps are taken, and how much longer than those of `Dopri8` the steps are: at equal error they may be.
TOLERANCE, STRETCHES = 1e-9, (1.2, 1.8)

PLAIN = unknowns_of(diffrax.Dopri8().tableau)

States = Float[Array, "components launches"]


class Steps(NamedTuple):
    """Steps of one motion: the problem, the start states, the lengths [s], the end states, the units of errors, and the
    weight of each step."""

    problem: AbstractProblem
    starts: States
    lengths: Float[Array, " launches"]
    ends: States
    units: States
    share: Float[Array, " launches"]


def motions(launches: int) -> dict[str, Case]:
    """The scenes of `work_precision.py` without the stiff scene, a top in a sphere, and a faster top with dry
    friction."""
    top, theta = tippe.Top(*TOP), np.linspace(0.05, 0.6, launches)
    ball = tippe.Scene(top, tippe.Sphere(0.3), tippe.Viscous(0.3))
    dry = tippe.Scene(top, friction=tippe.Coulomb(0.3, 1e-2))
    cases = {name: case for name, case in scenes(launches).items() if name != "cylinder, Coulomb 1e-3"}
    cases["sphere, viscous"] = of_top(ball, tippe.Launch(theta, 120.0, eta=0.2), 3.0, None)
    cases["plane, Coulomb 1e-2"] = of_top(dry, tippe.Launch(theta, 150.0, eta=0.5), 3.0, ANGLE, False)
    return cases


def steps_of(case: Case, seed: int) -> list[Steps]:
    """Steps from random times of a motion, a set for each of `STRETCHES`."""
    problem, launches = case.problem, case.task.launches
    times = np.random.default_rng(seed).uniform(0.02, 1.0, launches) * min(case.task.t1, 6.0)
    states = solve_ensemble(problem, jnp.asarray(times), jnp.asarray(launches), Settings(1e-11))[0].state
    scales = problem.start()[1]
    absolute = 0.1 * TOLERANCE * jnp.broadcast_to(scales.reshape(len(scales), -1), states.shape)
    lengths = jnp.full(launches, 1e-4)
    for _ in range(12):
        ends, error = moved(PLAIN, problem, states, lengths)
        ratio = error / (absolute + TOLERANCE * jnp.maximum(jnp.abs(states), jnp.abs(ends)))
        lengths = lengths * jnp.clip(0.9 * jnp.mean(ratio**2, axis=0) ** (-1.0 / 16.0), 0.2, 5.0)
    counts = []
    for stretch in STRETCHES:
        ends = states
        for _ in range(16):
            ends, _ = moved(PLAIN, problem, ends, stretch * lengths / 16.0)
        units = absolute + TOLERANCE * jnp.maximum(jnp.abs(states), jnp.abs(ends))
        counts.append(shared(Steps(problem, states, stretch * lengths, ends, units, jnp.ones(launches))))
    return counts


@eqx.filter_jit
def moved(unknowns: Unknowns, problem: AbstractProblem, states: States, lengths: Any) -> tuple[States, States]:
    """The end state of a step, and its error estimate."""
    pair = pair_of(unknowns)

    def rate(state: States) -> States:
        return jnp.stack(list(problem.field(jnp.zeros_like(lengths), state)))

    rates = [rate(states)]
    for stage in range(1, STAGES):
        rates.append(rate(states + lengths * _sum(pair.stages[stage], rates)))
    return states + lengths * _sum(pair.eighth, rates), lengths * _sum(pair.eighth - pair.seventh, rates)


def _sum(weights: Float[Array, " stages"], rates: list[States]) -> States:
    return sum((weight * rate for weight, rate in zip(weights, rates, strict=False)), jnp.zeros_like(rates[0]))


@eqx.filter_jit
def errors(unknowns: Unknowns, steps: Steps) -> Float[Array, "components launches"]:
    """The weighted errors of the steps, in their units."""
    ends, _ = moved(unknowns, steps.problem, steps.starts, steps.lengths)
    return jnp.where(steps.share > 0.0, (ends - steps.ends) / steps.units, 0.0) * steps.share


#: Their slopes by the unknowns.
slopes = eqx.filter_jit(jax.jacfwd(errors))


def shared(steps: Steps) -> Steps:
    """The steps with weights such that the errors of `Dopri8` have the norm 1 and all steps count about equally."""
    plain_error = jnp.sum(errors(PLAIN, steps) ** 2, axis=0)
    is_finite = jnp.isfinite(plain_error)
    share = jnp.where(
        is_finite, 1.0 / jnp.sqrt((plain_error + 0.1 * jnp.nanmedian(plain_error)) * jnp.sum(is_finite)), 0.0
    )
    return steps._replace(share=share)
