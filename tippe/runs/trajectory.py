"""One run of a tippe top, with its path."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.compilation.xla_cpu import on_device
from nonholonomic.geometry import scale, sum_vectors
from nonholonomic.integration.status import Status

from ..model.friction import length
from .observables import AbstractTrajectory, of_each_run
from .run_kind import why_unbalanced


class Trajectory(AbstractTrajectory):
    """A run of a tippe top, or a batch of runs, with the batch first.

    Vectors are given in the fixed frame (x, y, z) as arrays (times, 3); `azimuth` and `slip` refer to the moving frame
    (t1, t2, n) at the place where the top is. `position` and `velocity` are those of the sphere's centre, or of the
    centre of mass for other bodies; `contact` is the contact point, and `normal` the arena's normal there. `rotation`
    (times, 3, 3) rotates the body's axes to the fixed frame, and `angular_velocity` is its rate.

    - `status`: the word of a `Status`; inside a transformation, its integer. The run ends at `end_time`.
      "does_not_fit": a curvature of the arena reaches that of the top's sphere, which would then touch at other points,
      too. "jammed": the equation for the normal force has no solution, because friction pulls the top into the arena as
      strongly as the normal force pushes it out; this needs strong friction, a large offset and a slip along the axis.
      "unresolved": the energy grows, or does not balance, by more than 1e4 times the tolerance, relative to the energy.
      For numbers out of range, `status` is `Status.ILLEGAL`, and all results are NaN.
    - `stats`: accepted and rejected steps, the greatest drift of |e| and the greatest energy residual
      |E - E(0) - work of friction| [J]; with `SetValuedCoulomb`, also `sticks`, the number of changes from slip to
      rolling.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> run = tippe.simulate(scene, tippe.Launch(0.1, 155.0), t1=1.0, tolerance=1e-6)
    >>> later = run.at([0.25, 0.5])
    >>> later.position.shape, later.axis.shape
    ((2, 3), (2, 3))
    >>> data = run.to_table()
    >>> data.units["normal_force"], data.label("theta")
    ('N', 'inclination θ [rad]')

    ```
    """

    @property
    def above(self) -> tuple[None, None]:
        """`None`: the contact persists, so there is no distance from the arena."""
        return None, None

    @of_each_run
    def energy(self) -> Float[Array, " times"]:
        """Kinetic and potential energy [J]."""
        return self.scene.energy(self.states)

    @of_each_run
    def normal_force(self) -> Float[Array, " times"]:
        """Normal force [N]."""
        return self.scene.normal_force(self.states)

    @of_each_run
    def reaction(self) -> Float[Array, "times 3"]:
        """Force of the arena on the body [N]: normal force and friction."""
        motion = self.scene.dynamics.motion(self.states)
        f1, f2 = motion.friction.force
        return self._fixed(scale(motion.normal_force, (f1, f2, 1.0)))

    @of_each_run
    def grip(self) -> Float[Array, " times"]:
        """Friction over normal force [1]: the least coefficient of friction that the contact needs."""
        motion = self.scene.dynamics.motion(self.states)
        f1, f2 = (jnp.zeros_like(self.t) if part is None else part for part in motion.friction.force)
        return length(f1, f2)

    @of_each_run
    def normal_spin(self) -> Float[Array, " times"]:
        """Angular velocity about the arena's normal [rad/s]."""
        return self.scene.angular_velocity(self.states)[2]

    @of_each_run
    def contact(self) -> Float[Array, "times 3"]:
        """The point at which the top touches the arena [m]."""
        frame, places = self.scene.frame, (self._place, self._path)
        foot = sum_vectors(frame.position(*places), scale(-frame.distance, frame.axes(*places)[2]))
        return jnp.stack(foot, axis=-1)

    @of_each_run
    def slip(self) -> Float[Array, "times 2"]:
        """Velocity of the contact point along the arena, in the moving frame [m/s]."""
        return self.scene.slip_velocity(self.states).T

    def __str__(self) -> str:
        unresolved = isinstance(self.status, str) and self.status == Status.UNRESOLVED.word
        return super().__str__() + (f"\n  unresolved: {why_unbalanced(self)}" if unresolved else "")

    def with_rows(self, times: Float[np.ndarray, " times"], rows: Any, mode: Any) -> "Trajectory":
        parts = {"t": times, **self.parts_of(rows, mode, len(self.start))}
        return dataclasses.replace(self, **dict(zip(parts, on_device(*parts.values()), strict=True)))
