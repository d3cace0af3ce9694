"""One run through contacts, flights and impacts, with its path."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.hybrid import BETWEEN, MOST_ROUNDS, Segment
from nonholonomic.integration.status import UNRESOLVED, Status
from nonholonomic.validation import is_traced

from ..modes.bouncing import height
from ..modes.free_body import Ball, FreeBody, as_free_body, balls, energy, standing_on
from ..modes.impact import TOUCHING, approach
from ..modes.leaning import BOTH
from ..modes.sliding import MOST_BOUNCES
from .observables import AbstractTrajectory, of_each_run
from .run_kind import why_unbalanced


class HybridTrajectory(AbstractTrajectory):
    """A run through contacts, flights and impacts; vectors are arrays (times, 3) in the fixed frame (x, y, z).

    - `status`: "completed", "jammed" (as in `Trajectory`), "failed" or "unresolved"; the run ends at `end_time`.
      `print(run)` states why a run is unresolved: more than 10 000 flights in a row or 2000 contacts; a flight that does
      not end at the arena; an energy that grows or does not balance, by more than 1e4 times the tolerance, relative to
      the energy; or, for a top with a stem, contact of sphere and stem at once, on the level plane with so much friction
      that the forces are not determined, or at rest on any other arena.
    - `contact`: the sphere that touches at each time: 0 for the top's sphere, 1 for the stem's, 2 for both, -1 for none.
      At the time of an impact, values are those before the impact.
    - `distance`: distance of the top's own sphere from the plane [m], and its rate [m/s].
    - `hops`: start and end [s] of each flight until `end_time`, one row per flight; a table counts only the flights
      before the inversion. When the speed of bounces has decreased to 1e-5 sqrt(g R), the top counts as in contact,
      although the remaining bounces would take e / (1 - e) times as long as the last one (restitution e).
    - `stem_time`: when the stem of a top first carries it [s].
    - `work`: work of friction and of the impacts [J].
    - `stats`: accepted and rejected steps, the greatest drift of |e|, the greatest energy residual |E - E(0) - work| and
      the energy lost in impacts [J].
    - `rotation`, `angular_velocity`: as in `Trajectory`.

    Inside a transformation, `status` is the integer of the `Status`, `hops` is `None`, and `stats["hops"]` is the number
    of flights. First derivatives with respect to the scene and the launch pass through flights and impacts. They are
    NaN after a grazing event, because within the tolerance such an event may not happen.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3), contact="hybrid")
    >>> run = tippe.simulate(scene, tippe.Launch(0.1, 155.0), t1=0.1, tolerance=1e-6)
    >>> int(run.contact[0]), len(run.hops)
    (0, 0)

    ```
    """

    distance: Any = None
    contact: Any = None
    hops: Float[np.ndarray, "hops 2"] | None = None

    unused = (*AbstractTrajectory.unused, "hops")
    by_time = (*AbstractTrajectory.by_time, "distance", "contact")

    @property
    def above(self) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, " times"]]:
        """Distance of the top's own sphere from the plane [m] and its rate [m/s]."""
        return self.distance[0], self.distance[1]

    @property
    def inversion_time(self) -> float:
        return self.stem_time if self.scene.has_stem else super().inversion_time

    @property
    def stem_time(self) -> float:
        """Time [s] at which the stem first carries the top, as it bears a force or, in a bounce, an impulse; infinite if
        the stem does not touch by the end, or if there is no stem.

        **Raises:** as for `inversion_time`.
        """
        if self.dense is None:
            raise ValueError("a run made inside jit, vmap or grad has no dense output: use tippe.inversion_time there")
        if not self.scene.has_stem:
            return np.inf
        segments = self.dense.segments
        on_stem = [segment.begin for segment in segments if self.touching(np.asarray(segment.number)) >= 1]
        # The stem may bounce before it slides. Values at the end of a flight are those before the impact.
        ends = np.unique([segment.end for segment in segments])
        first = min([*on_stem, np.inf])
        ends = ends[ends < min(first, self.end_time)]
        if not ends.size:
            return float(first)
        strokes = ends[np.asarray(self.resampled(ends)._stem_gap) < TOUCHING * float(self.scene.body.radius)]
        return float(min([*strokes, first]))

    @of_each_run
    def _stem_gap(self) -> Float[Any, " times"]:
        """Distance of the stem from the arena [m]."""
        main, stem = balls(self.scene.body)
        return self.above[0] + height(main, stem, self.states)

    @property
    def _free(self) -> FreeBody:
        """The top as a free body, also in contact."""
        body = self.scene.body
        free = as_free_body(body, balls(body)[0], self.states)
        (distance, rate), (u1, u2, u3) = self.above, free.velocity
        return FreeBody((u1, u2, u3 + rate), free.height + distance, free.axis, free.momentum)

    @property
    def _ball(self) -> Ball:
        """The touching sphere; in flight, and if both touch, the top's own."""
        spheres = balls(self.scene.body)
        pairs = zip(spheres[0], spheres[-1], strict=True)
        return Ball(*(jnp.where(self.contact == 1, stem, main) for main, stem in pairs))

    @of_each_run
    def energy(self) -> Float[Array, " times"]:
        """Kinetic energy plus weight times the height of the centre of mass [J]."""
        return energy(self.scene.body, self.scene.gravity, self._free)

    @of_each_run
    def normal_force(self) -> Float[Array, " times"]:
        """Normal force [N]; 0 in flight. If both spheres touch, this is the sum of both forces, the weight."""
        motion = standing_on(self.scene.dynamics, self._ball).motion(self.states)
        total_force = jnp.where(self.contact == BOTH, self.scene.body.mass * self.scene.gravity, motion.normal_force)
        return jnp.where(self.contact < 0, 0.0, total_force)

    @of_each_run
    def slip(self) -> Float[Array, "times 2"]:
        """Velocity along the plane of the lowest point of the sphere that touches [m/s]; of the top's own sphere in
        flight and if both touch."""
        return jnp.stack(approach(self.scene.body, self._ball, self._free).velocity[:2], axis=-1)

    @classmethod
    def parts_of(cls, rows: Any, mode: Any, core: int) -> dict[str, Any]:
        # The rows end with the distance and its rate.
        parts = super().parts_of(rows[:-2], mode, core)
        return parts | {"distance": rows[-2:], "contact": cls.touching(mode)}

    @staticmethod
    def work_in(piece: Segment) -> float:
        """The work [J] of friction in a segment of the path, without the work of impacts."""
        return 0.0 if piece.number == BETWEEN else piece.motion.states[-1, -1] - piece.motion.states[-1, 0]

    @staticmethod
    def touching(numbers: Int[Array | np.ndarray, " times"]) -> Any:
        """The sphere that touches, for each mode index."""
        return numbers

    @property
    def _whether_it_turned_over(self) -> str:
        if not (self.scene.has_stem and np.isfinite(self.stem_time)):
            return super()._whether_it_turned_over
        again = ", and at the end its sphere touches again" if np.asarray(self.contact)[-1] in (0, 2) else ""
        return f"turned over: the stem first carries it at {self.stem_time:.6g} s{again}"

    @property
    def _flights(self) -> int:
        return 0 if self.hops is None else len(self.hops)

    @property
    def where_the_model_ends(self) -> str:
        """The reason why the motion is undetermined after the end of the run."""
        return "sphere and stem touch the plane together, and friction is so strong that the forces are not determined"

    def _reason(self) -> str:
        """The reason for the status "unresolved"."""
        contacts = sum(segment.number != BETWEEN for segment in self.dense.segments)
        if self.dense.status != UNRESOLVED:
            return why_unbalanced(self)
        if self._flights >= MOST_BOUNCES or contacts >= MOST_ROUNDS:
            return "there were too many flights or changes of contact"
        return self.where_the_model_ends

    def __str__(self) -> str:
        text = super().__str__()
        # A run made inside a transformation does not know it.
        if "impact_loss" not in self.stats:
            hops = self.stats.get("hops")
            return text if hops is None or is_traced(hops) or np.ndim(hops) else f"{text}\n  {int(hops)} flights"
        text = f"{text}\n  {self._flights} flights, {self.stats['impact_loss']:.3g} J lost in impacts"
        return f"{text}\n  unresolved: {self._reason()}" if self.status == Status.UNRESOLVED.word else text
