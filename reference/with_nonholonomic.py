"""The reference scenes by this package, at `TOLERANCE`, for `check.py`."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import stroller
import tippe

TOLERANCE = 1e-12
#: Under exact Coulomb friction, a slip ends when the remaining slip is within the tolerance.
HYBRID_TOLERANCE = 1e-11


class Waves(eqx.Module):
    """z = sum of h sin(kx x + ky y + phase)."""

    rows: tuple[tuple[float, ...], ...]

    def __call__(self, x, y):
        return sum(h * jnp.sin(kx * x + ky * y + phase) for h, kx, ky, phase in self.rows)


def simulate(scene: dict[str, Any]) -> dict[str, Any]:
    return (top if scene["vehicle"] == "top" else ride)(scene)


def surface_of(arena: dict[str, Any]) -> Any:
    """The surface of an arena; its side is in `arena["side"]`."""
    make = {
        "plane": lambda: tippe.Plane(arena["tilt"]) if arena["tilt"] else tippe.Plane(),
        "cylinder": lambda: tippe.Cylinder(arena["radius"]),
        "sphere": lambda: tippe.Sphere(arena["radius"]),
        "spheroid": lambda: tippe.Spheroid(arena["equatorial"], arena["polar"]),
        "paraboloid": lambda: tippe.Paraboloid(arena["radius"]),
        "torus": lambda: tippe.Torus(arena["ring"], arena["tube"]),
        "waves": lambda: tippe.Graph(Waves(tuple(map(tuple, arena["waves"])))),
    }
    return make[arena["shape"]]()


def top_scene(scene: dict[str, Any]) -> tippe.Scene:
    friction = dict(scene["friction"])
    laws = {"viscous": tippe.Viscous, "coulomb": tippe.Coulomb, "set-valued coulomb": tippe.SetValuedCoulomb}
    law = laws[friction.pop("law")](**friction)
    body = (tippe.SpheroidBody if "polar" in scene["body"] else tippe.Top)(**scene["body"])
    flies = {"contact": "hybrid", "restitution": scene["restitution"]} if "restitution" in scene else {}
    arena = scene["arena"]
    return tippe.Scene(body, surface_of(arena), law, scene["gravity"], side=arena.get("side"), **flies)


def top_launch(scene: dict[str, Any]) -> tippe.Launch:
    """The launch in the arena's frame: t1 is the projection of x, t2 = n x t1."""
    start = {name: np.array(vector) for name, vector in scene["start"].items()}
    n, e, w = start["normal"], start["axis"], start["angular_velocity"]
    t1 = np.array((1.0, 0.0, 0.0)) - n[0] * n
    t1 /= np.linalg.norm(t1)
    t2 = np.cross(n, t1)
    spin = w @ e
    rest = w - spin * e
    # The velocity of a launch is that of a sphere's centre, or of the centre of mass for other bodies.
    velocity = start["velocity"] + (0.0 if "polar" in scene["body"] else scene["body"]["offset"]) * np.cross(w, e)
    theta = np.arctan2(np.linalg.norm(np.cross(n, e)), n @ e)
    moving = np.linalg.norm(velocity) > 1e-14 or np.linalg.norm(rest) > 1e-11
    motion = {"velocity": (velocity @ t1, velocity @ t2), "angular_velocity": (rest @ t1, rest @ t2, rest @ n)}
    place = (
        {"place": tuple(start["contact"])}
        if scene["arena"]["shape"] not in ("cylinder", "sphere") or moving
        else {"eta": np.arctan2(-n[0], n[2])}
    )
    if scene["arena"] == {"shape": "plane", "tilt": 0.0} and not moving:
        place = {}
    return tippe.Launch(theta, spin, azimuth=np.arctan2(e @ t2, e @ t1), **place, **(motion if moving else {}))


def top(scene: dict[str, Any]) -> dict[str, Any]:
    set_up, launch, times = top_scene(scene), top_launch(scene), np.array(scene["states"]["times"])
    exact = scene["friction"]["law"] == "set-valued coulomb"
    tolerance = HYBRID_TOLERANCE if exact or "restitution" in scene else TOLERANCE
    end = max(*times, *(1.01 * event["time"] for event in scene["events"]), 0.0)
    run = tippe.simulate(set_up, launch, end, times, tolerance)
    offset = 0.0 if "polar" in scene["body"] else scene["body"]["offset"]
    turned = np.cross(run.angular_velocity, run.axis)
    states = {"position": run.position - offset * run.axis, "velocity": run.velocity - offset * turned}
    states |= {"axis": run.axis, "angular_velocity": run.angular_velocity}
    if scene["outcome"] == "inverted":
        events = [float(tippe.inversion_time(set_up, launch, end, tolerance=tolerance))]
    elif scene["outcome"] == "contact_lost":
        events = [float(run.end_time)] if run.status == "contact_lost" else []
    elif exact:
        # Without the beginnings: the onset of a slip is solved separately, between two segments.
        events = [segment.end for segment in run.dense.mode_segments[:-1]]
    elif "restitution" in scene:
        events = [time for time in run.hops.ravel() if time > 0.0][: len(scene["events"])]
    else:
        events = []
    return {"events": events, "states": states}


class Push(eqx.Module):
    """mean + amplitude sin(frequency t + phase), of a force [N] and a torque [N m]."""

    force: dict[str, jax.Array]
    torque: dict[str, jax.Array]

    def __call__(self, t, motion):
        return tuple(
            wave["mean"] + wave["amplitude"] * jnp.sin(wave["frequency"] * t + wave["phase"])
            for wave in (self.force, self.torque)
        )


def ride(scene: dict[str, Any]) -> dict[str, Any]:
    start, surface, times = scene["start"], surface_of(scene["arena"]), np.array(scene["states"]["times"])
    body, law = stroller.Stroller(**scene["body"]), stroller.Damping(**scene["damping"])
    side = "inside" if scene["arena"]["shape"] == "torus" else scene["arena"].get("side")
    set_up = stroller.Scene(body, surface, law, scene["gravity"], side, "absolute")
    place = tuple(start["position"])
    east, north = (np.array(surface.in_fixed_frame(vector)) for vector in surface.chart(place)[1:])
    heading = np.arctan2(start["direction"] @ north, start["direction"] @ east)
    launch = stroller.Launch(place, heading, start["speed"], start["steering"], start["steering_rate"])
    push = Push(**jax.tree.map(jnp.asarray, scene["input"]))
    run = stroller.simulate(set_up, launch, times[-1], push, times, TOLERANCE)
    return {"events": [], "states": {name: getattr(run, name) for name in scene["states"] if name != "times"}}
