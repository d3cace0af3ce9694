"""A top that hops, slides and changes to its stem: a reference in plain NumPy and SciPy, SI units.

The body is a rigid body in space: place s and velocity u of the centre of mass, axis e, angular velocity w, all in the fixed
frame, with Euler's equations J w' = M - w x J w, J = I1 + (I3 - I1) e e^T, and e' = w x e. A ball of the body has its centre
at s + a e and radius R. In contact the normal forces are those that keep the heights of the balls that touch where they are:
the accelerations are affine in the forces, so one evaluation without them and one for each give a linear system. It has
two unknowns where the top leans, on ball and stem at once. Flight is the same equations without the force, integrated like
everything else.
Impact: d(velocities)/dp = the response to the force (f(v), 1) and to the torque tau(v, w), p the normal impulse, until
the ball's normal velocity is -restitution times what it was; for viscous friction that is a linear equation, solved by
the matrix exponential, for Coulomb's regularised law it is integrated. A rebound slower than 1e-5 sqrt(g R) closes the
contact; if the other ball is at the plane and no faster, both balls are put to rest along the normal, u_z = 0 and e_z'
= 0, and stay if both forces are positive.
That leaves out the friction of the blows that would follow, an error in proportion to the speed at which the contact closes. So
a top that comes to lean is followed with four such speeds, each 0.262 of the last. As the speeds shrink by the same factor from
landing to landing, so do the errors, and the limit is what is written.

Run: python hop_reference.py   writes hop_reference.csv (some minutes). Nothing here is shared with the simulator.
"""

import csv
from dataclasses import asdict, dataclass, fields
from math import cos, inf, pi, sin, sqrt
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

CLOSING = 1e-5
UP = np.array((0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Case:
    """Top, friction, restitution and launch; `stem_radius` 0 is a top without stem, `slip_speed` 0 viscous friction, and
    `contact_radius` and `resistance` 0 are friction without a torque."""

    mass: float
    radius: float
    offset: float
    I1: float
    I3: float
    mu: float
    theta: float
    spin: float
    restitution: float = 0.0
    slip_speed: float = 0.0
    stem_radius: float = 0.0
    stem_offset: float = 0.0
    gravity: float = 9.81
    t1: float = 20.0
    angle: float = 0.95 * pi
    contact_radius: float = 0.0
    resistance: float = 0.0
    turning_speed: float = 1.0

    @property
    def balls(self):
        """(offset, radius) of the spheres that can touch."""
        stem = [(self.stem_offset, self.stem_radius)] if self.stem_radius else []
        return [(self.offset, self.radius), *stem]


def cross(x, y):
    return np.array((x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]))


def split(state):
    """s, u, e, w."""
    return state[:3], state[3:6], state[6:9], state[9:12]


def friction(case, slip, w):
    """Tangential force and torque per unit normal force, for the contact point's velocity and the angular velocity."""
    slip, lever = slip * (1.0 - UP), 3.0 * pi / 16.0 * case.contact_radius
    size = sqrt(slip @ slip + (lever * w[2]) ** 2 + case.slip_speed**2) if case.slip_speed else 1.0
    rolling_rate = w * (1.0 - UP)
    resistance = case.resistance / sqrt(rolling_rate @ rolling_rate + case.turning_speed**2) * rolling_rate
    return -case.mu / size * slip, -case.mu / size * lever**2 * w[2] * UP - resistance


def solve_inertia(case, e, torque):
    """J^-1 torque."""
    axial_part = (torque @ e) * e
    return (torque - axial_part) / case.I1 + axial_part / case.I3


def arm(ball, e):
    """From the centre of mass to the contact point."""
    return ball[0] * e - ball[1] * UP


def accelerations(case, state, loads=()):
    """u' and w' under forces and torques at the contact points of balls, (ball, force, torque)."""
    _, _, e, w = split(state)
    spin_momentum = case.I1 * w + (case.I3 - case.I1) * (w @ e) * e
    torque = -cross(w, spin_momentum)
    for ball, force, contact_forces in loads:
        torque = torque + cross(arm(ball, e), force) + contact_forces
    return sum((force for _, force, _ in loads), 0.0) / case.mass - case.gravity * UP, solve_inertia(case, e, torque)


def centre_acceleration(state, ball, u_dot, w_dot):
    """Acceleration of a ball's centre along the normal."""
    _, _, e, w = split(state)
    return u_dot[2] + ball[0] * (cross(w_dot, e) + cross(w, cross(w, e)))[2]


def contact(case, state, balls):
    """The normal forces [N] of the balls that stay on the plane, and u' and w' under them."""
    _, u, e, w = split(state)
    units = []
    for ball in balls:
        force, torque = friction(case, u + cross(w, arm(ball, e)), w)
        units.append((ball, force + UP, torque))
    free = accelerations(case, state)
    accelerations_of_balls = np.array([centre_acceleration(state, ball, *free) for ball in balls])
    responses = [accelerations(case, state, [unit]) for unit in units]
    matrix = [
        [centre_acceleration(state, ball, *pushing_force) - rise for pushing_force in responses]
        for ball, rise in zip(balls, accelerations_of_balls, strict=True)
    ]
    forces = np.linalg.solve(matrix, -accelerations_of_balls) if balls else accelerations_of_balls
    loads = [(ball, N * force, N * torque) for N, (ball, force, torque) in zip(forces, units, strict=True)]
    return forces, *accelerations(case, state, loads)


def rate(case, state, balls):
    """Rate of the state; `balls` are those on the plane, none in flight."""
    _, u, e, w = split(state)
    _, u_dot, w_dot = contact(case, state, balls)
    return np.concatenate((u, u_dot, cross(w, e), w_dot))


def gap(ball, state):
    return state[2] + ball[0] * state[8] - ball[1]


def gap_rate(ball, state):
    _, u, e, w = split(state)
    return u[2] + ball[0] * cross(w, e)[2]


def energy(case, state):
    s, u, e, w = split(state)
    rotation = case.I1 * (w @ w) + (case.I3 - case.I1) * (w @ e) ** 2
    return (case.mass * (u @ u) + rotation) / 2 + case.mass * case.gravity * s[2]


def resolve_impact(case, state, ball, closing=CLOSING):
    """The state after the impact of a ball, and whether it bounces."""
    s, u, e, w = split(state)
    r = arm(ball, e)
    velocity_before = u + cross(w, r)
    response = np.array([d / case.mass + cross(solve_inertia(case, e, cross(r, d)), r) for d in np.eye(3)]).T
    bounces = -case.restitution * velocity_before[2] > closing * sqrt(case.gravity * case.radius)
    target_speed = -case.restitution * velocity_before[2] if bounces else 0.0
    torque = np.zeros(3)
    if case.slip_speed:
        # Impulses of the force and of the torque.
        def moved(P):
            new_rotation = w + solve_inertia(case, e, cross(r, P[:3]) + P[3:])
            return u + P[:3] / case.mass + cross(new_rotation, r), new_rotation

        def change(_, P):
            force, torque = friction(case, *moved(P))
            return np.concatenate((force + UP, torque))

        def reaches(_, P):
            return moved(P)[0][2] - target_speed

        reaches.terminal = True
        # Strong friction can at first pull the ball down.
        max_impulse = 1e3 * (target_speed - velocity_before[2]) / response[2, 2]
        run = solve_ivp(
            change, (0.0, max_impulse), np.zeros(6), method="DOP853", rtol=1e-12, atol=1e-18, events=reaches
        )
        impulse, torque = np.split(run.y_events[0][0], 2)
    else:
        # P' = -mu (before + response P) along the plane, 1 along the normal: P(p) from one exponential.
        matrix = np.zeros((4, 4))
        matrix[:2, :3], matrix[:2, 3], matrix[2, 3] = -case.mu * response[:2], -case.mu * velocity_before[:2], 1.0

        def after(p):
            return expm(p * matrix)[:3, 3]

        max_impulse = 3.0 * (target_speed - velocity_before[2]) / response[2, 2]
        p = brentq(
            lambda p: (velocity_before + response @ after(p))[2] - target_speed,
            0.0,
            max_impulse,
            xtol=1e-20,
            rtol=1e-15,
        )
        impulse = after(p)
    new_rotation = w + solve_inertia(case, e, cross(r, impulse) + torque)
    return np.concatenate((s, u + impulse / case.mass, e, new_rotation)), bounces


def at_rest(state):
    """The state without u_z and without the turning of e towards the normal."""
    s, u, e, w = split(state)
    side_axis = cross(UP, e)
    return np.concatenate((s, u * (1.0 - UP), e, w - (w @ side_axis) / (side_axis @ side_axis) * side_axis))


def launch(case):
    """State at the start, on the ball that is lower, and that ball's number."""
    e = np.array((sin(case.theta), 0.0, cos(case.theta)))
    heights = [radius - offset * e[2] for offset, radius in case.balls]
    number = int(np.argmax(heights))
    return np.concatenate((heights[number] * UP, np.zeros(3), e, case.spin * e)), number


def watched(function, direction):
    """An event of solve_ivp that ends the run."""

    def event(_, state):
        return function(state)

    event.terminal, event.direction = True, direction
    return event


def follow(case, rtol=1e-12, flight_step=2e-4, contact_step=2.5e-4, slowest=CLOSING):
    """Run until theta reaches the angle, or t1.

    Returns (status, time [s] of the angle, end state, flights, list of (time, ball) at which a ball came to the plane, 2 where
    both came to rest there, energies at the ends of all pieces, when first one of two balls parted)."""
    state, number = launch(case)
    # `touching`: the numbers of the balls on the plane.
    time, contacts_closed, flights, contacts, energies, parted = 0.0, [number], 0, [], [energy(case, state)], inf
    swing = sqrt(case.gravity / case.radius)
    closing, numbers = slowest * swing * case.radius, range(len(case.balls))
    absolute = rtol * np.repeat((case.radius, swing * case.radius, 1.0, swing), 3)
    inverts = watched(lambda y: y[8] - cos(case.angle), -1.0)
    while True:
        balls, free_numbers = [case.balls[k] for k in contacts_closed], [k for k in numbers if k not in contacts_closed]
        ends = [watched(lambda y, k=k: contact(case, y, balls)[0][k], -1.0) for k in range(len(balls))]  # noqa: B023
        ends += [watched(lambda y, k=k: gap(case.balls[k], y), -1.0) for k in free_numbers]
        # A short bounce must not hide within the first step.
        speed, max_impulse = (
            max((gap_rate(case.balls[k], state) for k in free_numbers), default=0.0),
            [contact_step, flight_step][not balls],
        )
        first = min(0.2 * speed / case.gravity, max_impulse, case.t1 - time) if speed > 1e-9 else None
        run = solve_ivp(
            lambda _, y: rate(case, y, balls),  # noqa: B023
            (time, case.t1),
            state,
            method="DOP853",
            rtol=rtol,
            atol=absolute,
            first_step=first,
            max_step=max_impulse,
            events=[inverts, *ends],
        )
        time, state = run.t[-1], run.y[:, -1]
        state[6:9] /= np.linalg.norm(state[6:9])
        energies.append(energy(case, state))
        if run.status == 0:
            return "not_inverted", inf, state, flights, contacts, energies, parted
        event_number = next(k for k, times in enumerate(run.t_events) if len(times))
        if event_number == 0:
            return "inverted", time, state, flights, contacts, energies, parted
        if event_number <= len(balls):
            parted = min(parted, time) if len(balls) == 2 else parted
            contacts_closed = [k for k in contacts_closed if k != contacts_closed[event_number - 1]]
            flights += not contacts_closed
            continue
        number = free_numbers[event_number - 1 - len(balls)]
        ball = case.balls[number]
        # Put the ball exactly on the plane: the event leaves a distance of round-off.
        state[2] = ball[1] - ball[0] * state[8]
        state, flying = resolve_impact(case, state, ball, slowest)
        contacts.append((time, number))
        contacts_closed = [] if flying else [number]
        if not flying:
            state[5] -= gap_rate(ball, state)
            touching_pairs = [(k, b) for k, b in enumerate(case.balls) if abs(gap(b, state)) < 1e-9 * case.radius]
            if len(touching_pairs) == 2 and max(abs(gap_rate(b, state)) for _, b in touching_pairs) <= closing:
                state = at_rest(state)
                forces = contact(case, state, case.balls)[0]
                contacts_closed = [k for k in numbers if forces[k] > 0.0]
                contacts += [(time, 2)] if len(contacts_closed) == 2 else []
            elif contact(case, state, [ball])[0][0] <= 0.0:
                contacts_closed = []
        flights += not contacts_closed


MR2 = 0.02 * 0.02**2
RUTSTAM = dict(mass=0.02, radius=0.02, offset=0.006, I1=131 / 350 * MR2, I3=0.4 * MR2, mu=0.3, theta=0.1)
LEINE_GLOCKER = dict(mass=6e-3, radius=0.015, offset=3e-3, I1=8e-7, I3=7e-7, stem_radius=5e-3, stem_offset=0.016)

CASES = (
    Case(**RUTSTAM, spin=180.0),
    Case(**RUTSTAM, spin=200.0),
    Case(**RUTSTAM, spin=250.0),
    Case(**RUTSTAM, spin=280.0),
    Case(**RUTSTAM, spin=200.0, restitution=0.5),
    Case(**RUTSTAM, spin=155.0, slip_speed=0.05),
    Case(**RUTSTAM, spin=180.0, slip_speed=0.1, restitution=0.3),
    Case(**LEINE_GLOCKER, mu=0.3, slip_speed=0.05, theta=0.1, spin=180.0, t1=8.0),
    Case(**LEINE_GLOCKER, mu=0.3, theta=0.1, spin=200.0, t1=20.0),
    Case(**LEINE_GLOCKER, mu=0.3, slip_speed=0.05, theta=0.1, spin=140.0, t1=3.0),
    Case(**LEINE_GLOCKER, mu=0.3, theta=2.4, spin=90.0, t1=3.0),
    Case(**LEINE_GLOCKER, mu=0.3, theta=0.1, spin=140.0, t1=8.0),
)

RESULTS = ("status", "time", "end_theta", "flights", "landings", "last_landing", "end_energy", "leans", "parted")


def row(case, **accuracy):
    """The row of a case in the table."""
    status, time, state, flights, contacts, energies, parted = follow(case, **accuracy)
    last = contacts[-1][0] if contacts else inf
    theta = np.arctan2(np.hypot(state[6], state[7]), state[8])
    lean_time = next((time_of_contact for time_of_contact, ball in contacts if ball == 2), inf)
    values = (status, time, theta, flights, len(contacts), last, energies[-1], lean_time, parted)
    return dict(zip(RESULTS, values, strict=True))


def limit(rows):
    """The limit of the last three of some rows as the landings go on, and how much it differs from that of the first three."""

    def beyond(three, name):
        """The t of t + A q^n, n the landings; the angle at which a run ends does not change."""
        n, (a, b, c) = np.array([row["landings"] for row in three]), (row[name] for row in three)
        if not np.isfinite(c) or abs(c - b) < 1e-13 * abs(c):
            return c
        n = n - n[0]
        q = brentq(lambda q: (b - a) * (q ** n[2] - q ** n[1]) - (c - b) * (q ** n[1] - 1.0), 0.1, 0.99, xtol=1e-15)
        return c - (c - b) * q ** n[2] / (q ** n[2] - q ** n[1])

    # What is left out after a landing of the one ball is not what is left out after one of the other.
    assert np.all(np.diff([row["landings"] for row in rows]) % 2 == 0)
    names = ("time", "end_theta", "end_energy", "leans", "parted", "last_landing")
    first, last = ({name: beyond(three, name) for name in names} for three in (rows[:3], rows[1:]))
    error = max(abs(first[name] / last[name] - 1) for name in names[:3] if np.isfinite(last[name]))
    return rows[1] | last, error


def main():
    """Write the file next to this script."""
    with open(Path(__file__).with_name("hop_reference.csv"), "w", newline="") as file:
        names = [field.name for field in fields(Case)]
        table = csv.DictWriter(file, [*names, *RESULTS, "reference_error"], lineterminator="\n")
        table.writeheader()
        for case in CASES:
            fine_row, check = row(case), row(case, rtol=3e-11, flight_step=1e-4, contact_step=2e-3)
            error = max(
                abs(fine_row[name] / check[name] - 1)
                for name in ("time", "end_theta", "end_energy")
                if np.isfinite(fine_row[name])
            )
            if np.isfinite(fine_row["leans"]):
                rows_of_speeds = [row(case, slowest=closing) for closing in CLOSING * 0.262 ** np.arange(-1.0, 3.0)]
                fine_row, extrapolated = limit(rows_of_speeds)
                error = max(error, extrapolated)
            agree = fine_row["flights"] == check["flights"] and fine_row["status"] == check["status"]
            print(case, fine_row, error, agree, sep="\n  ", flush=True)
            table.writerow(
                {k: v if isinstance(v, str) else float(v) for k, v in (asdict(case) | fine_row).items()}
                | {"reference_error": float(error)}
            )


if __name__ == "__main__":
    main()
