"""theta over time of one launch with flights, from the programs of its table."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from nonholonomic.integration import Settings
from nonholonomic.parameters import numbers
from nonholonomic.sweeps import chunk_for

from ..model.launch import Launch
from ..model.scene import Scene
from .cells import InversionRuns
from .run_kind import run_kind_of


def theta_over_time(
    scene: Scene, launch: Launch, times: Float[np.ndarray, " times"], tolerance: float, axes: Sequence[str]
) -> Float[np.ndarray, " times"]:
    """theta [rad] of one launch at the given times, also in flight. A separate run ends at each time, and all runs are
    cells of a table. A program that has computed a table therefore compiles nothing more for its plot, whereas
    `simulate` compiles fifty programs.

    **Arguments:** `axes`: full names of the parameters along the axes of that table, such as "launch.theta".
    """
    roots = {"scene": scene, "launch": launch}
    values = {path: value for root, tree in roots.items() for path, value in numbers(root, tree).items()}
    size, settings = chunk_for(1), Settings(tolerance)
    columns, blocks = {name: np.full(size, float(values[name])) for name in axes}, []
    for first in range(0, len(times), size):
        block = times[first : first + size]
        # No inclination exceeds pi, so no run ends before its time.
        horizons: Any = np.pad(block, (0, size - len(block)))
        runs = InversionRuns(run_kind_of(scene), horizons, math.pi, "first", settings, "ensemble", [])
        blocks.append(runs.results(roots, columns, len(block))["end_theta"][: len(block)])
    return np.concatenate(blocks)
