"""The family of Runge-Kutta pairs of orders 8 and 7 to which Prince and Dormand's RK8(7)13M belongs.

The pairs have thirteen stages, of which only the next stages use the second and the third, and satisfy all simplifying
assumptions of that pair. The unknowns are the weights that may differ from 0; the equations leave ten of them free.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

STAGES = 13

#: The stages that each stage may use: the second and third no other than the next ones, the last not the one before it.
USED = [
    [0],
    [0, 1],
    [0, 2],
    [0, 2, 3],
    [0, 3, 4],
    *([0, *range(3, stage)] for stage in range(6, 12)),
    [0, *range(3, 11)],
]
AT = np.array([(stage, used) for stage, row in enumerate(USED, 1) for used in row]).T

#: The stages with weights in a step.
WEIGHTED = np.array([0, *range(5, STAGES)])

Unknowns = Float[Array, " unknowns"]


class Pair(NamedTuple):
    """The stages, and the weights of the steps of eighth and seventh order."""

    stages: Float[Array, "stages stages"]
    eighth: Float[Array, " stages"]
    seventh: Float[Array, " stages"]


def pair_of(unknowns: Unknowns) -> Pair:
    """The pair with the given weights."""
    inner, count = AT.shape[1], len(WEIGHTED)
    empty = jnp.zeros(STAGES)
    return Pair(
        jnp.zeros((STAGES, STAGES)).at[tuple(AT)].set(unknowns[:inner]),
        empty.at[WEIGHTED].set(unknowns[inner : inner + count]),
        empty.at[WEIGHTED].set(unknowns[inner + count :]),
    )


def unknowns_of(tableau: diffrax.ButcherTableau, caution: float = 1.0) -> Unknowns:
    """The weights of a pair of this family, whose last stage in Diffrax is the end of the step; `caution`: ratio of its
    error estimate to the difference of the two steps."""
    stages = np.zeros((STAGES, STAGES))
    for stage, row in enumerate(tableau.a_lower[: STAGES - 1], 1):
        stages[stage, :stage] = row
    eighth = tableau.b_sol[:STAGES]
    seventh = eighth - tableau.b_error[:STAGES] / caution
    return jnp.concatenate([stages[tuple(AT)], eighth[WEIGHTED], seventh[WEIGHTED]])


@jax.jit
def equations(unknowns: Unknowns) -> Float[Array, " equations"]:
    """The expressions that vanish for a pair of this family, where c are the row sums of A, and b and h the weights of
    the steps.

    For the stages, A c^k = c^(k+1) / (k+1) for k = 1, 2, 3, except for the first stages. For the steps, w A = w (1 -
    c), and the quadrature conditions; the fourth and fifth stages have a lower order than the others, so their
    contributions to products of two or three stages must vanish. Then one more condition remains for seventh order, and
    three for eighth order.
    """
    A, b, h = pair_of(unknowns)
    c = A.sum(axis=1)
    poor_pair, rich_pair = slice(3, 5), slice(5, None)
    residuals = [
        (A @ c - c**2 / 2.0)[2:],
        (A @ c**2 - c**3 / 3.0)[3:],
        (A @ c**3 - c**4 / 4.0)[rich_pair],
        c[11:] - 1.0,
        h[12:],
    ]
    for w, order in ((b, 8), (h, 7)):
        residuals += [w @ A - w * (1.0 - c), jnp.stack([w @ c**k - 1.0 / (k + 1) for k in range(order)])]
        residuals += [((w * c) @ A)[poor_pair], jnp.atleast_1d((w * c) @ A @ c**4 - 1.0 / 35.0)]
    residuals += [((b * c**2) @ A)[poor_pair], ((b * (1.0 - c)) @ A @ A)[poor_pair]]
    residuals += [
        (b * c**2) @ A @ c**4 - 1.0 / 40.0,
        (b * c) @ A @ c**5 - 1.0 / 48.0,
        (b * c) @ A @ A @ c**4 - 1.0 / 240.0,
    ]
    return jnp.concatenate([jnp.atleast_1d(residual) for residual in residuals])


_slopes = jax.jit(jax.jacfwd(equations))


def free_directions(unknowns: Unknowns) -> Float[np.ndarray, "unknowns free"]:
    """The directions in which the weights can move without leaving the family."""
    rank, _, right, _ = _decomposed(unknowns)
    return right[rank:].T


def returned(unknowns: Unknowns, passes: int = 12) -> tuple[Unknowns, float]:
    """The weights, returned to the family by Newton's method, and the residuals of the equations."""
    for _ in range(passes):
        left = np.asarray(equations(unknowns))
        if np.abs(left).max() < 1e-15:
            break
        rank, values, right, directions = _decomposed(unknowns)
        unknowns = unknowns - right[:rank].T @ ((directions.T @ left)[:rank] / values[:rank])
    return unknowns, float(np.abs(equations(unknowns)).max())


def _decomposed(unknowns: Unknowns) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Rank, singular values and vectors of the slopes of the equations. There are more equations than needed, so a gap
    in the singular values determines the rank."""
    left, values, right = np.linalg.svd(np.asarray(_slopes(unknowns)))
    drops = np.where(values[1:] < 1e-8 * values[0], values[:-1] / np.maximum(values[1:], 1e-300), 0.0)
    return 1 + int(np.argmax(drops)), values, right, left
