"""What measurements say about predictions: residuals whose squares add up to -2 log likelihood."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Bool, Float

from ..validation import require

#: Residual of a measurement for which the model has no prediction: a penalty without a slope.
MISSING = 1e4


class Measurements(eqx.Module):
    """Measured numbers with independent Gaussian errors.

    **Arguments:**

    - `value`: (n,), what was measured; where `censored`, what the quantity was only seen to exceed, with its own
      error (a clock stopped by hand is uncertain too).
    - `error`: (n,), standard deviations, positive; a scalar serves for all.
    - `censored`: (n,), which are lower limits; none by default.

    **Raises:** `ValueError` for numbers that are not finite or shapes that do not fit.
    """

    value: Float[Array, "... n"]
    error: Float[Array, "... n"]
    censored: Bool[Array, "... n"]

    def __init__(self, value: Any, error: Any, censored: Any = False):
        require(value, "value")
        require(error, "error", above=0.0)
        if np.ndim(value) == 0 or np.size(value) == 0:
            raise ValueError(f"value must be a non-empty list, not of shape {np.shape(value)}")
        shape = np.shape(value)
        for name, given in (("error", error), ("censored", censored)):
            if np.shape(given) not in ((), shape):
                raise ValueError(f"{name} must be one number or of the shape {shape} of value, not {np.shape(given)}")
        self.value = jnp.asarray(value, float)
        self.error = jnp.broadcast_to(jnp.asarray(error, float), shape)
        self.censored = jnp.broadcast_to(jnp.asarray(censored, bool), shape)

    def residuals(self, prediction: Float[Array, "... n"]) -> Float[Array, "... n"]:
        """Residuals whose squares are -2 log likelihood, up to a constant.

        For a measurement it is (prediction - value) / error; for a lower limit the one-sided
        r = -sqrt(-2 log Phi(z)), z = (prediction - value) / error, Phi being the normal distribution: close to z where the
        prediction is far below the limit, to 0 where it is above. A prediction that is not finite counts as `MISSING`,
        except for an infinite one of a lower limit, which exceeds it.

        **Arguments:** `prediction`: (..., n). **Returns:** (..., n).
        """
        known = jnp.isfinite(prediction)
        z = (jnp.where(known, prediction, self.value) - self.value) / self.error
        beyond = self.censored & (prediction == jnp.inf)
        return jnp.where(known, jnp.where(self.censored, one_sided(z), z), jnp.where(beyond, 0.0, MISSING))


def one_sided(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """The residual -sqrt(-2 log Phi(z)) of a lower limit; 0 from where it is less than 1e-9."""
    # Beyond that, the derivative of the square root would be infinity times zero.
    near = z < 9.0
    return jnp.where(near, -jnp.sqrt(-2.0 * log_ndtr(jnp.where(near, z, 0.0))), 0.0)
