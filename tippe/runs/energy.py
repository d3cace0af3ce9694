"""Check runs by their energy: without a drive, energy never grows, and it decreases by the work of friction."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nonholonomic.integration.status import Status

from ..model.scene import Scene

#: Largest allowed error of the energy, relative to its size, divided by the tolerance. Flights over ripples and in a
#: spheroid stay below 1e-4 of this value; a faulty landing away from the arena once left 8e4 times this value.
BALANCED = 1e4


def allowance(scene: Scene[Any], energy: Any, tolerance: Any) -> Any:
    """The allowed error [J] of an energy of the given size [J] at a tolerance."""
    return BALANCED * tolerance * (abs(energy) + scene.body.mass * scene.gravity * scene.body.size)


def has_grown(
    scene: Scene[Any],
    before: Float[Array, "..."],
    after: Float[Array, "..."],
    tolerance: float | Float[Array, "..."],
) -> Bool[Array, "..."]:
    """Whether the energy [J] at the end of a run is greater than at its start, by more than the tolerance allows: then the
    arena's heights, the law of friction or the integration is wrong. NaN counts as not grown.
    """
    return jnp.asarray(after > before + allowance(scene, before, tolerance))


def if_balanced(run: Any, tolerance: float | Float[Array, ""]) -> Any:
    """A single run, with the status "unresolved" if its energy has grown or does not balance the work of friction and
    impacts."""
    energy = np.asarray(run.energy)
    limit = float(allowance(run.scene, np.max(np.abs(energy)), tolerance))
    balanced = run.stats["energy_residual"] <= limit and energy[-1] <= energy[0] + limit
    if balanced or run.status == Status.FAILED.word:
        return run
    return dataclasses.replace(run, status=Status.UNRESOLVED.word)


def why_unbalanced(run: Any) -> str:
    """The reason why such a run is "unresolved"."""
    energy = np.asarray(run.energy)
    if (gain := energy[-1] - energy[0]) > run.stats["energy_residual"]:
        return f"the energy has grown by {gain:.1e} J, although nothing drives the top"
    return f"the energy residual of {run.stats['energy_residual']:.1e} J is beyond what the tolerance allows"
