"""A user's hybrid system without its numbers: the part for which JAX compiles a program, and the traits found by
tracing."""

import abc
import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..compilation.tracing import depends_on_first, is_elementary, jumps_of, named_errors, spelled_out, warn_of_unclear
from ..compilation.xla_cpu import opened, programs_in, traced
from ..formulations import AbstractSystem
from ..parameters import TreeForm
from ..text import described, shown

# A user's own hybrid system: smooth modes with resets between them, as functions of one state.

State = Float[Array, " components"]

#: The event function, of time [s] and state; the event happens when it falls through zero.
Event = Callable[[Float[Array, ""], State], Float[Array, ""]]


def values_of_margin(margin: Any) -> tuple[Array, ...]:
    """The values of a margin, one or several, in order."""
    if isinstance(margin, dict):
        return tuple(map(jnp.asarray, margin.values()))
    return (margin,) if jnp.ndim(margin) == 0 else tuple(margin[k] for k in range(margin.shape[0]))


def exit_of(margin: Any, number: Any) -> tuple[Any, ...]:
    """The further argument of a reset after the margin of this index has fallen, if there are several: the index, or for a
    dict whether it is the margin of each name."""
    if isinstance(margin, dict):
        return ({name: jnp.asarray(number) == k for k, name in enumerate(margin)},)
    return () if jnp.ndim(margin) == 0 else (jnp.asarray(number),)


class AbstractMode(eqx.Module):
    """A mode of a hybrid system: its equations of motion, its end, and the next mode. Subclass it, declare the
    parameters of your model as attributes, and write functions of a single time and a single state with `jax.numpy`.
    A class attribute such as `names = ("height", "velocity")` names the components of the state.
    You can sweep, fit and differentiate every attribute that is a float or an array. A mode that never ends needs only
    the method `field`.

    **Example:** a ball that falls and bounces.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Ball(nonholonomic.AbstractMode):
    ...     gravity: float = 9.81
    ...     restitution: float = 0.8
    ...
    ...     def field(self, t, y):
    ...         return jnp.array([y[1], -self.gravity])
    ...
    ...     def margin(self, t, y):
    ...         return y[0]
    ...
    ...     def reset(self, t, y):
    ...         return jnp.array([0.0, -self.restitution * y[1]]), 0
    >>> ball = nonholonomic.Hybrid([Ball()], event=lambda t, y: y[1])
    >>> time = nonholonomic.event_time(ball, jnp.array([1.0, 0.0]), t1=5.0)
    >>> print(f"highest again after {time:.4f} s")
    highest again after 0.8127 s

    ```
    """

    #: Names of the components of the state, such as ("height", "velocity"), in tables and pictures; by default "y0", "y1"
    #: and so on. One mode of a `Hybrid` is enough.
    names: ClassVar[tuple[str, ...] | None] = None

    @abc.abstractmethod
    def field(self, t: Float[Array, ""], y: State) -> State:
        """Rate of change of the state.

        **Arguments:** `t`: time [s]; `y`: state, (components,).

        **Returns:** the rate, (components,).
        """

    def margin(self, t: Float[Array, ""], y: State) -> Float[Array, "..."] | dict[str, Float[Array, ""]] | None:
        """A smooth function that is positive while the mode holds and falls through zero where it ends; or several such
        functions, of which the first to fall ends the mode.

        The function may change faster than the motion, as the height above a vibrating table or above waves: no zero is
        missed, unless the function contains an operation without bounds, such as a loop.

        **Arguments:** as for `field`.

        **Returns:** a number; several in an array, (k,), or in a dict by name; or `None`, the default, for a mode that never
        ends.
        """
        return None

    def reset(self, t: Float[Array, ""], y: State) -> tuple[State, Any] | None:
        """The state and mode that follow when the margin has fallen to zero.

        The margin of the next state may be zero if it then rises, as for a ball that has just bounced.

        **Arguments:** as for `field`, at the end of the mode. If there are several margins, write `reset(self, t, y, exit)`:
        `exit` is the index of the margin that fell in the array, a traced whole number, or for a dict a dict that is true for
        the name of the margin that fell and false for the others. Of margins that fall at the same time, the first one counts,
        and the others follow at once.

        **Returns:** the next state, (components,), and the index of the next mode in `Hybrid.modes`, a whole number
        that may depend on the state; or `None`, the default, if the run ends here.
        """
        return None


def require_event(event: Any) -> None:
    """Raise `ValueError` unless the event is a function."""
    if not callable(event):
        raise ValueError(f"event = {shown(event)} must be a function event(t, y) of time and state, or None")


def as_modes(modes: Any) -> Any:
    """A list of modes as a tuple; anything else stays unchanged, for later checks."""
    return tuple(modes) if isinstance(modes, list | tuple) else modes


class Hybrid(eqx.Module):
    """A hybrid system: modes of one state, and the event to be timed.

    **Arguments:**

    - `modes`: the modes, whose states have the same components. A mode can also be an `AbstractSystem` without a
      Lagrangian of its own: its state is its coordinates, followed by their rates, and its `reset` may return
      `(q, rate, number)` with the index of the next mode. A run then starts from the state or from a pair (q, rate).
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

    modes: tuple[AbstractMode | AbstractSystem, ...] = eqx.field(converter=as_modes)
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
            raise ValueError(
                f"first = {shown(self.first)} must be the number of a mode, from 0 to {len(self.modes) - 1}"
            )


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


#: A field with more operations on arrays is large: that of a car with a trailer has 800, that of a top in Euler angles 150.
LARGE = 60


class Traits(NamedTuple):
    """The traits of a hybrid system, found by tracing its functions.

    - `depends_on_time`: whether a function depends on time, which is then an additional component of the state.
    - `elementary`: whether all functions that are evaluated within steps fit a single kernel.
    - `ends`, `resets`: for each mode, the number of its margins, and whether it also has a reset.
    - `projected`: for each mode, whether it has constraints that a state may violate.
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

    def is_large(field: OfRun) -> bool:
        program, _ = traced(spelled_out(field), numbers, t, y)
        return sum(len(opened(inner)[0].eqns) for inner in programs_in(program)) > LARGE

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
        tuple(is_large(form.function("field", k)) for k in range(form.modes)),
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
