"""Estimate parameters of any model from recorded runs and from times of events, and their posterior."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..identification import AbstractRecording, Free, Identification, LogDensity, Measurements
from ..identification.data import free_numbers, joined_data, own_name
from ..identification.identify import check_search
from ..identification.identify import identify as most_likely
from ..integration import Settings
from ..integration.checks import tolerance_bound
from ..integration.settings import MOST_STEPS
from ..parameters import full_name, require_apart
from ..progress import status_line
from ..validation import shown
from .data import AbstractEventTimes
from .model import check_run
from .predictions import DataModel, Source

#: The words for data that can be fitted.
EXPECTED = "a nonholonomic.Recording or EventTimes"


def identify(
    system: Any,
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
    """Estimate parameters and starts of a system from recorded runs and times of events, with errors and undetermined
    combinations.

    **Arguments:**

    - `system`: a scene, a `Hybrid`, or an `AbstractSystem`, with the values of the parameters that are not free.
    - `data`: a `Recording` or an `EventTimes`, or a list of several to be fitted together; for scenes, also the data of
      `tippe.identify` and `stroller.identify`.
    - `free`: full name of a parameter -> a `nonholonomic.Free` or only the start value. Examples of names are
      `"scene.friction.mu"` or `"system.modes[0].drag"`, or `"drag"` if no other name ends so, `"modes[*].drag"` for all
      modes that have a drag, `"launch.theta"`, `"start[0]"`, `"start.q[0]"` and `"t0"`, the reading of a recording's
      clock at the start. `"start[0]"` and `"t0"` are the same in all recordings; `"data[1].start[0]"` belongs to the
      second recording, and `"data[*].t0"` is a separate parameter for each. In systems with resets, `"t0"` cannot be
      free.
    - `starts`, `spread`, `seed`, `max_steps`, `progress`: as for `nonholonomic.identification.identify`.
    - `tolerance`: relative tolerance of the integration.

    **Returns:** an `Identification` with its `verdict`; a doubtful fit gives a `FitWarning`.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> data = nonholonomic.Recording([1.0], [0.5, 1.0, 1.5], [0.37, 0.135, 0.05], 0.005)
    >>> fit = nonholonomic.identify(nonholonomic.Hybrid([Decay(1.0)]), data, {"rate": 1.0}, progress=False)
    >>> print(f"{fit.estimates['system.modes[0].rate']:.2f}")
    1.99

    ```
    """
    search = search_options(starts, spread, seed, max_steps, progress)
    return fit_runs(system, sources_of(data, EXPECTED), free, tolerance, search)


def log_density(
    system: Any, data: Any, free: dict[str, Any], priors: dict[str, Any] | None = None, *, tolerance: float = 1e-8
) -> LogDensity:
    """The log of the posterior density of a system's parameters, as a function of unbounded coordinates.

    **Arguments:** `system`, `data`, `free`, `tolerance`: as for `identify`; `priors`: as for `tippe.log_density`.

    **Returns:** a `LogDensity`, for `nonholonomic.identification.sample` and any other sampler; for tops with several modes it
    has values only, for `sample`.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:** the rate of a decay.

    ```
    >>> import nonholonomic
    >>> from nonholonomic.identification import sample
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> data = nonholonomic.Recording([1.0], [0.5, 1.0, 1.5], [0.37, 0.135, 0.05], 0.005)
    >>> density = nonholonomic.log_density(nonholonomic.Hybrid([Decay(1.0)]), data, {"rate": 1.0})
    >>> draws = sample(density, draws=200, progress=False)
    >>> print(f"{draws.values['system.modes[0].rate'].mean():.2f}")
    1.99

    ```
    """
    return posterior_of_runs(system, sources_of(data, EXPECTED), free, priors, tolerance)


def sources_of(data: Any, expected: str) -> tuple[Any, ...]:
    """Sets of data as a tuple.

    **Arguments:** `data`: a set or several; `expected`: words for the message.

    **Raises:** `ValueError` unless there is at least one set of data, and all sets are recordings or times of events.
    """
    sources = tuple(data) if isinstance(data, list | tuple) else (data,)
    if not sources or not all(isinstance(source, AbstractRecording | AbstractEventTimes) for source in sources):
        reader = "; read a file with read_recording" if isinstance(data, str | Path) else ""
        raise ValueError(f"data = {shown(data)} must be {expected}, or a list of them{reader}")
    return sources


def search_options(starts: Any, spread: Any, seed: Any, max_steps: Any, progress: Any) -> dict[str, Any]:
    """The options of the search, checked before a model prepares its data."""
    check_search(starts, spread, seed, max_steps, progress)
    return {"starts": starts, "spread": spread, "seed": seed, "max_steps": max_steps, "progress": progress}


def fit_runs(
    system: Any,
    data: tuple[Any, ...],
    free: dict[str, Any],
    tolerance: Any,
    search: dict[str, Any],
    slopes: str | None = None,
) -> Identification:
    """Fit sets of data of runs.

    **Arguments:** as for `identify`; `data`: `sources_of`; `search`: `search_options`; `slopes`: "exact" or "differences", by
    default as the model requires.
    """
    with status_line("fitting", search["progress"]):
        problem = _Fit.of(system, data, free, tolerance)
        options = {"slopes": slopes or problem.slopes, "labels": problem.labels}
        fit = most_likely(problem.model, problem.measurements, problem.unknowns, **options, **search)
    label = problem.model.data[0].model.label
    names = {name: own_name(name) for name in problem.unknowns}
    units = {name: "s" if own == "t0" else label([own])[own][1] for name, own in names.items()}
    return dataclasses.replace(fit, series_units=problem.series_units, units=units)


def posterior_of_runs(
    system: Any, data: tuple[Any, ...], free: dict[str, Any], priors: dict[str, Any] | None, tolerance: Any
) -> LogDensity:
    """The posterior, given sets of data of runs. **Arguments:** as for `log_density`; `data`: `sources_of`."""
    fit = _Fit.of(system, data, free, tolerance)
    if priors is not None and not isinstance(priors, dict):
        raise ValueError(
            f"priors = {shown(priors)} must be a dictionary, name of a number -> (mean, standard deviation)"
        )
    by_name = {full_name("priors", name, list(fit.unknowns)): prior for name, prior in (priors or {}).items()}
    return LogDensity.of(fit.model, fit.measurements, fit.unknowns, by_name, fit.series_units, fit.slopes)


class _Fit(NamedTuple):
    """The predictions of the measurements, the measurements with their labels, and the unknowns, all checked."""

    model: DataModel
    measurements: Measurements
    labels: tuple[str, ...]
    unknowns: dict[str, Free]

    @property
    def slopes(self) -> str:
        """The slopes that guide the fit."""
        models = [source.model for source in self.model.data]
        # Runs with resets have no derivatives with respect to the times of samples.
        moves_times = any(name.rpartition(".")[2] == "t0" for name in self.unknowns)
        if moves_times and not all(model.smooth for model in models):
            return "differences"
        return models[0].fit_slopes

    @property
    def series_units(self) -> tuple[str, ...]:
        """The unit of each series of the measurements."""
        units: list[str] = []
        for source in self.model.data:
            last = int(np.max(source.data.measurements.series))
            units += source.data.units_of(source.model)[: last + 1]
        return tuple(units)

    @classmethod
    def of(cls, system: Any, data: tuple[Any, ...], free: dict[str, Any], tolerance: Any) -> "_Fit":
        """**Arguments:** as for `fit_runs`."""
        tolerance_bound(tolerance).require()
        models = tuple(source.model(system) for source in data)
        for source, model in zip(data, models, strict=True):
            horizon = source.horizon if isinstance(source, AbstractEventTimes) else source.times[-1] - source.t0
            check_run(model, horizon, tolerance)
        own = [[name for name in model.known if name.startswith(("start", "launch"))] for model in models]
        shared = [name for name in models[0].known if name not in own[0]]
        names_of_data = [
            [*names, "t0"] if isinstance(source, AbstractRecording) else names
            for names, source in zip(own, data, strict=True)
        ]

        def check(values: dict[str, float]) -> None:
            models[0].require_values({name: value for name, value in values.items() if name != "t0"})

        unknowns = free_numbers(free, shared, names_of_data, check)
        require_apart("free", unknowns)
        measurements, labels, seen = joined_data(data)
        sources = tuple(Source(source, model) for source, model in zip(data, models, strict=True))
        return cls(DataModel(sources, seen, Settings(tolerance, max_steps=MOST_STEPS)), measurements, labels, unknowns)
