"""The implicit midpoint rule, whose energy balance closes to round-off on the P-form."""

from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..geometry import inverse
from ..text import one_line
from ..validation import as_known, require

#: Number of simplified Newton iterations; each reduces the error by a factor of the order of (step times rate of
#: change)^2.
ITERATIONS = 8


class ImplicitMidpoint(diffrax.AbstractSolver):
    """The implicit midpoint rule y1 = y0 + h f((y0 + y1) / 2), second order, with a fixed step.

    It conserves every linear and quadratic invariant, and on the P-form the balance of energy and work, up to rounding
    errors (`stroller.md`, section 5).

    **Arguments:**

    - `step_length`: longest step [s], positive. The steps between two output times are equal, and steps end on the
      output times.

    **Raises:** `ValueError` if the step is not positive.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> run = stroller.simulate(scene, launch, 1.0, solver=stroller.ImplicitMidpoint(0.02), times=[0.5, 1.0])
    >>> bool(abs(run.energy_residual[-1]) < 1e-12)
    True

    ```
    """

    step_length: Float[Array, ""] = eqx.field(converter=as_known)

    units: ClassVar[dict[str, str]] = {"step_length": "s"}
    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def __repr__(self) -> str:
        return one_line(self)

    def __check_init__(self):
        require(self.step_length, "step_length", above=0.0)

    def order(self, terms):
        return 2

    def init(self, terms, t0, t1, y0, args):
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        control = terms.contr(t0, t1)
        middle = t0 + 0.5 * (t1 - t0)

        def increment(z: Float[Array, " state"]) -> Float[Array, " state"]:
            return terms.vf_prod(middle, y0 + 0.5 * z, args, control)

        guess = increment(jnp.zeros_like(y0))
        newton = inverse(jnp.eye(y0.size, dtype=y0.dtype) - jax.jacfwd(increment)(guess))

        def improve(z, _):
            correction = newton @ (increment(z) - z)
            return z + correction, jnp.max(jnp.abs(correction) / (jnp.abs(y0) + jnp.abs(z) + 1.0))

        z, corrections = jax.lax.scan(improve, guess, length=ITERATIONS)
        converged = corrections[-1] < 1e3 * jnp.finfo(y0.dtype).eps
        diverged: Any = diffrax.RESULTS.nonlinear_divergence
        result = diffrax.RESULTS.where(converged, diffrax.RESULTS.successful, diverged)
        y1 = y0 + z
        return y1, None, dict(y0=y0, y1=y1), None, result

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)
