"""Estimate parameters of a stroller, its ground and its launch from recorded rides."""

from collections.abc import Hashable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.identification import (
    AbstractDataModel,
    Free,
    Identification,
    as_sources,
    fit_data,
    predicted,
    scene_unknowns,
    search_options,
)
from nonholonomic.integration.checks import tolerance_bound
from nonholonomic.parameters import numbers
from nonholonomic.progress import status_line
from nonholonomic.validation import as_number, require_kind

from ..model.launch import Launch
from ..model.scene import Scene
from ..runs.verbs import simulate
from .recording import Recording


class SceneModel(AbstractDataModel):
    """Predictions of all recordings of a scene."""

    scene: Scene
    data: tuple[Recording, ...]
    seen: Int[Array | np.ndarray, " n"]
    tolerance: Float[Array, ""] = eqx.field(converter=as_number)

    def together(self, source: Recording, values: dict[str, Array]) -> Hashable:
        return id(source.input), tuple(numbers("launch", source.launch)), tuple(values)

    def predict(self, sources: list[tuple[Recording, Any]], rows: int) -> list[Float[Array, "rows samples"]]:
        first = sources[0][0]

        def run(scene: Scene, launch: Launch, times: Float[Array, " times"]) -> Any:
            return simulate(scene, launch, times[-1], first.input, times, self.tolerance)

        return predicted(self.scene, sources, rows, run)


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
    """Estimate parameters of a scene and its launch from recorded rides, with errors and undetermined combinations.

    **Arguments:**

    - `scene`: a `Scene`, with the values of the parameters that are not free.
    - `data`: a `Recording`, or a list of several, which are fitted together.
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
    >>> found = stroller.identify(scene, data, {"rolling": 1.5}, progress=False)
    >>> print(f"{found.estimates['scene.friction.rolling']:.2f} N s/m, {found.status}")
    2.00 N s/m, converged

    ```
    """
    search = search_options(starts, spread, seed, max_steps, progress)
    with status_line("fitting", progress):
        require_kind(scene, "scene", Scene)
        data = as_sources(data, Recording, "a Recording")
        tolerance_bound(tolerance).require()
        for recording in data:
            scene.check(recording.launch)
        unknowns = _unknowns_of(scene, data, free)
        return fit_data(
            lambda indices: SceneModel(scene=scene, data=data, seen=indices, tolerance=tolerance),
            data,
            unknowns,
            search,
        )


def _unknowns_of(scene: Scene, data: tuple[Recording, ...], free: Any) -> dict[str, Free]:
    """Check the unknowns of a scene and its data, and return them by their full names."""
    names_of_data = [[*numbers("launch", recording.launch), "t0"] for recording in data]
    return scene_unknowns(free, scene, data[0].launch, list(numbers("scene", scene)), names_of_data)
