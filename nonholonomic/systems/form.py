"""A user's hybrid system without its numbers: the part for which JAX compiles a program, and the traits found by
tracing."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..lanes.comparisons import jumps_of, warn_of_unclear
from ..lanes.tracing import depends_on_first, is_elementary, named_errors, spelled_out
from ..parameters import TreeForm
from ..text import described
from .mode import Hybrid, State, exit_of, values_of_margin

#: The last argument of a reset, in words for a message.
EXIT = "; and exit, which of them fell, if the mode has several margins"

#: A function of the numbers, the time and the state of one run.
OfRun = Callable[..., Any]


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

    def system(self, numbers: Sequence[Array]) -> Hybrid:
        """The system with the given numbers, each a scalar."""
        return self.tree.tree(numbers)

    def function(self, name: str, mode: int = 0) -> OfRun:
        """One of the user's functions: "field", "margin" or "reset" of a mode, or "event"; "margins", the values of the margin
        as a tuple; or "entered", which projects the state after a reset to a mode onto its constraints. A reset also receives
        the index of the margin that fell."""

        def called(numbers: Sequence[Array], t: Array, y: State, exit: Any = 0) -> Any:
            system = self.system(numbers)
            if name == "event":
                assert system.event is not None
                return system.event(t, y)
            part: Any = system.modes[mode]
            if name == "margins":
                return values_of_margin(part.margin(t, y))
            return getattr(part, name)(t, y, *(exit_of(part.margin(t, y), exit) if name == "reset" else ()))

        return called

    def jump_times(self, mode: int, numbers: Sequence[Array]) -> Array:
        """The times at which the functions of a mode that are evaluated within steps may jump, (jumps,)."""
        _, t, y = self.arguments
        names = ["field", *(["margins"] if self.traits.ends[mode] else []), *(["event"] if self.has_event else [])]
        functions = [functools.partial(self.function(name, mode), numbers) for name in names]
        return jnp.concatenate([jumps_of(function, t, y)[0] for function in functions])

    @property
    def arguments(self) -> tuple[Any, ...]:
        """The shapes of the functions' arguments."""
        real = jnp.result_type(float)
        return self.tree.types, jax.ShapeDtypeStruct((), real), jax.ShapeDtypeStruct((self.size,), real)

    @property
    def traits(self) -> "Traits":
        """The traits found by tracing the functions."""
        return _traits(self)


class Traits(NamedTuple):
    """The traits of a hybrid system, found by tracing its functions.

    - `depends_on_time`: whether a function depends on time, which is then an additional component of the state.
    - `elementary`: whether all functions that are evaluated within steps fit a single kernel.
    - `ends`, `resets`: for each mode, the number of its margins, and whether it also has a reset.
    - `projected`: for each mode, whether it has constraints that a state may violate.
    """

    depends_on_time: bool
    elementary: bool
    ends: tuple[int, ...]
    resets: tuple[bool, ...]
    projected: tuple[bool, ...]

    @property
    def smooth(self) -> bool:
        """Whether a run is one smooth motion, without resets."""
        return len(self.ends) == 1 and not self.resets[0]


@functools.lru_cache(maxsize=256)
def _traits(form: Form) -> Traits:
    """The traits of a form; also checks its functions.

    **Raises:** `ValueError` that names a function that returns a wrong type or shape.
    """
    ends, resets, step_functions, reset_functions = [], [], [], []
    for k in range(form.modes):
        _require_shape(form, "field", k, (form.size,))
        ends.append(_margin_count(form, k))
        reset = _result(form, "reset", k) if ends[k] else None
        resets.append(reset is not None)
        step_functions.append(form.function("field", k))
        if ends[k]:
            step_functions.append(form.function("margins", k))
        if reset is not None:
            _require_pair(form, k, reset)
            reset_functions.append(form.function("reset", k))
    if form.has_event:
        _require_shape(form, "event", 0, ())
        step_functions.append(form.function("event"))

    def combined(functions: list[OfRun]) -> Callable[..., Any]:
        return lambda t, y, *numbers: [function(numbers, t, y) for function in functions]

    numbers, t, y = form.arguments

    def warned(numbers: Sequence[Array]) -> None:
        for k, own in itertools.product(range(form.modes), ("field", "margins")):
            if own == "field" or ends[k]:
                warn_of_unclear(_name(own.rstrip("s"), k), functools.partial(form.function(own, k), numbers), y)

    modes = form.system([jnp.zeros((), kind.dtype) for kind in numbers]).modes
    depends_on_time = depends_on_first(combined([*step_functions, *reset_functions]), t, y, *numbers)
    if depends_on_time:
        jax.eval_shape(warned, numbers)
    return Traits(
        depends_on_time,
        is_elementary(spelled_out(combined(step_functions)), t, y, *numbers),
        tuple(ends),
        tuple(resets),
        tuple(getattr(mode, "is_projected", False) for mode in modes),
    )


def _name(name: str, mode: int) -> str:
    return f"{name if name == 'event' else f'modes[{mode}].{name}'}(t, y)"


def arguments_in_words(size: int) -> str:
    """The arguments of a function of time and state, for a message."""
    return f"the time t, a number, and the state y, an array of shape ({size},)"


def _result(form: Form, name: str, mode: int) -> Any:
    """The shape and type that a function returns."""
    words = arguments_in_words(form.size) + (EXIT if name == "reset" else "")
    with named_errors(_name(name, mode), words):
        return jax.eval_shape(form.function(name, mode), *form.arguments)


def _margin_count(form: Form, mode: int) -> int:
    """The number of margins of a mode. **Raises:** `ValueError` unless they are floats, in an array or a dict if several."""
    result = _result(form, "margin", mode)
    if result is None:
        return 0
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
    return sum(part.size for part in parts)


def _require_shape(form: Form, name: str, mode: int, shape: tuple[int, ...]) -> None:
    """Raise `ValueError` unless a function returns an array of floats of a shape."""
    function_name, result = _name(name, mode), _result(form, name, mode)
    if not hasattr(result, "shape") or result.shape != shape:
        expected = "one number" if shape == () else f"an array of shape {shape}, like the start"
        raise ValueError(
            f"{function_name} must return {expected}, not {described(result)}; jnp.array([...]) makes an array of numbers"
        )
    if not jnp.issubdtype(result.dtype, jnp.floating):
        raise ValueError(f"{function_name} must return floats, not {result.dtype}: it must be smooth")


def _require_pair(form: Form, mode: int, result: Any) -> None:
    """Raise `ValueError` unless a reset returns a state and a whole number."""
    expected = f"modes[{mode}].reset(t, y) must return (state, number of the next mode)"
    if not isinstance(result, tuple) or len(result) != 2:
        raise ValueError(f"{expected}, not {described(result)}")
    state, number = (jax.eval_shape(lambda part=part: part) if callable(part) else part for part in result)
    if getattr(state, "shape", None) != (form.size,):
        raise ValueError(f"{expected}; its state is {described(state)}, not an array of shape ({form.size},)")
    if getattr(number, "shape", None) != () or not jnp.issubdtype(number.dtype, jnp.integer):
        raise ValueError(f"{expected}; its number is {described(number)}, not a whole number")
