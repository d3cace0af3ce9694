"""Functions that JAX can trace, written as programs of scalars in JavaScript or in CUDA C.

The jaxpr of a function is written element by element: an array becomes one scalar per element. Slices, stacks and similar
operations then cost nothing, and unused elements are omitted. Loops and branches that depend on numbers stay loops and
branches. No existing package converts jaxprs to these languages.
"""

import functools
import itertools
import json
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import ArrayLike, PyTree

from ..compilation.components import AbstractScalarReader, rows_along
from ..compilation.xla_cpu import Equation, Program, called_program, programs_of, traced

#: A number: a Python number if known, otherwise its name or text in the program. A value is an array of numbers.
Number = str | float
Value = np.ndarray
Values = list[Value]


class Notation(NamedTuple):
    """A language in which scalar programs are written.

    - `language`: its name; `head`, `argument`, `end`: the first line of a function, each of its arguments, and its last
      statement, if any.
    - `constant`, `variable`: how a name is declared that keeps its value, and one that changes.
    - `counter`: how the counter of a loop is declared, and `out`: the list of results.
    - `operations`: the text of each elementwise operation, by the name of the primitive.
    - `number`: the text of a number.
    """

    language: str
    head: str
    argument: str
    end: str
    constant: str
    variable: str
    counter: str
    out: str
    operations: dict[str, str]
    number: Callable[[float], str]


CHOICE = "{0} ? {2} : {1}"

#: Elementwise operations that have the same text in both languages.
ALIKE = {
    "add": "{} + {}",
    "add_any": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "div": "{} / {}",
    "eq": "{} == {}",
    "ne": "{} != {}",
    "lt": "{} < {}",
    "le": "{} <= {}",
    "gt": "{} > {}",
    "ge": "{} >= {}",
    "neg": "-{}",
    "square": "{0} * {0}",
    "one_minus_square": "(1 + {0}) * (1 - {0})",
    # The order in which `jnp.searchsorted` and `jnp.interp` sort: NaN comes last.
    "lt_to": "{0} < {1} || ({1} != {1} && {0} == {0})",
    "le_to": "{0} <= {1} || {1} != {1}",
}

#: Functions that have the same name as a primitive.
FUNCTIONS = """
    sqrt cbrt sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp expm1 log log1p log2 floor ceil
"""

JAVASCRIPT = Notation(
    language="JavaScript",
    head="function {name}({arguments}) {{",
    argument="{}",
    end="return out;",
    constant="const {} = {};",
    variable="let {};",
    counter="let k",
    out="out",
    operations=ALIKE
    | {name: f"Math.{name}({{}})" for name in f"{FUNCTIONS} abs sign".split()}
    | {name: f"Math.{name}({{}}, {{}})" for name in ("max", "min", "pow", "atan2")}
    | {
        # The primitive of `planar_length`.
        "departure_from_pole": "Math.hypot({}, {})",
        "and": "{} & {}",
        "or": "{} | {}",
        "xor": "{} ^ {}",
        "not": "!{}",
        "rem": "{} % {}",
        "rsqrt": "1 / Math.sqrt({})",
        "exp2": "Math.pow(2, {})",
        "clamp": "Math.min(Math.max({1}, {0}), {2})",
        "logistic": "1 / (1 + Math.exp(-{}))",
        "is_finite": "Number.isFinite({})",
        "cut": "Math.trunc({})",
        "quotient": "Math.trunc({} / {})",
        "of_truth": "+{}",
        "not_bits": "~{}",
        "and_bits": "{} & {}",
        "or_bits": "{} | {}",
        "xor_bits": "{} ^ {}",
    },
    number=json.dumps,
)

# Truths are numbers in arrays, and bool between operations. The functions without a prefix are those of `loops.cu`.
CUDA = Notation(
    language="CUDA C",
    head="DEVICE static void {name}({arguments}) {{",
    argument="const double* {}",
    end="",
    constant="const auto {} = {};",
    variable="double {};",
    counter="int k",
    out="double* out",
    operations=ALIKE
    | {name: f"{name}({{}})" for name in f"{FUNCTIONS} exp2 erf erfc lgamma rsqrt sign is_finite logistic".split()}
    | {name: f"{name}({{}}, {{}})" for name in ("pow", "atan2", "nextafter")}
    | {
        "and": "({} != 0) && ({} != 0)",
        "or": "({} != 0) || ({} != 0)",
        "xor": "({} != 0) != ({} != 0)",
        "not": "!({} != 0)",
        "abs": "fabs({})",
        "max": "greatest({}, {})",
        "min": "least({}, {})",
        "rem": "fmod({}, {})",
        "clamp": "least(greatest({1}, {0}), {2})",
        "cut": "trunc({})",
        "quotient": "trunc({} / {})",
        "of_truth": "double({})",
        "departure_from_pole": "hypot({}, {})",
    },
    number=lambda number: repr(float(number)).replace("nan", "NaN").replace("inf", "Infinity"),
)

#: Elementwise operations that Python evaluates if all numbers are known, mostly for indices.
KNOWN: dict[str, Callable[..., Number]] = {
    name: getattr(operator, name) for name in ("add", "sub", "mul", "lt", "le", "gt", "ge", "eq", "ne")
}
KNOWN |= {"max": max, "min": min, "clamp": lambda low, value, high: min(max(value, low), high)}
KNOWN |= {CHOICE: lambda which, no, yes: yes if which else no}

#: Operations that move elements to indices given by operands, and the positions of these operands.
INDEXED = {"dynamic_slice": slice(1, None), "dynamic_update_slice": slice(2, None), "gather": slice(1, 2)}
INDEXED["scatter"] = INDEXED["scatter-add"] = slice(1, 2)

SAME = ("stop_gradient", "optimization_barrier", "copy", "copy_p", "reduce_precision")

#: Loops with at most this many iterations are unrolled, unless that writes more than this many statements.
WRITTEN_OUT, MOST_STATEMENTS = 16, 4000

#: Marks the exit of a loop among the names.
LEAVES = "break"


def javascript(name: str, function: Callable[..., PyTree], *arguments: PyTree) -> str:
    """A function in JavaScript, as `scalar_code` writes it.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> from nonholonomic.kernels import javascript
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
    return scalar_code(JAVASCRIPT, name, function, *arguments)


def scalar_code(notation: Notation, name: str, function: Callable[..., PyTree], *arguments: PyTree) -> str:
    """A function as a program of scalars.

    **Arguments:**

    - `notation`: the language; `name`: name of the function in it.
    - `function`: a function that JAX can trace.
    - `arguments`: examples of its arguments, arrays or trees of arrays.

    **Returns:** the text of a function. For each argument it takes a list of numbers: the elements of all leaves, one after
    another. Its last argument is a list that it fills with the results, after it has read everything.

    **Raises:** `ValueError` for an unsupported primitive of JAX.
    """
    block, values = _Block(notation, itertools.count(), {}), []
    for number, argument in enumerate(arguments):
        names = (f"a{number}[{place}]" for place in itertools.count())
        shapes = [np.zeros(leaf.shape) for leaf in jax.tree.leaves(argument)]
        values += [_map(lambda _, names=names: block.name(next(names)), shape) for shape in shapes]
    results = _flat(block.read(traced(function, *arguments)[0], values))
    statements = [f"out[{k}] = {block.text(number)};" for k, number in enumerate(results)]
    heads = ", ".join([*(notation.argument.format(f"a{number}") for number in range(len(arguments))), notation.out])
    body = _indented([*block.leading_to(results)[0], *statements, *filter(None, [notation.end])])
    return "\n".join([notation.head.format(name=name, arguments=heads), *body, "}", ""])


def _map(function: Callable[..., Number], *values: Value) -> Value:
    """Apply a function of numbers to every element of some values."""
    # NaN is NaN in JavaScript, too.
    with np.errstate(invalid="ignore"):
        return np.asarray(np.frompyfunc(function, len(values), 1)(*values), object)


class _Block(AbstractScalarReader):
    """Consecutive statements: each defines names, reads others, and has lines of text."""

    def __init__(self, notation: Notation, names: Iterator[int], known: dict[str, str]):
        self.notation, self.names, self.known = notation, names, known
        self.statements: list[tuple[list[Number], set[str], list[str]]] = []

    def text(self, number: Number) -> str:
        """A name, or a number as an operand."""
        text = number if isinstance(number, str) else self.notation.number(number)
        return f"({text})" if text.startswith("-") else text

    def name(self, text: str, *reads: Number) -> str:
        """The name for the value of an expression, which is written only once."""
        if text not in self.known:
            self.known[text] = f"v{next(self.names)}"
            self.statements.append(
                ([self.known[text]], set(_strings(reads)), [self.notation.constant.format(self.known[text], text)])
            )
        return self.known[text]

    def inner(self) -> "_Block":
        """A block inside this one that sees the names of this one."""
        return _Block(self.notation, self.names, dict(self.known))

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
        """An elementwise operation: its name in the notation, or its text."""
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
        is_truth, is_whole = types[0] == np.bool_, np.issubdtype(types[0], np.integer)
        if name == "convert_element_type":
            if parameters["new_dtype"] == np.bool_:
                return "{} != 0"
            cut = np.issubdtype(parameters["new_dtype"], np.integer) and np.issubdtype(types[0], np.floating)
            return "cut" if cut else "of_truth" if is_truth else "{}"
        if name in ("not", "and", "or", "xor") and not is_truth:
            name = f"{name}_bits"
        if name == "div" and is_whole:
            name = "quotient"
        if name not in self.notation.operations:
            known = f"use some of {', '.join(sorted(self.notation.operations))}"
            raise ValueError(f"the primitive {name!r} of JAX cannot be written in {self.notation.language}; {known}")
        return name

    def element(self, name: str, *numbers: Number, equation: Equation | None = None) -> Number:
        if name in KNOWN and not _strings(numbers):
            return KNOWN[name](*numbers)
        if name == "{}":
            return numbers[0]
        return self.name(self.notation.operations.get(name, name).format(*map(self.text, numbers)), *numbers)

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
        names = [np.asarray(inputs[k][place], object) for k, place in unknown]
        labels, is_sum = itertools.count(), equation.primitive.name == "scatter-add"
        labelled = [value if k in indices else _map(lambda _: next(labels), value) for k, value in enumerate(inputs)]

        def at(option: dict[int, int]) -> Values:
            # The labels of the elements, or their sums, with some of the unknown indices, and 0 for the others.
            operands = [value.copy() for value in labelled]
            for number, (k, index) in enumerate(unknown):
                operands[k][index] = option.get(number, 0)
            if is_sum:
                return [self.summed_at(equation, inputs[0], operands[1], inputs[2])]
            # An index beyond the end gives -1, which is not a label.
            parameters = equation.params | ({"fill_value": -1} if "fill_value" in equation.params else {})
            output = equation.primitive.bind(*(operand.astype(int) for operand in operands), **parameters)
            return [np.asarray(part) for part in jax.tree.leaves(output)]

        # One more than the number of elements: an index beyond the end has a separate meaning.
        options = range(max(inputs[0].shape, default=0) + 1)
        # The unknown indices on which each element depends: few of them where many places are read.
        first, everything = at({}), frozenset(range(len(unknown)))
        is_read = equation.primitive.name == "gather"
        decided_by = [np.full(part.shape, frozenset() if is_read else everything, object) for part in first]
        for number, option in itertools.product(everything if is_read else [], options):
            for sets, part, other in zip(decided_by, first, at({number: option}), strict=True):
                sets[part != other] = _map(lambda numbers, number=number: numbers | {number}, sets[part != other])
        # A gather beyond the end fills with a number that is not a label.
        pick = functools.partial(_map, lambda k: k if is_sum else pool[k] if 0 <= k < len(pool) else math.nan)
        values = [pick(part) for part in first]
        for numbers in {numbers for sets in decided_by for numbers in sets.flat if numbers}:
            order = sorted(numbers)
            for option in itertools.islice(itertools.product(options, repeat=len(order)), 1, None):
                chosen = dict(zip(order, option, strict=True))
                matches = [self.each("eq", names[number], self.constants(k)) for number, k in chosen.items()]
                condition = functools.reduce(functools.partial(self.each, "and"), matches)
                for value, sets, part in zip(values, decided_by, at(chosen), strict=True):
                    elements = sets == numbers
                    value[elements] = self.each(CHOICE, condition, value[elements], pick(part[elements]))
        return values

    def summed_at(self, equation: Equation, values: Value, indices: Value, updates: Value) -> Value:
        """Values with updates added at indices, which are known."""
        sums, nothing = values, np.zeros(values.shape)
        for place in np.ndindex(updates.shape):
            unit = np.zeros(updates.shape)
            unit[place] = 1.0
            places = equation.primitive.bind(nothing, indices.astype(int), unit, **equation.params)
            # Where the update is added, the sum; elsewhere, the value.
            added = self.each("add", sums, np.full(sums.shape, updates[place], object))
            sums = np.where(np.asarray(places) != 0.0, added, sums)
        return sums

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
            f"{name} = {self.text(number)};" for name, number in zip(names, new_values, strict=True) if name != number
        ]
        body, reads = block.leading_to([*new_values, LEAVES])
        lines = [
            self.notation.variable.format(f"{name} = {self.text(start)}")
            for name, start in zip(names, starts, strict=True)
        ]
        lines += [f"{head} {{", *_indented([*body, *assignments]), "}"]
        self.statements.append((names, reads.union(_strings(starts)), lines))
        return variables

    def variables(self, values: Sequence[Value]) -> Values:
        """New names, one for each number in some values."""
        return [_map(lambda _: f"v{next(self.names)}", value) for value in values]

    def while_(
        self, inputs: Values, cond_jaxpr: Program, body_jaxpr: Program, cond_nconsts: int, body_nconsts: int
    ) -> Values:
        of_cond, of_body = inputs[:cond_nconsts], inputs[cond_nconsts : cond_nconsts + body_nconsts]

        def step(block: "_Block", carry: Values) -> Values:
            goes_on = block.read(cond_jaxpr, [*of_cond, *carry])[0].item()
            block.statements.append(([LEAVES], set(_strings([goes_on])), [f"if (!{self.text(goes_on)}) break;"]))
            return block.read(body_jaxpr, [*of_body, *carry])

        return self.loop("while (true)", inputs[cond_nconsts + body_nconsts :], step)

    def scan_(self, inputs: Values, jaxpr: Program, length: int, reverse: bool, **counts: Any) -> Values:
        first, count = counts.get("num_consts", 0), counts.get("num_carry", 0)
        if "ft_in" in counts:  # jax 0.11 and later
            first, count, _ = map(len, counts["ft_in"].unpack())
        constants, carry, rows = inputs[:first], inputs[first : first + count], inputs[first + count :]
        unrolled = length <= WRITTEN_OUT and length * _statements(jaxpr) <= MOST_STATEMENTS
        if not rows and len(jaxpr.outvars) == count and not unrolled:
            head = f"for ({self.notation.counter} = 0; k < {length}; k++)"
            return self.loop(head, carry, lambda block, carry: block.read(jaxpr, [*constants, *carry]))
        rows_of_steps: list[Values] = [[]] * length
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
        lines = [self.notation.variable.format(", ".join(_strings(names)))] if names else []
        for k, branch in enumerate(branches):
            block = self.inner()
            end = _flat(block.read(branch, operands))
            body, inside_reads = block.leading_to(end)
            assignments = [f"{name} = {self.text(value)};" for name, value in zip(names, end, strict=True)]
            lines += [f"{'} else ' if k else ''}if ({number} == {k}) {{", *_indented([*body, *assignments])]
            reads |= inside_reads
        self.statements.append((names, reads, [*lines, "}"]))
        return variables


def _flat(values: Sequence[Value]) -> list[Number]:
    return [number for value in values for number in value.ravel()]


def _statements(jaxpr: Program) -> int:
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
