"""Traced programs (jaxprs): how to make them, and how to read them equation by equation."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jax.interpreters import partial_eval


def traced(function: Callable[..., Any], *arguments: Any) -> tuple[ClosedJaxpr, Any]:
    """Trace a function, for those who read its operations.

    **Returns:** the program, and the tree of the shapes of its results.

    Since JAX 0.12, `jnp.searchsorted`, `jnp.interp` and `jnp.einsum` are traced as primitives of another kind, which JAX
    expands only when it compiles. Here they are expanded.
    """
    program, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    if getattr(program, "is_high", False):
        program = partial_eval.lower_jaxpr2(program)  # pyright: ignore[reportAttributeAccessIssue]
    return program, shape


def opened(program: Any) -> tuple[Jaxpr, Sequence[Any]]:
    """A program without its constants, and the constants."""
    return (program.jaxpr, program.consts) if isinstance(program, ClosedJaxpr) else (program, ())


def read_program(
    program: Any,
    arguments: Sequence[Any],
    apply: Callable[[Any, list[Any]], Sequence[Any]],
    known: Callable[[Any], Any] = lambda value: value,
) -> list[Any]:
    """The results of a program, whose equations are applied to values of any kind.

    **Arguments:**

    - `program`, `arguments`: the program, and the values of its arguments.
    - `apply`: function of an equation and of the values of its operands that returns the values of its results.
    - `known`: converts a constant to a value.

    **Example:** count the operations on the way to a result.

    >>> import jax.numpy as jnp
    >>> from nonholonomic.compilation.programs import read_program, traced
    >>> program, _ = traced(lambda x: jnp.sin(x) * x + 2.0, 1.0)
    >>> read_program(program, [0], lambda equation, counts: [1 + sum(counts)], known=lambda constant: 0)
    [3]
    """
    jaxpr, constants = opened(program)
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*map(known, constants), *arguments), strict=True))

    def read(atom: Any) -> Any:
        return known(atom.val) if isinstance(atom, Literal) else values[atom]

    for equation in jaxpr.eqns:
        results = apply(equation, [read(atom) for atom in equation.invars])
        values |= dict(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def bound(equation: Any, operands: Sequence[Any]) -> Sequence[Any]:
    """The results of an equation for other operands, by JAX."""
    results = equation.primitive.bind(*operands, **equation.primitive.get_bind_params(equation.params))
    return results if equation.primitive.multiple_results else [results]


def called_program(equation: Any) -> Any:
    """The program that an equation calls, such as a compiled function; `None` if it calls none."""
    return next((equation.params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in equation.params), None)


def programs_in(program: Any, visited: set[int] | None = None) -> Iterator[Any]:
    """A program and all programs inside it, each once."""
    visited = set() if visited is None else visited
    if id(program) in visited:
        return
    visited.add(id(program))
    yield program
    for equation in opened(program)[0].eqns:
        for inner in programs_of(equation):
            yield from programs_in(inner, visited)


def programs_of(equation: Any) -> list[Any]:
    """The programs among the parameters of an equation."""
    return list(filter(_is_program, jax.tree.leaves(list(equation.params.values()), is_leaf=_is_program)))


def operations(program: Any) -> set[str]:
    """The names of the operations of a program and of the programs inside it."""
    return {equation.primitive.name for inner in programs_in(program) for equation in opened(inner)[0].eqns}


def _is_program(value: Any) -> bool:
    return isinstance(value, Jaxpr | ClosedJaxpr)
