"""One run through contacts, flights and impacts, with its path."""

from typing import Any, NamedTuple, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.geometry import dot, scale, sum_vectors
from nonholonomic.integration import (
    FAILED,
    GUARD_LOST,
    MOST_STEPS,
    REACHED_END,
    RUNNING,
    UNRESOLVED,
    AbstractProblem,
    Followed,
    follow,
)
from nonholonomic.validation import require

from ..dynamics import Dynamics, stacked
from ..inversion import ABSOLUTE
from ..launch import Launch
from ..scene import Scene
from .flight import cone, flown
from .free_body import Ball, FreeBody, axis_rate, balls, energy, freed, grounded, jellett, standing_on
from .impact import approach
from .leaning import BOTH, LeaningDynamics
from .sliding import MOST_BOUNCES, clearance, first_ball, land, leaning, lifted, lost_contact, take_flight

#: Pieces, that is contacts and flights, after which a run is given up: as many as a table allows bounces in a row.
MOST_PIECES = MOST_BOUNCES

#: Angle by which the axis turns between the times at which a flight is shown by default [rad].
SHOWN = 0.4

#: No angle has this cosine: a trajectory goes on through all of them.
NEVER = -2.0

STATUS = {REACHED_END: "reached t1", GUARD_LOST: "jammed", FAILED: "failed", UNRESOLVED: "unresolved"}

#: Rows of what is shown of a run: state, velocity and height of the centre of mass, its place, spin angle, work.
ROWS = 14

Rows: TypeAlias = Float[np.ndarray, "14 times"]


class Contact(AbstractProblem):
    """Sliding, with the place of the centre of mass, the spin angle and the work of friction; see `Sliding`."""

    dynamics: Dynamics | LeaningDynamics
    own: Ball
    other: Ball | None
    axial: Float[Array, ""]
    state: Float[Array, "12"]
    scales: Float[Array, "12"]

    def start(self) -> tuple[Float[Array, "12"], Float[Array, "12"]]:
        return self.state, self.scales

    def field(self, time: Float[Array, ""], state: Float[Array, "12"]) -> Float[Array, "12"]:
        motion = self.dynamics.motion(state[:8])
        rates = (*motion.rate, state[0], state[1], motion.spin_momentum / self.axial, motion.friction_power)
        return stacked(rates, state)

    def crossing(self, state: Float[Array, "12"]) -> None:
        return None

    def guard(self, time: Float[Array, ""], state: Float[Array, "12"]) -> Float[Array, ""]:
        margin = self.dynamics.contact_margin(state[:8])
        return margin if self.other is None else jnp.minimum(margin, clearance(self.own, self.other, state))


class Sojourn(NamedTuple):
    """A stretch of the run on one sphere: when it begins [s], the numbers of the motion since, the sphere and its number."""

    begin: float
    path: Followed
    scene: Scene
    ball: Ball
    number: int

    @property
    def end(self) -> float:
        return self.begin + float(self.path.times[-1])

    def shown(self) -> Float[np.ndarray, " times"]:
        return self.begin + self.path.times[1:]

    def at(self, times: Float[np.ndarray, " times"]) -> Rows:
        states = self.path.at(np.clip(times - self.begin, 0.0, self.path.times[-1]))
        return _rows_in_contact(self.scene, states, self.ball)


class Arc(NamedTuple):
    """A flight: when it begins [s], how long it takes [s], and the body, its place and numbers at the start."""

    begin: float
    duration: float
    scene: Scene
    free: FreeBody
    rest: Float[np.ndarray, "4"]

    number = -1

    @property
    def end(self) -> float:
        return self.begin + self.duration

    def shown(self) -> Float[np.ndarray, " times"]:
        turned = float(cone(self.scene.body, self.free).rate) * self.duration
        return self.begin + self.duration * np.linspace(0.0, 1.0, 2 + int(turned / SHOWN))[1:]

    def at(self, times: Float[np.ndarray, " times"]) -> Rows:
        passed = jnp.asarray(np.clip(times - self.begin, 0.0, self.duration))
        later = _flown(self.scene, self.free, passed)
        return _rows_in_flight(self.scene, later, self.rest, passed)


# Compiled once for all pieces of all runs.
_flown = eqx.filter_jit(lambda scene, free, time: flown(scene.body, scene.gravity, free, time))
_take_flight = eqx.filter_jit(take_flight)
_energy = eqx.filter_jit(lambda scene, free: energy(scene.body, scene.gravity, free))
_land = eqx.filter_jit(land)
_lost_contact = eqx.filter_jit(lost_contact)
_lifted = eqx.filter_jit(lifted)


def _rows_in_contact(scene: Scene, states: Float[np.ndarray, "12 times"], ball: Ball) -> Rows:
    """The rows of a run in contact; velocity and height along the normal follow from the axis."""
    free = freed(scene.body, ball, jnp.asarray(states[:8]))
    return np.concatenate([states[:8], np.stack([free.velocity[2], free.height]), states[8:]])


def _rows_in_flight(
    scene: Scene, later: FreeBody, rest: Float[np.ndarray, "4"], passed: Float[Array, " times"]
) -> Rows:
    """The rows of a run in flight, `passed` [s] after its start, where place, spin angle and work are `rest`."""
    one = np.ones(len(passed))
    spin = dot(later.axis, later.momentum) / scene.body.I3
    x, y = (place + speed * passed for place, speed in zip(rest[:2], later.velocity[:2], strict=True))
    (u1, u2, u3), height = later.velocity, later.height
    rows = (u1, u2, *later.axis, *later.momentum, u3, height, x, y, rest[2] + spin * passed, rest[3])
    return np.stack([np.asarray(row) * one for row in rows])


class HybridTrajectory(eqx.Module):
    """A run through contacts, flights and impacts; vectors are arrays (times, 3) in the fixed frame (x, y, z).

    `status` is "reached t1", "jammed" (as in `Trajectory`), "failed" or "unresolved" (more than 10 000 contacts and flights,
    or sphere and stem on the plane together with so much friction that the forces are not determined); the run ends at
    `end_time`. `contact` says at each time which sphere touches: 0 the top's, 1 its stem's, 2 both, -1 none. At the time of
    an impact the values are those before it. `hops` has a row for each flight until `end_time`, its begin and its end [s]; a
    table counts those before the inversion. `work` is that of friction and of the impacts [J]. `stats` holds accepted and
    rejected steps, the greatest drift of |e|, the greatest energy residual |E - E(0) - work| and the energy lost in impacts
    [J].
    """

    t: Float[np.ndarray, " times"]
    scene: Scene
    rows: Rows
    contact: Int[np.ndarray, " times"]
    hops: Float[np.ndarray, "hops 2"]
    status: str
    end_time: float
    stats: dict[str, Any]
    pieces: list[Any]

    @property
    def _free(self) -> FreeBody:
        rows = self.rows
        return FreeBody((rows[0], rows[1], rows[8]), rows[9], tuple(rows[2:5]), tuple(rows[5:8]))

    @property
    def _ball(self) -> Ball:
        """The sphere that touches, the top's own in flight and where both do."""
        spheres = balls(self.scene.body)
        return Ball(
            *(jnp.where(self.contact == 1, stem, own) for own, stem in zip(spheres[0], spheres[-1], strict=True))
        )

    @property
    def theta(self) -> Float[np.ndarray, " times"]:
        """Angle from the normal to the axis [rad]."""
        return np.arctan2(np.hypot(self.rows[2], self.rows[3]), self.rows[4])

    @property
    def eta(self) -> Float[np.ndarray, " times"]:
        """Angle of the place from the arena's lowest point [rad]: 0 on the plane."""
        return np.zeros_like(self.t)

    @property
    def azimuth(self) -> Float[np.ndarray, " times"]:
        """Direction in which the axis leans [rad], from x towards y, in (-pi, pi]."""
        return np.arctan2(self.rows[3], self.rows[2])

    @property
    def spin(self) -> Float[np.ndarray, " times"]:
        """Angular velocity about the axis [rad/s]."""
        return dot(tuple(self.rows[2:5]), tuple(self.rows[5:8])) / np.asarray(self.scene.body.I3)

    @property
    def spin_angle(self) -> Float[np.ndarray, " times"]:
        """Angle by which the top has turned about its axis [rad]."""
        return self.rows[12]

    @property
    def axis(self) -> Float[np.ndarray, "times 3"]:
        """The unit vector e along the axis."""
        return self.rows[2:5].T

    @property
    def angular_momentum(self) -> Float[np.ndarray, "times 3"]:
        """Angular momentum about the centre of mass [kg m^2/s]."""
        return self.rows[5:8].T

    @property
    def velocity(self) -> Float[np.ndarray, "times 3"]:
        """Velocity of the sphere's centre [m/s]."""
        free = self._free
        rate = axis_rate(self.scene.body, free.axis, free.momentum)
        return np.stack(sum_vectors(free.velocity, scale(self.scene.body.offset, rate)), axis=-1)

    @property
    def position(self) -> Float[np.ndarray, "times 3"]:
        """Position of the sphere's centre [m]; the plane is z = 0, and the run starts above the origin."""
        place = (self.rows[10], self.rows[11], self.rows[9])
        return np.stack(sum_vectors(place, scale(self.scene.body.offset, self._free.axis)), axis=-1)

    @property
    def energy(self) -> Float[np.ndarray, " times"]:
        """Kinetic energy plus weight times the height of the centre of mass [J]."""
        return np.asarray(energy(self.scene.body, self.scene.gravity, self._free))

    @property
    def work(self) -> Float[np.ndarray, " times"]:
        """Work of friction and of the impacts since the start [J]."""
        return self.rows[13]

    @property
    def jellett(self) -> Float[np.ndarray, " times"]:
        """Jellett's quantity of the top's own sphere [kg m^3/s]: constant unless the stem touches the plane."""
        return np.asarray(jellett(balls(self.scene.body)[0], self._free))

    @property
    def normal_force(self) -> Float[np.ndarray, " times"]:
        """Normal force [N]; 0 in flight. Where both spheres touch it is their sum, the weight."""
        motion = standing_on(self.scene.dynamics, self._ball).motion(jnp.asarray(self.rows[:8]))
        both = np.where(self.contact == BOTH, self.scene.body.mass * self.scene.gravity, motion.normal_force)
        return np.where(self.contact < 0, 0.0, both)

    @property
    def slip(self) -> Float[np.ndarray, "times 2"]:
        """Velocity along the plane of the lowest point of the sphere that touches [m/s]: of the top's own in flight too, and
        where both touch."""
        return np.stack(approach(self.scene.body, self._ball, self._free).velocity[:2], axis=-1)

    def at(self, times: Any) -> "HybridTrajectory":
        """The same run at other times.

        **Arguments:** `times`: increasing, within [0, `end_time`] [s].

        **Raises:** `ValueError` for times outside the run.
        """
        times = np.asarray(times, dtype=float)
        require(times, "times", at_least=0.0, at_most=self.end_time, why="the run ends there")
        rows, contact = np.zeros((ROWS, len(times))), np.full(len(times), self.pieces[0].number)
        ends = [piece.end for piece in self.pieces]
        where = np.minimum(np.searchsorted(ends, times), len(ends) - 1)
        for index in np.unique(where):
            here = np.flatnonzero(where == index)
            # Padded to one length, so that one program serves all pieces.
            padded = np.concatenate([times[here], np.full(len(times) - here.size, times[here[-1]])])
            rows[:, here] = self.pieces[index].at(padded)[:, : here.size]
            contact[here] = self.pieces[index].number
        return eqx.tree_at(lambda one: (one.t, one.rows, one.contact), self, (times, rows, contact))

    def __str__(self) -> str:
        ending = "ran to" if self.status == "reached t1" else f"{self.status} at"
        return "\n".join(
            [
                f"Trajectory of {len(self.t)} times, {ending} {self.end_time:.6g} s, {len(self.hops)} flights",
                f"  theta: {self.theta[0]:.6g} to {self.theta[-1]:.6g} rad",
                f"  steps: {self.stats['accepted']} accepted, {self.stats['rejected']} rejected",
                f"  drift of |e|: {self.stats['axis_drift']:.1e}",
                f"  lost in impacts: {self.stats['impact_loss']:.3g} J",
                f"  energy residual: {self.stats['energy_residual']:.1e} J of {self.energy[0]:.4g} J",
            ]
        )

    def __repr__(self) -> str:
        return str(self)


def simulate_hybrid(
    scene: Scene, launch: Launch, t1: float, times: Any, tolerance: float, solver: diffrax.AbstractSolver
) -> HybridTrajectory:
    """Run one launch of a hybrid scene until `t1`. **Arguments:** as for `simulate`, checked."""
    pieces, status, steps, loss = _pieces(scene, launch, t1, tolerance, solver)
    hops = np.array([(piece.begin, piece.end) for piece in pieces if isinstance(piece, Arc)]).reshape(-1, 2)
    # A contact that was lost as soon as it began has no time of its own.
    shown = [np.zeros(1), *(piece.shown() for piece in pieces)]
    run = HybridTrajectory(
        np.zeros(1), scene, np.zeros((ROWS, 1)), np.zeros(1, int), hops, status, pieces[-1].end, {}, pieces
    )
    run = run.at(np.unique(np.minimum(np.concatenate(shown), run.end_time)))
    stats = {
        "accepted": steps[0],
        "rejected": steps[1],
        "axis_drift": float(np.max(np.abs(np.linalg.norm(run.axis, axis=1) - 1.0))),
        "energy_residual": float(np.max(np.abs(run.energy - run.energy[0] - run.work))),
        "impact_loss": loss,
    }
    run = eqx.tree_at(lambda one: one.stats, run, stats)
    return run if times is None else run.at(np.asarray(times)[np.asarray(times) <= run.end_time])


def _pieces(
    scene: Scene, launch: Launch, t1: float, tolerance: float, solver: diffrax.AbstractSolver
) -> tuple[list[Any], str, tuple[int, int], float]:
    """Contacts and flights one after another, how the run ended, accepted and rejected steps, energy lost in impacts."""
    spheres = balls(scene.body)
    state = np.asarray(scene.state(launch))
    number = first_ball(spheres, jnp.asarray(state))
    centre = [-float(spheres[0].offset) * state[2], -float(spheres[0].offset) * state[3]]
    rest = np.array([*centre, 0.0, 0.0])
    radius, weight = scene.body.radius, scene.body.mass * scene.gravity
    scales = jnp.concatenate([scene.scales(launch), jnp.stack([radius, radius, jnp.ones(()), weight * radius])])
    never = jnp.asarray(NEVER)
    pieces, time, accepted, rejected, loss = [], 0.0, 0, 0, 0.0

    def ended(code: int) -> tuple[list[Any], str, tuple[int, int], float]:
        return pieces, STATUS[code], (accepted, rejected), loss

    while len(pieces) < MOST_PIECES:
        number = int(number)
        own, other = _own_and_other(spheres, number)
        start = jnp.concatenate([jnp.asarray(state), jnp.asarray(rest)])
        dynamics = leaning(scene) if number == BOTH else standing_on(scene.dynamics, own)
        problem = Contact(dynamics, own, other, scene.body.I3, start, scales)
        most = MOST_STEPS - accepted - rejected
        path = follow(problem, t1 - time, solver=solver, rtol=tolerance, atol=ABSOLUTE * tolerance, max_steps=most)
        pieces.append(Sojourn(time, path, scene, own, number))
        time, accepted, rejected = pieces[-1].end, accepted + path.accepted, rejected + path.rejected
        if path.failed or not path.guard_lost:
            return ended(FAILED if path.failed else REACHED_END)
        state, rest = path.states[:8, -1], path.states[8:, -1]
        if number == BOTH:
            numbers, states = _lifted(scene, jnp.asarray(state)[:, None])
            number, state = numbers[0], states[:, 0]
            continue
        air = _lost_contact(scene, jnp.asarray(number), jnp.asarray(state)[:, None])
        if int(air.status[0]) != RUNNING:
            return ended(int(air.status[0]))
        while bool(air.open[0]):
            if air.falls is None or not bool(air.falls[0]):
                before = air
                air, landed = _take_flight(
                    scene, before._replace(elapsed=jnp.zeros(1)), never, jnp.asarray([t1 - time]), False
                )
                arc = Arc(time, float(air.elapsed[0]), scene, _single(before.free), rest)
                pieces.append(arc)
                time, rest = arc.end, arc.at(np.array([arc.end]))[10:, 0]
                if not bool(landed[0]):
                    return ended(int(air.status[0]))
            struck = _land(scene, air)
            lost = float(_energy(scene, air.free)[0] - _energy(scene, struck.free)[0])
            loss, rest, air = loss + lost, rest - np.array([0.0, 0.0, 0.0, lost]), struck
            if int(air.status[0]) != RUNNING:
                return ended(int(air.status[0]))
            if len(pieces) >= MOST_PIECES:
                return ended(UNRESOLVED)
        number, state = air.ball[0], np.asarray(grounded(_single(air.free)))
    return ended(UNRESOLVED)


def _own_and_other(spheres: tuple[Ball, ...], number: int) -> tuple[Ball, Ball | None]:
    """The sphere that touches, the top's own if both do, and the one that does not if there is one."""
    if number == BOTH or len(spheres) == 1:
        return spheres[0], None
    return spheres[number], spheres[1 - number]


def _single(free: FreeBody) -> FreeBody:
    """The only cell of a block."""
    return jax.tree.map(lambda values: values[0], free)
