"""The cells of a table of trajectories: samples of many launches, and the quantities at the samples."""

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nonholonomic.geometry import Plane
from nonholonomic.integration import CoreProblem, Outcome, Settings, solve_with_samples
from nonholonomic.integration.status import FAILED, LEFT_DOMAIN
from nonholonomic.xla_cpu import compiled_alone

from ..model.launch import Launch
from ..model.scene import Scene
from ..modes.trajectory_problem import BEHIND_PATH, TrajectoryProblem, trajectory_problem
from .quantities import QUANTITIES
from .sampled import ended
from .trajectory import Trajectory

#: Quantities that follow from the state alone. The other quantities need the path; on a plane, only the position needs
#: it.
OF_THE_STATE = {"theta", "azimuth", "spin", "energy", "jellett", "normal_force", "slip", "theta_rate"}

#: Quantities that do not change if the frame turns about n.
WITHOUT_DIRECTION = {"theta", "theta_rate", "eta", "spin", "energy", "jellett", "normal_force"}

#: Tables with at least this many samples interpolate them inside steps. Runs often take about as many steps; tables of
#: runs with many more steps take up to a sixth longer, those with fewer up to two thirds less time.
DENSE = 1000


def launches_with(scene: Scene, launch: Launch, cells: int, names: tuple[str, ...]) -> CoreProblem:
    """The runs of the given cells with the parts of a `TrajectoryProblem` that the named quantities need.

    Only some quantities need the path, and none needs rotation or work. On the plane, a run without path, rotation and
    work takes half the time. If no quantity has a direction, the frame turns on the level plane, and samples are thirty
    to a hundred times as accurate.
    """
    run = trajectory_problem((scene, launch), cells)
    if scene.level and WITHOUT_DIRECTION.issuperset(names):
        turning = eqx.tree_at(lambda run: run.problem.dynamics, run, scene.turning_dynamics)
        return CoreProblem(turning, run.leading)
    quantities_needed = {"position"} if isinstance(scene.surface, Plane) else set(QUANTITIES) - OF_THE_STATE
    return CoreProblem(run, run.leading if quantities_needed.isdisjoint(names) else len(run.start()[0]) - BEHIND_PATH)


def _reader(
    run: TrajectoryProblem, scene: Scene, names: tuple[str, ...]
) -> Callable[[Int[Array, " lanes"], Float[Array, "rows components lanes"]], dict[str, Array]]:
    """A function that computes the named quantities of some cells from their states."""

    def read_lane(scene: Scene, states: Float[Array, "rows components"]) -> dict[str, Array]:
        # No quantity reads the spin angle or the work.
        missing = len(run.start()[0]) - 2 - states.shape[1]
        zeros = jnp.zeros(len(states))
        state, cyclic = jnp.split(jnp.pad(states.T, ((0, missing), (0, 0))), [run.leading])
        trajectory = Trajectory(zeros, scene, state, cyclic, zeros, zeros)
        return {name: getattr(trajectory, name) for name in names}

    def own_axis(leaf: Any) -> int | None:
        return 0 if eqx.is_array(leaf) and leaf.ndim else None

    def reader(cells: Int[Array, " lanes"], states: Float[Array, "rows components lanes"]) -> dict[str, Array]:
        of_lanes = jax.tree.map(lambda leaf: leaf if own_axis(leaf) is None else leaf[cells], scene)
        return eqx.filter_vmap(read_lane, in_axes=(own_axis, -1), out_axes=1)(of_lanes, states)

    return reader


# Compiled on its own, not inside other transformed functions; otherwise it does not get the compiler's options.
@compiled_alone
def _followed(
    problem: CoreProblem,
    scene: Scene,
    times: Float[Array, " times"],
    count: Int[Array, ""],
    settings: Settings,
    names: tuple[str, ...],
) -> tuple[Outcome, Int[Array, " cells"], dict[str, Float[Array, "cells times ..."]]]:
    """The `Status` of the runs as integers, and the named quantities at the samples."""
    run = cast(TrajectoryProblem, problem.whole)
    reader = _reader(run, scene, names)
    dense = len(times) >= DENSE
    outcome, samples = solve_with_samples(
        problem, times, times[-1], count, settings, one_kernel=True, read=reader, dense=dense
    )
    codes = (outcome.status == LEFT_DOMAIN, outcome.status == FAILED)
    status = ended(run, scene, outcome.state, *codes, settings.tolerance)
    return outcome, status, samples


def solve_cells(
    scene: Scene, launch: Launch, cells: int, times: Any, settings: Settings, names: tuple[str, ...], count: int
) -> dict[str, Array]:
    """The variables of the given cells.

    **Arguments:** `scene`, `launch`: numbers that are scalars or one per cell; `cells`: number of cells, of which only
    the first `count` are run; `times`: times of the samples [s], of which the last is the horizon; `settings`: settings
    of the integration; `names`: names of the quantities.

    **Returns:** name -> values, the cells first.
    """
    numbers = (jnp.asarray(times, float), jnp.asarray(count), settings)
    problem = launches_with(scene, launch, cells, names)
    outcome, status, values = _followed(problem, scene, *numbers, names)
    ending = {"status": status, "end_time": outcome.end_time, "steps": outcome.steps, "rejected": outcome.rejected}
    return jax.tree.map(jnp.asarray, values | ending)
