"""The posterior of a ride's parameters, for any sampler."""

from typing import Any

from nonholonomic.identification import LogDensity, as_sources
from nonholonomic.runs import posterior_of_runs
from nonholonomic.validation import require_kind

from ..model.scene import Scene
from .recording import Recording


def log_density(
    scene: Scene, data: Any, free: dict[str, Any], priors: dict[str, Any] | None = None, *, tolerance: float = 1e-8
) -> LogDensity:
    """The log of the posterior density of the parameters of a scene and its launch, as a function of unbounded coordinates.

    **Arguments:** `scene`, `data`, `free`, `tolerance`: as for `identify`; `priors`: as for `tippe.log_density`.

    **Returns:** a `LogDensity`, for `nonholonomic.identification.sample` and any other sampler.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:** rolling friction from two speeds, with a prior of 10 %.

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> data = stroller.Recording(launch, times=[0.5, 1.0], value=[1.765, 1.557], error=0.01, quantity="speed")
    >>> density = stroller.log_density(scene, data, {"rolling": 2.0}, priors={"rolling": (2.0, 0.2)})
    >>> density.names, density.start.shape
    (('scene.friction.rolling',), (1,))

    ```
    """
    require_kind(scene, "scene", Scene)
    return posterior_of_runs(scene, as_sources(data, Recording, "a Recording"), free, priors, tolerance)
