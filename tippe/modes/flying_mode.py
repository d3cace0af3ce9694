"""Common base of all modes of runs with flights."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.hybrid import AbstractBatchedMode
from nonholonomic.integration import AbstractPassive, AbstractProblem, ExtendedProblem

from ..model.scene import Scene
from ..model.top import Top


class AbstractFlyingMode(AbstractBatchedMode):
    """A mode of runs that continue through flights.

    - `scene`: a scene with `contact="hybrid"`; `scales`: magnitudes that scale absolute errors of the state.
    - `cos_angle`: cosine of the theta that is the event.
    - `stem_counts`: as for `InversionProblem`; `None` for a top without a stem.
    - `with_quadratures`: whether this is a single run whose path is kept, with passive quadratures after its state.
    """

    scene: Scene[Top]
    scales: Float[Array, "components cells"]
    cos_angle: Float[Array, "..."]
    with_quadratures: bool = eqx.field(static=True)
    stem_counts: Any = eqx.field(kw_only=True, default=None)

    def extended(
        self, problem: AbstractProblem, passive: AbstractPassive, state: Float[Array, "components cells"]
    ) -> AbstractProblem:
        """The problem for given states, including the passive quadratures."""
        size = len(problem.start()[0])
        if not self.with_quadratures:
            return problem
        return ExtendedProblem(problem, passive, state[size:], self.scales[size:])
