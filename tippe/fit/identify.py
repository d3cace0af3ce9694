"""Estimate parameters of a top, its arena and its launches from measured times and motion, and their posterior."""

import dataclasses
from collections.abc import Callable, Hashable
from typing import Any, ClassVar

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
from nonholonomic.integration import Settings
from nonholonomic.parameters import numbers, with_numbers
from nonholonomic.progress import status_line
from nonholonomic.runs import TableJob
from nonholonomic.validation import as_number, require_kind

from ..model.launch import Launch
from ..model.scene import Scene
from ..runs.checks import angle_of, check_run, check_smooth
from ..runs.launches import labels, variable_numbers
from ..runs.run_kind import run_kind_of
from ..runs.verbs import simulate
from .inversion_times import AbstractTimes, InversionTimes, Values
from .recording import Recording


def _unit_of(model: Any, name: str) -> str:
    """The unit of a parameter of a scene or a launch."""
    return labels(model.scene, model.data[0].launch, [name], ())[name][1]


@eqx.filter_jit
def _samples_of_rows(scene: Scene, data: Recording, tolerance: Any, columns: dict[str, Any]) -> Any:
    """The samples of a recording in every row; NaN for illegal parameters, and after the end of a run."""

    def run(scene: Scene, launch: Any, times: Any) -> Any:
        return simulate(scene, launch, times[-1], times, tolerance)

    rows = len(next(iter(columns.values())))
    return predicted(scene, [(data, columns)], rows, run)[0]


class HybridModel(AbstractDataModel):
    """Predictions of all data for a scene with flights, impacts, stick and slip; `SceneModel` does the same for smooth
    scenes.

    Times are computed as in tables, in one ensemble, and the runs of a recording as lanes of one program; only recordings
    with `SetValuedCoulomb` are simulated one by one. For parameters that are illegal in the scene, there are no
    predictions.
    """

    scene: Scene
    data: tuple[Any, ...]
    seen: Int[np.ndarray, " n"]
    tolerance: float

    #: The model runs mode by mode and cannot be traced.
    on_host: ClassVar[bool] = True

    def unit_of(self, name: str) -> str:
        return _unit_of(self, name)

    def together(self, source: Any, values: Values) -> int:
        """Each set of data is predicted for itself."""
        return id(source)

    def predict(self, sources: list[tuple[Any, Values]], rows: int) -> list[Float[np.ndarray, "rows size"]]:
        predictions = []
        for data, values in sources:
            columns = {name: np.asarray(part) for name, part in values.items()}
            of_rows: Any = self._times
            if isinstance(data, Recording):
                # To compile lanes of runs that stick would take longer than to run them one by one.
                of_rows = self._samples_one_by_one if self.scene.friction.set_valued else self._samples
            predictions.append(of_rows(data, columns))
        return predictions

    def _samples(self, data: Recording, columns: dict[str, np.ndarray]) -> Float[np.ndarray, "rows size"]:
        """The samples in all rows, by a program for this number of rows."""
        return np.asarray(_samples_of_rows(self.scene, data, np.asarray(self.tolerance), columns))

    def _samples_one_by_one(self, data: Recording, columns: dict[str, np.ndarray]) -> Float[np.ndarray, "rows size"]:
        """The same, run by run. Samples before the launch equal those at the launch; samples after the run's end are NaN."""
        rows = [dict(zip(columns, row, strict=True)) for row in np.stack(list(columns.values()), axis=1).tolist()]
        predictions = np.full((len(rows), len(data.times), len(data.columns)), np.nan)
        for row, samples in zip(rows, predictions, strict=True):
            t0 = row.pop("t0", float(data.t0))
            if not self._allows(data, row):
                continue
            roots = with_numbers({"scene": self.scene, "launch": data.launch}, row)
            times, inverse = np.unique(np.maximum(np.asarray(data.times) - t0, 0.0), return_inverse=True)
            run = simulate(roots["scene"], roots["launch"], float(times[-1]), tolerance=self.tolerance)
            reached = run.at(times[times <= float(run.end_time)])
            values = np.stack([np.asarray(data.quantities.samples(reached, name)) for name in data.columns], axis=-1)
            is_reached = inverse < len(values)
            samples[is_reached] = values[inverse[is_reached]]
        return predictions.reshape(len(rows), -1)

    def _times(self, data: AbstractTimes, columns: dict[str, np.ndarray]) -> Float[np.ndarray, "rows launches"]:
        """The times in all rows; NaN for illegal parameters."""
        count, launches = len(next(iter(columns.values()))), data.size
        columns = {name: part for name, part in columns.items() if name != "t0"}
        legal = np.array(
            [self._allows(data, {name: float(part[i]) for name, part in columns.items()}) for i in range(count)]
        )
        predictions = np.full((count, launches), np.nan)
        if not legal.any():
            return predictions
        # However many rows are legal, there are as many cells, hence one program; only the first cells run.
        of_launch = {name: value for name, value in numbers("launch", data.launch).items() if value is not None}
        cells = {
            name: np.tile(np.broadcast_to(np.asarray(value), (launches,)), count) for name, value in of_launch.items()
        }
        for name, part in columns.items():
            filled = np.pad(part[legal], (0, count - legal.sum()), constant_values=part[legal][0])
            cells[name] = np.repeat(filled, launches)
        job = TableJob(data.timed(self.scene), data.form, float(data.t1), "first", Settings(self.tolerance))
        results = job(cells, launches * int(legal.sum()))
        time = np.asarray(data.of_cells(self.scene, results, cells["launch.theta"]))
        has_failed = np.asarray(results["status"]) == data.form.words.index("failed")
        predictions[legal] = np.where(has_failed, np.nan, time).reshape(count, launches)[: legal.sum()]
        return predictions

    def _allows(self, data: Any, row: dict[str, float]) -> bool:
        try:
            with_numbers({"scene": self.scene, "launch": data.launch}, row)
        except ValueError:
            return False
        return True


class SceneModel(AbstractDataModel):
    """Predictions of all data of a scene, whose runs are smooth."""

    scene: Scene
    data: tuple[Any, ...]
    seen: Int[Array | np.ndarray, " n"]
    tolerance: Float[Array, ""] = eqx.field(converter=as_number)

    def unit_of(self, name: str) -> str:
        return _unit_of(self, name)

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
    """The predictions of the measured indices, the data and the unknowns, all checked. **Arguments:** as for `identify`;
    `caller`: name of the function that needs derivatives, or `None`."""
    require_kind(scene, "scene", Scene)
    if caller is not None:
        check_smooth(scene, caller)
    data = as_sources(data, AbstractTimes | Recording, "an InversionTimes, a ReversalTimes or a Recording")
    check_run(scene, Launch(0.0, 0.0), 1.0, tolerance)
    sources, names_of_data = [], []
    for source in data:
        names = [name for name, value in numbers("launch", source.launch).items() if value is not None]
        names_of_data.append(names + ["t0"] * isinstance(source, Recording))
        if isinstance(source, AbstractTimes):
            source.check(scene)
        if isinstance(source, InversionTimes) and source.angle is None and not scene.has_stem:
            # With the default angle written out, one program serves every angle.
            source = dataclasses.replace(source, angle=angle_of(scene, None))
        sources.append(source)
    unknowns = scene_unknowns(free, scene, data[0].launch, list(variable_numbers(scene)), names_of_data)
    kind: Any = SceneModel if run_kind_of(scene).smooth else HybridModel

    def build(seen: Any) -> Any:
        return kind(scene=scene, data=tuple(sources), seen=seen, tolerance=tolerance)

    return build, tuple(sources), unknowns


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
