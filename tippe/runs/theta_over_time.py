"""theta over time of one launch with flights, from the programs of its table."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import Settings
from nonholonomic.integration.status import REACHED_END
from nonholonomic.parameters import numbers, with_numbers
from nonholonomic.runs import Ensemble, at_the_end
from nonholonomic.sweeps import chunk_for

from ..model.launch import Launch
from ..model.scene import Scene
from .model import TopModel
from .turned_over import event_of


def theta_over_time(
    scene: Scene, launch: Launch, times: Float[np.ndarray, " times"], tolerance: float, axes: Sequence[str]
) -> Float[np.ndarray, " times"]:
    """theta [rad] of one launch at the given increasing times, also in flight. A program that has computed a table
    compiles nothing more for its plot, whereas `simulate` compiles fifty programs.

    All cells of a table run this launch. Each cell runs to the first time of its own part of the times, and from there
    from time to time.

    **Arguments:** `axes`: full names of the parameters along the axes of that table, such as "launch.theta".
    """
    roots = {"scene": scene, "launch": launch}
    values = {path: value for root, tree in roots.items() for path, value in numbers(root, tree).items()}
    size, settings = chunk_for(1), Settings(tolerance)
    cells = with_numbers(roots, {name: np.full(size, float(values[name])) for name in axes})
    model = TopModel.timed(**cells, angle=event_of(scene, None))
    ensemble = Ensemble.of(model, size, settings.tolerance, False)
    # No inclination exceeds pi, so no run ends before its time, in the programs of the table.
    never = {"cos_angle": jnp.asarray(-1.0)} | ({"stem_counts": jnp.zeros(())} if scene.has_stem else {})
    modes = tuple(dataclasses.replace(mode, **never) for mode in ensemble.modes or ())
    ensemble = dataclasses.replace(ensemble, modes=modes)
    parts = -(-len(times) // size)
    ends = np.pad(times, (0, size * parts - len(times)), mode="edge").reshape(size, parts)
    rows, goes = [], np.ones(size, bool)
    for spans in np.diff(ends, axis=1, prepend=0.0).T:
        outcome: Any = ensemble.solve(spans, size, settings)
        assert isinstance(outcome, HybridOutcome)
        theta = np.asarray(at_the_end(model, ensemble, outcome, settings.tolerance)[1]["end_theta"])
        rows.append(theta if not rows else np.where(goes, theta, rows[-1]))
        goes &= outcome.status == REACHED_END
        ensemble = dataclasses.replace(ensemble, states=outcome.state, first=outcome.mode)
    return np.stack(rows, axis=1).ravel()[: len(times)]
