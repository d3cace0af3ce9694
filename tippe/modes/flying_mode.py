"""What all modes of runs through flights have in common."""

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.hybrid import AbstractBatchedMode

from ..model.scene import Scene


class AbstractFlyingMode(AbstractBatchedMode):
    """A mode of runs that go on through flights.

    - `scene`: with `contact="hybrid"`; `scales`: magnitudes by which absolute errors of the state are measured.
    - `cos_angle`: cosine of the angle of theta that is the event.
    - `rides`: whether it is a single run whose path is kept, so that more rides along behind its state.
    """

    scene: Scene
    scales: Float[Array, "components cells"]
    cos_angle: Float[Array, "..."]
    rides: bool = eqx.field(static=True)

    @property
    def axial(self) -> Float[Array, "..."] | None:
        """The moment of inertia about the axis [kg m^2], `None` where nothing rides along."""
        return self.scene.body.I3 if self.rides else None
