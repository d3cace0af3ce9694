"""Tops without jumps: on a plane, in a cylinder, in a sphere and on other arenas, and eggs on a plane."""

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from math import cos, pi, sin, sqrt
from pathlib import Path
from typing import Any

import arena_reference
import coulomb_top
import egg_reference
import lagrange_top
import numpy as np

from .solutions import (
    ANGLE,
    COARSE,
    FINE,
    UP,
    Array,
    Scene,
    X,
    Y,
    bounded_event,
    first_event,
    friction_of,
    rounded_times,
    states_at,
    top_start,
    top_states,
)

PROGRAMS = Path(arena_reference.__file__).parent


class NewtonEuler:
    """A top on a plane, in a cylinder or in a sphere by `coulomb_top.Contact`, under a smooth law of friction."""

    def __init__(self, body: coulomb_top.Body, slip_speed: float | None):
        self.body, self.slip_speed = body, slip_speed
        self.scales = np.repeat([1.0, sqrt(body.gravity * body.radius), 100.0, body.radius], 3)
        #: Of the sphere's centre in `coulomb_top`, whose plane is at -R.
        self.shift = body.radius * UP if body.arena is None else np.zeros(3)

    def start(self, theta: float, spin: float, eta: float, azimuth: float) -> Array:
        """State of `coulomb_top` at a launch from rest."""
        n, t = np.array((-sin(eta), 0.0, cos(eta))), np.array((cos(eta), 0.0, sin(eta)))
        if self.body.arena is None:
            n, t, centre = UP, X, np.zeros(3)
        else:
            centre = (self.body.radius - self.body.arena) * n
        e = cos(theta) * n + sin(theta) * (cos(azimuth) * t + sin(azimuth) * Y)
        return np.concatenate([e, np.zeros(3), spin * e, centre])

    def load(self, contact: coulomb_top.Contact) -> tuple[float, Array]:
        """The normal force, and the force for each newton of it."""
        v = contact.v
        size = sqrt(v @ v + self.slip_speed**2) if self.slip_speed else 1.0
        direction = contact.n - self.body.mu * v / size
        return (-v @ contact.n_dot - contact.n @ contact.drift) / (contact.n @ contact.W @ direction), direction

    def field(self, _: float, y: Array) -> Array:
        contact = coulomb_top.Contact(self.body, y)
        load, direction = self.load(contact)
        return contact.rate(load * direction)

    @property
    def margins(self) -> dict[str, Callable]:
        def short_of_angle(y: Array) -> float:
            return y[:3] @ coulomb_top.Contact(self.body, y).n - cos(ANGLE)

        return {
            "inverted": short_of_angle,
            "contact_lost": lambda y: self.load(coulomb_top.Contact(self.body, y))[0] / self.body.mass,
        }

    def states(self, y: Array, times: Sequence[float], rtol: float) -> Array:
        return np.array([self.exported(state) for state in states_at(self.field, y, times, rtol, rtol * self.scales)])

    def event(self, y: Array, t1: float, rtol: float) -> tuple[str, float]:
        return first_event(self.field, y, t1, self.margins, rtol, rtol * self.scales)

    def exported(self, y: Array) -> Array:
        """Position and velocity of the centre of mass, axis, angular velocity."""
        centre = y[9:] + self.shift
        return np.concatenate([centre - self.body.offset * y[:3], y[3:6], y[:3], y[6:9]])

    def angle(self, y: Array) -> float:
        contact = coulomb_top.Contact(self.body, y)
        return float(np.arctan2(np.linalg.norm(np.cross(contact.n, y[:3])), contact.n @ y[:3]))


def top_scene(name: str, top: NewtonEuler, y: Array, arena: dict[str, Any]) -> Scene:
    """What a scene is before its solution."""
    body, n = top.body, coulomb_top.Contact(top.body, y).n
    contact = y[9:] + top.shift - body.radius * n
    return {
        "name": name,
        "vehicle": "top",
        "body": {key: getattr(body, key) for key in ("mass", "radius", "offset", "I1", "I3")},
        "arena": arena,
        "friction": friction_of(body.mu, top.slip_speed),
        "gravity": body.gravity,
        "start": top_start(top.exported(y), contact, n),
    }


def plane_and_cylinder() -> Iterator[Scene]:
    """The 40 scenes of `inversion_reference.csv`: Lagrange's equations in Euler angles beside those of Newton and Euler."""
    rows = list(csv.DictReader((PROGRAMS / "inversion_reference.csv").read_text().splitlines()))
    for number, row in enumerate(rows):
        data = {key: float(value) for key, value in row.items() if key not in ("family", "status") and value}
        plain = {key: data[key] for key in data if key in lagrange_top.Scene.__dataclass_fields__}
        arena = data.get("surface_radius")
        curved = (0.0, 0.0, 0.0) if arena is None else (1.0, 0.0, 1.0)
        body = coulomb_top.Body(
            *(data[k] for k in ("mass", "radius", "offset", "I1", "I3", "mu", "gravity")), arena, curved
        )
        top = NewtonEuler(body, data.get("slip_speed"))
        y = top.start(data["theta"], data["spin"], data["eta"], data["azimuth"])
        kind, time = top.event(y, data["t1"], FINE)
        outcome = "completed" if row["status"] == "not_inverted" else row["status"]
        assert kind == outcome, (row, kind)
        times = rounded_times(time, (0.25, 0.5, 0.75, 1.0 if kind == "completed" else 0.95))
        states, check = (top.states(y, times, rtol) for rtol in (FINE, COARSE))
        # Lagrange's equations give theta at the same times.
        raw = states_at(top.field, y, times, FINE, FINE * top.scales)
        tilts = [lagrange_top.follow(lagrange_top.Scene(**plain), t, pi, FINE)[2] for t in times]
        apart = max(abs(tilt - top.angle(state)) for tilt, state in zip(tilts, raw, strict=True))
        shape = {"shape": "plane", "tilt": 0.0} if arena is None else {"shape": "cylinder", "radius": arena}
        scene = top_scene(f"{row['family'].lower()}-{number % 10 + 1:02d}", top, y, shape)
        solution = top_states(times, states, check)
        solution["axis"]["bound"] = max(solution["axis"]["bound"], float(f"{apart:.2g}"))
        event_error = float(row["reference_error"]) * data["t1"]
        events = [] if kind == "completed" else [bounded_event(kind, float(row["time"]), time, event_error)]
        yield scene | {
            "outcome": outcome,
            "states": solution,
            "events": events,
            "source": {
                "values": "events: Lagrange's equations, tests/physics/lagrange_top.py, rtol 1e-13; states: "
                "Newton's and Euler's equations, tests/physics/coulomb_top.py, rtol 1e-13",
                "bounds": "events: the two formulations against each other; states: rtol 1e-12, and theta by "
                "Lagrange's equations",
            },
        }


def spheres() -> Iterator[Scene]:
    """Eight tops in spheres: Newton and Euler with the normal in closed form, beside the foot by Newton's method."""
    rows = csv.DictReader((PROGRAMS / "gradient_reference.csv").read_text().splitlines())
    for number, row in enumerate(row for row in rows if row["family"] == "sphere-viscous"):
        data = {key: float(value) for key, value in row.items() if key != "family" and value}
        radius = data["surface_radius"]
        numbers = (data[k] for k in ("mass", "radius", "offset", "I1", "I3", "mu", "gravity"))
        top = NewtonEuler(coulomb_top.Body(*numbers, radius, (1.0, 1.0, 1.0)), None)
        y = top.start(data["theta"], data["spin"], data["eta"], data["azimuth"])
        kind, time = top.event(y, 8.0, FINE)
        times = rounded_times(time, (0.25, 0.5, 0.75, 0.95))
        states = top.states(y, times, FINE)
        body = {k: data[k] for k in ("mass", "radius", "offset", "I1", "I3", "gravity")}
        launch = (
            data["mu"],
            0.0,
            data["theta"],
            data["azimuth"],
            data["spin"],
            *(y[9:] * radius / np.linalg.norm(y[9:])),
        )
        case = arena_reference.Case("spheroid", radius, radius, *launch, 0.0, 0.0, 0.0, 0.0, 0.0, 8.0, **body)
        other = ArenaTop(case)
        y_other = other.start()
        # The other program's t1 is the projection of x: its axis is the same where the launch is in the plane of x and z.
        check = other.states(y_other, times, COARSE)
        kind_other, time_other = other.event(y_other, 8.0, COARSE)
        assert kind == kind_other, (kind, kind_other)
        yield top_scene(f"sphere-viscous-{number + 1:02d}", top, y, {"shape": "sphere", "radius": radius}) | {
            "outcome": kind,
            "states": top_states(times, states, check),
            "events": [bounded_event(kind, time, time_other)],
            "source": {
                "values": "Newton's and Euler's equations, the normal in closed form, tests/physics/coulomb_top.py, rtol 1e-13",
                "bounds": "the foot by Newton's method, other variables, tests/physics/arena_reference.py, rtol 1e-12",
            },
        }


class ArenaTop(arena_reference.Top):
    """`arena_reference.Top` with its state exported as that of the centre of mass."""

    def field(self, _: float, y: Array) -> Array:
        return self.motion(y)[0]

    def exported(self, y: Array) -> Array:
        centre, u, e, w = y.reshape(4, 3)
        return np.concatenate([centre - self.case.offset * e, u, e, w])

    def normal(self, y: Array) -> Array:
        return (y[:3] - arena_reference.foot(self.case, y[:3], self.near, self.case.radius)[0]) / self.case.radius

    @property
    def margins(self) -> dict[str, Callable]:
        return {
            "inverted": lambda y: y[6:9] @ self.normal(y) - cos(ANGLE),
            "contact_lost": lambda y: self.motion(y)[1] / self.case.mass,
        }

    def states(self, y: Array, times: Sequence[float], rtol: float) -> Array:
        self.start()
        return np.array([self.exported(state) for state in states_at(self.field, y, times, rtol, 0.1 * rtol)])

    def event(self, y: Array, t1: float, rtol: float, kinds: Sequence[str] = ("inverted", "contact_lost")):
        self.start()
        margins = {kind: self.margins[kind] for kind in kinds}
        return first_event(self.field, y, t1, margins, rtol, 0.1 * rtol)


ARENAS: dict[str, Callable[[float, float], dict[str, Any]]] = {
    "tilted plane": lambda p1, p2: {"shape": "plane", "tilt": p1},
    "paraboloid": lambda p1, p2: {"shape": "paraboloid", "radius": p1},
    "graph": lambda p1, p2: {"shape": "waves", "waves": [[0.5 * p1, p2, p2, 0.0], [0.5 * p1, p2, -p2, 0.0]]},
    "spheroid": lambda p1, p2: {"shape": "spheroid", "equatorial": p1, "polar": p2, "side": "inside"},
    "outside of a sphere": lambda p1, p2: {"shape": "sphere", "radius": p1, "side": "outside"},
    "outside of a spheroid": lambda p1, p2: {"shape": "spheroid", "equatorial": p1, "polar": p2, "side": "outside"},
    "torus": lambda p1, p2: {"shape": "torus", "ring": p1, "tube": p2},
}


def arena_scene(name: str, case: arena_reference.Case, top: ArenaTop, y: Array) -> Scene:
    """What a scene of `arena_reference` is before its solution."""
    numbers = asdict(case)
    return {
        "name": name,
        "vehicle": "top",
        "body": {key: numbers[key] for key in ("mass", "radius", "offset", "I1", "I3")},
        "arena": ARENAS[case.arena](case.p1, case.p2),
        "friction": friction_of(case.mu, case.slip_speed),
        "gravity": case.gravity,
        "start": top_start(top.exported(y), top.near.copy(), top.normal(y)),
    }


def arenas() -> Iterator[Scene]:
    """The 14 scenes of `arena_reference.py`, some with a loss of contact, at two tolerances."""
    for number, case in enumerate(arena_reference.cases()):
        top = ArenaTop(case)
        y = top.start()
        scene = arena_scene(f"arena-{case.arena.replace(' ', '-')}-{number + 1:02d}", case, top, y)
        runs = [top.event(y, case.t1, rtol, ["contact_lost"]) for rtol in (FINE, COARSE)]
        kind, end = runs[0]
        times = rounded_times(end, (0.25, 0.5, 0.75, 1.0 if kind == "completed" else 0.95))
        states = [top.states(y, times, rtol) for rtol in (FINE, COARSE)]
        yield scene | {
            "outcome": kind,
            "states": top_states(times, *states),
            "events": [] if kind == "completed" else [bounded_event(kind, end, runs[1][1])],
            "source": {
                "values": "Newton's and Euler's equations, the foot by Newton's method, "
                "tests/physics/arena_reference.py, rtol 1e-13",
                "bounds": "the same program, rtol 1e-12",
            },
        }


#: The egg; theta, azimuth and spin; the angular velocity besides the spin; the velocity of the centre of mass.
EGGS = {
    "egg-coulomb": (
        egg_reference.Egg(0.05, 0.02, 0.028, 0.003, 1.184e-5, 8e-6, 0.3, 0.05),
        (1.3, 0.5, 40.0),
        (3.0, -2.0, 120.0),
        (0.1, -0.05),
    ),
    "egg-viscous": (
        egg_reference.Egg(0.05, 0.02, 0.028, 0.003, 1.184e-5, 8e-6, 0.3, 0.0),
        (1.3, 0.5, 40.0),
        (3.0, -2.0, 120.0),
        (0.1, -0.05),
    ),
    "egg-oblate": (
        egg_reference.Egg(0.05, 0.02, 0.015, 0.002, 6.25e-6, 8e-6, 0.2, 0.02),
        (0.4, -1.0, 30.0),
        (1.0, -1.0, 5.0),
        (-0.05, 0.1),
    ),
}


def eggs() -> Iterator[Scene]:
    """Spheroids that slide on a plane."""
    for name, (egg, launch, turning, velocity) in EGGS.items():
        y = egg.start(*launch, np.array(turning), np.array(velocity))
        times = [0.05, 0.1, 0.15]

        def exported(y: Array) -> Array:
            return np.concatenate([y[:6], y[[8, 11, 14]], y[15:18]])

        runs = [
            states_at(lambda _, y, egg=egg: egg.motion(y)[0], y, times, rtol, 0.1 * rtol) for rtol in (FINE, COARSE)
        ]
        assert first_event(
            lambda _, y, egg=egg: egg.motion(y)[0],
            y,
            times[-1],
            {"contact_lost": lambda y, egg=egg: egg.motion(y)[1]},
            1e-9,
            1e-10,
        ) == ("completed", times[-1])
        r = egg.motion(y)[2]
        yield {
            "name": name,
            "vehicle": "top",
            "body": {
                "mass": egg.mass,
                "equatorial": egg.b,
                "polar": egg.p,
                "offset": egg.a,
                "I1": egg.I1,
                "I3": egg.I3,
            },
            "arena": {"shape": "plane", "tilt": 0.0},
            "friction": friction_of(egg.mu, egg.slip_speed),
            "gravity": egg.gravity,
            "start": top_start(exported(y), y[:3] + r, UP),
            "outcome": "completed",
            "states": top_states(times, *(np.array([exported(state) for state in run]) for run in runs)),
            "events": [],
            "source": {
                "values": "rotation matrix and shape matrix, tests/physics/egg_reference.py, rtol 1e-13",
                "bounds": "the same program, rtol 1e-12",
            },
        }
