"""Pages with sliders that simulate in the browser: their contents, their equations of motion as JavaScript generated from
jaxprs, and how all parts are combined into one file.
"""

import functools
import itertools
import json
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from ..compilation.components import AbstractScalarReader, rows_along
from ..compilation.xla_cpu import Equation, Program, called_program, programs_of, traced
from ..hybrid import MOST_ROUNDS, AbstractBatchedMode, AbstractHoppingMode, HybridOutcome
from ..hybrid.ensemble import after_reset, after_solve, at_start, mode_numbered, program_groups
from ..integration import AbstractProblem, Lanes, LaneState, Settings, explicit_tableau
from ..integration.problem import LEFT_DOMAIN, RUNNING, UNRESOLVED, Status
from ..integration.runge_kutta import Step, inner_stages, middle_weights, watched_places
from ..integration.scheduler import LaneScheduler, back_to_margin, outcome_of, with_crossing_times
from ..integration.step import Control, after_step, length_to_try, looks_of
from ..text import Unit
from .pages import Page, page, script, template
from .stage import Kind, Stage, converted, curves_in

# Convert a function that JAX can trace to a JavaScript function of the same numbers.
#
# The function's jaxpr is written element by element: an array becomes one scalar per element. Slices, stacks and similar
# operations then cost nothing, and unused elements are omitted. Loops and branches that depend on numbers stay loops and
# branches. No existing package converts jaxprs to JavaScript.

#: A number: a Python number if known, otherwise its name or text in JavaScript. A value is an array of numbers.
Number = str | float
Value = np.ndarray
Values = list[Value]

#: JavaScript for elementwise operations.
_MATH = (
    "abs sqrt cbrt sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp expm1 log log1p log2 sign floor ceil"
)
_PAIRS = {"add": "+", "add_any": "+", "sub": "-", "mul": "*", "div": "/", "rem": "%", "eq": "==", "ne": "!=", "lt": "<"}
_PAIRS |= {"le": "<=", "gt": ">", "ge": ">=", "and": "&", "or": "|", "xor": "^"}
ELEMENTWISE = {name: f"Math.{name}({{}})" for name in _MATH.split()}
ELEMENTWISE |= {name: f"{{}} {sign} {{}}" for name, sign in _PAIRS.items()}
ELEMENTWISE |= {name: f"Math.{name}({{}}, {{}})" for name in ("max", "min", "pow", "atan2")}
ELEMENTWISE |= {
    "neg": "-{}",
    "square": "{0} * {0}",
    "one_minus_square": "(1 + {0}) * (1 - {0})",
    "rsqrt": "1 / Math.sqrt({})",
    "exp2": "Math.pow(2, {})",
}
ELEMENTWISE |= {"clamp": "Math.min(Math.max({1}, {0}), {2})", "logistic": "1 / (1 + Math.exp(-{}))"}
ELEMENTWISE |= {"is_finite": "Number.isFinite({})"}
# The order in which `jnp.searchsorted` and `jnp.interp` sort: NaN comes last.
ELEMENTWISE |= {"lt_to": "{0} < {1} || ({1} != {1} && {0} == {0})", "le_to": "{0} <= {1} || {1} != {1}"}
CHOICE = "{0} ? {2} : {1}"

#: Elementwise operations that Python evaluates if all numbers are known, mostly for indices.
KNOWN: dict[str, Callable[..., Number]] = {
    name: getattr(operator, name) for name in ("add", "sub", "mul", "lt", "le", "gt", "ge", "eq", "ne")
}
KNOWN |= {"max": max, "min": min, "clamp": lambda low, value, high: min(max(value, low), high)}
KNOWN |= {CHOICE: lambda which, no, yes: yes if which else no}

#: Operations that move elements to indices given by operands, and the positions of these operands.
INDEXED = {"dynamic_slice": slice(1, None), "dynamic_update_slice": slice(2, None), "gather": slice(1, 2)}
INDEXED["scatter"] = slice(1, 2)

SAME = ("stop_gradient", "optimization_barrier", "copy", "copy_p", "reduce_precision")

#: Loops with at most this many iterations are unrolled, unless that writes more than this many statements.
WRITTEN_OUT, MOST_STATEMENTS = 16, 4000

#: Marks the exit of a loop among the names.
LEAVES = "break"


def javascript(name: str, function: Callable[..., Any], *arguments: Any) -> str:
    """A function in JavaScript.

    **Arguments:**

    - `name`: name of the function in JavaScript.
    - `function`: a function that JAX can trace.
    - `arguments`: examples of its arguments, arrays or trees of arrays.

    **Returns:** the text of a JavaScript function. For each argument it takes a list of numbers: the elements of all
    leaves, one after another. Its last argument is a list that it fills with the results and returns.

    **Raises:** `ValueError` for an unsupported primitive of JAX.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> from nonholonomic.views.explore import javascript
    >>> print(javascript("turn", lambda x: jnp.stack([-x[1], x[0] ** 2]), jnp.zeros(2)))
    function turn(a0, out) {
      const v0 = a0[0];
      const v1 = a0[1];
      const v2 = -v1;
      const v3 = v0 * v0;
      out[0] = v2;
      out[1] = v3;
      return out;
    }

    ```
    """
    block, values = _Block(itertools.count(), {}), []
    for number, argument in enumerate(arguments):
        names = (f"a{number}[{place}]" for place in itertools.count())
        shapes = [np.zeros(leaf.shape) for leaf in jax.tree.leaves(argument)]
        values += [_map(lambda _, names=names: block.name(next(names)), shape) for shape in shapes]
    results = _flat(block.read(traced(function, *arguments)[0], values))
    statements = [f"out[{k}] = {_text(number)};" for k, number in enumerate(results)]
    heads = ", ".join([*(f"a{number}" for number in range(len(arguments))), "out"])
    body = _indented([*block.leading_to(results)[0], *statements, "return out;"])
    return "\n".join([f"function {name}({heads}) {{", *body, "}", ""])


def _text(number: Number) -> str:
    text = number if isinstance(number, str) else json.dumps(number)
    return f"({text})" if text.startswith("-") else text


def _map(function: Callable[..., Number], *values: Value) -> Value:
    """Apply a function of numbers to every element of some values."""
    # NaN is NaN in JavaScript, too.
    with np.errstate(invalid="ignore"):
        return np.asarray(np.frompyfunc(function, len(values), 1)(*values), object)


class _Block(AbstractScalarReader):
    """Consecutive statements: each defines names, reads others, and has lines of text."""

    def __init__(self, names: Any, known: dict[str, str]):
        self.names, self.known = names, known
        self.statements: list[tuple[list[Number], set[str], list[str]]] = []

    def name(self, text: str, *reads: Number) -> str:
        """The name for the value of an expression, which is written only once."""
        if text not in self.known:
            self.known[text] = f"v{next(self.names)}"
            self.statements.append(([self.known[text]], set(_strings(reads)), [f"const {self.known[text]} = {text};"]))
        return self.known[text]

    def inner(self) -> "_Block":
        """A block inside this one that sees the names of this one."""
        return _Block(self.names, dict(self.known))

    def leading_to(self, needed: Sequence[Number]) -> tuple[list[str], set[str]]:
        """The lines that some numbers depend on, and the names that these lines read."""
        names, blocks = set(_strings(needed)), []
        for results, reads, lines in reversed(self.statements):
            if not names.isdisjoint(results):
                names |= reads
                blocks.append(lines)
        return [line for lines in reversed(blocks) for line in lines], names

    def constants(self, array: ArrayLike) -> Value:
        """A known array as Python numbers."""
        return np.asarray(array).astype(object)

    def apply(self, equation: Equation, inputs: Values) -> Sequence[Value] | Program:
        name, parameters = equation.primitive.name, equation.params
        if name in SAME:
            return inputs
        if name in ("while", "cond", "scan"):
            return getattr(self, f"{name}_")(inputs, **parameters)
        if (inner := called_program(equation)) is not None:
            return inner
        if name in INDEXED:
            return self.indexed(equation, inputs, range(len(inputs))[INDEXED[name]])
        if name == "cumsum":
            rows = rows_along(inputs[0], parameters["axis"])[:: -1 if parameters["reverse"] else 1]
            sums = list(itertools.accumulate(rows, functools.partial(self.each, "add")))
            return [np.stack(sums[:: -1 if parameters["reverse"] else 1], parameters["axis"])]
        if name in ("argmin", "argmax"):
            return [self.extreme("lt" if name == "argmin" else "gt", inputs[0], parameters["axes"][0])]
        return super().apply(equation, inputs)

    def kind(self, equation: Equation) -> str:
        """An elementwise operation: the name of a primitive, or JavaScript."""
        name, parameters = equation.primitive.name, equation.params
        types = [atom.aval.dtype for atom in equation.invars]
        if name == "integer_pow":
            power = " * ".join(["{0}"] * abs(parameters["y"])) or "1"
            return power if parameters["y"] >= 0 else f"1 / ({power})"
        if name == "polynomial":
            return functools.reduce(
                lambda terms, k: f"({terms}) * {{0}} + {{{k}}}", range(len(types) - 2, 0, -1), f"{{{len(types) - 1}}}"
            )
        if name == "select_n":
            chain = (f"{{0}} == {k - 1} ? {{{k}}} : " for k in range(1, len(types)))
            return CHOICE if types[0] == np.bool_ else "".join(chain) + "NaN"
        if name == "not":
            return "!{}" if types[0] == np.bool_ else "~{}"
        if name == "div" and np.issubdtype(types[0], np.integer):
            return "Math.trunc({} / {})"
        if name == "convert_element_type":
            if parameters["new_dtype"] == np.bool_:
                return "{} != 0"
            cut = np.issubdtype(parameters["new_dtype"], np.integer) and np.issubdtype(types[0], np.floating)
            return "Math.trunc({})" if cut else "+{}" if types[0] == np.bool_ else "{}"
        if name not in ELEMENTWISE:
            known = f"use some of {', '.join(sorted(ELEMENTWISE))}"
            raise ValueError(f"the primitive {name!r} of JAX cannot be written in JavaScript; {known}")
        return name

    def element(self, name: str, *numbers: Number, equation: Equation | None = None) -> Number:
        if name in KNOWN and not _strings(numbers):
            return KNOWN[name](*numbers)
        if name == "{}":
            return numbers[0]
        return self.name(ELEMENTWISE.get(name, name).format(*map(_text, numbers)), *numbers)

    def extreme(self, kind: str, value: Value, axis: int) -> Value:
        """The index of the first extreme element along an axis."""

        def choose(extreme: Values, candidate: Values) -> Values:
            is_better = self.each(kind, candidate[1], extreme[1])
            return [self.each(CHOICE, is_better, *pair) for pair in zip(extreme, candidate, strict=True)]

        rows = enumerate(rows_along(value, axis))
        return functools.reduce(choose, ([self.constants(np.full(row.shape, number)), row] for number, row in rows))[0]

    def indexed(self, equation: Equation, inputs: Values, indices: Sequence[int]) -> Values:
        """Elements at indices that may be known only in JavaScript, which then selects among all possible indices."""
        pool = _flat([value for k, value in enumerate(inputs) if k not in indices])
        unknown = [(k, place) for k in indices for place, x in np.ndenumerate(inputs[k]) if isinstance(x, str)]
        labels, values = itertools.count(), []
        labelled = [value if k in indices else _map(lambda _: next(labels), value) for k, value in enumerate(inputs)]
        # A gather beyond the end fills with a number that is not a label.
        pick = functools.partial(_map, lambda k: pool[k] if 0 <= k < len(pool) else math.nan)
        # One more than the number of elements: an index beyond the end has a separate meaning.
        options = range(max(inputs[0].shape, default=0) + 1)
        for option in itertools.product(options, repeat=len(unknown)):
            operands, matches = [value.copy() for value in labelled], []
            for (k, index), choice in zip(unknown, option, strict=True):
                operands[k][index] = choice
                matches.append(self.each("eq", np.asarray(inputs[k][index], object), self.constants(choice)))
            # An index beyond the end gives -1, which is not a label.
            parameters = equation.params | ({"fill_value": -1} if "fill_value" in equation.params else {})
            output = equation.primitive.bind(*(operand.astype(int) for operand in operands), **parameters)
            results = [pick(np.asarray(part)) for part in jax.tree.leaves(output)]
            if values:
                condition = functools.reduce(functools.partial(self.each, "and"), matches)
                results = [self.each(CHOICE, condition, *pair) for pair in zip(values, results, strict=True)]
            values = results
        return values

    def loop(self, head: str, carry: Values, step: Callable[["_Block", Values], Values]) -> Values:
        """A loop: each iteration computes the next values of the loop variables."""
        variables, starts, block = self.variables(carry), _flat(carry), self.inner()
        names = _flat(variables)
        # A loop variable may become another one, so read all of them before writing any.
        new_values = [
            block.name(f"({number})", number) if number in names and number != name else number
            for name, number in zip(names, _flat(step(block, variables)), strict=True)
        ]
        assignments = [
            f"{name} = {_text(number)};" for name, number in zip(names, new_values, strict=True) if name != number
        ]
        body, reads = block.leading_to([*new_values, LEAVES])
        lines = [f"let {name} = {_text(start)};" for name, start in zip(names, starts, strict=True)]
        lines += [f"{head} {{", *_indented([*body, *assignments]), "}"]
        self.statements.append((names, reads.union(_strings(starts)), lines))
        return variables

    def variables(self, values: Sequence[Value]) -> Values:
        """New names, one for each number in some values."""
        return [_map(lambda _: f"v{next(self.names)}", value) for value in values]

    def while_(self, inputs: Values, cond_jaxpr: Any, body_jaxpr: Any, cond_nconsts: int, body_nconsts: int) -> Values:
        of_cond, of_body = inputs[:cond_nconsts], inputs[cond_nconsts : cond_nconsts + body_nconsts]

        def step(block: "_Block", carry: Values) -> Values:
            goes_on = block.read(cond_jaxpr, [*of_cond, *carry])[0].item()
            block.statements.append(([LEAVES], set(_strings([goes_on])), [f"if (!{_text(goes_on)}) break;"]))
            return block.read(body_jaxpr, [*of_body, *carry])

        return self.loop("while (true)", inputs[cond_nconsts + body_nconsts :], step)

    def scan_(self, inputs: Values, jaxpr: Any, length: int, reverse: bool, **counts: Any) -> Values:
        first, count = counts.get("num_consts", 0), counts.get("num_carry", 0)
        if "ft_in" in counts:  # jax 0.11 and later
            first, count, _ = map(len, counts["ft_in"].unpack())
        constants, carry, rows = inputs[:first], inputs[first : first + count], inputs[first + count :]
        unrolled = length <= WRITTEN_OUT and length * _statements(jaxpr) <= MOST_STATEMENTS
        if not rows and len(jaxpr.outvars) == count and not unrolled:
            head = f"for (let k = 0; k < {length}; k++)"
            return self.loop(head, carry, lambda block, carry: block.read(jaxpr, [*constants, *carry]))
        rows_of_steps: list[Any] = [None] * length
        for k in reversed(range(length)) if reverse else range(length):
            new_values = self.read(jaxpr, [*constants, *carry, *(np.asarray(row[k], object) for row in rows)])
            carry, rows_of_steps[k] = new_values[:count], new_values[count:]
        return [*carry, *(np.stack(parts) for parts in zip(*rows_of_steps, strict=True))]

    def cond_(self, inputs: Values, branches: Sequence[Any], **_: Any) -> Values:
        number, operands = inputs[0].item(), inputs[1:]
        if not isinstance(number, str):
            return self.read(branches[int(number)], operands)
        variables = self.variables([np.empty(kind.shape) for kind in branches[0].out_avals])
        names, reads = _flat(variables), {number}
        lines = [f"let {', '.join(_strings(names))};"] if names else []
        for k, branch in enumerate(branches):
            block = self.inner()
            end = _flat(block.read(branch, operands))
            body, inside_reads = block.leading_to(end)
            assignments = [f"{name} = {_text(value)};" for name, value in zip(names, end, strict=True)]
            lines += [f"{'} else ' if k else ''}if ({number} == {k}) {{", *_indented([*body, *assignments])]
            reads |= inside_reads
        self.statements.append((names, reads, [*lines, "}"]))
        return variables


def _flat(values: Sequence[Value]) -> list[Number]:
    return [number for value in values for number in value.ravel()]


def _statements(jaxpr: Any) -> int:
    """About how many statements a jaxpr takes: one for each number that it computes."""
    total = 0
    for equation in jaxpr.eqns:
        inner = programs_of(equation)
        results: list[Any] = [atom.aval for atom in equation.outvars]
        numbers = sum(math.prod(result.shape) for result in results)
        total += sum(map(_statements, inner)) * equation.params.get("length", 1) if inner else numbers
    return total


def _indented(lines: list[str]) -> list[str]:
    return [f"  {line}" for line in lines]


def _strings(numbers: Sequence[Number]) -> list[str]:
    return [number for number in numbers if isinstance(number, str)]


# The contents of a page at one time of a run, in the form for the player (`player.js`).


class Frame(NamedTuple, Generic[Kind]):
    """One moment of a run, or several, with bodies, traces, arrows and curves in the order of the `Show` of the page.

    - `normal`: normal of the arena, towards the body; `bodies`: position [m] and quaternion (x, y, z, w) of each body.
    - `traces`: the point of each trace [m], and the point to which it is relative, or `None`.
    - `arrows`: start [m] and vector of each arrow, in its unit; `curves`: a number for each curve.
    - `turning_rate`: greatest rotation rate of all parts [rad/s], which determines the number of frames.
    """

    normal: Float[Kind, "*times 3"]
    bodies: tuple[tuple[Float[Kind, "*times 3"], Float[Kind, "*times 4"]], ...]
    traces: tuple[tuple[Float[Kind, "*times 3"], Float[Kind, "*times 3"] | None], ...]
    arrows: tuple[tuple[Float[Kind, "*times 3"], Float[Kind, "*times 3"]], ...]
    curves: tuple[Float[Kind, "*times"], ...]
    turning_rate: Float[Kind, "*times"]


# The steps of a smooth motion for integration in the browser: their functions and their method, in JavaScript.
#
# Everything is generated from the objects that make tables (`nonholonomic.integration`), so both take the same steps. Only the
# loops over steps and stages are written by hand, in `integrator.js`.

Numbers = Float[Array, " numbers"]

#: Functions of a page by name, with examples of their arguments.
Functions = dict[str, tuple[Callable[..., PyTree], tuple[PyTree, ...]]]


def steps_of(
    begin: Callable[..., LaneScheduler], end: Callable[..., PyTree], examples: tuple[PyTree, ...], settings: Settings
) -> tuple[dict[str, object], Functions]:
    """The steps of a motion.

    **Arguments:** `begin`: function that returns the scheduler of one cell; `end`: function of the problem, the `LaneState` at
    the end of the motion, and the arguments of `begin`; `examples`: example arguments of `begin`; `settings`: settings of the
    steps.

    **Returns:** the sizes and the coefficients that `integrator.js` reads, and the functions that it calls.
    """

    def started(*inputs: PyTree) -> tuple[tuple[AbstractProblem, Control, PyTree], LaneState]:
        scheduler = begin(*inputs)
        return (scheduler.problem, scheduler.control, scheduler.atols), scheduler.fresh

    shapes = eqx.filter_eval_shape(started, *examples)
    (constants, lane), static = eqx.partition(shapes, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))
    # Problem, control and absolute tolerances from the constants of a run.
    run, time, state = functools.partial(eqx.combine, static[0]), lane.time, lane.state
    tableau = explicit_tableau(settings.for_lanes)
    inner = inner_stages(tableau)
    # The stages at which margins and event function are evaluated, too.
    looks = looks_of(run(constants)[0], tableau, lane)
    places = len(watched_places(tableau, looks))
    margins = jax.tree.map(lambda least: jax.ShapeDtypeStruct((places, *least.shape), least.dtype), lane.margins)
    trial, along = Step(state, state, state, time, time, margins, (), state, None), (constants, time, state)
    functions: Functions = {
        "begin": (lambda *inputs: eqx.filter(started(*inputs), eqx.is_array), examples),
        "length": (
            lambda constants, lane: length_to_try(run(constants)[0], run(constants)[1], lane),
            (constants, lane),
        ),
        "field": (lambda constants, *at: run(constants)[0].field(*at), along),
        "margins": (lambda constants, *at: run(constants)[0].margins(*at), along),
        "crossing": (lambda constants, *at: run(constants)[0].crossing_along(*at), (constants, state, state)),
        "after": (lambda constants, *step: after_step(*run(constants), *step), (constants, lane, time, trial)),
        "ended": (lambda constants, *ended: end(run(constants)[0], *ended), (constants, lane, *examples)),
    }
    facts = {
        "constants": size_of(constants),
        "components": state.shape[0],
        "lane": offsets_of(lane),
        "running": RUNNING,
        "stages": [row.tolist() for row in tableau.a_lower[:inner]],
        "places": np.asarray(tableau.c[:inner]).tolist(),
        "looks": looks,
        "margins_count": 0 if lane.margins is None else len(lane.margins),
        "step": np.asarray(tableau.b_sol[: 1 + inner]).tolist(),
        "error": np.asarray(tableau.b_error).tolist(),
        "middle": middle_weights(tableau),
    }
    return facts, functions


def as_object(facts: Mapping[str, object], functions: Functions, **more: str) -> str:
    """A JavaScript object with facts and functions; `more`: text of further entries."""
    lines = [f"{name}: {javascript('', function, *examples)}" for name, (function, examples) in functions.items()]
    lines += [f"{name}: {text}" for name, text in more.items()]
    return "{\n" + ",\n".join([*(f"{name}: {json.dumps(fact)}" for name, fact in facts.items()), *lines]) + "}"


def size_of(tree: PyTree) -> int:
    """Number of numbers in a tree of arrays."""
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def offsets_of(parts: LaneState | HybridOutcome) -> dict[str, int]:
    """The offset of each part of a named tuple in its flat list of numbers, and under `size` the length of the list."""
    return dict(zip((*parts._fields, "size"), np.cumsum([0, *map(size_of, parts)]).tolist(), strict=True))


# A run through modes for integration in the browser.
#
# Only the loops over rounds and over the stretches of a transition are written by hand, in `integrator.js`.


Start = tuple[tuple[AbstractBatchedMode, ...], Int[Array, "1"], Float[Array, "components 1"]]


class Simulator(NamedTuple):
    """A run that is integrated in the browser.

    - `start`: function of the numbers of the sliders that returns the modes, the index of the first mode, and the
      initial state, for one cell.
    - `t1`: horizon [s]; `settings`: settings with an explicit Runge-Kutta solver of Diffrax; `counters`: rows of
      `Transition.counts`; `passes`: whether a run continues through its event.
    - `outcome`: function of the sliders' numbers and the `HybridOutcome` that returns the `Status` of the run, and the
      result, or infinity. `None` if no result is needed.
    - `frame`: function that returns the frame at any time; its arguments are the sliders' numbers, the index of the
      mode or -1 between modes, the output rows of the modes, and the time [s]. `None` if no path is needed.
    """

    start: Callable[[Numbers], Start]
    t1: float
    settings: Settings
    counters: int
    passes: bool
    outcome: Callable[[Numbers, HybridOutcome], PyTree] | None = None
    frame: Callable[[Numbers, Array, PyTree, Array], Frame] | None = None

    def javascript(self, values: Numbers) -> str:
        """The simulator as an object of JavaScript.

        **Arguments:** `values`: numbers of the sliders; only their count matters.
        """

        def first(values: Numbers) -> HybridOutcome:
            _, mode, state = self.start(values)
            return at_start(mode, state, 1, self.counters)

        modes, runs = eqx.filter_eval_shape(self.start, values)[0], jax.eval_shape(first, values)
        groups = program_groups(modes)
        facts: dict[str, object] = {
            "runs": offsets_of(runs),
            "modes": [next(k for k, group in enumerate(groups) if number in group) for number in range(len(modes))],
            "rounds": MOST_ROUNDS,
            "running": RUNNING,
            "left": LEFT_DOMAIN,
            "unresolved": UNRESOLVED,
        }
        functions: Functions = {"first": (first, (values,))}
        if self.outcome is not None:
            functions["outcome"] = (self.outcome, (values, runs))
        if self.frame is not None:
            rows = eqx.filter_eval_shape(lambda mode, state: mode.shown(state), modes[0], runs.state)
            examples = (values, runs.mode, rows, runs.end_time)
            functions["frame"], frame = (self.frame, examples), eqx.filter_eval_shape(self.frame, *examples)
            # For readers of the flat list of numbers of a frame.
            facts["layout"] = {
                "bodies": len(frame.bodies),
                "traces": [about is not None for _, about in frame.traces],
                "arrows": len(frame.arrows),
                "curves": len(frame.curves),
            }
        kinds = [self._kind(values, group, modes[group[0]], runs) for group in groups]
        return as_object(facts, functions, kinds=f"[{', '.join(kinds)}]")

    def _kind(self, values: Numbers, group: tuple[int, ...], mode: AbstractBatchedMode, runs: HybridOutcome) -> str:
        """The modes of one group: how they are integrated, and how they end."""
        t1, examples = jnp.full(1, self.t1), (values, runs)

        def entered(values: Numbers, runs: HybridOutcome) -> tuple[Any, Lanes]:
            """The mode of a run, and the time [s] to the horizon."""
            modes: Any = self.start(values)[0]
            return mode_numbered(modes, group, runs.mode), jnp.maximum(t1 - runs.end_time, 0.0)

        def begin(values: Numbers, runs: HybridOutcome) -> LaneScheduler:
            mode, left = entered(values, runs)
            problem, cells = mode.problem(runs.state), jnp.asarray(1)
            return LaneScheduler.of(problem, left, cells, self.settings, nonterminal=self.passes)

        def end(problem: AbstractProblem, lane: LaneState, values: Numbers, runs: HybridOutcome) -> HybridOutcome:
            outcome = back_to_margin(problem, outcome_of(lane))
            return after_solve(runs, outcome if self.passes else with_crossing_times(problem, outcome), t1)

        def reset(values: Numbers, runs: HybridOutcome) -> HybridOutcome:
            mode, left = entered(values, runs)
            return after_reset(runs, mode.reset_map(runs.state, left), t1)

        def lost(values: Numbers, runs: HybridOutcome) -> PyTree:
            stretch = entered(values, runs)[0].lost(runs.state)
            return stretch.open, stretch.elapsed, stretch

        def hop(values: Numbers, runs: HybridOutcome, stretch: PyTree) -> PyTree:
            mode, left = entered(values, runs)
            state_after, following = mode.hop(stretch, left)
            return following.open, state_after.elapsed, following

        def closed(values: Numbers, runs: HybridOutcome, stretch: PyTree) -> HybridOutcome:
            return after_reset(runs, entered(values, runs)[0].closed(stretch), t1)

        def between(values: Numbers, runs: HybridOutcome, stretch: PyTree, elapsed: Array) -> PyTree:
            mode, _ = entered(values, runs)
            return mode.between(mode.motion_in(stretch), elapsed)

        def shown(values: Numbers, runs: HybridOutcome, state: Array) -> Array:
            return entered(values, runs)[0].shown(state)

        facts, functions = steps_of(begin, end, examples, self.settings)
        if not isinstance(mode, AbstractHoppingMode):
            functions["reset"] = (reset, examples)
        else:
            stretch = eqx.filter_eval_shape(lost, *examples)[2]
            facts |= {"stretch": size_of(stretch), "most_hops": mode.most_hops}
            functions |= {"lost": (lost, examples), "hop": (hop, (*examples, stretch))}
            functions["closed"] = (closed, (*examples, stretch))
            if self.frame is not None:
                functions["between"] = (between, (*examples, stretch, runs.end_time))
        if self.frame is not None:
            functions["shown"] = (shown, (*examples, runs.state))
        return as_object(facts, functions)


# A page with sliders: its contents, and how they are combined into one file.


class Slider(NamedTuple):
    """A slider: its `name` in the page's address, the `path` of its parameter, a `label`, its range and its value in the SI
    unit, the unit in which the page shows it, and the factor that converts to this unit."""

    name: str
    path: str
    label: str
    unit: str
    low: float
    high: float
    value: float
    factor: float = 1.0


class LiveRun(NamedTuple):
    """The contents of a page with sliders.

    - `title`: title of the page.
    - `sliders`: the sliders; `allowed`: function that returns whether their numbers are legal in combination.
    - `answer`: the simulator whose `outcome` is the result of a run, which the page also shows as a map; `label`, `unit`: those
      of the result.
    - `motion`: the simulator of the drawn run, with its `frame`.
    - `summaries`: indices of the curves of the `Show` whose values at the start and the end of the run the page also shows as
      numbers, beside the result.
    """

    title: str
    sliders: tuple[Slider, ...]
    allowed: Callable[[Numbers], Bool[Array, ""]]
    answer: Simulator
    label: str
    unit: str
    motion: Simulator
    summaries: tuple[int, ...]


def live_page(live: LiveRun, stage: Stage, speed: float = 1.0, below: str = "", unit: Unit = None) -> Page:
    """The page of a run with sliders.

    **Arguments:** `stage`: a stage with one run, for its arena, meshes and names; `speed`, `below`: as for `page`; `unit`: that
    of curves, arrows and sliders, as for `in_unit`.

    **Raises:** `ValueError` for equations that cannot be written in JavaScript.
    """
    # The title and the warnings describe one run, but the sliders change the run.
    stage_of_live = stage._replace(title="", shows=tuple(show._replace(note="") for show in stage.shows))
    sliders = tuple(slider._replace(**converted(slider.unit, unit)) for slider in live.sliders)
    texts = (programs(live._replace(sliders=sliders)), template("map.js"), template("explore.js"))
    scripts = [script(text) for text in texts]
    section = f'<section id="below">{below}</section>'
    return page(curves_in([stage_of_live], unit), live.title, speed, template("explore.html"), section, scripts=scripts)


def programs(live: LiveRun) -> str:
    """The JavaScript of the simulation: the data of the sliders, all functions and the integrator, without a page."""
    values = jnp.array([slider.value for slider in live.sliders])
    facts = {
        "sliders": [slider._asdict() for slider in live.sliders],
        "words": {int(status): status.word for status in Status},
        "answer": {"label": live.label, "unit": live.unit},
        "summaries": live.summaries,
    }
    parts = {
        "facts": json.dumps(facts),
        "answer": live.answer.javascript(values),
        "motion": live.motion.javascript(values),
        "allowed": javascript("", live.allowed, values),
    }
    return (
        f"window.live = {{{', '.join(f'{name}: {text}' for name, text in parts.items())}}};\n"
        f"{template('integrator.js')}"
    )
