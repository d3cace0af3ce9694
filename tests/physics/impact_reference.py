"""Routh's impact with friction in plain NumPy and SciPy, for any friction however strong, SI units.

The velocity v of the contact point and the angular velocity w obey d(v, w)/dp = W (f, 1, tau), with p the normal
impulse, W the response to force and torque there, and f the friction of Coulomb's regularised law, f = -mu v_t /
sqrt(v_t^2 + slip_speed^2). With a disc of contact x = (v_t, b w_n), b = 3 pi / 16 of its radius, stands in place of
v_t, and what answers to b w_n is the torque about the normal over b; rolling resistance is a law of the same form for
w_t. The motion is followed in p, which always grows, by an implicit method, because a contact that sticks or reverses
is stiff: first through compression, however the normal velocity goes to and fro, then until it is `restitution` times
that of the approach, or until the energy is what it was before. W comes from the rigid body's mass matrix.
Nothing here is shared with the simulator.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp


class Body(NamedTuple):
    """A sphere with its centre of mass at `offset` from its centre."""

    mass: float
    radius: float
    offset: float
    I1: float
    I3: float


class Impact(NamedTuple):
    """Velocity of the centre of mass and angular velocity after an impact, the normal impulse and the least stiffness.

    The stiffness is the normal velocity gained per unit normal impulse, in units of that without friction: where it is negative
    friction pulls the body down faster than the impulse pushes it up.
    """

    velocity: np.ndarray
    turning: np.ndarray
    normal_impulse: float
    least_painleve_factor: float


def skew(r):
    """The matrix of w -> r x w."""
    return np.array(((0.0, -r[2], r[1]), (r[2], 0.0, -r[0]), (-r[1], r[0], 0.0)))


class Law(NamedTuple):
    """Coulomb's regularised law [1, m/s], the radius of its disc [m], and rolling resistance [m, rad/s]."""

    mu: float
    slip_speed: float
    contact_radius: float = 0.0
    resistance: float = 0.0
    turning_speed: float = 1.0

    def parts(self, speed):
        """Where the law's two parts act in (v, w) / speed, how hard, and below which slip they yield."""
        sliding, rolling = np.zeros((3, 6)), np.zeros((2, 6))
        sliding[0, 0] = sliding[1, 1] = rolling[0, 3] = rolling[1, 4] = 1.0
        sliding[2, 5] = 3.0 * np.pi / 16.0 * self.contact_radius
        return (sliding, self.mu, self.slip_speed / speed), (rolling, self.resistance, self.turning_speed / speed)


def resolve_impact(body, axis, velocity, turning, law, restitution):
    """The motion after an impact of the sphere on the plane z = 0, from the motion before.

    `axis`, `velocity` (of the centre of mass [m/s]) and `turning` (angular velocity [rad/s]) are vectors (3,).
    """
    arm = body.offset * axis - body.radius * np.array((0.0, 0.0, 1.0))
    inertia = body.I1 * np.eye(3) + (body.I3 - body.I1) * np.outer(axis, axis)
    mass_matrix = np.block([[body.mass * np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), inertia]])
    # (v, w) at the contact is J (velocity, turning); impulses of force and torque there change both by M^-1 J^T.
    jacobian = np.block([[np.eye(3), -skew(arm)], [np.zeros((3, 3)), np.eye(3)]])
    lever = np.linalg.solve(mass_matrix, jacobian.T)
    response = jacobian @ lever
    velocity_before = jacobian @ np.concatenate([velocity, turning])
    speed = -velocity_before[2]
    # In units of the speed of approach, and of the impulse that it would take without friction.
    start, matrix, up = velocity_before / speed, response / response[2, 2], np.eye(6)[2]

    def rate(_, impulse):
        load, v = up, start + matrix @ impulse
        for acts, max_force, is_slow in law.parts(speed):
            slip = acts @ v
            load = load - max_force / np.sqrt(slip @ slip + is_slow**2) * (acts.T @ slip)
        return load

    def jacobian_of_rate(_, impulse):
        slope, v = np.zeros((6, 6)), start + matrix @ impulse
        for acts, max_force, is_slow in law.parts(speed):
            slip = acts @ v
            square = slip @ slip + is_slow**2
            slope -= max_force / np.sqrt(square) * acts.T @ (np.eye(len(slip)) - np.outer(slip, slip) / square) @ acts
        return slope @ matrix

    def compressed(_, impulse):
        return (start + matrix @ impulse)[2]

    def rebounds(_, impulse):
        return (start + matrix @ impulse)[2] - restitution

    def restores(_, impulse):
        return impulse @ start + 0.5 * impulse @ matrix @ impulse

    for event in (compressed, rebounds, restores):
        event.terminal, event.direction = True, 1.0

    def until(impulse, events):
        span = (impulse[2], impulse[2] + 1e6)
        options = {"method": "Radau", "rtol": 1e-10, "atol": 1e-13, "jac": jacobian_of_rate}
        run = solve_ivp(rate, span, impulse, events=events, **options)
        min_response = min(matrix[2] @ rate(0.0, state) for state in run.y.T)
        ends = [state[0] for state in run.y_events if len(state)]
        assert ends, "an impact without an end"
        return ends[0], min_response

    impulse, min_response = until(np.zeros(6), [compressed])
    if restitution > 0.0:
        impulse, min_response_later = until(impulse, [rebounds, restores])
        min_response = min(min_response, min_response_later)
    scale = speed / response[2, 2]
    change = lever @ (scale * impulse)
    return Impact(velocity + change[:3], turning + change[3:], scale * impulse[2], min_response)
