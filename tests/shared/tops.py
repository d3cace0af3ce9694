"""The declared tops, and states of a scene to try."""

import jax.numpy as jnp
import numpy as np

import tippe


def rutstam_top(I1_factor: float = 131.0 / 350.0) -> tippe.Top:
    """Rutstam's top (SIGMA 8 (2012) 019); his later papers have I1 = 131/350 m R^2, this one 235/625."""
    mass, radius = 0.02, 0.02
    inertia = mass * radius**2
    return tippe.Top(mass, radius, 0.3 * radius, I1_factor * inertia, 0.4 * inertia)


def homogeneous_ball(mass: float = 0.1, radius: float = 0.02) -> tippe.Top:
    """A homogeneous ball: no offset, I = 2/5 m R^2."""
    inertia = 0.4 * mass * radius**2
    return tippe.Top(mass, radius, 0.0, inertia, inertia)


def random_states(scene: tippe.Scene, count: int, seed: int = 0):
    """Legal states with nothing special about them: any axis, spins to 200 rad/s, slips to 1 m/s."""
    random = np.random.default_rng(seed)
    axis = random.normal(size=(3, count))
    axis /= np.linalg.norm(axis, axis=0)
    momentum = float(scene.body.I3) * 100.0 * random.normal(size=(3, count))
    place, _ = scene.start(tippe.Launch(0.0, 0.0, eta=random.uniform(-1.2, 1.2, count)))
    place = np.array(jnp.stack(place)) if place else np.zeros((0, count))
    return jnp.asarray(np.concatenate([random.normal(scale=0.3, size=(2, count)), axis, momentum, place]))
