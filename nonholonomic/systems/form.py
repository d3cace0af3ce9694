"""What a user writes: modes and mechanical systems in a hybrid system; its form without its numbers, for which JAX compiles a
program; and what is checked before anything compiles."""

import dataclasses
import difflib
import functools
import inspect
from collections.abc import Callable, Sequence
from types import CodeType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from ..compilation.components import spelled_out
from ..compilation.tracing import dependent_outputs, is_elementary, jumps_of, named_errors, warn_of_unclear
from ..compilation.xla_cpu import Function, equations_in, traced
from ..parameters import TreeForm
from ..text import counted, described, shown
from ..validation import ArrayOrList, as_number, is_traced, require, warn
from . import mechanics
from .mechanics import AbstractFormulation, AbstractMode, AbstractSystem, Lagrange, State, components_of, exit_of

# A hybrid system: smooth modes with resets between them, as functions of one state.

#: The event function, of time [s] and state; the event happens when it falls through zero.
Event = Callable[[Float[Array, ""], State], Float[Array, ""]]


def require_event(event: object) -> None:
    """Raise `ValueError` unless the event is a function."""
    if not callable(event):
        raise ValueError(f"event = {shown(event)} must be a function event(t, y) of time and state, or None")


class Hybrid(eqx.Module):
    """A hybrid system: modes of one state, and the event to be timed.

    **Arguments:**

    - `modes`: the modes, whose states have the same components. A mode can also be an `AbstractSystem`: its state is its
      coordinates, followed by their rates, and its `reset` may return `(q, rate, number)` with the index of the next mode. A
      run then starts from the state or from a pair (q, rate).
    - `event`: a function of time [s] and state, `event(t, y)`, or `None`. The event is the first time after the start
      at which the function falls through zero, along the motion or by a reset. An `equinox.Module` can have its own
      parameters.
    - `first`: index of the mode in which runs start.

    **Raises:** `ValueError` for wrong modes, an event that is not a function, and a first mode that does not exist.

    **Example:** as for `AbstractMode`.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> decay = nonholonomic.Hybrid([Decay(rate=2.0)], event=lambda t, y: y[0] - 0.5)
    >>> print(f"{nonholonomic.event_time(decay, jnp.array([1.0]), t1=5.0):.6f} s")  # ln(2) / 2
    0.346574 s

    ```
    """

    modes: tuple[AbstractMode | AbstractSystem, ...] = eqx.field(
        converter=lambda modes: tuple(modes) if isinstance(modes, list) else modes
    )
    event: Event | None = None
    first: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        if not isinstance(self.modes, tuple):
            raise ValueError(f"modes = {shown(self.modes)} must be a list of modes, such as [Flying(), Sliding()]")
        illegal = [mode for mode in self.modes if not isinstance(mode, AbstractMode | AbstractSystem)]
        if not self.modes or illegal:
            problem = f"modes holds {shown(illegal[0])}" if illegal else "modes is empty"
            raise ValueError(f"{problem}: it must hold one AbstractMode or more, such as [Flying(), Sliding()]")
        if self.event is not None:
            require_event(self.event)
        if not isinstance(self.first, int) or not 0 <= self.first < len(self.modes):
            raise ValueError(f"first = {shown(self.first)} must be the number of a mode, 0 to {len(self.modes) - 1}")


# The form of a system: what is left without its numbers.

#: The last argument of a reset, in words for a message.
EXIT = "; and exit, which of them fell, if the mode has several margins"

#: A function of the numbers, the time and the state of one run.
OfRun = Function


#: A field with more operations on arrays is large: that of a car with a trailer has 800, that of a top in Euler angles 150.
LARGE = 500


class Traits(NamedTuple):
    """The traits of a hybrid system, found by tracing its functions.

    - `depends_on_time`: whether a function depends on time, which is then an additional component of the state.
    - `elementary`: whether all functions that are evaluated within steps fit a single kernel.
    - `ends`, `resets`: for each mode, the number of its margins, and whether it also has a reset.
    - `projected`: for each mode, whether it has constraints that a state may violate, so that `entered` changes its rates.
    - `large`: for each mode, whether its field takes much longer to compile than to compute.
    """

    depends_on_time: bool
    elementary: bool
    ends: tuple[int, ...]
    resets: tuple[bool, ...]
    projected: tuple[bool, ...]
    large: tuple[bool, ...]

    @property
    def smooth(self) -> bool:
        """Whether a run is one smooth motion, without resets."""
        return len(self.ends) == 1 and not self.resets[0]


@dataclasses.dataclass(frozen=True)
class Form:
    """A hybrid system without its numbers.

    - `tree`: the form of the `Hybrid`.
    - `modes`: number of modes; `first`: mode in which runs start; `has_event`: whether there is an event.
    - `size`: number of components of the state.
    """

    tree: TreeForm
    modes: int
    first: int
    has_event: bool
    size: int

    @classmethod
    def of(cls, hybrid: Hybrid, size: int) -> tuple["Form", tuple[Array, ...]]:
        """The form of a system with states of the given size, and its numbers."""
        tree, numbers = TreeForm.of(hybrid)
        return cls(tree, len(hybrid.modes), hybrid.first, hybrid.event is not None, size), numbers

    def function(self, name: str, mode: int = 0) -> OfRun:
        """One of the user's functions: "field", "margin" or "reset" of a mode, or "event"; "margins", the values of the margin
        as a tuple; or "entered", which projects the state after a reset to a mode onto its constraints. A reset also receives
        the index of the margin that fell."""

        def called(numbers: Sequence[Array], t: Array, y: State, exit: ArrayLike = 0) -> PyTree:
            system = self.tree.tree(numbers)
            part: Any = system.modes[mode]
            if name == "event":
                assert system.event is not None
                return system.event(t, components_of(part, y))
            if name == "margins":
                margin = part.margin(t, y)
                if isinstance(margin, dict):
                    return tuple(map(jnp.asarray, margin.values()))
                return (margin,) if jnp.ndim(margin) == 0 else tuple(margin[k] for k in range(margin.shape[0]))
            if name != "reset":
                return getattr(part, name)(t, y)
            following = part.reset(t, y, *exit_of(part.margin(t, y), exit))
            if isinstance(part, AbstractFormulation) and following is not None:
                # A mechanical system need not name the next mode.
                return (*following, mode)[:2]
            return following

        return called

    def jump_times(self, mode: int, numbers: Sequence[Array]) -> Array:
        """The times at which the functions of a mode that are evaluated within steps may jump, (jumps,)."""
        _, t, y = self.arguments
        names = ["field", *(["margins"] if self.traits.ends[mode] else []), *(["event"] if self.has_event else [])]
        functions = [functools.partial(self.function(name, mode), numbers) for name in names]
        return jnp.concatenate([jumps_of(function, t, y)[0] for function in functions])

    @property
    def arguments(self) -> tuple[tuple[jax.ShapeDtypeStruct, ...], jax.ShapeDtypeStruct, jax.ShapeDtypeStruct]:
        """The shapes of the functions' arguments."""
        real = jnp.result_type(float)
        return self.tree.types, jax.ShapeDtypeStruct((), real), jax.ShapeDtypeStruct((self.size,), real)

    @property
    @functools.lru_cache(maxsize=256)  # noqa: B019  Equal forms share their traits.
    def traits(self) -> Traits:
        """The traits found by tracing the functions, which are also checked.

        **Raises:** `ValueError` that names a function that returns a wrong type or shape.
        """
        numbers, t, y = self.arguments
        ends, resets = zip(*(_check_mode(self, k) for k in range(self.modes)), strict=True)
        within_steps = [
            (name, k) for k in range(self.modes) for name in ("field", "margins") if name == "field" or ends[k]
        ]
        functions = [self.function(*named) for named in within_steps]
        if self.has_event:
            _require_shape(self, "event", 0, ())
            functions.append(self.function("event"))
        reset_functions = [self.function("reset", k) for k, has_reset in enumerate(resets) if has_reset]

        def results(functions: list[OfRun], t: Array, y: State, *numbers: Array) -> list[PyTree]:
            return [function(numbers, t, y) for function in functions]

        def energies(numbers: Sequence[Array], t: Array, y: State) -> list[Array]:
            # The potential may depend on time where the forces do not.
            modes = [mode for mode in self.tree.tree(numbers).modes if isinstance(mode, AbstractFormulation)]
            driven = (mode for mode in modes if mechanics.is_driven(mode.system))
            return [mechanics.at_time(mode.system, t).energy(*mode.split(y)) for mode in driven]

        def warned(numbers: Sequence[Array]) -> None:
            for name, k in within_steps:
                warn_of_unclear(_name(name.rstrip("s"), k), functools.partial(self.function(name, k), numbers), y)

        everything = functools.partial(results, [*functions, *reset_functions, energies])
        depends_on_time = any(dependent_outputs(everything, t, y, *numbers, on_first_alone=True))
        if depends_on_time:
            jax.eval_shape(warned, numbers)
        fields = [traced(spelled_out(self.function("field", k)), numbers, t, y)[0] for k in range(self.modes)]
        modes = self.tree.tree([jnp.zeros((), kind.dtype) for kind in numbers]).modes
        return Traits(
            depends_on_time,
            is_elementary(functools.partial(results, functions), t, y, *numbers),
            ends,
            resets,
            tuple(isinstance(mode, Lagrange) and mode.system.freedom < mode.system.dimension for mode in modes),
            tuple(len(equations_in(field)) > LARGE for field in fields),
        )


def _name(name: str, mode: int) -> str:
    return f"{name if name == 'event' else f'modes[{mode}].{name}'}(t, y)"


def arguments_in_words(size: int) -> str:
    """The arguments of a function of time and state, for a message."""
    return f"the time t, a number, and the state y, an array of shape ({size},)"


def _result(form: Form, name: str, mode: int) -> PyTree:
    """The shape and type that a function returns."""
    words = arguments_in_words(form.size) + (EXIT if name == "reset" else "")
    with named_errors(_name(name, mode), words):
        return jax.eval_shape(form.function(name, mode), *form.arguments)


def _require_shape(form: Form, name: str, mode: int, shape: tuple[int, ...]) -> None:
    """Raise `ValueError` unless a function returns an array of floats of a shape."""
    function_name, result = _name(name, mode), _result(form, name, mode)
    if not hasattr(result, "shape") or result.shape != shape:
        expected = "one number" if shape == () else f"an array of shape {shape}, like the start"
        fix = "jnp.array([...]) makes an array of numbers"
        if hasattr(result, "shape") and len(result.shape) == len(shape) == 1:
            fix = f"pass a start of {counted(result.shape[0], 'number')}, or return {counted(shape[0], 'number')}"
        raise ValueError(f"{function_name} must return {expected}, not {described(result)}; {fix}")
    if not jnp.issubdtype(result.dtype, jnp.floating):
        raise ValueError(f"{function_name} must return floats, not {result.dtype}: it must be smooth")


def _check_mode(form: Form, mode: int) -> tuple[int, bool]:
    """The number of margins of a mode, and whether it has a reset.

    **Raises:** `ValueError` unless the margins are floats, in an array or a dict if several, and a reset returns a state and
    a whole number.
    """
    _require_shape(form, "field", mode, (form.size,))
    result = _result(form, "margin", mode)
    if result is None:
        return 0, False
    parts = list(result.values()) if isinstance(result, dict) else [result]
    most = 0 if isinstance(result, dict) else 1
    if not parts or not all(hasattr(part, "shape") and part.ndim <= most and part.size for part in parts):
        raise ValueError(
            f"{_name('margin', mode)} must return one number, an array of shape (k,), a dict of numbers by name, or None, not "
            f"{described(result)}"
        )
    wrong = [part.dtype for part in parts if not jnp.issubdtype(part.dtype, jnp.floating)]
    if wrong:
        raise ValueError(f"{_name('margin', mode)} must return floats, not {wrong[0]}: it must be smooth")
    count, result = sum(part.size for part in parts), _result(form, "reset", mode)
    if result is None:
        return count, False
    expected = f"{_name('reset', mode)} must return (state, number of the next mode)"
    if not isinstance(result, tuple) or len(result) != 2:
        raise ValueError(f"{expected}, not {described(result)}")
    state, number = (jax.eval_shape(lambda part=part: part) if callable(part) else part for part in result)
    if getattr(state, "shape", None) != (form.size,):
        raise ValueError(f"{expected}; its state is {described(state)}, not an array of shape ({form.size},)")
    if getattr(number, "shape", None) != () or not jnp.issubdtype(number.dtype, jnp.integer):
        raise ValueError(f"{expected}; its number is {described(number)}, not a whole number")
    following: list[Any] = []
    jax.eval_shape(lambda *arguments: following.append(form.function("reset", mode)(*arguments)[1]), *form.arguments)
    if not is_traced(following) and not 0 <= following[0] < form.modes:
        known = "there is 1 mode (0)" if form.modes == 1 else f"there are {form.modes} modes (0 to {form.modes - 1})"
        raise ValueError(f"{_name('reset', mode)} returned mode {following[0]}; {known}")
    return count, True


# The checks of a mechanical system and of a start.


def is_pair(start: object) -> bool:
    """Whether a start is a pair (q, rate) of vectors."""
    return isinstance(start, tuple | list) and len(start) == 2 and all(np.ndim(as_number(part)) == 1 for part in start)


def check_start(system: Hybrid | AbstractSystem, start: Any) -> None:
    """Raise `ValueError` unless the start is one of this system, and warn of misspelt methods."""
    modes = [system] if isinstance(system, AbstractSystem) else system.modes
    for mode in modes:
        for field in dataclasses.fields(mode):
            if isinstance(value := getattr(mode, field.name), str) and field.type in (float, int):
                raise ValueError(f"{type(mode).__name__}: {field.name} = {value!r} is a text, not a number")
        warn_of_misspelt_methods(mode, AbstractSystem if isinstance(mode, AbstractSystem) else AbstractMode)
    mechanical = {number: mode for number, mode in enumerate(modes) if isinstance(mode, AbstractSystem)}
    sizes = {mode.dimension for mode in mechanical.values()}
    if len(sizes) > 1:
        raise ValueError(
            f"the systems among the modes must have one number of coordinates, not {', '.join(map(str, sorted(sizes)))}"
        )
    (size,) = sizes or (None,)
    if isinstance(system, AbstractSystem) and not (isinstance(start, tuple | list) and len(start) == 2):
        raise ValueError(f"start = {shown(start)} must be a pair (q, rate) of coordinates and their rates")
    if isinstance(system, AbstractSystem) or (mechanical and is_pair(start)):
        for name, part in zip(("q", "rate"), start, strict=True):
            _check_vector(part, f"start: {name}", size)
    else:
        _check_vector(start, "start", None if size is None else 2 * size)
    for number, mode in mechanical.items():
        prefix = "" if mode is system else f"modes[{number}]."
        names = [name for name in mechanics.ARGUMENTS if name == "margin" or mechanics.is_own(mode, name)]
        for name in (name for name in names if name in mechanics.TIMED):
            _check_signature(mode, name, prefix)
        if "frame" in names and mechanics.is_driven(mode):
            raise ValueError(
                f"{prefix}frame: quasi-velocities need constraints without a drift and functions that do not depend on time; "
                "leave frame out to run with Lagrange multipliers"
            )
        form = Form.of(Hybrid([Lagrange(mode)]), 2 * mode.dimension)[0]
        _check_functions(form, prefix, tuple(mechanics.written(mode, name) for name in names))


def _check_vector(value: ArrayOrList, name: str, size: int | None) -> None:
    value = as_number(value)
    if not isinstance(value, jax.Array):
        raise ValueError(f"{name} = {shown(value)} is not a list of numbers")
    require(value, name)
    shape = f"({'components' if size is None else size},)"
    if np.ndim(value) != 1 or np.size(value) == 0 or size not in (None, np.size(value)):
        example = (
            f": write [{shown(value)}]"
            if np.ndim(value) == 0 and size in (None, 1)
            else "; jax.vmap or sweep runs many"
        )
        raise ValueError(f"{name} must be of shape {shape}, not {np.shape(value)}{example}")


def _check_signature(system: AbstractSystem, name: str, prefix: str) -> None:
    """Raise `ValueError` unless a function that may depend on time takes its arguments, the time first."""
    signature, has_time = inspect.signature(getattr(system, name)), mechanics.takes_time(system, name)
    arguments = mechanics.ARGUMENTS[name]
    try:
        signature.bind(*range(has_time + 1 + arguments.count(",")))
        is_wrong = "t" in signature.parameters and not has_time
    except TypeError:
        is_wrong = True
    if is_wrong:
        raise ValueError(
            f"{prefix}{name}({', '.join(signature.parameters)}) must be {name}({arguments}) or, if it depends on time, "
            f"{name}(t, {arguments})"
        )


@functools.lru_cache(maxsize=256)
def _check_functions(form: Form, prefix: str, names: tuple[str, ...]) -> None:
    """Raise `ValueError` that names a function of a system that JAX cannot trace or that returns a wrong shape.

    **Arguments:** `form`: that of a `Hybrid` of one formulation, so that a system with other numbers is not traced
    again; `prefix`: that of the names of the functions; `names`: the functions with their arguments.
    """
    n = form.size // 2
    numbers, t, _ = form.arguments
    q = jax.ShapeDtypeStruct((n,), t.dtype)
    shapes = {}
    functions = {
        "metric": (f"of shape ({n}, {n})", lambda shape: shape == (n, n)),
        "potential": ("one number", lambda shape: shape == ()),
        "constraints": (
            f"of shape (k, {n}), a row for each constraint, such as jnp.array([[...]]) for one",
            lambda shape: shape is not None and len(shape) == 2 and shape[1] == n,
        ),
        "drift": (
            "of shape (k,), a number for each row of constraints",
            lambda shape: shape == shapes.get("constraints", (0,))[:1],
        ),
        "lagrangian": ("one number", lambda shape: shape == ()),
        "frame": (f"of shape ({n}, {n})", lambda shape: shape == (n, n)),
        "force": (f"of shape ({n},)", lambda shape: shape == (n,) or (n == 1 and shape == ())),
        "input": (
            f"of shape ({n}, ports), a column for each port",
            lambda shape: shape is not None and shape[:1] == (n,) and len(shape) == 2,
        ),
        "margin": (
            "one number, an array of shape (k,), a dict of numbers by name, or None",
            lambda shape: shape is None or (shape != "" and (set(shape) == {()} or len(shape) < 2)),
        ),
        "reset": (
            f"(q, rate), both of shape ({n},), or None; as a mode of a Hybrid also (q, rate, number of the next mode)",
            lambda shape: shape is None or (shape[:2] == ((n,), (n,)) and shape[2:] in ((), ((),))),
        ),
    }

    def called(method: str, numbers: Sequence[Array], *arguments: Array) -> PyTree:
        mode: Any = form.tree.tree(numbers).modes[0]
        system = mode.system
        exit = exit_of(system.margin(*arguments), 0) if method == "reset" else ()
        return getattr(system, method)(*arguments, *exit)

    for name in names:
        method, _, listed = name.removesuffix(")").partition("(")
        expected_shape, fits = functions[method]
        arguments = [t if argument == "t" else q for argument in listed.split(", ")]
        words = f"the coordinates q{' and their rates, each' if 'rate' in name else ','} of shape ({n},)"
        words = (f"the time t, a number, and {words}" if "(t" in name else words) + EXIT * (method == "reset")
        with named_errors(f"{prefix}{name}", words):
            result = jax.eval_shape(functools.partial(called, method), numbers, *arguments)
        shape = shapes[method] = _shape_of(result)
        if method == "margin" and result is None:
            break  # Nothing calls the reset.
        if not fits(shape):
            raise ValueError(f"{prefix}{name} must be {expected_shape}, not {shown(result) if shape == '' else shape}")
        if method in (*mechanics.TIMED, "frame") and not jnp.issubdtype(result.dtype, jnp.floating):
            raise ValueError(f"{prefix}{name} must return floats, not {result.dtype}: write 1.0 instead of 1")


def _shape_of(result: Any) -> Any:
    """The shape of an array, a tuple of those of several arrays, `None` for `None`, and "" for anything else."""
    result = tuple(result.values()) if isinstance(result, dict) else result
    if isinstance(result, tuple):
        return tuple(map(_shape_of, result))
    return None if result is None else getattr(result, "shape", "")


#: Least similarity of a name to a known one, as `difflib` measures it: "forces" and "force" have 0.91.
SIMILARITY = 0.75


def warn_of_misspelt_methods(part: AbstractMode | AbstractSystem, base: type) -> None:
    """Warn of every method of a mode or a system that resembles a method of its base class which the class does not
    define, unless another method of the class calls it; and of a reset without a margin.

    **Arguments:** `part`: an object of a user's class; `base`: `AbstractMode` or `AbstractSystem`.
    """
    kind = type(part)
    free = [name for name in vars(base) if not name.startswith("_") and getattr(kind, name) is getattr(base, name)]
    own = {name for parent in kind.__mro__[: kind.__mro__.index(base)] for name in vars(parent)}
    own -= {field.name for field in dataclasses.fields(kind)}
    methods = {name: getattr(kind, name) for name in sorted(own) if inspect.isfunction(getattr(kind, name, None))}
    for name in methods:
        matches = difflib.get_close_matches(name, free, 1, SIMILARITY)
        others = (function for other, function in methods.items() if other != name)
        if matches and not name.startswith("_") and not any(name in _names_in(other.__code__) for other in others):
            warn(f"{kind.__name__}.{name} is never called; did you mean {matches[0]}?")
    if "reset" not in free and "margin" in free:
        warn(f"{kind.__name__}.reset is never called: write margin too, which falls to zero where the reset happens")


def _names_in(code: CodeType) -> set[str]:
    """The names that a function and the functions inside it use."""
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names_in, inner))
