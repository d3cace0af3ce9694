"""Rides for the host, as data that can leave a transformation."""

from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import Settings
from nonholonomic.integration.status import REACHED_END

from ..model.input import Input
from ..model.launch import Launch
from ..model.scene import Scene

#: The coefficient of friction [1] that no tyre exceeds on a dry road: 0.7 to 1.0 is usual, and 1.8 is that of racing slicks
#: (Milliken and Milliken, Race Car Vehicle Dynamics (1995), chapter 2).
MOST_GRIP = 1.8


class Stats(NamedTuple):
    """Numbers of accepted and rejected steps, and whether the integration reached its end."""

    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    finished: Bool[Array, ""]


class Ride(NamedTuple):
    """A ride and the options of its integration.

    - `model`: the `RideModel` with scene, launch and input; `t1`: end [s].
    - `grid`: the ends of the steps [s] of a solver without an error estimate.
    """

    model: Any
    t1: Float[Array, ""]
    settings: Settings
    grid: Float[Array, " steps"] | None

    @property
    def scene(self) -> Scene:
        return self.model.scene

    @property
    def launch(self) -> Launch:
        return self.model.launch

    @property
    def input(self) -> Input | None:
        return self.model.input


class RideSpec(eqx.Module):
    """A `Ride` that can leave a transformation: its numbers are leaves and everything else is static."""

    numbers: Any
    static: Any = eqx.field(static=True)

    @classmethod
    def of(cls, ride: Ride) -> "RideSpec":
        """The specification of a ride."""
        return cls(*eqx.partition(ride, eqx.is_array_like))

    @property
    def ride(self) -> Ride:
        """The ride."""
        return eqx.combine(self.numbers, self.static)


def stats_of(outcome: HybridOutcome[Array]) -> Stats:
    """The statistics of a run of one cell."""
    accepted, rejected = outcome.steps[0] - outcome.rejected[0], outcome.rejected[0]
    return Stats(accepted.astype(int), rejected.astype(int), outcome.status[0] == REACHED_END)
