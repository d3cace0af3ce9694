"""A user's own hybrid system: smooth modes with resets between them, as functions of one state."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..formulations import AbstractSystem
from ..validation import shown

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
