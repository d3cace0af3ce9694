"""The top under viscous friction F = -mu N v: a reference in NumPy and SciPy, with the contact of `coulomb_top.py`."""

import numpy as np
from coulomb_top import Body as Body
from coulomb_top import Contact
from coulomb_top import start as start
from coulomb_top import theta as theta
from scipy.integrate import solve_ivp


def rate(body: Body):
    """The field: the force per normal force is n - mu v, so that the persisting contact fixes the normal force."""

    def of(_, state):
        contact = Contact(body, state)
        return contact.rate(_load(contact) * _direction(contact))

    return of


def normal_force(body: Body, state: np.ndarray) -> float:
    """Normal force [N] at a state."""
    return _load(Contact(body, state))


def _direction(contact: Contact) -> np.ndarray:
    return contact.n - contact.body.mu * contact.v


def _load(contact: Contact) -> float:
    load = -contact.v @ contact.n_dot - contact.n @ contact.drift
    return load / (contact.n @ contact.W @ _direction(contact))


def follow(body: Body, state: np.ndarray, times: np.ndarray, rtol: float = 1e-9) -> np.ndarray:
    """States (12, times) at times [s], which increase from 0 or later; before that the top is where it starts."""
    atol = rtol * np.repeat([1.0, np.sqrt(body.gravity * body.radius), 100.0, body.radius], 3)
    elapsed = np.maximum(times, 0.0)
    span = (0.0, elapsed[-1])
    run = solve_ivp(rate(body), span, state, "DOP853", t_eval=np.unique(elapsed), rtol=rtol, atol=atol)
    assert run.success, run.message
    return run.y[:, np.searchsorted(run.t, elapsed)]


def azimuth(states: np.ndarray) -> np.ndarray:
    """Direction in which the axis leans [rad], in (-pi, pi]."""
    return np.arctan2(states[1], states[0])
