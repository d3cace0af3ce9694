"""A mode: its equations of motion, and its transition to the next mode, which may take time."""

import abc
from collections.abc import Callable, Sequence
from typing import ClassVar, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from ..integration import AbstractProblem, Lanes, States
from ..integration.scheduler import Numbers

#: A kind of mode.
Mode = TypeVar("Mode", bound="AbstractBatchedMode")


class TransitionPath(NamedTuple):
    """Path of a single run from one mode to the next, as successive stretches of motion in closed form.

    - `ends`: when each stretch ends [s], counted from the end of the mode; infinite for unused entries.
    - `motions`: for each stretch the argument of `AbstractBatchedMode.between`; the first axis of every leaf counts the
      stretches.
    - `shown`: number of default output times of each stretch.

    **Example:** a hop of 0.4 s in closed form, drawn with three points.

    >>> from nonholonomic.hybrid import TransitionPath
    >>> record = TransitionPath(jnp.array([[0.4]]), {"speed": jnp.array([[1.962]])}, jnp.array([[3]]))
    """

    ends: Float[Array, " stretches 1"]
    motions: PyTree
    shown: Int[Array, " stretches 1"]


class Transition(NamedTuple, Generic[Numbers]):
    """The result of a reset map, one number per cell.

    `status` is `RUNNING` where the motion continues in the mode numbered `mode`, otherwise the code for how it ended;
    `state` is the new state, `elapsed` [s] the duration of the transition, and `crossing_time` [s] the last time of the
    event during the transition, infinite if there was none. `counts` contains the counters, one per row. `record` is
    the path of a single run (`ensemble.py`); `None` for instantaneous transitions, or where no path is kept. `log_rates` is
    the sum of the logarithms of the rates of the event functions at the events during the transition; `None` if there
    are none.

    **Example:** the bounce of both balls at 5 m/s.

    >>> transition = modes[0].reset_map(jnp.array([[0.0, 0.0], [-5.0, -5.0]]), jnp.ones(2))
    >>> print(transition.state[1], transition.mode)
    [3. 4.] [0 0]
    """

    mode: Int[Numbers, " cells"]
    state: Float[Numbers, "components cells"]
    elapsed: Float[Numbers, " cells"]
    status: Int[Numbers, " cells"]
    crossing_time: Float[Numbers, " cells"]
    counts: Int[Numbers, "counters cells"]
    record: TransitionPath | None = None
    log_rates: Float[Numbers, " cells"] | None = None


class AbstractBatchedMode(eqx.Module):
    """One mode of a hybrid system. Its leaves are scalars, or hold one number per cell in their last axis.

    **Example:** the mode of the subpackage's example, at its start.

    >>> print(modes[0].problem(start).field(0.0, start)[1])
    [-9.81 -9.81]
    """

    #: Whether few runs enter the mode: its programs are compiled when a run enters it, not beforehand.
    rare: ClassVar[bool] = False

    @abc.abstractmethod
    def problem(self, state: States) -> AbstractProblem:
        """The motion in this mode from the given states; the mode ends where the problem's domain margin vanishes."""

    @abc.abstractmethod
    def reset_map(self, state: States, left: Lanes) -> Transition:
        """Map the states at the end of the mode, where the domain margin vanishes, to the start of the next mode.

        **Arguments:**

        - `state`: the states at the end of the mode.
        - `left`: time [s] to the horizon.

        **Returns:** a `Transition`, which ends with `REACHED_END` where it would take longer than `left`.
        """

    def shown(self, state: Float[Array, "components times"]) -> Float[Array, "shown times"]:
        """Map mode states to output rows; every mode must return the same number of rows."""
        return state

    def between(self, motion: PyTree, passed: Float[Array, " times"]) -> Float[Array, "shown times"]:
        """The output rows of one stretch in `Transition.record`, at times [s] counted from its start."""
        raise NotImplementedError(f"{type(self).__name__} records stretches but does not say what they show")


class AbstractHoppingMode(AbstractBatchedMode):
    """A mode whose reset map is a succession of stretches of motion in closed form, each with a jump at its end.

    The reset map continues while `open` is true for the current stretch, for at most `most_hops` stretches; `elapsed`
    [s] of a stretch is the time since the end of the mode.

    **Example:** small hops of a ball, and the first of them.

    >>> from typing import NamedTuple
    >>> from nonholonomic.hybrid import AbstractHoppingMode
    >>> class Hop(NamedTuple):
    ...     speed: jax.Array
    ...     elapsed: jax.Array
    ...     open: jax.Array
    >>> class Hops(Bounce, AbstractHoppingMode):
    ...     most_hops = 100
    ...     def lost(self, state):
    ...         return Hop(-self.restitution * state[1], 0.0 * state[1], state[1] < -0.1)
    ...     def hop(self, stretch, left):
    ...         end = stretch._replace(elapsed=stretch.elapsed + 2.0 * stretch.speed / 9.81)
    ...         return end, Hop(self.restitution * stretch.speed, end.elapsed, stretch.speed > 0.1)
    ...     def closed(self, stretch):
    ...         return self.reset_map(jnp.stack([0.0 * stretch.speed, -stretch.speed]), stretch.elapsed)
    ...     def motion_in(self, stretch):
    ...         return stretch.speed
    >>> hops = Hops(jnp.array([0.6, 0.8]))
    >>> end, following = hops.hop(hops.lost(jnp.array([[0.0, 0.0], [-9.81, -9.81]])), jnp.ones(2))
    >>> print(end.elapsed, (following.speed / 9.81).round(2))
    [1.2 1.6] [0.36 0.64]
    """

    most_hops: ClassVar[int]

    @abc.abstractmethod
    def lost(self, state: States) -> PyTree:
        """The first stretch of motion after the mode, which starts from the states at its end."""

    @abc.abstractmethod
    def hop(self, stretch: PyTree, left: Lanes) -> tuple[PyTree, PyTree]:
        """Follow one stretch of motion; `left` [s] is the time from the end of the mode to the horizon.

        **Returns:** the stretch at its end, before the jump; and the next stretch, after the jump.
        """

    @abc.abstractmethod
    def closed(self, stretch: PyTree) -> Transition:
        """The transition that the last stretch leads to, without a record."""

    @abc.abstractmethod
    def motion_in(self, stretch: PyTree) -> PyTree:
        """The argument of `between` for a stretch that begins."""


def over_cells(function: Callable[..., PyTree], mode: AbstractBatchedMode) -> Callable[..., PyTree]:
    """Map a function of the mode of one run, and of more arguments, over cells, which are in the last axis of every
    array."""

    def mapped(*arguments: PyTree) -> PyTree:
        axes = (lambda leaf: -1 if eqx.is_array(leaf) and leaf.ndim else None, *[-1] * len(arguments))
        return eqx.filter_vmap(function, in_axes=axes, out_axes=-1)(mode, *arguments)

    return mapped


def mode_of_cells(mode: Mode, cell: Int[Numbers, " selected"]) -> Mode:
    """The mode of the cells with these indices."""
    numbers, static = eqx.partition(mode, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda leaf: leaf if leaf.ndim == 0 else leaf[..., cell], numbers), static)


def program_groups(modes: Sequence[AbstractBatchedMode]) -> list[tuple[int, ...]]:
    """The indices of the modes, in groups. The modes of a group differ only in the values of their arrays, so they
    share a program."""
    # The modes with the shapes of their arrays in place of their values.
    shapes = [
        jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)) if eqx.is_array(leaf) else leaf, mode) for mode in modes
    ]
    firsts = [next(k for k, other in enumerate(shapes) if eqx.tree_equal(other, shape)) for shape in shapes]
    return [tuple(k for k, other in enumerate(firsts) if other == first) for first in dict.fromkeys(firsts)]


def mode_numbered(modes: Sequence[Mode], numbers: Sequence[int], selected: Int[Array, "..."]) -> Mode:
    """The mode numbered `selected` in one of the `program_groups`."""
    mode = modes[numbers[0]]
    for number in numbers[1:]:

        def leaf(old: PyTree, new: PyTree, number: int = number) -> PyTree:
            return old if old is new or not eqx.is_array(old) else jnp.where(selected == number, new, old)

        mode = jax.tree.map(leaf, mode, modes[number])
    return mode
