"""Common base of all modes of runs with flights."""

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.hybrid import AbstractBatchedMode

from ..model.scene import Scene
from ..model.top import Top


class AbstractFlyingMode(AbstractBatchedMode):
    """A mode of runs that continue through flights.

    - `scene`: with `contact="hybrid"`; `scales`: magnitudes that scale absolute errors of the state.
    - `cos_angle`: cosine of the angle of theta that is the event.
    - `rides`: whether this is a single run whose path is kept, with passive quadratures behind its state.
    """

    scene: Scene[Top]
    scales: Float[Array, "components cells"]
    cos_angle: Float[Array, "..."]
    rides: bool = eqx.field(static=True)

    @property
    def axial(self) -> Float[Array, "..."] | None:
        """The moment of inertia about the axis [kg m^2], `None` without passive quadratures."""
        return self.scene.body.I3 if self.rides else None
