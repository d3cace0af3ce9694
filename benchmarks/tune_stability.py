"""Compute the weights of `Stabilized8`: the pair of its family that stays stable in the longest steps on a decay.

    python benchmarks/tune_stability.py

A step of length h along y' = -k y multiplies y by R(-h k), a polynomial of degree 12 whose first coefficients, up to the
eighth, are those of the exponential function. The other four determine how far |R| <= 1 on the negative axis. A linear
program computes them for the interval `INTERVAL`, on which |R| <= `DAMPING` where the exponential itself is small.

The script starts from `Oscillatory8`, whose family (`tuning/family.py`) leaves ten weights free, moves these four
coefficients to their goal in ten moves, and after each move minimises the errors in ninth order and the weights, because
large weights magnify round-off. It prints the interval, the errors and the weights, and takes two minutes.
"""

import math
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from measure import machine
from numpy.polynomial import Chebyshev, Polynomial
from scipy.optimize import linprog
from tune_pair import descended
from tuning.family import STAGES, Pair, Unknowns, pair_of, unknowns_of
from tuning.trees import error_coefficients

from nonholonomic.integration import Oscillatory8
from nonholonomic.integration.runge_kutta import CAUTION

#: The pair is stable for -INTERVAL <= z <= 0, with |R(z)| <= DAMPING beyond z = -3. For degree 12 and eighth order, 17.2
#: would be the limit without damping.
INTERVAL, DAMPING = 16.5, 0.9

#: Order of the step, and degree of R: the thirteenth stage contributes nothing to it.
ORDER, DEGREE = 8, 12

#: How much an error in ninth order and a weight count, and a coefficient of R: at first little, so that the search for
#: small errors does not have to follow a narrow valley.
NINTH, SMALLNESS, HOLDS = 1e5, 0.03, (30.0, 3000.0, 1e5)

#: The coefficients of R from the ninth on, times their factorials.
FACTORIALS = np.array([math.factorial(k) for k in range(ORDER + 1, DEGREE + 1)], dtype=float)


def polynomial(pair: Pair) -> Any:
    """The coefficients of R: 1, and the weights of the step times powers of its stages."""
    powers, coefficients = jnp.ones(STAGES), [jnp.ones(())]
    for _ in range(DEGREE):
        coefficients.append(pair.eighth @ powers)
        powers = pair.stages @ powers
    return jnp.stack(coefficients)


def interval(coefficients: Any) -> float:
    """The end of the interval of stability on the negative axis."""
    places = np.linspace(0.0, 30.0, 300_001)
    is_unstable = np.abs(np.polyval(np.asarray(coefficients)[::-1], -places)) > 1.0 + 1e-12
    return float(places[np.argmax(is_unstable)])


def goal() -> np.ndarray:
    """The last coefficients of R, times their factorials, for which the greatest |R| / limit on the interval is least."""
    # Places as dense at the ends of the interval as the polynomials below change there.
    places = -0.5 * INTERVAL * (1.0 - np.cos(np.linspace(0.0, np.pi, 1500)))
    fixed = sum(places**k / math.factorial(k) for k in range(ORDER + 1))
    shapes = [Chebyshev.basis(k, domain=[-INTERVAL, 0.0]).convert(kind=Polynomial) for k in range(DEGREE - ORDER)]
    basis = [shape * Polynomial([0.0] * (ORDER + 1) + [INTERVAL ** -(ORDER + 1)]) for shape in shapes]
    values = np.stack([shape(places) for shape in basis], axis=1)
    limits = np.where(places > -3.0, 1.0, DAMPING)[:, None]
    rows = np.block([[values, -limits], [-values, -limits]])
    least = [0.0] * len(basis) + [1.0]
    free = [(None, None)] * len(basis) + [(0.0, None)]
    solution = linprog(least, A_ub=rows, b_ub=np.concatenate([-fixed, fixed]), bounds=free, method="highs")
    total = sum((factor * shape for factor, shape in zip(solution.x, basis, strict=False)), Polynomial([0.0]))
    return total.coef[ORDER + 1 :] * FACTORIALS


@jax.jit
def _terms(unknowns: Unknowns) -> tuple[Any, Any]:
    pair = pair_of(unknowns)
    return polynomial(pair)[ORDER + 1 :] * FACTORIALS, error_coefficients(pair.stages, pair.eighth, ORDER + 1)


_slopes = jax.jit(jax.jacfwd(_terms))


class StabilityAim:
    """The objective: the distance from the coefficients of R, the errors in ninth order, and the weights."""

    def __init__(self, coefficients: np.ndarray, hold: float):
        self.coefficients, self.hold = coefficients, hold

    def __call__(self, unknowns: Unknowns) -> float:
        return 0.5 * float(np.sum(self.least_squares(unknowns)[0] ** 2))

    def least_squares(self, unknowns: Unknowns) -> tuple[Any, Any]:
        """Residuals whose sum of squares is twice the objective, and their slopes."""
        (ends, ninth), (end_slopes, ninth_slopes) = _terms(unknowns), _slopes(unknowns)
        residuals = [
            self.hold * (np.asarray(ends) - self.coefficients),
            NINTH * np.asarray(ninth),
            SMALLNESS * unknowns,
        ]
        rows = [self.hold * np.asarray(end_slopes), NINTH * np.asarray(ninth_slopes), SMALLNESS * np.eye(len(unknowns))]
        return np.concatenate(residuals), np.concatenate(rows)


def main() -> None:
    """Compute and print."""
    print(machine())
    unknowns = unknowns_of(Oscillatory8.tableau, CAUTION)
    start, end = np.asarray(_terms(unknowns)[0]), goal()
    for part in np.linspace(0.1, 1.0, 10):
        for hold in HOLDS:
            unknowns, height = descended(StabilityAim(start + part * (end - start), hold), unknowns, passes=200)
        pair = pair_of(unknowns)
        print(f"{part:.0%}: aim {height:.4f}, stable to -{interval(polynomial(pair)):.2f}", flush=True)
    for name, stages in (("this pair", pair), ("Dopri8", pair_of(unknowns_of(diffrax.Dopri8.tableau)))):
        ninth = jnp.linalg.norm(error_coefficients(stages.stages, stages.eighth, 9))
        eighth = jnp.linalg.norm(error_coefficients(stages.stages, stages.seventh, 8))
        print(
            f"{name}: T9 {ninth:.2e}, T8 of the seventh order {eighth:.2e}, weights {jnp.abs(stages.stages).max():.1f}"
        )
    for name, rows in pair._asdict().items():
        print(name, *(repr(row.tolist()) for row in np.atleast_2d(np.asarray(rows))), sep="\n")


if __name__ == "__main__":
    main()
