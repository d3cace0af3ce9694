"""Kernels: a run as a program in CUDA C, and how the numbers of many runs are laid out for it."""

import dataclasses
import functools
from collections.abc import Callable, Hashable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ..derivatives import VariationalProblem
from ..derivatives.adjoint import slope_of_event
from ..derivatives.variation import Tangents, slopes_at_event
from ..hybrid import AbstractBatchedMode, HybridOutcome
from ..integration import AbstractProblem, Outcome, Settings
from ..text import is_array
from .motions import HybridRuns, HybridStart, Part, SmoothRuns, size_of
from .scalar_code import CUDA, scalar_code

#: Runs the cells of a kernel, given the numbers that all cells share, those of each cell, (numbers, cells), and how many cells
#: to run. Returns the results, (results, cells).
Runner: TypeAlias = Callable[
    ["Kernel", Float[np.ndarray, " shared"], Float[np.ndarray, "numbers cells"], int],
    Float[np.ndarray, "results cells"],
]

#: The loops, which precede every kernel.
LOOPS = Path(__file__).with_name("loops.cu")

#: Greatest number of characters of a program: NVIDIA's compiler takes 24 s for a million.
MOST_TEXT = 1_200_000

#: Functions with more lines than the first number are called, not written out. For those that are not part of a step, and so
#: run seldom, it is the second one.
MOST_IN_STEPS, MOST_OUTSIDE = 1500, 300
IN_STEPS = ("length", "field", "margins", "crossing", "after")


class Kernel(NamedTuple):
    """A kernel: the text of a program whose function `run_cells` runs cells; and the number of results of a cell."""

    text: str
    results: int


@dataclasses.dataclass(frozen=True)
class Recipe:
    """What determines a kernel: solves with equal recipes share it.

    - `static`, `structure`: what is not an array in the arguments of a solve, and the structure of the arguments.
    - `kinds`: shape and type of each array for a single run; arrays with an axis have the cell in the last one.
    - `options`: names and values of the options of `SmoothRuns` or `HybridRuns`.
    """

    static: tuple[Hashable, ...]
    structure: Any
    kinds: tuple[tuple[tuple[int, ...], str], ...]
    options: tuple[tuple[str, Any], ...]

    @classmethod
    def of(cls, arguments: PyTree, options: dict[str, Any]) -> "Recipe":
        arrays, static = eqx.partition(arguments, is_array)
        leaves = [np.shape(leaf) for leaf in jax.tree.leaves(arrays)]
        kinds = zip(leaves, (str(jnp.result_type(leaf)) for leaf in jax.tree.leaves(arrays)), strict=True)
        of_one = tuple(((*shape[:-1], 1) if shape else (), kind) for shape, kind in kinds)
        rest, structure = jax.tree.flatten(static, is_leaf=lambda leaf: leaf is None)
        return cls(tuple(rest), (structure, jax.tree.structure(arrays)), of_one, tuple(options.items()))

    @property
    def values(self) -> PyTree:
        """The arrays of a single run, by shape and type."""
        leaves = [jax.ShapeDtypeStruct(shape, np.dtype(kind)) for shape, kind in self.kinds]
        return jax.tree.unflatten(self.structure[1], leaves)

    def arguments(self, values: PyTree) -> Any:
        """The arguments of a solve from their arrays."""
        return eqx.combine(values, jax.tree.unflatten(self.structure[0], self.static))

    def read(self, values: PyTree, state: Float[Array, "components 1"]) -> PyTree:
        """What `solve_smooth_with_samples` samples, from the arrays of its arguments and a state."""
        return self.arguments(values)[3](state)


def solve_smooth(
    problem: AbstractProblem,
    t1: Float[Array, "..."],
    count: Int[Array, ""] | int,
    settings: Settings,
    *,
    run: Runner,
    nonterminal: bool = False,
    n_blocks: int = 1,
) -> Outcome[np.ndarray]:
    """`solve_ensemble` by a kernel. **Arguments:** as there, and `run`: runs a kernel."""
    cells = problem.start()[0].shape[1]
    arguments = (problem, jnp.asarray(t1), settings)
    return _solved(arguments, cells, int(count), run, {"passes": nonterminal, "n_blocks": n_blocks})[0]


def solve_smooth_with_samples(
    problem: AbstractProblem,
    times: Float[np.ndarray, " times"],
    t1: Float[Array, "..."],
    count: Int[Array, ""] | int,
    settings: Settings,
    *,
    run: Runner,
    read: Callable[[Float[Array, "components 1"]], PyTree],
) -> tuple[Outcome[np.ndarray], PyTree]:
    """`solve_with_samples` by a kernel, in which a shorter step from the same start leads to each sample.

    **Arguments:** as there, and `run`: runs a kernel; `read`: an `equinox.Module`, a function of the state of one run whose
    numbers have the cells in their last axis.
    """
    cells, arguments = problem.start()[0].shape[1], (problem, jnp.asarray(t1), settings, read)
    options = {"passes": False, "n_blocks": 1, "times": len(times)}
    outcome, rows = _solved(arguments, cells, int(count), run, options, times)
    recipe, state = Recipe.of(arguments, options), jax.ShapeDtypeStruct((len(outcome.state), 1), outcome.state.dtype)
    kinds = eqx.filter_eval_shape(recipe.read, recipe.values, state)
    leaves, structure = jax.tree.flatten(kinds)
    parts = np.split(rows.reshape(len(times), -1, cells), np.cumsum(list(map(size_of, leaves)))[:-1], axis=1)
    samples = [
        np.moveaxis(part, -1, 0).reshape(cells, len(times), *leaf.shape)
        for part, leaf in zip(parts, leaves, strict=True)
    ]
    return outcome, jax.tree.unflatten(structure, samples)


def solve_smooth_with_tangents(
    problem: AbstractProblem,
    tangents: Tangents,
    t1: Float[Array, "..."],
    count: Int[Array, ""] | int,
    settings: Settings,
    *,
    run: Runner,
    nonterminal: bool = False,
) -> tuple[Outcome[np.ndarray], list[Float[Array, " cells"]]]:
    """`solve_ensemble_with_tangents` by a kernel: a thread carries a run and one variation. **Arguments:** as there, and
    `run`: runs a kernel."""
    outcome, slopes = solve_smooth(problem, t1, count, settings, run=run, nonterminal=nonterminal), []
    # The derivatives need the run only up to the event, whose time is now known.
    t1 = jnp.where(jnp.isfinite(outcome.crossing_time), outcome.crossing_time, 0.0) if nonterminal else t1
    for tangent in tangents:
        variational = VariationalProblem(problem, (tangent,), not nonterminal)
        ended = solve_smooth(variational, t1, count, settings, run=run, n_blocks=2)
        slopes.append(_slope(variational, outcome, ended, nonterminal))
    return outcome, slopes


@eqx.filter_jit
def _slope(
    variational: VariationalProblem, outcome: Outcome, ended: Outcome, nonterminal: bool
) -> Float[Array, " cells"]:
    """The derivative of the times of the events, from runs without and with their variations."""
    ended, (slope,) = slopes_at_event(variational, ended)
    return slope_of_event(outcome, ended, slope, nonterminal)


def solve_in_modes(
    modes: tuple[AbstractBatchedMode, ...],
    mode: Int[np.ndarray, " cells"],
    state: Float[np.ndarray, "components cells"],
    t1: float | Float[np.ndarray, "*cells"],
    count: Int[Array, ""] | int,
    settings: Settings,
    *,
    run: Runner,
    counters: int,
    nonterminal: bool = False,
    n_blocks: int = 1,
) -> HybridOutcome[np.ndarray]:
    """`solve_hybrid` by a kernel. **Arguments:** as there, and `run`: runs a kernel."""
    horizon = np.broadcast_to(np.asarray(t1, float), len(mode))
    arguments: PyTree = (modes, np.asarray(mode), np.asarray(state), horizon, settings)
    options = {"counters": counters, "passes": nonterminal, "n_blocks": n_blocks}
    return _solved(arguments, len(mode), int(count), run, options)[0]


def _solved(
    arguments: PyTree,
    cells: int,
    count: int,
    run: Runner,
    options: dict[str, Any],
    times: Float[np.ndarray, " times"] = np.zeros(0),  # noqa: B008  Nothing changes it.
) -> Any:
    """The outcome of some cells, zero for padding, and the rows of their samples at some times."""
    kernel, outcome = kernel_of(Recipe.of(arguments, options))
    shared, columns = [np.zeros(0)], [np.zeros((0, cells))]
    for leaf in map(np.asarray, jax.tree.leaves(eqx.filter(arguments, is_array))):
        (columns if leaf.ndim else shared).append(leaf.reshape(-1, *leaf.shape[-1:]).astype(float))
    results = run(kernel, np.concatenate([*shared, times]), np.concatenate(columns), count)
    *parts, samples = np.split(results, np.cumsum([size_of(part) for part in outcome]))
    # The parts of an outcome are numbers, or lists of numbers.
    return outcome._make(
        values.reshape(*part.shape[:-1], cells).astype(part.dtype) for values, part in zip(parts, outcome, strict=True)
    ), samples


@functools.lru_cache(maxsize=64)
def kernel_of(recipe: Recipe) -> tuple[Kernel, Outcome | HybridOutcome]:
    """The kernel of a recipe, and shapes and types of the outcome of a cell."""
    values, options = recipe.values, dict(recipe.options)
    if "counters" in options:
        runs = HybridRuns(lambda values: HybridStart(*recipe.arguments(values)), **options)
        rounds, kinds = runs.parts(values)
        outcome = jax.eval_shape(runs.first, values)
        offsets = {f"runs_{name}": rounds.facts["runs"][name] for name in ("status", "mode")}
        structs = [_struct(f"Mode{k}", kind, offsets | {"left": rounds.facts["left"]}) for k, kind in enumerate(kinds)]
        cases = [
            f"if (runs[runs_mode] == {number}) {{ one_round<Mode{kind}>(values, runs); return; }}"
            for number, kind in enumerate(rounds.facts["modes"])
        ]
        advance = ["DEVICE static void advance(const double* values, double* runs) {", *cases, "}"]
        facts = {name: rounds.facts[name] for name in ("rounds", "running", "unresolved")} | offsets
        structs.append(_struct_of("Rounds", facts, [_function("first", rounds), "\n".join(advance)]))
        run, samples = "run_rounds<Rounds>(values, outcome);", 0
    else:
        times = options.pop("times", 0)
        options["read"] = recipe.read if times else None
        part = SmoothRuns(lambda values: recipe.arguments(values)[:3], **options).part(values)
        outcome = eqx.filter_eval_shape(part.functions["ended"][0], *part.functions["ended"][1])
        structs = [_struct("Motion", part, {})]
        run, samples = "run_smooth<Motion>(values, outcome);", times * part.facts.get("quantities", 0)
        if times:
            shared = sum(leaf.shape == () for leaf in jax.tree.leaves(values))
            place = f"{{shared + {shared}, {times}, 0, results + {size_of(outcome)} * capacity + cell, capacity}}"
            run = f"run_sampled<Motion>(values, outcome, {place});"
    results = size_of(outcome)
    text = "\n".join([LOOPS.read_text(), *structs, _entry(values, results, run)])
    if len(text) > MOST_TEXT:
        raise ValueError(f"its program of {len(text):_} characters is too long for a kernel")
    return Kernel(text, results + samples), outcome


def _function(name: str, part: Part) -> str:
    """The text of a function of a part."""
    function, examples = part.functions[name]
    text = scalar_code(CUDA, name, function, *examples)
    is_called = text.count("\n") > (MOST_IN_STEPS if name in IN_STEPS else MOST_OUTSIDE)
    return text.replace("DEVICE", "CALLED", 1) if is_called else text


def _struct_of(name: str, facts: dict[str, int], functions: list[str]) -> str:
    """A type with constants and functions."""
    constants = [f"static constexpr int {fact} = {int(value)};" for fact, value in facts.items()]
    return "\n".join([f"struct {name} {{", *constants, *functions, "};", ""])


def _struct(name: str, part: Part, more: dict[str, int]) -> str:
    """The type of a smooth motion, as `loops.cu` reads it. **Arguments:** `more`: further constants."""
    facts, stages = part.facts, len(part.facts["stages"])
    crossing = eqx.filter_eval_shape(part.functions["crossing"][0], *part.functions["crossing"][1])
    numbers = {name: facts[name] for name in ("components", "constants", "running", "margins_count")}
    numbers |= {
        f"lane_{name}": facts["lane"][name] for name in ("status", "time", "state", "rate", "margins", "side", "size")
    }
    numbers |= {"stages": stages, "looks": len(facts["looks"]), "has_event": crossing is not None}
    numbers |= {name: facts.get(name, 0) for name in ("most_hops", "stretch", "quantities")} | more
    # After the stages come the end of the step, its error and its middle.
    sums = [
        " + ".join(f"{weight!r} * rates[{stage}][k]" for stage, weight in enumerate(weights) if weight != 0.0) or "0.0"
        for weights in (*facts["stages"], facts["step"], facts["error"], facts["middle"])
    ]
    looks = [facts["looks"].index(k) + 1 if k in facts["looks"] else 0 for k in range(stages)]
    tables = [
        _by_stage("double", "sum", f"const double (*rates)[{numbers['components']}], int k", sums),
        _by_stage("constexpr double", "place", "", map(repr, facts["places"])),
        _by_stage("constexpr int", "look", "", map(str, looks)),
    ]
    return _struct_of(name, numbers, [*tables, *(_function(function, part) for function in part.functions)])


def _by_stage(result: str, name: str, arguments: str, texts: Iterable[str]) -> str:
    """A function of the number of a stage that returns one of several expressions."""
    cases = " else ".join(f"if constexpr (stage == {stage}) return {text};" for stage, text in enumerate(texts))
    return f"template <int stage> DEVICE static {result} {name}({arguments}) {{ {cases} }}"


def _entry(values: PyTree, results: int, run: str) -> str:
    """The function that runs cells: it takes one after another from a queue."""
    loads, shared, columns = [], 0, 0
    for leaf in jax.tree.leaves(values):
        for _ in range(int(np.prod(leaf.shape))):
            source = f"columns[{columns} * capacity + cell]" if leaf.shape else f"shared[{shared}]"
            loads.append(f"values[{len(loads)}] = {source};")
            columns, shared = columns + bool(leaf.shape), shared + (not leaf.shape)
    return "\n".join(
        [
            "KERNEL run_cells(const double* shared, const double* columns, double* results, long long capacity,",
            "                 unsigned long long end, unsigned long long* queue) {",
            "  for (unsigned long long cell = NEXT; cell < end; cell = NEXT) {",
            f"    double values[{max(len(loads), 1)}], outcome[{results}];",
            *(f"    {load}" for load in loads),
            f"    {run}",
            f"    UNROLLED for (int k = 0; k < {results}; k++) results[k * capacity + cell] = outcome[k];",
            "  }",
            "}",
            "",
        ]
    )
