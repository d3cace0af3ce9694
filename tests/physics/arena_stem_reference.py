"""A top with a stem that flies, and bounces on both of its spheres, over any arena: NumPy and SciPy, SI units, viscous law.

Each sphere slides, flies and strikes as that of `arena_hop_reference.py` does, with its own foot and its own normal. The body
in between is carried as the centre of mass, its velocity, axis and angular velocity. A contact ends where its normal force
vanishes or the other sphere is at the arena. That one then strikes, and after it whichever of the two the last blow has thrown
into the arena, until none is.

Run: python arena_stem_reference.py   writes arena_stem_reference.csv (some seconds). Nothing is shared with the simulator.
"""

import csv
from dataclasses import dataclass, replace
from math import sqrt
from pathlib import Path

import arena_hop_reference
import numpy as np
from arena_hop_reference import CLOSING, SAMPLES, Hopper, watched
from arena_reference import Case, level
from scipy.integrate import solve_ivp


@dataclass(frozen=True)
class StemCase(Case):
    """A case with the numbers of a stem, and the coefficient of restitution."""

    stem_radius: float = 0.0
    stem_offset: float = 0.0
    restitution: float = 0.0


class TwoSpheres:
    """A top with two spheres; its state is (s, u, e, w)."""

    def __init__(self, case):
        self.case = case
        stem = replace(case, radius=case.stem_radius, offset=case.stem_offset)
        self.spheres = [Hopper(case), Hopper(stem)]

    def start(self):
        """The state and the sphere that touches: the one at whose foot the launch's place is."""
        for number in (0, 1):
            y = self.spheres[number].start()
            y[:3] -= self.spheres[number].case.offset * y[6:9]
            self.spheres[1 - number].near = self.spheres[number].near.copy()
            # The velocity of the launch is that of the centre of the top's own sphere; that of the one that touches has no part
            # along the normal.
            (t1, t2, n), e_dot = self.frame(number), np.cross(y[9:], y[6:9])
            slip = self.case.v1 * t1 + self.case.v2 * t2 - self.case.offset * e_dot
            y[3:6] = slip - n * (n @ slip) - self.spheres[number].case.offset * n * (n @ e_dot)
            if self.gap(1 - number, y) > 0.0:
                return y, number
        raise ValueError(self.case)

    def frame(self, number):
        """The axes t1, t2 and n at the start."""
        sphere = self.spheres[number]
        g = level(sphere.case, sphere.near)[1]
        n = g / np.linalg.norm(g)
        t1 = np.array((1.0, 0.0, 0.0)) - n[0] * n
        t1 /= np.linalg.norm(t1)
        return t1, np.cross(n, t1), n

    def of(self, number, y):
        """The state as a sphere counts it, from its centre."""
        return np.concatenate([y[:3] + self.spheres[number].case.offset * y[6:9], y[3:]])

    def gap(self, number, y):
        return self.spheres[number].below(self.of(number, y)[:3])[0]

    def speed(self, number, y):
        return self.spheres[number].speed(self.of(number, y))

    def rates(self, sphere_in_contact, y):
        """Rates of the state; in flight `touching` is `None`."""
        number = sphere_in_contact or 0
        sphere, state_of_sphere = self.spheres[number], self.of(number, y)
        slope = sphere.flight_state(state_of_sphere) if sphere_in_contact is None else sphere.motion(state_of_sphere)[0]
        # Of a sphere's centre.
        slope[:3] = y[3:6]
        return slope

    def force(self, number, y):
        return self.spheres[number].motion(self.of(number, y))[1]

    def slip(self, number, y):
        """Speed of the contact point."""
        sphere, (centre, u, e, w) = self.spheres[number], self.of(number, y).reshape(4, 3)
        n = sphere.below(centre)[1]
        return np.linalg.norm(u + np.cross(w, sphere.case.offset * e - sphere.case.radius * n))

    def struck(self, number, y):
        """The state after the blow of a sphere, and whether it bounces."""
        state_after, bounces = self.spheres[number].resolve_impact(self.of(number, y))
        return np.concatenate([y[:3], state_after[3:]]), bounces

    def landed(self, number, y):
        """The state after the blows that follow the landing of a sphere, and the one that touches then, `None` in flight."""
        c, blows = self.case, 0
        closing = CLOSING * sqrt(c.gravity * c.radius)
        while True:
            y, bounces = self.struck(number, y)
            blows += 1
            other_number = 1 - number
            if self.gap(other_number, y) > 1e-9 * c.radius or self.speed(other_number, y) > -closing:
                return y, None if bounces else number, blows
            number = other_number


def follow(case):
    """The motion, normal force and slip at `SAMPLES`; the start; the landings, (time, number of the sphere, blows); and the
    flights."""
    arena_hop_reference.RESTITUTION = case.restitution
    top = TwoSpheres(case)
    y, sphere_in_contact = top.start()
    place, samples, landings, hops, time = top.spheres[sphere_in_contact].near.copy(), [], [], [], 0.0
    sample_times = list(np.array(SAMPLES) * case.t1)
    if top.force(sphere_in_contact, y) <= 0.0:
        sphere_in_contact = None
    while True:
        free = [number for number in (0, 1) if number != sphere_in_contact]
        events = [watched(lambda y, k=k: top.gap(k, y)) for k in free]
        if sphere_in_contact is not None:
            events.append(watched(lambda y: top.force(sphere_in_contact, y)))  # noqa: B023
        parting = [speed for k in free if top.gap(k, y) < 1e-6 and (speed := top.speed(k, y)) > 0.0]
        first = min([0.2 * max(min(parting, default=1.0), 1e-7) / case.gravity, 1e-3, case.t1 - time])
        run = solve_ivp(
            lambda _, y: top.rates(sphere_in_contact, y),  # noqa: B023
            (time, case.t1),
            y,
            first_step=first,
            max_step=5e-4,
            events=events,
            dense_output=True,
            method="DOP853",
            rtol=1e-13,
            atol=1e-15,
        )
        while sample_times and sample_times[0] <= run.t[-1]:
            sample = run.sol(sample_times.pop(0))
            samples.append(
                (
                    sample,
                    *(
                        (0.0, 0.0)
                        if sphere_in_contact is None
                        else (top.force(sphere_in_contact, sample), top.slip(sphere_in_contact, sample))
                    ),
                )
            )
        if sphere_in_contact is None:
            hops.append((time, run.t[-1]))
        time, y = run.t[-1], run.y[:, -1]
        y[6:9] /= np.linalg.norm(y[6:9])
        event_numbers = [k for k, times in enumerate(run.t_events) if times.size]
        if not event_numbers:
            return samples, place, landings, hops
        if event_numbers[0] < len(free):
            y, sphere_in_contact, blows = top.landed(free[event_numbers[0]], y)
            landings.append((time, free[event_numbers[0]], blows))
            if sphere_in_contact is not None and top.force(sphere_in_contact, y) <= 0.0:
                sphere_in_contact = None
        else:
            sphere_in_contact = None


def row(case):
    """The row of a case in the file."""
    samples, place, landings, hops = follow(case)
    entry = dict(zip(("q1", "q2", "q3"), place, strict=True)) | {"hops": len(hops), "landings": len(landings)}
    entry |= {f"landings_{k}": sum(sphere == k for _, sphere, _ in landings) for k in (0, 1)}
    entry |= {"blows": sum(blows for *_, blows in landings), "last": landings[-1][0]}
    for k, (y, force, slip) in enumerate(samples, 1):
        entry |= {f"N_{k}": force, f"slip_{k}": slip}
        centre = y[:3] + case.offset * y[6:9]
        entry |= {f"O{i}_{k}": centre[i] for i in range(3)} | {f"e{i}_{k}": y[6 + i] for i in range(3)}
    return {name: repr(float(value)) for name, value in entry.items()}


def recorded():
    """The rows of the file, in the order of `CASES`."""
    rows = csv.DictReader(Path(__file__).with_name("arena_stem_reference.csv").read_text().splitlines())
    return [{name: float(value) for name, value in row.items()} for row in rows]


LEINE_GLOCKER = dict(mass=6e-3, radius=0.015, offset=3e-3, I1=8e-7, I3=7e-7, stem_radius=5e-3, stem_offset=0.016)
FRICTION, PLACE = (0.3, 0.0), (0.1, -0.06)

#: A top thrown over onto its stem, in whose flights both spheres land; one that starts on its stem; the first in a bowl.
CASES = (
    StemCase(
        *("cylinder", 0.3, 0.0, *FRICTION, 2.3, 0.0, 100.0, *PLACE, -0.28, 0.1, 0.3, 40.0, -60.0, 0.0, 0.2),
        **LEINE_GLOCKER,
        restitution=0.4,
    ),
    StemCase(
        *("cylinder", 0.3, 0.0, *FRICTION, 2.7, 1.0, 150.0, *PLACE, -0.28, -0.1, 0.2, 20.0, 10.0, 0.0, 0.2),
        **LEINE_GLOCKER,
        restitution=0.1,
    ),
    StemCase(
        *("paraboloid", 0.3, 0.0, *FRICTION, 2.3, 0.0, 100.0, *PLACE, 0.023, 0.1, 0.3, 40.0, -60.0, 0.0, 0.2),
        **LEINE_GLOCKER,
        restitution=0.4,
    ),
)


if __name__ == "__main__":
    rows = [row(case) for case in CASES]
    with Path(__file__).with_name("arena_stem_reference.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
