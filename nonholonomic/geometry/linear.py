"""Small linear systems in plain JAX operations.

LAPACK, which `jnp.linalg.solve` calls on a CPU, costs more than the elimination itself for a few unknowns, and large
batches of it inside one compiled program can deadlock on a machine with few cores.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def solve(matrix: Float[Array, "n n"], right: Float[Array, "n ..."], positive: bool = False) -> Float[Array, "n ..."]:
    """Solution X of A X = B by Gauss-Jordan elimination, unrolled.

    **Arguments:**

    - `matrix`: A, of a few rows.
    - `right`: B, a vector or the columns of a matrix.
    - `positive`: whether A is symmetric and positive definite, so that no pivoting is needed.
    """
    size = matrix.shape[0]
    if size == 0:
        return right
    rows = jnp.concatenate([matrix, right.reshape(size, -1)], axis=1)
    for k in range(size):
        if not positive and k < size - 1:
            pivot = k + jnp.argmax(jnp.abs(rows[k:, k]))
            rows = rows.at[jnp.stack([jnp.asarray(k), pivot])].set(rows[jnp.stack([pivot, jnp.asarray(k)])])
        row = rows[k] / rows[k, k]
        rows = jnp.where(jnp.arange(size)[:, None] == k, row, rows - jnp.outer(rows[:, k], row))
    return rows[:, size:].reshape(right.shape)


def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a small matrix."""
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))
