"""Workarounds for XLA on a CPU: for each, what it gains, the versions that need it, and when it can be removed.

Unless another version is named, gains are measured with jaxlib 0.10.2 on a core with AVX-512; `benchmarks/scaling.py`
and `benchmarks/work_precision.py` measure all of them together.
"""

import contextlib
import functools
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Primitive, Var, jaxpr_as_fun
from jax.interpreters import mlir, partial_eval
from jaxlib.version import __version__ as jaxlib_version
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree, Shaped

from ..validation import is_traced, warn

# Traced programs (jaxprs): how to make them, and how to read them equation by equation.

#: A function to be traced or compiled, of any arguments; and a traced one.
Function = Callable[..., Any]
Program = Jaxpr | ClosedJaxpr

#: An equation of a traced program, JAX's `JaxprEqn`, whose types lack the shapes of its operands.
Equation = Any

#: What stands for an array where a program is read; and a tree of arrays.
Value = TypeVar("Value")
Tree = TypeVar("Tree")


def traced(function: Function, *arguments: PyTree) -> tuple[ClosedJaxpr, PyTree]:
    """Trace a function, for those who read its operations.

    **Returns:** the program, and the tree of the shapes of its results.

    Since JAX 0.12, `jnp.searchsorted`, `jnp.interp` and `jnp.einsum` are traced as primitives of another kind, which JAX
    expands only when it compiles. Here they are expanded.
    """
    program, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    if getattr(program, "is_high", False):
        program = partial_eval.lower_jaxpr2(program)  # pyright: ignore[reportAttributeAccessIssue]
    return program, shape


def with_constants_first(program: ClosedJaxpr) -> ClosedJaxpr:
    """The program of a function whose first arguments are the values that it closes over."""
    inputs = [*program.jaxpr.constvars, *program.jaxpr.invars]
    return ClosedJaxpr(program.jaxpr.replace(constvars=[], invars=inputs), ())


def traced_once(function: Function, *examples: PyTree) -> Function:
    """The same function, which JAX traces once, for arguments like the examples, however often it is called."""
    return eqx.filter_closure_convert(lambda *arguments: function(*arguments), *examples)


def read_program(
    program: Program,
    arguments: Sequence[Value],
    apply: Callable[[Equation, list[Value]], Sequence[Value] | Program],
    known: Callable[[Any], Value] = lambda value: value,
) -> list[Value]:
    """The results of a program, whose equations are applied to values of any kind.

    **Arguments:**

    - `program`, `arguments`: the program, and the values of its arguments.
    - `apply`: function of an equation and of the values of its operands that returns the values of its results, or a
      program to be read for these operands.
    - `known`: converts a constant to a value.

    **Example:** count the operations on the way to a result.

    >>> import jax.numpy as jnp
    >>> from nonholonomic.compilation.xla_cpu import read_program, traced
    >>> program, _ = traced(lambda x: jnp.sin(x) * x + 2.0, 1.0)
    >>> read_program(program, [0], lambda equation, counts: [1 + sum(counts)], known=lambda constant: 0)
    [3]
    """
    # Until JAX 0.12, a program that is not closed has no attribute for its constants.
    constants = map(known, getattr(program, "consts", ()))
    values = dict(zip((*program.constvars, *program.invars), (*constants, *arguments), strict=True))

    def read(atom: Var | Literal) -> Value:
        return known(atom.val) if isinstance(atom, Literal) else values[atom]

    for equation in program.eqns:
        inputs = [read(atom) for atom in equation.invars]
        results = apply(equation, inputs)
        if isinstance(results, Program):
            results = read_program(results, inputs, apply, known)
        values |= dict(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in program.outvars]


def bound(equation: Equation, operands: Sequence[ArrayLike]) -> Sequence[Array]:
    """The results of an equation for other operands, by JAX."""
    results = equation.primitive.bind(*operands, **equation.primitive.get_bind_params(equation.params))
    return results if equation.primitive.multiple_results else [results]


def called_program(equation: Equation) -> Program | None:
    """The program that an equation calls, such as a compiled function; `None` if it calls none."""
    return next((equation.params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in equation.params), None)


def programs_in(program: Program, visited: set[int] | None = None) -> Iterator[Program]:
    """A program and all programs inside it, each once."""
    visited = set() if visited is None else visited
    if id(program) in visited:
        return
    visited.add(id(program))
    yield program
    for equation in program.eqns:
        for inner in programs_of(equation):
            yield from programs_in(inner, visited)


def programs_of(equation: Equation) -> list[Program]:
    """The programs among the parameters of an equation."""
    values = jax.tree.leaves(list(equation.params.values()), is_leaf=lambda value: isinstance(value, Program))
    return [value for value in values if isinstance(value, Program)]


def equations_in(program: Program) -> list[Equation]:
    """The equations of a program and of the programs inside it."""
    return [equation for inner in programs_in(program) for equation in inner.eqns]


Result = TypeVar("Result")


def _compiler(**options: Any) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """`filter_jit` with options of `jax.jit`, which Equinox's types omit; compiled functions also accept NumPy
    arrays."""
    return eqx.filter_jit(**options)


#: Vectors of 512 bits, which compilers avoid by default, make the sums over stages 1.2 to 1.6 times as fast. JAX
#: accepts compiler options only for the outermost compiled function, so this is for programs that are called on their
#: own. It has no effect without AVX-512. It can be removed when XLA prefers 512 bits by itself.
compiled_alone = _compiler(compiler_options={"xla_cpu_prefer_vector_width": 512})

_HAS_OLDER_EMITTERS = jaxlib_version.startswith("0.10.")

#: For programs that are called on their own and run only for a moment: jaxlib 0.10 compiles them in half the time
#: without the newer of its two emitters of fused operations. Loops may run slower, a table with two derivatives by a
#: quarter. It can be removed when jaxlib 0.10 is no longer supported: later versions have a single emitter, and reject
#: the option.
_OLDER_EMITTER = {"xla_cpu_use_fusion_emitters": False} if _HAS_OLDER_EMITTERS else {}
compiled_quickly = _compiler(compiler_options=_OLDER_EMITTER)

#: For a single run, also without LLVM's optimisations: a gradient through the flights of a top with a stem compiles in
#: 27 instead of 54 s (jaxlib 0.12; 0.10: 26 instead of 32 s), and takes 0.04 instead of 0.03 s; a smooth one compiles in
#: 3.6 instead of 4.1 s (2.5 instead of 3.3 s), and takes 0.019 instead of 0.013 s.
compiled_for_one = _compiler(compiler_options={**_OLDER_EMITTER, "xla_backend_optimization_level": 0})

#: XLA's flags for short jobs: without LLVM's optimisations, a module of code instead of many, and without the newer emitter.
#: The second saves a seventh of XLA's time with jaxlib 0.10. A flag that XLA does not know ends the process, and later
#: versions do not know the third.
QUICK_FLAGS = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1" + (
    " --xla_cpu_use_fusion_emitters=false" if _HAS_OLDER_EMITTERS else ""
)


def compile_quickly() -> None:
    """Compile all programs of this process with `QUICK_FLAGS`, unless XLA_FLAGS is set: for jobs of seconds.

    This halves the compile time; loops run three times as slowly. XLA reads its flags on its first use.
    """
    os.environ.setdefault("XLA_FLAGS", QUICK_FLAGS)


def chosen_device() -> Any:
    """The device, or the name of a platform, that JAX's option `jax_default_device` names; `None` without one."""
    config: Any = jax.config
    return config.jax_default_device


def current_platform() -> str:
    """The platform on which JAX runs what is called now, such as "cpu" or "gpu"."""
    chosen = chosen_device()
    return jax.default_backend() if chosen is None else getattr(chosen, "platform", chosen)


@contextlib.contextmanager
def on_cpu() -> Iterator[None]:
    """Run on the CPU what is called now, unless a device was chosen or this is inside of `jit`.

    A single run, or a few, take longer on a GPU: `python -m tippe` 54 instead of 17 s.
    """
    if current_platform() == "cpu" or chosen_device() is not None or is_traced(jnp.zeros(())):
        yield
    else:
        with jax.default_device(jax.devices("cpu")[0]):
            yield


#: For preparations that run once before a run: called on their own they are one program and not dozens of small ones,
#: each of which takes 40 ms to compile; inside other programs this has no effect.
compiled_setup = _compiler(inline=True)


def stored(*values: Float[Array, "..."] | None) -> tuple[Any, ...]:
    """The same values, computed once even if several results depend on them; `None` stays `None`.

    Otherwise XLA fuses every result with everything that leads to it, and evaluates the common part again for each
    result. A barrier alone does not prevent this. Joining the values, and putting a barrier after them, prevents it and
    makes the top's field 1.2 times as fast. It also gives all readers the same value: two kernels may round
    differently. It can be removed when XLA's fusion counts what it repeats.
    """
    present, structure = jax.tree.flatten(values)
    if not present:
        return values
    joined = jax.lax.optimization_barrier(jnp.stack(jnp.broadcast_arrays(*present)))
    return jax.tree.unflatten(structure, jnp.unstack(joined))


@jax.custom_jvp
def stored_with_tangents(*values: Float[Array, "..."] | None) -> tuple[Any, ...]:
    """The same values; in programs that differentiate them, values and tangents are `stored`.

    Without derivatives, XLA computes cheap values faster where they are used. Tangents cost more, and are used more often:
    storing them makes tables with derivatives 1.1 to 1.3 times as fast. Like `stored`, it can be removed when XLA's
    fusion counts what it repeats.
    """
    return values


@stored_with_tangents.defjvp
def _stored_tangents(values: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    return stored(*values), stored(*tangents)


def written_in_place(stacks: Tree, entries: Tree, at: Int[Array, ""]) -> Tree:
    """A tree of stacks of arrays, (stack, ...), with one array in each stack replaced, in place.

    This makes a Runge-Kutta step 1.2 times as fast as with `at[].set`, which checks the index, or with
    `dynamic_update_index_in_dim`, which is a separate call and therefore copies. It can be removed when XLA inlines
    that call.
    """

    def written(stack: Shaped[Array, "stack ..."], entry: Shaped[Array, "..."]) -> Shaped[Array, "stack ..."]:
        start = (at, *(0 for _ in entry.shape))
        return jax.lax.dynamic_update_slice(stack, entry[None], start, allow_negative_indices=False)

    return jax.tree.map(written, stacks, entries)


def written_by_component(
    stack: Float[Array, "stack components lanes"], entry: Float[Array, "components *lanes"], at: Int[Array, ""]
) -> Float[Array, "stack components lanes"]:
    """`written_in_place` for every component separately, from where it is computed.

    If the components are joined first, they are copied twice, which costs a quarter of a Runge-Kutta step. It can be
    removed when XLA fuses a concatenation with the update that it is for.
    """
    for row, component in enumerate(entry):
        stack = jax.lax.dynamic_update_slice(stack, component[None, None], (at, row, 0), allow_negative_indices=False)
    return stack


def uncounted(is_running: Bool[Array, ""], carried: Int[Array, ""]) -> Bool[Array, ""]:
    """The condition of a loop, joined with a loop variable that is never negative.

    XLA tries to count the iterations of a loop whose condition reads a single loop variable. To do so, XLA copies
    everything that leads to the variable's next value, possibly the whole body, in every round of its simplifications.
    This takes a twelfth of the time to compile derivatives with respect to several numbers. XLA does not do this for
    conditions that read two variables. This can be removed when XLA looks at how the variable changes before it copies.
    """
    return is_running & (carried >= 0)


def least(*numbers: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
    """The least of some numbers, with the derivative of that number; NaN stays NaN.

    JAX differentiates `minimum`, `maximum` and `clip` by comparing each number with the result. If XLA computes a
    number again and rounds it differently, no number is equal, and the derivative is 0. It can be removed when JAX
    compares the numbers with each other.

    **Example:**

    >>> import jax
    >>> jax.grad(lambda x: least(2.0 * x, 1.0))(0.3).item()
    2.0
    """
    result: Any = functools.reduce(lambda a, b: jnp.where(jnp.less(a, b) | jnp.isnan(a), a, b), numbers)
    return result


def greatest(*numbers: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
    """The greatest of some numbers, with the derivative of that number, like `least`.

    **Example:**

    >>> import jax
    >>> jax.grad(lambda x: greatest(2.0 * x, 0.0))(0.3).item()
    2.0
    """
    result: Any = functools.reduce(lambda a, b: jnp.where(jnp.greater(a, b) | jnp.isnan(a), a, b), numbers)
    return result


def in_one_kernel(function: Function) -> Function:
    """A function of a tree of arrays that XLA compiles, on a CPU, into a single kernel.

    Otherwise every fused operation in the body of a loop is a separate call; for blocks that fit the first-level
    caches, calling costs as much as computing. XLA does this by itself only for loops over very small arrays. A single
    kernel is 2.5 times as fast with jaxlib 0.10.2, and 1.3 times as fast with 0.12. It can be removed when XLA's
    threshold can be set for one program.

    XLA cannot put some operations into a kernel, such as sorts, products of matrices, large sums and calls of LAPACK: a
    function that has them is unchanged.

    JAX chooses the platform when it lowers a program; on platforms other than CPUs this function has no effect
    (`jax.export` lowers for platforms that this machine does not have).
    """
    if not _knows_the_attributes():
        return function

    def called(argument: PyTree) -> PyTree:
        context = jax.make_jaxpr(jnp.negative)(0.0).jaxpr.eqns[0].ctx
        # The attributes also prevent XLA from fusing small functions inside, such as `where`, into everything that uses
        # them.
        with set_xla_metadata(**_ATTRIBUTES):
            closed, shape = traced(function, argument)
        if any(map(_is_outside, equations_in(closed))):
            return function(argument)
        program = with_constants_first(closed).jaxpr
        results = _kernel.bind(*closed.consts, *jax.tree.leaves(argument), program=program, context=context)
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return called


#: Operations for which XLA calls a library, which the code of a single kernel cannot do.
OUTSIDE_KERNELS = """
    approx_top_k cholesky conv_general_dilated debug_callback dot_general eig eigh fft ffi_call geqp3 geqrf hessenberg
    householder_product io_callback lu pure_callback qr schur sort svd top_k triangular_solve tridiagonal tridiagonal_solve
"""

#: XLA also calls a library for sums, and for the greatest or the least, of at least so many numbers.
LARGE_SUM = 4096


def _is_outside(equation: Equation) -> bool:
    """Whether XLA calls a library for an operation."""
    name = equation.primitive.name
    is_sum = name in ("reduce_sum", "reduce_max", "reduce_min")
    return name in OUTSIDE_KERNELS.split() or (is_sum and equation.invars[0].aval.size >= LARGE_SUM)


_ATTRIBUTES = {"xla_cpu_small_call": "true", "inlineable": "false"}

#: A program with the attributes in all of its equations; `context` is the context of an equation without them.
_kernel = Primitive("in_one_kernel")
_kernel.multiple_results = True


@_kernel.def_impl
def _compiled_kernel(*arguments: Array, **parameters: Any) -> list[Array]:
    # Without compilation, the kernel would call itself without end.
    with jax.disable_jit(False):
        return jax.jit(functools.partial(_kernel.bind, **parameters))(*arguments)


_kernel.def_abstract_eval(lambda *arguments, program, context: [variable.aval for variable in program.outvars])


def _called_as_one(*arguments: Array, program: Jaxpr, context: Any) -> list[Array]:
    """The program as a function that is not inlined."""

    def looking_at_all(*arguments: Array) -> PyTree:
        look = sum(jnp.sum(jnp.ravel(leaf)[:1].astype(float)) for leaf in arguments)
        return jaxpr_as_fun(ClosedJaxpr(program, ()))(*arguments), look

    # XLA 0.10.2 aborts on a call with an argument that is not used. Therefore use each argument behind a barrier,
    # without which XLA would simplify the use away.
    with set_xla_metadata(**_ATTRIBUTES):
        results, _ = jax.lax.optimization_barrier(jax.jit(looking_at_all)(*jax.lax.optimization_barrier(arguments)))
    return results


def _inlined(*arguments: Array, program: Jaxpr, context: Any) -> list[Array]:
    """The program without the attributes."""
    return jaxpr_as_fun(ClosedJaxpr(_without_attributes(program, context), ()))(*arguments)


def _without_attributes(program: Any, context: Any) -> Any:
    """A program with plain contexts in its equations and those of the programs inside; other values unchanged."""
    if type(program) in (tuple, list):
        return type(program)(_without_attributes(part, context) for part in program)
    # Since JAX 0.12, a `ClosedJaxpr` is a `Jaxpr`.
    if isinstance(program, ClosedJaxpr) and program.jaxpr is not program:
        return program.replace(jaxpr=_without_attributes(program.jaxpr, context))
    if not isinstance(program, Jaxpr):
        return program
    equations = [
        part.replace(
            ctx=context, params={name: _without_attributes(value, context) for name, value in part.params.items()}
        )
        for part in program.eqns
    ]
    return program.replace(eqns=equations)


def _without_unused(use: list[bool], *arguments: Equation) -> tuple[list[bool], Equation]:
    """The equation with a program without unused computations, as JAX 0.12 prunes its own."""
    # Since JAX 0.12, a list of inputs comes before the equation.
    equation = arguments[-1]
    if not any(use):
        return [False] * len(equation.invars), None
    program = equation.params["program"]
    used_program, _ = partial_eval.dce_jaxpr(program, [True] * len(program.outvars), instantiate=True)
    return [True] * len(equation.invars), equation.replace(params={**equation.params, "program": used_program})


partial_eval.dce_rules[_kernel] = _without_unused
mlir.register_lowering(_kernel, mlir.lower_fun(_inlined, multiple_results=True))
mlir.register_lowering(_kernel, mlir.lower_fun(_called_as_one, multiple_results=True), platform="cpu")


def _knows_the_attributes() -> bool:
    """Whether the kernel attributes are known to help: they were tested with jaxlib 0.10 to 0.12."""
    if jaxlib_version.startswith(("0.10.", "0.11.", "0.12.")):
        return True
    warn(
        f"loops are compiled without XLA's kernel attributes, which are tested with jaxlib 0.10 to 0.12, but not with "
        f"{jaxlib_version}: results are the same, but tables may take up to 2.5 times as long. "
        "If that matters, install one of these versions."
    )
    return False
