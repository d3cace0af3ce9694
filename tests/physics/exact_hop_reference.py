"""A top that slips, rolls and flies under exact Coulomb friction, event by event: a reference in NumPy and SciPy, SI units.

Contact is that of `coulomb_top.py`, Newton's and Euler's equations with the three components of the force as unknowns; flight
is the same without a force. An impact is followed in the normal impulse by `impact_reference.py`, with a slip speed of 1e-10 of
the velocities; where less than 1e-7 of them is left of the slip, the contact has stuck. Nothing here is shared with the
simulator.
"""

from typing import NamedTuple

import impact_reference
import numpy as np
from coulomb_top import Body, Contact, begun, cross, rate_of, slip_to
from scipy.integrate import solve_ivp

CLOSING = 1e-5


class Stretch(NamedTuple):
    """A part of a run, "slipping", "rolling" or "flying", its begin and end [s] and the state at its end."""

    kind: str
    begin: float
    end: float
    state: np.ndarray


def gap(body: Body, state: np.ndarray) -> float:
    """Distance of the sphere from the arena [m]."""
    if body.arena is None:
        # Heights count from that of the sphere's centre in contact.
        return state[11]
    return body.arena - body.radius - np.linalg.norm(np.array(body.curved) * state[9:])


def free_rate(body: Body):
    """The field of flight."""
    return lambda _, state: Contact(body, state).rate(np.zeros(3))


def struck(body: Body, state: np.ndarray, restitution: float) -> tuple[np.ndarray, str]:
    """The state after an impact, and what follows it."""
    contact = Contact(body, state)
    n = contact.n / np.linalg.norm(contact.n)
    t = cross(n, np.array([0.3, 0.8, 0.5]))
    frame = np.array([t / np.linalg.norm(t), cross(n, t / np.linalg.norm(t)), n])
    speed = -(contact.v @ n)
    bounces = restitution * speed > CLOSING * np.sqrt(body.gravity * body.radius)
    body_of_impact = impact_reference.Body(body.mass, body.radius, body.offset, body.I1, body.I3)
    motion = (frame @ state[:3], frame @ state[3:6], frame @ state[6:9])
    law = impact_reference.Law(body.mu, 1e-10 * np.linalg.norm(contact.v))
    motion_after = impact_reference.resolve_impact(body_of_impact, *motion, law, restitution if bounces else 0.0)
    new = np.concatenate([state[:3], frame.T @ motion_after.velocity, frame.T @ motion_after.turning, state[9:]])
    if bounces:
        return new, "flying"
    new_contact = Contact(body, new)
    if np.linalg.norm(new_contact.along(new_contact.v)) > 1e-7 * np.linalg.norm(contact.v):
        return slip_to(body, new, new_contact.along(new_contact.v)), "slipping"
    return settled(body, slip_to(body, new, np.zeros(3)))


def settled(body: Body, state: np.ndarray) -> tuple[np.ndarray, str]:
    """What follows a contact at rest."""
    if Contact(body, state).reserve() > 0.0:
        return state, "rolling"
    return begun(body, state, 1e-10), "slipping"


def follow(
    body: Body, state: np.ndarray, t1: float, restitution: float, rtol: float = 1e-11, floor: float = 1e-8
) -> list[Stretch]:
    """Run to `t1` [s] from a state that slips, stretch by stretch; a slip ends where its speed has fallen to `floor` [m/s]."""
    atol = 0.1 * rtol * np.repeat([1.0, np.sqrt(body.gravity * body.radius), 100.0, body.radius], 3)

    def event(function):
        def watched(_, x):
            return function(x)

        watched.terminal, watched.direction = True, -1.0
        return watched

    ends = {
        "slipping": [
            event(lambda x: np.linalg.norm(Contact(body, x).v) - floor),
            event(lambda x: Contact(body, x).slipping_force() @ Contact(body, x).n),
        ],
        "rolling": [event(lambda x: Contact(body, x).reserve())],
        "flying": [event(lambda x: gap(body, x))],
    }
    kind, t, stretches = "slipping", 0.0, []
    while t < t1:
        rate = free_rate(body) if kind == "flying" else rate_of(body, kind)
        # A slip that has just begun is stiff.
        is_onset = kind == "slipping" and np.linalg.norm(Contact(body, state).v) < 1e-6
        method, t_end = ("Radau", min(t + 2e-3, t1)) if is_onset else ("DOP853", t1)
        # A flight begins on the arena.
        first = 1e-6 if kind == "flying" else None
        run = solve_ivp(rate, (t, t_end), state, method, rtol=rtol, atol=atol, events=ends[kind], first_step=first)
        assert run.success, run.message
        stretches.append(Stretch(kind, t, run.t[-1], run.y[:, -1]))
        t, state = run.t[-1], run.y[:, -1]
        if run.status == 0:
            continue
        if kind == "flying":
            state, kind = struck(body, state, restitution)
        elif kind == "rolling":
            state, kind = begun(body, state, 1e-10), "slipping"
        elif len(run.t_events[1]):
            kind = "flying"
        else:
            state, kind = settled(body, slip_to(body, state, np.zeros(3)))
    return stretches
