"""The posterior of a top's parameters, for any sampler."""

from typing import Any

from nonholonomic.identification import LogDensity, posterior_of_data

from ..model.scene import Scene
from .identify import prepared, slopes_of


def log_density(
    scene: Scene, data: Any, free: dict[str, Any], priors: dict[str, Any] | None = None, *, tolerance: float = 1e-8
) -> LogDensity:
    """The log of the posterior density of a scene's parameters, as a function of unbounded coordinates.

    The coordinate of a parameter that cannot be negative is its logarithm (see `Free`). A parameter without a prior has
    a flat prior in its coordinate; between two bounds, the prior is uniform in the parameter itself.

    **Arguments:**

    - `scene`, `data`, `free`, `tolerance`: as for `identify`. If the error of a recording is `None`, the error is also
      an unknown.
    - `priors`: name of a free parameter -> (mean, standard deviation) of a Gaussian prior; only the standard deviation, if
      the mean is the start value; or a function, written in JAX, that returns the log density of the parameter. These
      priors add to those of `Free`.

    **Returns:** a `LogDensity`: a function of coordinates (unknowns,) for any sampler, with `value_and_gradient` for
    samplers without JAX, `values` to convert back to parameters, `names` and `start`. With flights or set-valued friction, it
    has values only: use it with `sample`.

    **Raises:** `ValueError` for arguments out of range and an unknown name.

    **Example:** friction from one time, with a prior of 10 %.

    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=3.0e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> data = tippe.InversionTimes(tippe.Launch(0.2, [110.0]), [5.6], error=0.1, t1=20.0)
    >>> density = tippe.log_density(scene, data, {"mu": 0.3}, priors={"mu": (0.3, 0.03)})
    >>> density.names, density.start.shape
    (('scene.friction.mu',), (1,))
    """
    return posterior_of_data(*prepared(scene, data, free, tolerance, None), priors, slopes_of(scene))
