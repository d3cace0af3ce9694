"""Estimate parameters of a top, its arena and its launches from measured times and motion, and their posterior."""

from typing import Any

from nonholonomic.identification import Identification, LogDensity
from nonholonomic.runs import fit_runs, posterior_of_runs, search_options, sources_of
from nonholonomic.validation import require_kind

from ..model.scene import Scene
from ..runs.checks import check_smooth

#: The words for data that can be fitted.
EXPECTED = "an InversionTimes, a ReversalTimes or a Recording"


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
    slopes: str | None = None,
    progress: bool = True,
) -> Identification:
    """Estimate parameters of a scene and its launches from measurements, with errors and undetermined combinations.

    **Arguments:**

    - `scene`: a `Scene`, with the values of the parameters that are not free.
    - `data`: an `InversionTimes`, a `ReversalTimes` or a `Recording`, or a list of several, which are fitted together;
      `nonholonomic.EventTimes` and `nonholonomic.Recording`, too.
    - `free`: full name of a parameter -> a `Free` or only the start value: `"scene.friction.mu"`, or `"friction.mu"` if
      no other name ends so. A parameter of the launch, and `"t0"`, the reading of a recording's clock at the launch,
      are the same in all data; `"data[1].launch.azimuth"` belongs to the second set of data, and `"data[*].t0"` is a
      separate parameter for each recording. Parameters that cannot be negative are fitted by their logarithms.
    - `starts`, `spread`, `seed`, `max_steps`, `progress`: as for `nonholonomic.identification.identify`.
    - `slopes`: "exact", the derivatives of the equations; or "differences", central differences in every parameter. Slopes
      only guide the search; errors and intervals do not depend on them. By default, slopes are exact if a run is one
      smooth motion, and differences through flights, impacts, stick and slip.
    - `tolerance`: relative tolerance of the integration.

    **Returns:** an `Identification` with its `verdict`; a doubtful fit gives a `FitWarning`.

    **Raises:** `ValueError` for arguments out of range, for an unknown name, and for exact slopes through several
    modes. (Such slopes exist, but because the time jumps with every flight, they may have the opposite sign of the
    trend.)

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> launch = tippe.Launch(theta=[0.2, 0.2, 0.3, 0.2], spin=[155.0, 140.0, 110.0, 60.0])
    >>> data = tippe.InversionTimes(launch, time=[5.60, 5.53, 5.52, float("inf")], error=0.05, t1=8.0)
    >>> fit = tippe.identify(scene, data, {"friction.mu": 0.25}, tolerance=1e-6, progress=False)
    >>> print(f"{fit.estimates['scene.friction.mu']:.3f} s/m, {fit.status}")
    0.300 s/m, converged

    ```
    """
    search = search_options(starts, spread, seed, max_steps, progress)
    require_kind(scene, "scene", Scene)
    if slopes == "exact":
        check_smooth(scene, "identify with slopes = 'exact'")
    return fit_runs(scene, sources_of(data, EXPECTED), free, tolerance, search, slopes)


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
    require_kind(scene, "scene", Scene)
    return posterior_of_runs(scene, sources_of(data, EXPECTED), free, priors, tolerance)
