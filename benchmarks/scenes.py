"""The scenes of `work_precision.py`, each in the form of this package and as plain numbers for other programs."""

import dataclasses
import math
from typing import NamedTuple

import fields
import jax.numpy as jnp
import numpy as np
from peers import NUMPY, Task

import stroller
import tippe
from nonholonomic.integration import AbstractProblem
from stroller.runs.model import RideModel
from tippe.modes.problems import InversionProblem

ANGLE = 0.95 * math.pi

#: The reference top of all scenes.
MASS, RADIUS = 0.02, 0.02
INERTIA = MASS * RADIUS**2
TOP = (MASS, RADIUS, 0.006, 131.0 / 350.0 * INERTIA, 0.4 * INERTIA)

#: A top's axis and a stroller's position in the state.
AXIS, POSITION = slice(2, 5), slice(0, 3)


class Case(NamedTuple):
    """A scene with its launches: the task for other programs, and the problem for this package."""

    task: Task
    problem: AbstractProblem


def scenes(launches: int) -> dict[str, Case]:
    """Every scene of the benchmark by its name."""
    top, theta = tippe.Top(*TOP), np.linspace(0.05, 0.15, launches)
    flat = tippe.Launch(theta, 100.0)
    slope = tippe.Launch(theta, 100.0, eta=0.3)
    drum = tippe.Cylinder(0.3)
    return {
        # The same in the frame that turns, which all programs get, and in one at rest.
        "plane, viscous": of_top(tippe.Scene(top, tippe.Plane(), tippe.Viscous(0.3)), flat, 30.0, ANGLE),
        "plane, frame at rest": of_top(tippe.Scene(top, tippe.Plane(), tippe.Viscous(0.3)), flat, 30.0, ANGLE, False),
        # First crossings jump by whole oscillations in a cylinder, so the axis is compared there.
        "cylinder, viscous": of_top(tippe.Scene(top, drum, tippe.Viscous(0.3)), slope, 3.0, None),
        "cylinder, Coulomb 1e-2": of_top(tippe.Scene(top, drum, tippe.Coulomb(0.3, 1e-2)), slope, 0.5, None),
        "cylinder, Coulomb 1e-3": of_top(tippe.Scene(top, drum, tippe.Coulomb(0.3, 1e-3)), slope, 0.5, None),
        "spheroid, stroller": of_stroller(launches, 10.0),
    }


def of_top(scene: tippe.Scene, launch: tippe.Launch, t1: float, angle: float | None, turns: bool = True) -> Case:
    """A top that ends where theta reaches an angle or, with `None`, at the horizon `t1` [s]; `turns`: as in tables."""
    body, law, cells = scene.body, scene.friction, launch.theta.shape[0]
    problem = InversionProblem.of(scene, launch, ANGLE if angle is None else angle, cells)
    if not turns:
        problem = dataclasses.replace(problem, dynamics=scene.dynamics)
    if angle is None:
        # No angle has a cosine of -2: every run goes on to the horizon.
        problem = InversionProblem(problem.dynamics, jnp.asarray(-2.0), problem.states, problem.scales)
    is_cylinder = isinstance(scene.surface, tippe.Cylinder)
    numbers = fields.Top(
        *(float(value) for value in (body.mass, body.radius, body.offset, body.I1, body.I3, law.mu, scene.gravity)),
        slip_speed=float(getattr(law, "slip_speed", 0.0)),
        rho=float(scene.surface.radius - body.radius) if is_cylinder else 0.0,
        turns=0.0 if problem.dynamics.turns is None else float(problem.dynamics.turns),
    )
    return case(fields.cylinder if is_cylinder else fields.plane, numbers, problem, t1, angle, AXIS)


def of_stroller(launches: int, t1: float) -> Case:
    """A damped stroller inside a spheroid: launches over speed and place, each until `t1` [s]."""
    body = stroller.Stroller(12.0, 0.7, 1.5, 0.05, steering_spring=0.2)
    bowl, damping = stroller.Spheroid(6.0, 3.0), stroller.Damping(0.8, 0.4, 0.1, 0.02)
    scene = stroller.Scene(body, bowl, damping, side="inside")
    # Multiples of the golden ratio spread the latitudes evenly over the speeds.
    latitude = -1.2 + 0.8 * (0.5 * (1.0 + math.sqrt(5.0)) * np.arange(launches) % 1.0)
    launch = stroller.Launch((0.0, latitude), 0.3, np.linspace(1.0, 3.0, launches), 0.2, 0.5)
    scene.check(launch)
    # Contact is watched, as `stroller.sweep` does; none of these launches loses it.
    problem = RideModel.of(scene, launch, None).problem(launches, ())
    numbers = (body.mass, body.wheelbase, body.inertia, body.steering_inertia, body.steering_spring, scene.gravity)
    numbers += (bowl.equatorial, bowl.polar, damping.rolling, damping.front, damping.scrub, damping.steering)
    return case(fields.spheroid, fields.Ride(*map(float, numbers)), problem, t1, None, POSITION)


def case(field, numbers, problem, t1: float, angle: float | None, compared: slice) -> Case:
    """The case, with the same initial states and magnitudes for all programs."""
    states, scales = map(np.asarray, problem.start())
    return Case(Task(field, numbers, states, scales, t1, angle, compared), problem)


def misprint(case: Case) -> float:
    """Greatest difference of the field for other programs from the scene's own field, for each component, relative to
    the greatest rate. The states are scattered about the launches, so that no term of the formulas vanishes by chance.
    """
    task = case.task
    states = task.starts + 0.3 * task.scales * np.random.default_rng(5).normal(size=task.starts.shape)
    lean = np.array(task.field(states, task.numbers, NUMPY))
    rates = np.asarray(case.problem.field(jnp.zeros(task.launches), jnp.asarray(states)))
    return float(np.max(np.abs(lean - rates) / np.max(np.abs(rates), axis=1, keepdims=True)))
