"""The events of a top, and checks of the arguments of a run, before anything compiles and inside a program."""

import math
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from nonholonomic.integration.checks import require_run
from nonholonomic.validation import IN_DEGREES, as_number, is_traced, require, shown
from nonholonomic.warning import warn

from ..model.friction import Frictionless
from ..model.launch import Launch
from ..model.rigid_body import AbstractRigidBody
from ..model.scene import Scene
from ..modes.inversion_problem import StemContact

#: The inclination [rad] at which a body without a stem counts as turned over.
INVERTED = 0.95 * math.pi


def event_of(scene: Scene[Any], angle: Any) -> Float[Array, "..."] | StemContact:
    """The event of a run: theta reaches the angle [rad]; or, without an angle, the top has turned over.

    A top with a stem has turned over when its stem first carries it: when the stem bears a force or, as it lands, an
    impulse. In flight nothing carries the top, whatever theta. No angle defines this event, because after a hop the stem
    lands at a larger theta, and in a curved arena `Top.stem_angle` is not exactly the angle of the contact.
    """
    if angle is None and scene.has_stem:
        return StemContact()
    return as_number(INVERTED if angle is None else angle)


def angle_of(scene: Scene[Any], angle: Any) -> Float[Array, "..."]:
    """The angle [rad] itself; or, without an angle, the inclination beyond which the top has turned over on a level
    plane."""
    event = event_of(scene, angle)
    return scene.body.stem_angle if isinstance(event, StemContact) else event


#: Advice in messages about lists, where a table is the better choice.
LISTS = "inversion_table takes lists, and jax.vmap maps over them"


def check_run(scene: Any, launch: Any, t1: Any, tolerance: Any, lists: str = LISTS) -> None:
    """Raise `ValueError` unless the arguments are a scene, a launch that the scene allows, a positive horizon and a
    legal tolerance.

    **Arguments:** as for `require_run`.
    """
    require_run(scene, launch, t1, tolerance, (Scene, Launch), lists)
    scene.check_start(launch)


def warn_if_it_cannot_invert(scene: Scene, launch: Launch, theta: Any, angle: Any) -> None:
    """Warn if the scene has no friction, or if the top stands exactly upright on a level plane or is inverted already.

    **Arguments:** `launch`: its theta is ignored; `theta`: one angle or several [rad]; `angle`: the angle to be
    reached, or `None` (see `event_of`).
    """
    if isinstance(scene.friction, Frictionless):
        warn(
            "friction = Frictionless(): without friction no top turns over; give the scene a law, such as "
            "tippe.Scene(top, friction=tippe.Viscous(0.3))"
        )
    limit = angle_of(scene, angle)
    if isinstance(scene.body, AbstractRigidBody) or is_traced(theta) or is_traced(limit):
        return
    if np.any(np.asarray(theta) >= np.min(limit)):
        start = np.max(np.asarray(theta))
        on_stem = angle is None and scene.has_stem
        reached = "the angle at which the stem touches a level plane" if on_stem else "the angle to be reached"
        warn(
            f"theta = {start:g} rad is not below {reached}, {float(np.min(limit)):.4g} rad: the top "
            f"{'stands on its stem' if on_stem else 'is inverted'} from the start{IN_DEGREES.format(f'{start:g}')}"
        )
    at_rest = launch.velocity is None and launch.angular_velocity is None
    if scene.level and at_rest and np.any(np.asarray(theta) == 0.0):
        warn("theta = 0.0 is exactly upright, where a top stays forever: launch it at a small angle, such as 0.01 rad")


def check_smooth(scene: Scene, caller: str) -> None:
    """Raise `ValueError` for a scene with hybrid runs, which do not support derivatives here."""
    if scene.contact == "hybrid":
        raise ValueError(f"contact = 'hybrid' must be 'stop' for {caller}; inversion_table supports flights")
    if scene.friction.set_valued:
        kind = type(scene.friction).__name__
        raise ValueError(
            f"friction = {kind} must be a law with a single mode for {caller}; inversion_table supports others"
        )


def check_reversible(launch: Launch, values: dict[str, Any]) -> None:
    """Raise `ValueError` for a launch without spin, because there is no spin to reverse.

    **Arguments:** `values`: full name of a number -> values in place of the launch's own.
    """
    spin = values.get("launch.spin", launch.spin)
    if launch.angular_velocity is None and not is_traced(spin) and np.any(np.asarray(spin) == 0.0):
        raise ValueError("spin = 0.0 must not be zero: a spin of zero cannot reverse")


def check_event(angle: Any, crossing: Any, known: tuple[str, ...] = ("first", "last")) -> None:
    """Raise `ValueError` unless the angle is `None` or in (0, pi], and the crossing is a known word."""
    if angle is not None:
        require(angle, "angle", above=0.0, at_most=math.pi, unit="rad")
    if angle is not None and np.ndim(angle) != 0:
        raise ValueError(f"angle must be one number, not of shape {np.shape(angle)}")
    if crossing not in known:
        raise ValueError(f"crossing = {shown(crossing)} must be {' or '.join(map(repr, known))}")


def require_rigid(scene: Scene) -> None:
    """Raise `ValueError` unless the body can reverse its spin."""
    if not isinstance(scene.body, AbstractRigidBody):
        kind = type(scene.body).__name__
        raise ValueError(
            f"body = {kind} must be an Ellipsoid or a RigidBody for times of reversal: a body of revolution keeps its "
            "sense of rotation"
        )
