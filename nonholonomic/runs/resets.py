"""The resets of one run of a user's own system, and the run with the states before and after them, for pictures."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..hybrid import hybrid_resets
from ..sweeps import Table
from ..validation import is_traced


def is_one_run(run: Any) -> bool:
    """Whether a `Trajectory` is a single run outside of transformations."""
    return not is_traced(run.code) and np.ndim(run.code) == 0


def resets_of(run: Any) -> Table:
    """The resets of a run as a table, from a repetition of the run that keeps its path.

    **Arguments:** `run`: a `Trajectory`.

    **Raises:** `ValueError` inside transformations and for a batch of runs.
    """
    if not is_one_run(run):
        raise ValueError("resets takes one run outside jit, vmap and grad; run.mode and run.switches work there too")
    resets = []
    if not run.model.smooth and int(run.switches):
        modes, first, states = run.model.modes(1, run.settings.tolerance, None, False)
        start = (modes, int(np.asarray(first)[0]), np.asarray(states)[:, 0])
        changes = hybrid_resets(*start, float(run.t1), run.settings, counters=len(run.model.counters))
        # The end of a mode without a reset is not counted.
        resets = [pair for pair in changes if np.any(pair[1].counts > pair[0].counts)]
    columns = {"time": np.array([after.end_time[0] for _, after in resets], float)}
    for k, word in enumerate(("before", "after")):
        columns[f"mode_{word}"] = np.array([pair[k].mode[0] for pair in resets], int)
    for k, word in enumerate(("before", "after")):
        states = [run.model.components_of(jnp.asarray(pair[k].state[:, 0])) for pair in resets]
        components = np.array(states, float).reshape(-1, len(run.names))
        columns |= {f"{name}_{word}": components[:, part] for part, name in enumerate(run.names)}
    return Table({"reset": np.arange(1, len(resets) + 1)}, columns, {"time": "s"}, {})


def with_resets(run: Any) -> Any:
    """A run with the states before and after each reset in addition, so that its lines do not cut corners; a batch, and a
    run of one time, stay unchanged."""
    if not is_one_run(run) or len(run.t) < 2 or not int(run.switches):
        return run
    resets, t = run.resets, np.asarray(run.t)
    is_within = (resets["time"] >= t[0]) & (resets["time"] <= t[-1])
    times = np.repeat(resets["time"][is_within], 2)
    places = np.searchsorted(t, times, side="right")

    def added(before: str, after: str) -> np.ndarray:
        return np.stack([resets[before][is_within], resets[after][is_within]], axis=-1).reshape(-1)

    states = np.stack([added(f"{name}_before", f"{name}_after") for name in run.names], axis=-1)
    return dataclasses.replace(
        run,
        t=np.insert(t, places, times),
        state=np.insert(np.asarray(run.state), places, states, axis=0),
        mode=np.insert(np.asarray(run.mode), places, added("mode_before", "mode_after")),
    )
