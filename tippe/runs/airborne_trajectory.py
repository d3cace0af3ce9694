"""One run through contacts, flights and impacts, with its path, in scenes whose flights are integrated numerically."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.geometry import scale, sum_vectors, vector_of
from nonholonomic.hybrid import BETWEEN, Segment

from ..model.contact_dynamics import Motion
from ..model.state import parts
from ..model.stick_slip import StickSlip
from ..modes.airborne import (
    FLYING,
    ON_STEM,
    STRIKING,
    FlightState,
    flying_body,
    below,
    carried_frame,
    flight_state,
    in_contact,
    lift_off,
    standing,
)
from ..modes.airborne_ends import lifted
from ..modes.free_body import Ball, balls
from .flight_trajectory import HybridTrajectory
from .observables import of_each_run

#: A sphere is at the arena if its distance is below this fraction of its radius, at the end of a run.
NEAR = 1e-6


class ArenaTrajectory(HybridTrajectory):
    """A `HybridTrajectory` over any arena: `theta` and `azimuth` refer to the frame at the foot, the point of the arena
    nearest to the centre of the top's own sphere, and `distance` is the distance of this sphere from the arena and its
    rate. `slip` refers to the frame at the foot of the touching sphere."""

    @of_each_run
    def energy(self) -> Float[Array, " times"]:
        """Kinetic energy plus weight times the height of the centre of mass [J]."""
        return self.scene.energy(self.states) + lifted(self.scene, self.states, *self.above)

    @of_each_run
    def theta_rate(self) -> Float[Array, " times"]:
        """Rate of change of theta [rad/s]."""
        dynamics = self.scene.dynamics
        # theta changes with velocities only, so rolling and slipping do not differ.
        dynamics = dynamics.slipping if isinstance(dynamics, StickSlip) else dynamics
        # The frame moves with the centre of the top's sphere, also in flight.
        frame = dataclasses.replace(carried_frame(self.scene), distance=self.scene.body.radius + self.above[0])
        rates = dataclasses.replace(dynamics, frame=frame).field(self.states)
        return jax.jvp(self.scene.theta, (self.states,), (rates,))[1]

    @of_each_run
    def normal_force(self) -> Float[Array, " times"]:
        """Normal force [N]; 0 in flight."""
        force = self.scene.normal_force(self.states)
        if self.scene.body.stem is not None:
            force = jnp.where(self.contact == 1, self._on_stem.normal_force, force)
        return jnp.where(self.contact < 0, 0.0, force)

    @of_each_run
    def slip(self) -> Float[Array, "times 2"]:
        """Velocity along the tangent plane of the point of a sphere that is closest to the arena [m/s]: of the stem's
        sphere while it touches, otherwise of the top's own."""
        slip = self.scene.slip_velocity(self.states)
        if self.scene.body.stem is not None:
            of_stem = self._on_stem.slip
            slip = jnp.where(self.contact == 1, jnp.stack([of_stem.x, of_stem.y]), slip)
        return slip.T

    @of_each_run
    def _stem_gap(self) -> Float[Array, " times"]:
        """Distance of the stem from the arena [m]."""
        return below(self.scene, self._flying, balls(self.scene.body)[1]).gap

    @property
    def _flying(self) -> FlightState:
        """The top as if in flight, also in contact."""
        scene, place, (distance, rate) = self.scene, parts(self.states).place, self.above
        main = balls(scene.body)[0]
        # The flying top is treated as one whose own sphere is larger by the distance, so that this sphere touches.
        flying = flight_state(lift_off(scene, self.states, False, Ball(main.offset, main.radius + distance)))
        normal_velocity = scale(rate, carried_frame(scene).normal(place[:3]))
        return flying._replace(velocity=vector_of(sum_vectors(flying.velocity, normal_velocity)))

    @property
    def _on_stem(self) -> Motion:
        """The motion on the stem, at times at which the stem touches; the first tangent is the projection of the
        reported one."""
        scene, flying, stem = self.scene, self._flying, balls(self.scene.body)[1]
        ground = below(scene, flying, stem)
        ground = ground._replace(axes=carried_frame(scene).own_axes((*ground.foot, *parts(self.states).place[3:])))
        return standing(scene, stem).motion(in_contact(ground, flying_body(scene, flying, ground, stem)))

    @property
    def where_the_model_ends(self) -> str:
        body = self.scene.body
        height = self.resampled(np.array([self.end_time])).distance[0, 0]
        if body.stem is not None and abs(height) < NEAR * body.radius:
            return (
                "sphere and stem came to rest on the arena together; sliding on both at once is implemented only for the level "
                "plane, Plane() without tilt"
            )
        return "a flight does not end at the arena"

    @staticmethod
    def touching(numbers: Int[Array | np.ndarray, " times"]) -> Any:
        # Also for traced numbers; -1 after the end of a run.
        return (numbers == ON_STEM) - 1 * ((numbers == FLYING) | (numbers == STRIKING) | (numbers < 0))


class StickSlipArenaTrajectory(ArenaTrajectory):
    """An `ArenaTrajectory` under exact Coulomb friction; `stats` also holds `sticks`, the number of changes from slip
    to rolling."""

    @staticmethod
    def touching(numbers: Int[Array | np.ndarray, " times"]) -> Any:
        # Between two modes, a slip begins.
        return -1 * (numbers == FLYING)

    @staticmethod
    def work_in(piece: Segment) -> float:
        if piece.number == BETWEEN:
            rows = piece.at(np.array([piece.begin, piece.end]))
            # The last rows are the distance and its rate.
            return float(np.diff(rows[-3])[0])
        return ArenaTrajectory.work_in(piece)
