"""Estimate parameters of any model from recorded runs and from times of events, and their posterior."""

import dataclasses
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..identification import (
    AbstractDataModel,
    AbstractRecording,
    Free,
    Identification,
    LogDensity,
    as_sources,
    fit_data,
    free_numbers,
    posterior_of_data,
    search_options,
)
from ..integration import Settings
from ..integration.checks import tolerance_bound
from ..integration.settings import MOST_STEPS
from ..parameters import require_apart
from ..progress import status_line
from ..validation import nan_unless
from .data import EventTimes, Recording, predicted_columns, predicted_time
from .model import AbstractModel, check_run


class Source(eqx.Module):
    """A set of data and the model of its run."""

    data: Any
    model: AbstractModel

    @property
    def key(self) -> Hashable:
        """Sets of data with equal keys are lanes of one ensemble."""
        arrays = jax.tree.structure(eqx.filter(self.model, eqx.is_array))
        columns = getattr(self.data, "columns", None)
        return type(self.data), arrays, columns, id(getattr(self.data, "event", None))


class RunModel(AbstractDataModel):
    """Predictions of several sets of data of a system."""

    data: tuple[Source, ...]
    seen: Int[Array, " n"]
    settings: Settings

    @property
    def recorded(self) -> tuple[Any, ...]:
        return tuple(source.data for source in self.data)

    def with_recorded(self, recorded: tuple[Any, ...]) -> "RunModel":
        pairs = zip(recorded, self.data, strict=True)
        return dataclasses.replace(self, data=tuple(Source(data, source.model) for data, source in pairs))

    def unit_of(self, name: str) -> str:
        return self.data[0].model.label([name])[name][1]

    def together(self, source: Source, values: dict[str, Array]) -> Hashable:
        return source.key, tuple(values)

    def predict(self, sources: list[tuple[Source, dict[str, Array]]], rows: int) -> list[Float[Array, "rows samples"]]:
        """Every row of every set of data is a lane."""
        first, count = sources[0][0], len(sources)
        size = max(source.data.length for source, _ in sources)

        def lanes(of_each: list[Array]) -> Array:
            """One row after the other; each number is a scalar or has one value per row."""
            return jnp.stack([jnp.broadcast_to(number, (rows,)) for number in of_each], axis=1).reshape(-1)

        arrays, static = eqx.partition([source.model for source, _ in sources], eqx.is_array)
        models = jax.tree.map(lambda *leaves: lanes([*leaves]), *arrays)
        values = {name: lanes([values[name] for _, values in sources]) for name in sources[0][1]}
        numbers = [source.data.lane(size) for source, _ in sources]
        inputs = jax.tree.map(lambda *parts: jnp.tile(jnp.stack(parts), (rows,) + (1,) * jnp.ndim(parts[0])), *numbers)

        def of_lane(model: Any, values: dict[str, Array], lane: dict[str, Array]) -> Array:
            clock = {"t0": values["t0"]} if "t0" in values else {}
            moved = eqx.combine(model, static[0]).replaced(
                {name: value for name, value in values.items() if name != "t0"}
            )
            predict: Any = predicted_columns if isinstance(first.data, AbstractRecording) else predicted_time
            return nan_unless(moved.legal(), predict(first.data, moved, lane | clock, self.settings))

        predictions = jax.vmap(of_lane)(models, values, inputs)
        by_source = predictions.reshape(rows, count, *predictions.shape[1:])
        return [source.data.part(by_source[:, k]) for k, (source, _) in enumerate(sources)]


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
    - `data`: a `Recording` or an `EventTimes`, or a list of several to be fitted together.
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
    data = as_sources(data, Recording | EventTimes, "a nonholonomic.Recording or EventTimes")
    return fit_runs(system, data, free, tolerance, search)


def log_density(
    system: Any, data: Any, free: dict[str, Any], priors: dict[str, Any] | None = None, *, tolerance: float = 1e-8
) -> LogDensity:
    """The log of the posterior density of a system's parameters, as a function of unbounded coordinates.

    **Arguments:** `system`, `data`, `free`, `tolerance`: as for `identify`; `priors`: as for `tippe.log_density`.

    **Returns:** a `LogDensity`, for `nonholonomic.identification.sample` and any other sampler.

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
    data = as_sources(data, Recording | EventTimes, "a nonholonomic.Recording or EventTimes")
    return posterior_of_runs(system, data, free, priors, tolerance)


def fit_runs(
    system: Any, data: tuple[Any, ...], free: dict[str, Any], tolerance: Any, search: dict[str, Any]
) -> Identification:
    """Fit sets of data of runs. **Arguments:** as for `identify`; `search`: `search_options`."""
    with status_line("fitting", search["progress"]):
        return fit_data(*_prepared(system, data, free, tolerance), search)


def posterior_of_runs(
    system: Any, data: tuple[Any, ...], free: dict[str, Any], priors: dict[str, Any] | None, tolerance: Any
) -> LogDensity:
    """The posterior, given sets of data of runs. **Arguments:** as for `log_density`."""
    return posterior_of_data(*_prepared(system, data, free, tolerance), priors)


def _prepared(
    system: Any, data: tuple[Any, ...], free: dict[str, Any], tolerance: Any
) -> tuple[Callable[[Any], RunModel], tuple[Any, ...], dict[str, Free]]:
    """The predictions of the measured indices, the data and the unknowns, all checked."""
    tolerance_bound(tolerance).require()
    models = tuple(source.model(system) for source in data)
    for source, model in zip(data, models, strict=True):
        check_run(model, source.t1 if isinstance(source, EventTimes) else source.times[-1] - source.t0, tolerance)
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
    sources = tuple(Source(source, model) for source, model in zip(data, models, strict=True))
    settings = Settings(tolerance, max_steps=MOST_STEPS)
    return lambda seen: RunModel(data=sources, seen=jnp.asarray(seen), settings=settings), data, unknowns
