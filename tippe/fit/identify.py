"""Estimate parameters of a top, its arena and its launches from measured times and motion, and their posterior."""

import dataclasses
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.identification import (
    AbstractDataModel,
    Free,
    Identification,
    LogDensity,
    as_sources,
    fit_data,
    posterior_of_data,
    predicted,
    scene_unknowns,
    search_options,
)
from nonholonomic.parameters import numbers
from nonholonomic.progress import status_line
from nonholonomic.validation import as_number, require_kind

from ..model.launch import Launch
from ..model.scene import Scene
from ..runs.checks import angle_of, check_run, check_smooth
from ..runs.launches import variable_numbers
from ..runs.run_kind import run_kind_of
from ..runs.verbs import simulate
from .hybrid_fit import HybridModel
from .inversion_times import AbstractTimes, InversionTimes, Values
from .recording import Recording


class SceneModel(AbstractDataModel):
    """Predictions of all data of a scene, whose runs are smooth."""

    scene: Scene
    data: tuple[Any, ...]
    seen: Int[Array | np.ndarray, " n"]
    tolerance: Float[Array, ""] = eqx.field(converter=as_number)

    def together(self, source: Any, values: Values) -> Hashable:
        if isinstance(source, AbstractTimes):
            return type(source)
        names = tuple(name for name, value in numbers("launch", source.launch).items() if value is not None)
        return names, tuple(values)

    def predict(self, sources: list[tuple[Any, Values]], rows: int) -> list[Float[Array, "rows size"]]:
        def run(scene: Scene, launch: Launch, times: Float[Array, " times"]) -> Any:
            return simulate(scene, launch, times[-1], times, self.tolerance)

        if isinstance(sources[0][0], Recording):
            return predicted(self.scene, sources, rows, run)
        return [times.predict(self.scene, values, rows, self.tolerance) for times, values in sources]


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
    - `data`: an `InversionTimes`, a `ReversalTimes` or a `Recording`, or a list of several, which are fitted together.
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
    >>> found = tippe.identify(scene, data, {"friction.mu": 0.25}, tolerance=1e-6, progress=False)
    >>> print(f"{found.estimates['scene.friction.mu']:.3f} s/m, {found.status}")
    0.300 s/m, converged

    ```
    """
    search = search_options(starts, spread, seed, max_steps, progress)
    with status_line("fitting", progress):
        caller = "identify with slopes = 'exact'" if slopes == "exact" else None
        return fit_data(*prepared(scene, data, free, tolerance, caller), search, slopes or slopes_of(scene))


def slopes_of(scene: Scene) -> str:
    """The kind of slopes that the predictions of a scene have."""
    return "exact" if run_kind_of(scene).smooth else "differences"


def prepared(
    scene: Scene, data: Any, free: Any, tolerance: float, caller: str | None
) -> tuple[Callable[[Any], Any], tuple[Any, ...], dict[str, Free]]:
    """The predictions of the measured indices, the data and the unknowns, all checked. **Arguments:** as for
    `checked_data`."""
    data = checked_data(scene, data, tolerance, caller)
    kind = SceneModel if run_kind_of(scene).smooth else HybridModel

    def build(seen: Any) -> Any:
        return kind(scene=scene, data=data, seen=seen, tolerance=tolerance)

    return build, data, unknowns_of(scene, data, free)


def checked_data(scene: Scene, data: Any, tolerance: float, caller: str | None) -> tuple[Any, ...]:
    """Check the sets of data, and return them as a tuple; `caller`: name of the function that needs derivatives, or
    `None`."""
    require_kind(scene, "scene", Scene)
    if caller is not None:
        check_smooth(scene, caller)
    data = as_sources(data, AbstractTimes | Recording, "an InversionTimes, a ReversalTimes or a Recording")
    check_run(scene, Launch(0.0, 0.0), 1.0, tolerance)
    for source in data:
        if isinstance(source, AbstractTimes):
            source.check(scene)
    return tuple(_with_angle(scene, source) for source in data)


def _with_angle(scene: Scene, source: Any) -> Any:
    """The data with the default angle written out, so that one program serves every angle. With a stem, there is none."""
    if not isinstance(source, InversionTimes) or source.angle is not None or scene.has_stem:
        return source
    return dataclasses.replace(source, angle=angle_of(scene, None))


def unknowns_of(scene: Scene, data: tuple[Any, ...], free: Any) -> dict[str, Free]:
    """Check the unknowns of a scene and its data, and return them by their full names."""
    launches = [
        [name for name, value in numbers("launch", source.launch).items() if value is not None] for source in data
    ]
    names_of_data = [
        names + ["t0"] * isinstance(source, Recording) for names, source in zip(launches, data, strict=True)
    ]
    return scene_unknowns(free, scene, data[0].launch, list(variable_numbers(scene)), names_of_data)


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
