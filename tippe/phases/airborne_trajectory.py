"""One run through contacts, flights and impacts, with its path, where flights are integrated."""

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.derivatives import phased_samples
from nonholonomic.integration import BETWEEN, Piece, Settings, follow_phases

from ..dynamics import LOSSES, NO_COSINE
from ..inversion import InversionProblem
from ..launch import Launch
from ..observables import of_each_run
from ..sampled import STATUS as CODES
from ..sampled import TrajectoryProblem
from ..scene import Scene
from ..state import parts
from .airborne import FLYING, phases
from .airborne_stick_slip import phases as stick_slip_phases
from .flight_trajectory import STATUS, HybridTrajectory, flights_of, sampled_flights


class ArenaTrajectory(HybridTrajectory):
    """A `HybridTrajectory` over any arena: `theta`, `azimuth` and `slip` refer to the frame at the foot, the nearest point of
    the arena, and `distance` is that of the top's sphere from it."""

    @of_each_run
    def energy(self) -> Float[Array, " times"]:
        """Kinetic energy plus weight times the height of the centre of mass [J]."""
        scene, (_, e, L, place) = self.scene, parts(self.states)
        (distance, rate), n_up = self.above, scene.frame.vertical(place)[2]
        # In contact the velocity along n is that of the centre of mass about the sphere's centre.
        about = -scene.body.offset * (L[0] * e[1] - L[1] * e[0]) / scene.body.I1
        lifted = scene.gravity * distance * n_up + 0.5 * ((about + rate) ** 2 - about**2)
        return scene.energy(self.states) + scene.body.mass * lifted

    @of_each_run
    def normal_force(self) -> Float[Array, " times"]:
        """Normal force [N]; 0 in flight."""
        return jnp.where(self.contact < 0, 0.0, self.scene.normal_force(self.states))

    @of_each_run
    def slip(self) -> Float[Array, "times 2"]:
        """Velocity along the tangent plane of the point of the sphere that is closest to the arena [m/s]."""
        return self.scene.slip_velocity(self.states).T

    @staticmethod
    def parts_of(shown: Float[np.ndarray, "rows times"]) -> tuple[Any, Any, Any, Any, Any]:
        return shown[:14], shown[14:17], shown[17], shown[18], shown[19:]

    @staticmethod
    def touching(numbers: Int[np.ndarray, " times"]) -> Int[np.ndarray, " times"]:
        # Also of traced numbers, -1 after the end of a run.
        return -1 * ((numbers == FLYING) | (numbers < 0))


class StickSlipArenaTrajectory(ArenaTrajectory):
    """An `ArenaTrajectory` under Coulomb's law as it stands; `stats` holds `sticks` too, how often a slip has turned into
    rolling."""

    @staticmethod
    def touching(numbers: Int[np.ndarray, " times"]) -> Int[np.ndarray, " times"]:
        # Between two phases a slip begins.
        return -1 * (numbers == FLYING)

    @staticmethod
    def work_in(piece: Piece) -> float:
        if piece.number == BETWEEN:
            return float(np.diff(piece.at(np.array([piece.begin, piece.end]))[18])[0])
        return ArenaTrajectory.work_in(piece)


def arena_phases(modules: tuple[Scene, Launch], tolerance: Any) -> tuple[Any, Int[Array, "1"], Float[Array, "19 1"]]:
    """The phases of one launch of a hybrid scene on any arena, the number of the first, and the state there.

    **Arguments:** `modules`: scene and launch; `tolerance`: relative, of the integration.
    """
    run = TrajectoryProblem.of(*modules)
    state, scales = run.start()
    problem = InversionProblem(modules[0].dynamics, jnp.asarray(NO_COSINE), state[:, None], scales[:, None])
    of_law = stick_slip_phases if modules[0].friction.set_valued else phases
    return (*of_law(modules[0], problem, tolerance, last=False, rides=True), state[:, None])


def simulate_airborne(
    scene: Scene, launch: Launch, t1: float, times: Any, tolerance: float, solver: diffrax.AbstractSolver
) -> ArenaTrajectory:
    """Run one launch of a hybrid scene whose flights are integrated. **Arguments:** as for `simulate`, checked."""
    kinds, first, state = arena_phases((scene, launch), tolerance)
    exact = scene.friction.set_valued
    path = follow_phases(kinds, int(first[0]), state[:, 0], t1, Settings(tolerance, solver), kinds=1 + exact)
    status = STATUS[path.status]
    if status == "jammed":
        status = LOSSES[int(scene.dynamics.loss(jnp.asarray(path.state[:14])))]
    hops = np.array([(one.begin, one.end) for one in path.stays if one.number == FLYING]).reshape(-1, 2)
    run = flights_of(StickSlipArenaTrajectory if exact else ArenaTrajectory, scene, path, status, hops, times)
    if exact:
        run.stats["sticks"] = int(path.counts[1])
    return run


def sampled_airborne(scene: Scene, launch: Launch, times: Any, t1: Any, settings: Settings) -> ArenaTrajectory:
    """Run one launch of such a scene inside a transformation. **Arguments:** as for `simulate`, checked."""
    found = phased_samples(arena_phases, (scene, launch), times, t1, settings, kinds=1)
    codes = jnp.asarray([CODES.index(word) for word in LOSSES])
    return sampled_flights(ArenaTrajectory, scene, times, found, codes[scene.dynamics.loss(found.end_state[:14])])
