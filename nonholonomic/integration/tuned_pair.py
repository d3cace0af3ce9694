"""Explicit Runge-Kutta pairs of orders 8 and 7 whose free weights are tuned to a kind of motion.

The pairs have the thirteen stages, and all simplifying assumptions, of Prince and Dormand's pair RK8(7)13M (High order
embedded Runge-Kutta formulae, J. Comput. Appl. Math. 7, 1981), which is Diffrax's `Dopri8`. These assumptions leave ten
coefficients free. Prince and Dormand chose them for a small error in ninth order, for any field; `Oscillatory8` and
`Stabilized8` choose them for other purposes.

A continuous extension of order 7 needs no more stages, only the second derivatives at both ends
(`dense_samples.py`).
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import diffrax
import numpy as np

#: The error of a step is estimated by this factor times the difference between the two orders. With 2, smooth motions
#: take about as many steps as with Prince and Dormand's pair at the same tolerance, and err less.
CAUTION = 2.0


class AbstractTunedPair(diffrax.AbstractERK):
    """A pair of orders 8 and 7; `middle`: weights of the state in the middle of a step, of the stages, the field at the
    end, and the second derivatives at both ends. They satisfy the order conditions up to order 7.

    Its dense output in Diffrax is the cubic through states and rates at both ends (`Settings.for_single_runs`).
    """

    middle: ClassVar[tuple[float, ...]]
    interpolation_cls: ClassVar[Any] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms: Any) -> int:
        return 8


def tableau_of(
    stages: Sequence[Sequence[float]], eighth: Sequence[float], seventh: Sequence[float]
) -> diffrax.ButcherTableau:
    """The tableau of a pair.

    **Arguments:** `stages`: weights of the earlier stages in each stage from the second one on; `eighth`, `seventh`: weights
    of the stages in the step of eighth and of seventh order.
    """
    return diffrax.ButcherTableau(
        a_lower=tuple(map(np.array, (*stages, eighth))),
        b_sol=np.array([*eighth, 0.0]),
        b_error=np.array([*(CAUTION * np.subtract(eighth, seventh)), 0.0]),
        # The places of the stages in the step, and its end, where the next step begins.
        c=np.array([*(sum(row) for row in stages), 1.0]),
    )
