"""How much of the machine's arithmetic a run uses: operations counted in the program, and the peak measured beside it."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr
from measure import timed

from nonholonomic.integration import LaneScheduler, Settings, try_step
from tippe.modes.inversion_problem import InversionProblem

#: What counts as one operation.
ARITHMETIC = ("add", "add_any", "sub", "mul", "div", "sqrt", "max", "min")

#: Independent chains of multiply-adds, and links of each, in the measurement of the peak.
CHAINS, LINKS = 8, 64


def operations_per_step(problem: InversionProblem, tolerance: float) -> float:
    """Arithmetic operations of one attempted step of one lane: stages, error, step control and event."""
    cells = problem.states.shape[1]
    scheduler = LaneScheduler.of(problem, jnp.asarray(30.0), jnp.asarray(cells), Settings(tolerance))
    lane_state = scheduler.start().lane_state
    arguments = scheduler.here(lane_state)
    return (
        _counted(jax.make_jaxpr(lambda lane_state: try_step(*arguments, lane_state))(lane_state).jaxpr)
        / scheduler.lanes
    )


def _counted(jaxpr: Jaxpr) -> float:
    """Operations on arrays: one for each element of the result."""
    total = 0.0
    for equation in jaxpr.eqns:
        inner = [value for value in equation.params.values() if isinstance(value, ClosedJaxpr | Jaxpr)]
        total += sum(_counted(one.jaxpr if isinstance(one, ClosedJaxpr) else one) for one in inner)
        if equation.primitive.name in ARITHMETIC:
            total += max(float(variable.aval.size) for variable in equation.outvars)
    return total


def peak() -> float:
    """Operations per second [1/s] that multiply-adds on registers reach: on one core of a CPU, or on all of an accelerator."""
    on_cpu = jax.default_backend() == "cpu"
    elements, rounds = (1 << 11, 2000) if on_cpu else (1 << 24, 20)

    def links(values: Any) -> Any:
        chains = [values + 0.1 * k for k in range(CHAINS)]
        for _ in range(LINKS):
            chains = [chain * values + 0.5 for chain in chains]
        return 1e-3 * sum(chains)

    run = jax.jit(lambda values: jax.lax.fori_loop(0, rounds, lambda _, now: links(now), values))
    values = jnp.linspace(0.0, 0.5, elements)
    found = timed(lambda: run(values), 3)
    return 2.0 * CHAINS * LINKS * elements * rounds / (found.cpu if on_cpu else found.wall)
