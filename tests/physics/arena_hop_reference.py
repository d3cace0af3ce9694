"""A top that flies and bounces over any arena: a reference in plain NumPy and SciPy, SI units, viscous friction only.

Contact is that of `arena_reference.py`: the centre O of the sphere, the velocity u of the centre of mass, axis e and angular
velocity w, with a multiplier for the normal force. Flight is the same body without it, integrated like everything else,
until the distance of O from its foot is R again. In an impact the velocities change by the response W to the impulse P, dP/dp =
n - mu (1 - n n^T)(v + W P), p the normal impulse, which is linear: it is solved by the matrix exponential until the normal
velocity is -restitution times what it was. A rebound slower than `CLOSING` sqrt(g R) closes the contact.

Run: python arena_hop_reference.py   writes arena_hop_reference.csv (half a minute). Nothing is shared with the simulator.
"""

import csv
from math import sqrt
from pathlib import Path

import numpy as np
from arena_reference import UP, Case, Top, cross, foot, level
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

CLOSING = 1e-6
RESTITUTION = 0.4
#: Times at which the state is written, as fractions of t1.
SAMPLES = (0.25, 0.5, 0.75, 1.0)


def watched(function, direction=-1.0):
    """An event of solve_ivp that ends the run."""

    def event(_, y):
        return function(y)

    event.terminal, event.direction = True, direction
    return event


class Hopper(Top):
    """A top that may be in the air."""

    def below(self, centre):
        """Distance of the sphere from the arena and the normal there."""
        self.near, k = foot(self.case, centre, self.near, self.case.radius)
        g = level(self.case, self.near)[1]
        size = np.linalg.norm(g)
        return k * size - self.case.radius, g / size

    def inverse(self, e):
        return np.eye(3) / self.case.I1 + (1 / self.case.I3 - 1 / self.case.I1) * np.outer(e, e)

    def flight_state(self, y):
        """Rates in flight."""
        c = self.case
        _, u, e, w = y.reshape(4, 3)
        e_dot = cross(w, e)
        spin = c.I1 * w + (c.I3 - c.I1) * (w @ e) * e
        return np.concatenate([u + c.offset * e_dot, -c.gravity * UP, e_dot, -self.inverse(e) @ cross(w, spin)])

    def speed(self, y):
        """Velocity of the sphere's centre along the normal."""
        centre, u, e, w = y.reshape(4, 3)
        return self.below(centre)[1] @ (u + self.case.offset * cross(w, e))

    def resolve_impact(self, y):
        """The state after an impact, and whether it bounces."""
        c = self.case
        centre, u, e, w = y.reshape(4, 3)
        n = self.below(centre)[1]
        r, inverse = c.offset * e - c.radius * n, self.inverse(e)
        response = np.array([d / c.mass + cross(inverse @ cross(r, d), r) for d in np.eye(3)]).T
        v = u + cross(w, r)
        bounces = -RESTITUTION * (n @ v) > CLOSING * sqrt(c.gravity * c.radius)
        target_speed = -RESTITUTION * (n @ v) if bounces else 0.0
        projector, matrix = np.eye(3) - np.outer(n, n), np.zeros((4, 4))
        matrix[:3, :3], matrix[:3, 3] = -c.mu * projector @ response, n - c.mu * projector @ v

        def impulse(p):
            return expm(p * matrix)[:3, 3]

        max_impulse = 3.0 * (target_speed - n @ v) / (n @ response @ n)
        p = brentq(lambda p: n @ (v + response @ impulse(p)) - target_speed, 0.0, max_impulse, xtol=1e-20, rtol=1e-15)
        P = impulse(p)
        return np.concatenate([centre, u + P / c.mass, e, w + inverse @ cross(r, P)]), bounces


def follow(case, rtol=1e-13, max_step=1e-3):
    """The motion at `SAMPLES`, the flights (begin, end), and the foot at the start."""
    top = Hopper(case)
    y, time, flying, bounced = top.start(), 0.0, False, False
    place, samples, hops = top.near.copy(), [], []
    sample_times = list(np.array(SAMPLES) * case.t1)
    if top.motion(y)[1] <= 0.0:
        flying = True
    while True:
        if flying:
            event, field = watched(lambda y: top.below(y[:3])[0]), top.flight_state
            # Where the normal force vanishes the gap grows by the third power of the time: round-off is no landing.
            first = min(0.2 * top.speed(y) / case.gravity, 1e-3) if bounced else 1e-4
        else:
            event, field, first = watched(lambda y: top.motion(y)[1]), lambda y: top.motion(y)[0], 1e-6
        run = solve_ivp(
            lambda _, y: field(y),  # noqa: B023
            (time, case.t1),
            y,
            first_step=min(first, case.t1 - time),
            max_step=max_step,
            events=event,
            dense_output=True,
            method="DOP853",
            rtol=rtol,
            atol=0.01 * rtol,
        )
        while sample_times and sample_times[0] <= run.t[-1]:
            samples.append(run.sol(sample_times.pop(0)))
        if flying:
            hops.append((time, run.t[-1]))
        time, y = run.t[-1], run.y[:, -1]
        if not run.t_events[0].size:
            return samples, hops, place
        if flying:
            y, bounced = top.resolve_impact(y)
            flying = bounced
        else:
            flying, bounced = True, False


def row(case):
    """The row of a case in the file."""
    samples, hops, place = follow(case)
    entry = dict(zip(("q1", "q2", "q3"), place, strict=True))
    entry |= {"hops": len(hops), "first": hops[0][0], "landing": hops[0][1]}
    # What the bounces take that are too short to be followed, if they shrink by the restitution.
    entry["rest"] = hops[-1][1] + (hops[-1][1] - hops[-1][0]) * RESTITUTION / (1.0 - RESTITUTION)
    for k, y in enumerate(samples, 1):
        entry |= {f"O{i}_{k}": y[i] for i in range(3)} | {f"e{i}_{k}": y[6 + i] for i in range(3)}
    return {name: repr(float(value)) for name, value in entry.items()}


def recorded():
    """The rows of the file, in the order of `CASES`."""
    rows = csv.DictReader(Path(__file__).with_name("arena_hop_reference.csv").read_text().splitlines())
    return [{name: float(value) for name, value in row.items()} for row in rows]


#: A top thrown over in a bowl, which comes to rest on it; and one that jumps over a hill.
CASES = (
    Case("paraboloid", 0.3, 0.0, 0.3, 0.0, 0.5, 0.0, 200.0, 0.1, -0.06, 0.023, 0.0, 0.0, 50.0, 50.0, 0.0, 0.16),
    Case("graph", 0.03, 20.0, 0.02, 0.0, 1.2, 0.0, 150.0, -0.0785, 0.0, 0.03, 1.6, 0.2, 0.0, 0.0, 0.0, 0.3),
)


if __name__ == "__main__":
    rows = [row(case) for case in CASES]
    with Path(__file__).with_name("arena_hop_reference.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
