"""Estimate parameters of a stroller, its ground and its launch from recorded rides, and their posterior."""

from typing import Any

from nonholonomic.identification import Identification, LogDensity
from nonholonomic.runs import fit_runs, posterior_of_runs, search_options, sources_of
from nonholonomic.validation import require_kind

from ..model.scene import Scene

#: The words for data that can be fitted.
EXPECTED = "a Recording or a nonholonomic.EventTimes"


def identify(
    scene: Scene,
    data: Any,
    free: dict[str, Any],
    *,
    starts: int = 16,
    spread: float = 2.0,
    seed: int = 0,
    tolerance: float = 1e-8,
    max_steps: int = 60,
    progress: bool = True,
) -> Identification:
    """Estimate parameters of a scene and its launch from measurements, with errors and undetermined combinations.

    **Arguments:**

    - `scene`: a `Scene`, with the values of the parameters that are not free.
    - `data`: a `Recording`, or a list of several, which are fitted together; `nonholonomic.Recording` and `EventTimes`, too.
    - `free`: full name of a parameter -> a `Free` or only the start value: `"scene.friction.rolling"`, or `"rolling"`
      if no other name ends so; `"launch.place[0]"` and `"launch.place[1]"` are parts of the place. A parameter of the
      launch, and `"t0"`, the reading of a recording's clock at the launch, are the same in all recordings;
      `"data[1].launch.heading"` belongs to the second recording, and `"data[*].t0"` is a separate parameter for each.
      Parameters that cannot be negative are fitted by their logarithms.
    - `starts`, `spread`, `seed`, `max_steps`, `progress`: as for `nonholonomic.identification.identify`.
    - `tolerance`: relative tolerance of the integration.

    **Returns:** an `Identification` with its `verdict`; a doubtful fit gives a `FitWarning`.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> data = stroller.Recording(launch, times=[0.5, 1.0], value=[1.765, 1.557], error=0.01, quantity="speed")
    >>> fit = stroller.identify(scene, data, {"rolling": 1.5}, progress=False)
    >>> print(f"{fit.estimates['scene.friction.rolling']:.2f} N s/m, {fit.status}")
    2.00 N s/m, converged

    ```
    """
    search = search_options(starts, spread, seed, max_steps, progress)
    require_kind(scene, "scene", Scene)
    return fit_runs(scene, sources_of(data, EXPECTED), free, tolerance, search)


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
    return posterior_of_runs(scene, sources_of(data, EXPECTED), free, priors, tolerance)
