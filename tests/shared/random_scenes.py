"""Random scenes and launches, in batches that one compiled program serves: kind of scene -> numbers, one per cell."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import tippe

#: Arena, law and contact.
SMOOTH = [
    "plane-viscous-stop",
    "plane-coulomb-stop",
    "plane-contensou-stop",
    "plane-rolling-stop",
    "slope-coulomb-stop",
    "cylinder-viscous-stop",
    "cylinder-coulomb-stop",
    "sphere-viscous-stop",
    "spheroid-viscous-stop",
    "torus-viscous-stop",
    "paraboloid-coulomb-stop",
    "graph-viscous-stop",
]
IN_PHASES = ["plane-viscous-hybrid", "plane-coulomb-hybrid", "plane-setvalued-stop"]


def waves(x, y):
    """The ground of the kind "graph"."""
    return 0.02 * jnp.sin(4.0 * x) * jnp.cos(3.0 * y)


class Batch(NamedTuple):
    """A scene, a launch, and full name of a number -> its values in the cells, in place of those of the two."""

    scene: tippe.Scene
    launch: tippe.Launch
    columns: dict[str, Any]


def batch(kind: str, count: int, seed: int = 11) -> Batch:
    """Tops like those of `make_inversion_reference.py`, of about half to three times the spin of Jellett's threshold.

    **Arguments:** `kind`: such as "plane-viscous-stop"; `count`: of the scenes.
    """
    random = np.random.default_rng([seed, sum(map(ord, kind))])
    arena, law, contact = kind.split("-")
    mass, R = random.uniform(0.005, 0.05, count), random.uniform(0.015, 0.03, count)
    a, I3 = R * random.uniform(0.1, 0.35, count), mass * R * R * random.uniform(0.3, 0.45, count)
    I1, theta = I3 * random.uniform(0.9, 1.1, count), random.uniform(0.05, 0.5, count)
    mu = random.uniform(0.1, 0.5, count)
    alpha, gamma = a / R, I1 / I3
    threshold = R * np.sqrt(mass * 9.81 * a * I3 * (1 + alpha) ** 4 / np.maximum(1 + alpha - gamma, 1e-3))
    spin = np.minimum(threshold / (I3 * (R * np.cos(theta) - a)) * random.uniform(0.5, 3.0, count), 400.0)
    columns = {
        "scene.body.mass": mass,
        "scene.body.radius": R,
        "scene.body.offset": a,
        "scene.body.I1": I1,
        "scene.body.I3": I3,
        "launch.theta": theta,
        "launch.spin": spin,
        "launch.azimuth": random.uniform(-np.pi, np.pi, count),
    }
    surface, place, extra_options = _arena(arena, R, random.uniform(5.0, 30.0, count), random)
    slip_speed = random.uniform(0.02, 0.2, count)
    friction, of_law = _law(law, mu, slip_speed, R, random)
    options: dict[str, Any] = {}
    columns |= extra_options | of_law
    if contact == "hybrid":
        options = {"contact": "hybrid", "restitution": 0.3}
        columns["scene.restitution"] = random.uniform(0.0, 0.8, count)
        columns["launch.spin"] = spin * random.uniform(1.0, 1.6, count)
    top = tippe.Top(0.02, 0.02, 0.006, 2.994e-6, 3.2e-6)
    return Batch(tippe.Scene(top, surface, friction, **options), tippe.Launch(0.1, 100.0, place=place), columns)


def _arena(name: str, R: Any, size: Any, random: np.random.Generator) -> tuple[Any, Any, dict[str, Any]]:
    """The arena, a place where it takes one, and the numbers of both; `size` is that of the arena over the top's."""
    count = len(R)
    if name == "plane":
        return tippe.Plane(), None, {}
    if name == "slope":
        return tippe.Plane(0.1), None, {"scene.surface.tilt": random.uniform(0.01, 0.2, count)}
    if name in ("cylinder", "sphere"):
        arena = (tippe.Cylinder if name == "cylinder" else tippe.Sphere)(1.0)
        return arena, None, {"scene.surface.radius": R * size, "launch.eta": random.uniform(-1.0, 1.0, count)}
    if name == "spheroid":
        columns = {
            "scene.surface.equatorial": R * size,
            "scene.surface.polar": R * size * random.uniform(0.7, 1.4, count),
        }
        return tippe.Spheroid(1.0, 1.0), None, columns | {"launch.eta": random.uniform(-1.0, 1.0, count)}
    if name == "torus":
        columns = {
            "scene.surface.ring": 2.0 * R * size,
            "scene.surface.tube": R * size * random.uniform(0.4, 0.9, count),
        }
        return tippe.Torus(1.0, 0.3), None, columns | {"launch.eta": random.uniform(-1.0, 1.0, count)}
    if name == "paraboloid":
        columns = {"scene.surface.p": R * size, "launch.place[0]": R * random.uniform(-2.0, 2.0, count)}
        return tippe.Paraboloid(1.0), (0.0, 0.0), columns
    columns = {f"launch.place[{k}]": random.uniform(-0.5, 0.5, count) for k in range(2)}
    return tippe.Graph(waves), (0.0, 0.0), columns


def _law(name: str, mu: Any, slip_speed: Any, R: Any, random: np.random.Generator) -> tuple[Any, dict[str, Any]]:
    """The law, and its numbers."""
    columns = {"scene.friction.mu": mu}
    if name == "viscous":
        return tippe.Viscous(0.3), columns
    if name == "setvalued":
        return tippe.SetValuedCoulomb(0.3), columns
    columns["scene.friction.slip_speed"] = slip_speed
    if name == "coulomb":
        return tippe.Coulomb(0.3, 0.1), columns
    if name == "contensou":
        columns["scene.friction.contact_radius"] = random.uniform(1e-5, 1e-3, len(R))
        return tippe.Contensou(0.3, 1e-3, 0.1), columns
    columns = {"scene.friction.sliding.mu": mu, "scene.friction.sliding.slip_speed": slip_speed}
    columns["scene.friction.resistance"] = R * random.uniform(1e-4, 3e-3, len(R))
    return tippe.Rolling(1e-4, 1.0, tippe.Coulomb(0.3, 0.1)), columns
