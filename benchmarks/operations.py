"""Count the operations of a program in what JAX traces; nothing is compiled, so the machine does not matter."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn
from jax.interpreters.partial_eval import dce_jaxpr

from nonholonomic.integration import AbstractProblem, LaneState, Settings
from nonholonomic.integration.scheduler import LaneScheduler
from nonholonomic.integration.step import try_step

#: Primitives that count as one operation per number of the result.
ARITHMETIC = (
    "add",
    "add_any",
    "sub",
    "mul",
    "div",
    "sqrt",
    "rsqrt",
    "max",
    "min",
    "neg",
    "abs",
    "square",
    "integer_pow",
)

#: Functions that cost as much as 16 to 44 operations, and are counted separately.
FUNCTIONS = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp", "exp2", "expm1")
FUNCTIONS += ("log", "log1p", "logistic", "pow", "cbrt", "erf", "erf_inv")


class Operations(NamedTuple):
    """Arithmetic operations, and calls of slow functions."""

    arithmetic: float
    functions: float

    def times(self, factor: float) -> "Operations":
        """The operations of a program that runs several times."""
        return Operations(factor * self.arithmetic, factor * self.functions)

    def __add__(self, other: "Operations") -> "Operations":
        return Operations(self.arithmetic + other.arithmetic, self.functions + other.functions)


NONE = Operations(0.0, 0.0)


def operations(function: Callable[..., Any], *arguments: Any) -> Operations:
    """Count the operations that lead to a function's results.

    A loop of known length counts as many times as it runs, any other loop once. Of two branches, the shorter one
    counts: the other is for rare cases. Of more branches, the mean counts, which is exact if a loop over the stages of
    a step takes each of them once.

    **Arguments:** `arguments`: may be shapes alone.
    """
    program = eqx.filter_make_jaxpr(function)(*arguments)[0].jaxpr
    return _of_program(dce_jaxpr(program, [True] * len(program.outvars))[0])


def operations_per_step(problem: AbstractProblem, n_blocks: int = 1) -> Operations:
    """Count the operations of one attempted step of one lane: stages, error, step-size control and event.

    **Arguments:** `problem`: its numbers may be shapes alone; `n_blocks`: as for `Control`.
    """
    cells = _states(problem).shape[1]
    settings, t1 = Settings(1e-9, lanes=cells), jnp.asarray(30.0)
    scheduler = eqx.filter_eval_shape(LaneScheduler.of, problem, t1, jnp.asarray(cells), settings, n_blocks=n_blocks)
    lane_state = eqx.filter_eval_shape(lambda scheduler: scheduler.start().lane_state, scheduler)

    def step(scheduler: LaneScheduler, lane_state: LaneState) -> LaneState:
        return try_step(*scheduler.in_lanes(lane_state), lane_state)

    return operations(step, scheduler, lane_state).times(1.0 / cells)


def operations_of_field(problem: AbstractProblem) -> Operations:
    """Count the operations of one evaluation of a problem's vector field in one lane. **Arguments:** as above."""
    states = _states(problem)
    times = jax.ShapeDtypeStruct(states.shape[1:], states.dtype)
    return operations(lambda problem, *arguments: problem.field(*arguments), problem, times, states).times(
        1.0 / states.shape[1]
    )


def _states(problem: AbstractProblem) -> Any:
    return eqx.filter_eval_shape(lambda problem: problem.start()[0], problem)


def _of_program(program: Jaxpr) -> Operations:
    total = NONE
    for equation in program.eqns:
        inner = [_of_program(getattr(subprogram, "jaxpr", subprogram)) for subprogram in _programs(equation)]
        if equation.primitive.name == "cond":
            total += min(inner) if len(inner) == 2 else sum(inner, NONE).times(1.0 / len(inner))
        else:
            total += sum(inner, NONE).times(equation.params.get("length", 1))
        size = max((float(variable.aval.size) for variable in equation.outvars), default=0.0)
        if equation.primitive.name in ARITHMETIC:
            total += Operations(size, 0.0)
        elif equation.primitive.name in FUNCTIONS:
            total += Operations(0.0, size)
    return total


def _programs(equation: JaxprEqn) -> Iterator[Jaxpr | ClosedJaxpr]:
    """The programs among the parameters of an equation: branches, bodies, called functions."""

    def is_program(parameter: Any) -> bool:
        return isinstance(parameter, Jaxpr | ClosedJaxpr)

    return filter(is_program, jax.tree.leaves(equation.params, is_leaf=is_program))
