"""Predictions for fits of runs with several modes. These fits use central differences, and their models run outside
JAX's transformations."""

from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from nonholonomic.identification import AbstractDataModel, predicted
from nonholonomic.integration import Settings
from nonholonomic.parameters import numbers, with_numbers
from nonholonomic.runs import TableJob

from ..model.scene import Scene
from ..runs.verbs import simulate
from .inversion_times import AbstractTimes
from .recording import Recording

#: Number of rows that one program simulates together: as many as a fit explores at once, or a few.
BATCH, FEW = 512, 64


@eqx.filter_jit
def _samples_of_batch(scene: Scene, data: Recording, tolerance: Any, columns: dict[str, Any]) -> Any:
    """The samples of a recording in every row of a batch; NaN for illegal parameters, and after the end of a run."""

    def run(scene: Scene, launch: Any, times: Any) -> Any:
        return simulate(scene, launch, times[-1], times, tolerance)

    return predicted(scene, [(data, columns)], BATCH, run)[0]


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

    def together(self, source: Any, values: dict[str, Any]) -> int:
        """Each set of data is predicted for itself."""
        return id(source)

    def predict(self, sources: list[tuple[Any, dict[str, Any]]], rows: int) -> list[Float[np.ndarray, "rows size"]]:
        columns = [(data, {name: np.asarray(part) for name, part in values.items()}) for data, values in sources]
        return [
            self._of(data, [{name: float(part[i]) for name, part in values.items()} for i in range(rows)])
            for data, values in columns
        ]

    def _of(self, data: Any, rows: list[dict[str, float]]) -> Float[np.ndarray, "rows size"]:
        """The predictions of one set of data in every row."""
        predictions = np.full((len(rows), data.size), np.nan)
        if isinstance(data, Recording) and not self.scene.friction.set_valued:
            return self._samples_in_lanes(data, rows)
        allowed = [i for i, row in enumerate(rows) if self._allows(data, row)]
        if allowed and isinstance(data, AbstractTimes):
            legal = [rows[i] for i in allowed]
            batches = [legal[first : first + BATCH] for first in range(0, len(legal), BATCH)]
            predictions[allowed] = np.concatenate([self._times(data, batch) for batch in batches])
        elif allowed:
            for i in allowed:
                predictions[i] = self._samples(data, rows[i])
        return predictions

    def _samples_in_lanes(self, data: Recording, rows: list[dict[str, float]]) -> Float[np.ndarray, "rows size"]:
        """The samples of all rows, in batches of one size, so that one program serves them all."""
        names, parts = list(rows[0]), []
        values = np.array([[row[name] for name in names] for row in rows])
        for first in range(0, len(rows), BATCH):
            batch = np.full((BATCH, len(names)), np.nan)
            part = values[first : first + BATCH]
            batch[: len(part)] = part
            columns = {name: batch[:, k] for k, name in enumerate(names)}
            samples = _samples_of_batch(self.scene, data, np.asarray(self.tolerance), columns)
            parts.append(np.asarray(samples)[: len(part)])
        return np.concatenate(parts)

    def _allows(self, data: Any, row: dict[str, float]) -> bool:
        try:
            self._roots(data, row)
        except ValueError:
            return False
        return True

    def _roots(self, data: Any, row: dict[str, float]) -> dict[str, Any]:
        scene_row = {name: value for name, value in row.items() if name != "t0"}
        return with_numbers({"scene": self.scene, "launch": data.launch}, scene_row)

    def _times(self, data: AbstractTimes, rows: list[dict[str, float]]) -> Float[np.ndarray, "rows launches"]:
        """The predicted times of at most `BATCH` rows."""
        launches, count = data.size, len(rows)
        # Two numbers of cells, hence two programs, serve all calls; only the first cells run.
        size = FEW if count <= FEW else BATCH
        rows = rows + [rows[0]] * (size - count)
        of_launch = {name: value for name, value in numbers("launch", data.launch).items() if value is not None}
        columns = {
            name: np.tile(np.broadcast_to(np.asarray(value), (launches,)), len(rows))
            for name, value in of_launch.items()
        }
        columns |= {name: np.repeat([row[name] for row in rows], launches) for name in rows[0] if name != "t0"}
        job = TableJob(data.timed(self.scene), data.form, float(data.t1), "first", Settings(self.tolerance))
        cells = job(columns, launches * count)
        time = np.asarray(data.of_cells(self.scene, cells, columns["launch.theta"]))
        has_failed = np.asarray(cells["status"]) == data.form.words.index("failed")
        return np.where(has_failed, np.nan, time).reshape(size, launches)[:count]

    def _samples(self, data: Recording, row: dict[str, float]) -> Float[np.ndarray, " size"]:
        """The samples of one run. Samples before the launch equal those at the launch; samples after the run's end are
        NaN."""
        roots = self._roots(data, row)
        run_times = np.maximum(np.asarray(data.times) - row.get("t0", float(data.t0)), 0.0)
        times_to_sample, inverse = np.unique(run_times, return_inverse=True)
        run = simulate(roots["scene"], roots["launch"], float(times_to_sample[-1]), tolerance=self.tolerance)
        times_reached = times_to_sample[times_to_sample <= float(run.end_time)]
        samples = np.full((len(times_to_sample), len(data.columns)), np.nan)
        run_samples = run.at(times_reached)
        samples[: len(times_reached)] = np.stack(
            [np.asarray(data.quantities.samples(run_samples, name)) for name in data.columns], axis=-1
        )
        return samples[inverse].reshape(-1)
