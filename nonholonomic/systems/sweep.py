"""Tables of many runs of a user's system, over a grid of its parameters and starts."""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..derivatives import solve_ensemble_with_tangents, tangent_scale, tangents_of
from ..formulations import AbstractSystem
from ..hybrid import HybridOutcome, solve_hybrid, solve_hybrid_with_tangents
from ..integration import Outcome, Settings, explicit_tableau, solve_ensemble
from ..integration.status import CROSSED, FAILED, LEFT_DOMAIN, UNRESOLVED
from ..sweeps import Table, Variable, axis, chunk_for, size_of
from ..sweeps import sweep as computed
from ..validation import as_number, shown
from .engine import Cells
from .mode import Event, Hybrid
from .numbers import Named, check_again, has_checks, require_apart, short_names
from .system import Run, System, check_run, run_of
from .tracing import dependent_outputs

#: Smallest number of cells in a chunk of a large grid: runs of small systems are short, so the overhead of a chunk
#: counts.
LEAST_CHUNK = 1024

#: The words for how a run can end, and the code of each word but the first.
WORDS = ("event", "completed", "stopped", "failed", "unresolved")
CODES = {LEFT_DOMAIN: 2, FAILED: 3, UNRESOLVED: 4}


def sweep(
    system: System,
    start: Any,
    t1: float,
    *,
    axes: dict[str, Any],
    event: Event | None = None,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    sensitivities: Sequence[str] = (),
    path: Any = None,
    progress: bool = True,
    executor: Executor | None = None,
) -> Table:
    """Event times and ends of all runs over a grid of parameters, in one batched call on all cores.

    **Arguments:**

    - `system`, `start`, `event`, `tolerance`, `solver`: as for `event_time`. Without an event, runs end at `t1`.
    - `t1`: horizon [s].
    - `axes`: full name of a parameter -> values, such as `{"system.modes[0].drag": [0.1, 0.2], "start[1]": [0.0,
      1.0]}`; the end of a name is enough if it is unique. The start of an `AbstractSystem` has the names `"start.q[0]"`
      and `"start.rate[0]"`, and parameters of an event that is an `equinox.Module` have names such as `"event.level"`
      or `"system.event.level"`. `"modes[*].drag"` gives all modes that have a drag the same value. The first axis varies
      slowest.
    - `sensitivities`: names of the parameters with respect to which the times are differentiated.
    - `path`: HDF5 file to write, chunk by chunk. Repeat the same call to resume an interrupted sweep.
    - `progress`: whether to show progress, on a terminal or in a notebook.
    - `executor`: any `concurrent.futures.Executor`, such as that of `nonholonomic.local_processes`; by default a thread
      for each core. For other processes, define classes and functions at the top level of a module.

    **Returns:** a `Table` with `time` [s] of the event, infinite without one; `status`: "event", "completed" if the run
    reached `t1`, "stopped" if a mode without a reset ended, "failed" or "unresolved"; `end_time` [s]; the state at the
    end, `y0` and so on, or `q0`, `rate0` and so on; `steps` and `rejected`; and for a system with resets their number,
    `switches`. With `sensitivities`, the table also contains the derivative of `time` with respect to each parameter,
    such as `time_by_drag` for `"system.modes[0].drag"`, and for a system with resets `grazes`: 1 if the derivative is
    NaN because the margin of a mode only touched zero.

    **Raises:** `ValueError` for arguments out of range or an unknown axis; `OSError` for a path that cannot be used;
    `RuntimeError` for an executor that breaks down, or a worker with other versions.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> decay = nonholonomic.Hybrid([Decay(rate=2.0)], event=lambda t, y: y[0] - 0.5)
    >>> table = nonholonomic.sweep(decay, [1.0], t1=1.0, axes={"rate": [0.5, 1.0, 2.0]}, progress=False)
    >>> print(table.time.round(6), table.status)
    [     inf 0.693147 0.346574] ['completed' 'event' 'event']

    ```
    """
    check_run(system, start, t1, tolerance)
    if not isinstance(axes, dict) or not all(isinstance(name, str) for name in axes):
        raise ValueError(f"axes = {shown(axes)} must be a dictionary, name of a number -> values")
    settings = Settings(tolerance, solver)
    explicit_tableau(settings.for_lanes)
    if isinstance(system, Hybrid) and event is not None:
        system, event = dataclasses.replace(system, event=event), None
    mechanical = isinstance(system, AbstractSystem)
    initial = dict(zip(("q", "rate"), map(as_number, start), strict=True)) if mechanical else as_number(start)
    tree = {"system": system, "start": initial, "event": event}
    parameters = Named.of(tree)
    full_axes = {parameters.full_name("axes", name): values for name, values in axes.items()}
    sensitivity_names = [parameters.full_name("sensitivities", name) for name in sensitivities]
    require_apart("axes and sensitivities", [*full_axes, *sensitivity_names])
    parameters = Named.of(tree, [*full_axes, *sensitivity_names])
    shorts = short_names([*full_axes, *(name for name in sensitivity_names if name not in full_axes)])
    grid = [axis(shorts[name], name, "1", values) for name, values in full_axes.items()]
    for grid_axis in grid if has_checks(system) or has_checks(event) else ():
        for value in grid_axis.values:
            check_again(parameters.tree(parameters.replaced({grid_axis.number: jnp.asarray(value)})))
    job = SweepJob(parameters, float(t1), settings, tuple(sensitivity_names))
    run = _run(parameters.tree(parameters.values))
    if sensitivity_names and not run.cells.form.has_event:
        raise ValueError("sensitivities are those of the event's time: pass event=, a function of time and state")
    values = {name: float(value) for name, value in zip(parameters.names, parameters.values, strict=True)}
    request = {
        "system": type(system).__name__,
        "event": _function(system.event if isinstance(system, Hybrid) else event),
    }
    request |= {name: value for name, value in values.items() if name not in full_axes}
    request |= {name: "an axis" for name in full_axes} | {"sensitivities": sensitivity_names}
    request |= {
        "t1": float(t1),
        "tolerance": float(tolerance),
        "solver": type(settings.for_lanes).__name__,
    }
    cells = size_of(grid)
    chunk = max(LEAST_CHUNK, chunk_for(cells)) if cells > 4 * LEAST_CHUNK else None
    options = {"chunk": chunk, "path": path, "progress": progress, "executor": executor}
    return computed(job, grid, job.variables(run, shorts), request, **options)


def _function(event: Any) -> Any:
    return None if event is None else getattr(event, "__qualname__", type(event).__name__)


def _run(tree: dict[str, Any]) -> Run:
    """The run of a system, start and event."""
    start = tree["start"]
    return run_of(tree["system"], (start["q"], start["rate"]) if isinstance(start, dict) else start, tree["event"])


class SweepJob(NamedTuple):
    """The computation for every cell, as data that can be sent to another process; see `sweep`."""

    parameters: Named
    t1: float
    settings: Settings
    sensitivity_names: tuple[str, ...]

    @classmethod
    def of(cls, tree: dict[str, Any], shared: tuple[str, ...], *rest: Any) -> "SweepJob":
        """The job for a system, start and event. **Arguments:** `shared`: as for `Named.of`."""
        return cls(Named.of(tree, shared), *rest)

    def __reduce__(self) -> Any:
        # The structure of a tree with a user's classes cannot be pickled, but the tree can.
        return SweepJob.of, (self.parameters.tree(self.parameters.values), self.parameters.names, *self[1:])

    def variables(self, run: Run, shorts: dict[str, str]) -> dict[str, Variable]:
        """The variables of the table."""
        event, smooth = run.cells.form.has_event, run.cells.form.traits.smooth
        variables = {"time": Variable("s", np.float64, long_name="time of the event")} if event else {}
        variables |= {"status": Variable("1", np.int8, WORDS, long_name="how the run ended")}
        variables |= {"end_time": Variable("s", np.float64, long_name="end of the run")}
        variables |= {name: Variable("1", np.float64, long_name=f"{name} at the end") for name in run.names}
        counts = {"steps": "steps", "rejected": "rejected steps"} | ({} if smooth else {"switches": "resets"})
        variables |= {name: Variable("1", np.int64, long_name=words) for name, words in counts.items()}
        variables |= {f"time_by_{shorts[name]}": Variable("1", np.float64) for name in self.sensitivity_names}
        if self.sensitivity_names and not smooth:
            variables |= {"grazes": Variable("1", np.int8, long_name="whether the end of a mode was grazing")}
        return variables

    def __call__(self, columns: dict[str, Any], count: int) -> dict[str, Any]:
        """The variables of some cells, of which only the first `count` are run."""
        size = next((len(values) for values in columns.values()), 1)
        cells, initial, tangents, scales = _cells(self.parameters, columns, self.sensitivity_names, size)
        settings, t1 = self.settings, np.asarray(self.t1)
        grazing, slopes = np.zeros(size, bool), []
        if cells.form.traits.smooth:
            problem, count_array = initial, np.asarray(count)
            if self.sensitivity_names:
                outcome, slopes = solve_ensemble_with_tangents(problem, tangents, t1, count_array, settings)
            else:
                outcome, _ = solve_ensemble(problem, t1, count_array, settings)
        else:
            modes, first, states = initial
            options = (np.asarray(first), np.asarray(states), t1, count, settings)
            if self.sensitivity_names:
                outcome, sensitivities = solve_hybrid_with_tangents(modes, tangents, *options, counters=1)
                slopes, grazing = sensitivities.slopes, np.asarray(sensitivities.grazing)
            else:
                outcome = solve_hybrid(modes, *options, counters=1)
        crossed = np.asarray(outcome.status) == CROSSED
        shorts = short_names([*columns, *(name for name in self.sensitivity_names if name not in columns)])
        ends = self._ends(cells, columns, outcome, crossed, size)
        for name, slope, scale in zip(self.sensitivity_names, slopes, scales, strict=True):
            ends[f"time_by_{shorts[name]}"] = np.where(crossed, np.asarray(slope) / np.asarray(scale), 0.0)
        if self.sensitivity_names and not cells.form.traits.smooth:
            ends["grazes"] = (crossed & grazing).astype(np.int8)
        return ends

    def _ends(
        self, cells: Cells, columns: dict[str, Any], outcome: Outcome | HybridOutcome, crossed: Any, size: int
    ) -> dict[str, Any]:
        """The variables of the table that describe the ends of runs."""
        status = np.asarray(outcome.status)
        words = np.select([crossed, *(status == code for code in CODES)], [0, *CODES.values()], 1)
        ends = {"time": np.where(crossed, outcome.crossing_time, np.inf)} if cells.form.has_event else {}
        if cells.form.has_event:
            ends["time"] = np.where(words >= CODES[FAILED], np.nan, ends["time"])
        counts = {"steps": outcome.steps, "rejected": outcome.rejected}
        if isinstance(outcome, HybridOutcome):
            counts |= {"switches": outcome.counts[0]}
        states = _shown(self.parameters, columns, jnp.asarray(outcome.state), size)
        ends |= {"status": words.astype(np.int8), "end_time": np.asarray(outcome.end_time)}
        return ends | {name: np.asarray(values) for name, values in (counts | states).items()}


@eqx.filter_jit
def _cells(
    parameters: Named, columns: dict[str, Any], sensitivity_names: tuple[str, ...], size: int
) -> tuple[Cells, Any, Any, list[Array]]:
    """The cells, their engine objects, the tangents of these with respect to some numbers, and the scales of the
    tangents."""
    values = parameters.replaced({name: jnp.asarray(column) for name, column in columns.items()})
    indices = [k for k, name in enumerate(parameters.names) if name in columns or name in sensitivity_names]

    def of_one(*numbers: Array) -> Cells:
        all_values = list(parameters.values)
        for k, number in zip(indices, numbers, strict=True):
            all_values[k] = number
        return _run(parameters.tree(tuple(all_values))).cells

    point = tuple(jnp.broadcast_to(values[k], (size,)).astype(float) for k in indices)

    def of_all(*numbers: Array) -> Cells:
        first = [number[0] for number in numbers]
        single, batch = of_one(*first), jax.vmap(of_one, axis_size=size)(*numbers)
        depends = dependent_outputs(of_one, *first)
        leaves = [
            a if d else b for a, b, d in zip(jax.tree.leaves(batch), jax.tree.leaves(single), depends, strict=True)
        ]
        return jax.tree.unflatten(jax.tree.structure(single), leaves)

    def problem(*moving: Array) -> Any:
        all_values = list(point)
        for name, number in zip(sensitivity_names, moving, strict=True):
            all_values[indices.index(parameters.names.index(name))] = number
        cells = of_all(*all_values)
        if cells.form.traits.smooth:
            return cells.problem(size)
        modes, _, states = cells.modes(size)
        return modes, states

    positions = [indices.index(parameters.names.index(name)) for name in sensitivity_names]
    scales = [tangent_scale(point[k]) for k in positions]
    rows = [
        tuple(scale if i == j else jnp.zeros_like(scale) for j, scale in enumerate(scales))
        for i in range(len(sensitivity_names))
    ]
    tangents = tangents_of(problem, tuple(point[k] for k in positions), rows) if sensitivity_names else ()
    cells = of_all(*point)
    return cells, cells.problem(size) if cells.form.traits.smooth else cells.modes(size), tangents, scales


@eqx.filter_jit
def _shown(parameters: Named, columns: dict[str, Any], states: Array, size: int) -> dict[str, Array]:
    """The states in the user's components."""
    values = parameters.replaced({name: jnp.asarray(column) for name, column in columns.items()})
    axes = tuple(0 if name in columns else None for name in parameters.names)

    def of_one(state: Array, *numbers: Array) -> Array:
        return _run(parameters.tree(numbers)).shown(state)

    parts = jax.vmap(of_one, in_axes=(1, *axes), out_axes=1)(states, *values)
    return dict(zip(_run(parameters.tree(parameters.values)).names, parts, strict=True))
