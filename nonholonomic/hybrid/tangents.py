"""Ensembles of hybrid runs with the derivatives of the times of their events, which `saltation.py` carries through every
change of mode.
"""

from typing import Any, Generic, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..derivatives import in_groups
from ..integration import Settings
from ..integration.scheduler import Numbers
from ..integration.status import CROSSED, REACHED_END
from .ensemble import HybridOutcome, solve_hybrid, traced_solve_hybrid
from .mode import AbstractBatchedMode
from .saltation import VariationalMode, variational_modes, variational_start


class Slopes(NamedTuple, Generic[Numbers]):
    """Derivatives of the times of the events at which runs ended, (tangents, cells); and a mask of those that are NaN
    because an earlier event was `grazing`, so that the derivative would have no correct digits.
    """

    slopes: Float[Numbers, "tangents cells"]
    grazing: Bool[Numbers, " cells"]


def solve_hybrid_with_tangents(
    modes: tuple[AbstractBatchedMode, ...],
    tangents: tuple[tuple[tuple[Any, ...], Any], ...],
    mode: Int[np.ndarray, " cells"],
    state: Float[np.ndarray, "components cells"],
    t1: float | Float[np.ndarray, "..."],
    cells: int,
    settings: Settings,
    *,
    counters: int,
    ends_on_event: bool = True,
) -> tuple[HybridOutcome[np.ndarray], Slopes[np.ndarray]]:
    """Run every cell through its modes to its event, and differentiate the event's time along tangents.

    **Arguments:** as for `solve_hybrid`, and

    - `tangents`: pairs of the tangents of the modes and the tangent of the states, with `None` for leaves that do not
      move.
    - `ends_on_event`: whether runs end on the event; otherwise they end at `t1`, which then counts as the event's time.

    **Returns:** the `HybridOutcome`, and the `Slopes`, 0 where there is no event or the event is at the start.
    Source: implicit function theorem at the event, saltation at every change of mode.

    **Example:** the derivative with respect to the restitution.

    >>> from nonholonomic.hybrid import solve_hybrid_with_tangents
    >>> tangents = (((Bounce(jnp.ones(2)),), None),)
    >>> _, sensitivities = solve_hybrid_with_tangents(modes, tangents, first, start, 5.0, 2, settings, counters=1)
    >>> print(sensitivities.slopes.round(6))  # the time of the fall
    [[0.451524 0.451524]]
    """
    variational = variational_modes(modes, tangents, settings.tolerance, ends_on_event)
    start, n_blocks = np.asarray(variational_start(jnp.asarray(state), tangents)), 1 + len(tangents)
    ended = solve_hybrid(variational, mode, start, t1, cells, settings, counters=counters + 1, n_blocks=n_blocks)
    slopes = [np.asarray(_slopes(varied_mode, jnp.asarray(ended.state))) for varied_mode in variational]
    return _without_variations(ended, len(state)), _where_defined(np, ended, slopes, t1, ends_on_event)


def traced_solve_hybrid_with_tangents(
    modes: tuple[AbstractBatchedMode, ...],
    tangents: tuple[tuple[tuple[Any, ...], Any], ...],
    mode: Int[Array, " cells"],
    state: Float[Array, "components cells"],
    t1: Float[Array, "..."],
    cells: int,
    settings: Settings,
    *,
    counters: int,
    ends_on_event: bool = True,
) -> tuple[HybridOutcome[Array], Slopes[Array]]:
    """`solve_hybrid_with_tangents` inside other transformed functions; arguments and results are traced.

    **Example:** as for `solve_hybrid_with_tangents`.

    >>> from nonholonomic.hybrid import traced_solve_hybrid_with_tangents
    >>> tangents, options = (((Bounce(jnp.ones(2)),), None),), (jnp.asarray(first), jnp.asarray(start), 5.0, 2, settings)
    >>> _, sensitivities = traced_solve_hybrid_with_tangents(modes, tangents, *options, counters=1)
    >>> print(sensitivities.slopes.round(6))
    [[0.451524 0.451524]]
    """

    def run(group: tuple[Any, ...]) -> tuple[tuple[HybridOutcome[Array], Array], list[Float[Array, " cells"]]]:
        variational = variational_modes(modes, group, settings.tolerance, ends_on_event)
        start, n_blocks = variational_start(state, group), 1 + len(group)
        ended = traced_solve_hybrid(
            variational, mode, start, t1, cells, settings, counters=counters + 1, n_blocks=n_blocks
        )
        slopes = [varied_mode.slopes(ended.state) for varied_mode in variational]
        mask = _where_defined(jnp, ended, slopes, t1, ends_on_event)
        return (_without_variations(ended, len(state)), mask.grazing), list(mask.slopes)

    (outcome, grazing), slopes = in_groups(run, tangents)
    return outcome, Slopes(jnp.stack(slopes), grazing)


def _where_defined(
    xp: Any, ended: HybridOutcome[Numbers], slopes: list[Float[Numbers, "tangents cells"]], t1: Any, ends_on_event: bool
) -> Slopes[Numbers]:
    """The derivatives of the times of events, of each cell by its mode, where the events happened and the derivatives
    have correct digits.

    A run that has ended between two modes is in neither. Its event is the end of the previous mode, whose variation is
    the last row.
    """
    of_cells = xp.reshape(ended.state, (1 + len(slopes[0]), -1, len(ended.mode)))[1:, -1]
    for number, of_mode in enumerate(slopes):
        of_cells = xp.where(ended.mode == number, of_mode, of_cells)
    event_time = ended.crossing_time if ends_on_event else xp.broadcast_to(t1, ended.mode.shape)
    # An event at the start has a fixed time, whatever the tangent.
    has_event = xp.isfinite(event_time) & (event_time > 0.0)
    # With its variations a run takes other steps: where it does not reach the event, it has no derivative.
    arrived = ended.status == (CROSSED if ends_on_event else REACHED_END)
    grazing = has_event & ((ended.counts[-1] > 0) | ~arrived)
    return Slopes(xp.where(has_event, xp.where(grazing, xp.nan, of_cells), 0.0), grazing)


def _without_variations(ended: HybridOutcome[Numbers], size: int) -> HybridOutcome[Numbers]:
    """A hybrid outcome without its variations."""
    return ended._replace(state=ended.state[:size], counts=ended.counts[:-1])


_slopes = eqx.filter_jit(VariationalMode.slopes)
