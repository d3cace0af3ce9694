"""Predictions of sets of data of any model, for many sets of parameters at once: the runs are lanes of one batch."""

import dataclasses
from collections.abc import Hashable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compilation.xla_cpu import greatest
from ..identification import AbstractRecording
from ..identification.data import of_data
from ..integration import Settings
from ..validation import nan_unless
from .ensemble import SILENT
from .model import AbstractModel
from .simulate import sampled
from .table import first_events

#: Spacing [s] of model times for samples before the launch: so small that nothing moves.
INSTANT = 1e-9

#: Spacing [s] of times that are added to give recordings the same length.
AT_ONCE = 1e-6

#: Parameters of one set of data, name -> (rows,).
Values = dict[str, Float[Array, " rows"]]


class Source(eqx.Module):
    """A set of data and the model of its runs: one run, or one for each value of the numbers of the model's start."""

    data: Any
    model: AbstractModel

    @property
    def runs(self) -> int:
        """Number of runs."""
        sizes = [len(leaf) for leaf in jax.tree.leaves(self.model) if eqx.is_array(leaf) and leaf.ndim]
        return max(sizes, default=1)

    @property
    def key(self) -> Hashable:
        """Sets of data with equal keys are lanes of one batch."""
        arrays = jax.tree.structure(eqx.filter(self.model, eqx.is_array))
        columns = getattr(self.data, "columns", None)
        return type(self.data), arrays, columns, getattr(self.data, "side", None), id(getattr(self.data, "event", None))


class Lanes(eqx.Module):
    """The runs of several sets of data in every row of parameters, one row after the other.

    - `model`: with a value per lane for each number; `is_legal`: whether these values are legal.
    - `horizon`: of timed runs [s], or the times of samples and the clock's reading at the start.
    """

    model: AbstractModel
    is_legal: Bool[Array, " lanes"]
    horizon: Any


class DataModel(eqx.Module):
    """Predictions of several sets of data of a system, in the form that `nonholonomic.identification.identify` expects.

    `seen`: indices of the predictions that were measured.
    """

    data: tuple[Source, ...]
    seen: Int[Array | np.ndarray, " n"]
    settings: Settings

    @property
    def recorded(self) -> tuple[Any, ...]:
        """The sets of data, for curves between their samples."""
        return tuple(source.data for source in self.data)

    def with_recorded(self, recorded: tuple[Any, ...]) -> "DataModel":
        """The model of other sets of data of the same shapes."""
        pairs = zip(recorded, self.data, strict=True)
        return dataclasses.replace(self, data=tuple(Source(data, source.model) for data, source in pairs))

    @property
    def on_host(self) -> bool:
        """Whether derivatives through the modes of the runs mislead; such a model is neither traced nor differentiated."""
        return self.data[0].model.fit_slopes == "differences"

    def __call__(self, parameters: Values) -> Float[Array, "rows n"]:
        rows = len(next(iter(parameters.values())))
        values = [of_data(parameters, k) for k in range(len(self.data))]
        groups: dict[Hashable, list[int]] = {}
        for k, source in enumerate(self.data):
            groups.setdefault((source.key, tuple(values[k])), []).append(k)
        parts: dict[int, Array] = {}
        for indices in groups.values():
            sources = [self.data[k] for k in indices]
            predictions = self._predictions(sources, [values[k] for k in indices], rows)
            firsts = np.cumsum([0, *(source.runs for source in sources)])
            for k, source, first in zip(indices, sources, firsts, strict=False):
                of_source = predictions[:, first : first + source.runs]
                if isinstance(source.data, AbstractRecording):
                    parts[k] = of_source[:, 0, : len(source.data.times)].reshape(rows, -1)
                else:
                    parts[k] = jnp.broadcast_to(of_source, (rows, source.data.size))
        return jnp.concatenate([parts[k] for k in range(len(self.data))], axis=1)[:, self.seen]

    def _predictions(self, sources: list[Source], values: list[Values], rows: int) -> Float[Array, "rows runs ..."]:
        """The predictions of sets of data with equal keys."""
        if not self.on_host:
            predictions = _predicted(sources, values, rows, self.settings)
        elif getattr(sources[0].data, "by_tables", False):
            predictions = _predicted_by_tables(sources, values, rows, self.settings)
        else:
            predictions = _compiled(sources, values, rows, self.settings)
        return predictions.reshape(rows, -1, *predictions.shape[1:])


def _lanes(sources: list[Source], values: list[Values], rows: int) -> Lanes:
    """The runs of sets of data with equal keys."""
    counts = [source.runs for source in sources]

    def in_lanes(of_each: list[Array]) -> Array:
        """A number of each source: one for all, a value per run, or a column with a value per row."""
        parts = [jnp.broadcast_to(number, (rows, count)) for number, count in zip(of_each, counts, strict=True)]
        return jnp.concatenate(parts, axis=1).reshape(-1)

    arrays, static = eqx.partition([source.model for source in sources], eqx.is_array)
    model = eqx.combine(jax.tree.map(lambda *leaves: in_lanes([*leaves]), *arrays), static[0])
    moved = {name: in_lanes([jnp.asarray(of_source[name])[:, None] for of_source in values]) for name in values[0]}
    first = sources[0].data
    if not isinstance(first, AbstractRecording):
        horizon: Any = in_lanes([source.data.horizon for source in sources])
    else:
        size = max(len(source.data.times) for source in sources)
        clocks = jnp.stack([_lengthened(source.data.times, size) for source in sources])
        clock = in_lanes([source.data.t0 for source in sources])
        horizon = (jnp.tile(clocks, (rows, 1)), moved.pop("t0", clock))
    moved.pop("t0", None)

    def of_lane(model: AbstractModel, values: dict[str, Array]) -> tuple[AbstractModel, Array]:
        model = model.replaced(values)
        return model, model.legal()

    model, is_legal = eqx.filter_vmap(of_lane)(model, moved)
    return Lanes(model, is_legal, horizon)


def _model_times(times: Float[Array, " times"], t0: Float[Array, ""]) -> Float[Array, " times"]:
    """The times of the samples since the launch [s]; 0 for samples before the launch."""
    return greatest(times - t0, INSTANT * jnp.arange(times.shape[0]))


def _lengthened(times: Float[Array, " times"], count: int) -> Float[Array, " count"]:
    """The times, followed by additional times shortly after the last one."""
    return jnp.concatenate([times, times[-1] + AT_ONCE * jnp.arange(1, 1 + count - len(times))])


def _predicted(sources: list[Source], values: list[Values], rows: int, settings: Settings) -> Float[Array, "lanes ..."]:
    """The predictions in all lanes; NaN for illegal parameters, and after the end of a run."""
    data: Any = sources[0].data

    def of_lane(lane: Lanes) -> Array:
        if not isinstance(data, AbstractRecording):
            return nan_unless(lane.is_legal, data.predicted(lane.model, lane.horizon, settings))
        # An illegal run might never end, so it ends at its start.
        times = jnp.where(lane.is_legal, _model_times(*lane.horizon), 0.0)
        # A sample at the time of a reset, as accurately as it is known, is the state before it.
        times = times * (1.0 + INSTANT) if data.side == "after" else times
        run = sampled(lane.model, data.names, times, times[-1], settings)
        columns = data.columns_of(lane.model, lane.model.read(data.names, times, run.rows, run.mode))
        return nan_unless(lane.is_legal, jnp.stack(columns, axis=-1))

    return eqx.filter_vmap(of_lane)(_lanes(sources, values, rows))


_compiled = eqx.filter_jit(_predicted)
_compiled_lanes = eqx.filter_jit(_lanes)


def _predicted_by_tables(
    sources: list[Source], values: list[Values], rows: int, settings: Settings
) -> Float[Array, " lanes"]:
    """The times of events in all lanes, by the programs of tables; NaN for illegal parameters and for runs that failed or are
    unresolved."""
    lanes = _compiled_lanes(sources, values, rows)
    is_legal = np.asarray(lanes.is_legal)
    size, count = len(is_legal), int(is_legal.sum())
    predictions = np.full(size, np.nan)
    if count:
        # However many lanes are legal, there are as many cells, hence one program; only the first cells run.
        order = np.argsort(~is_legal, kind="stable")
        order[count:] = order[0]
        cells, t1 = jax.tree.map(lambda leaf: leaf[order] if eqx.is_array(leaf) else leaf, (lanes.model, lanes.horizon))
        status, time, ends = first_events(cells, np.asarray(t1), size, count, settings)
        time = np.asarray(sources[0].data.of_ends(cells, t1, time, ends))
        predictions[order[:count]] = np.where(np.isin(status, SILENT), np.nan, time)[:count]
    return jnp.asarray(predictions)
