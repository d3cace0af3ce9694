"""Checks of the arguments of steady motions; traced numbers pass."""

import math
from typing import Any

from nonholonomic.parameters import numbers
from nonholonomic.validation import require, require_flag, require_kind, require_outside, require_scalars, shown

from ..model.rigid_body import AbstractRigidBody
from ..model.scene import Scene
from ..model.top import Top

#: Advice in messages about lists.
MANY = "jax.vmap maps over several"


def require_top(body: Any) -> None:
    """Raise `ValueError` unless the body is a `Top`."""
    if not isinstance(body, Top):
        raise ValueError(f"body = {shown(body)} must be a Top: the formulas are those of a sphere")


def require_one_top(body: Any, caller: str) -> None:
    """Raise `ValueError` unless the body is a `Top` with known scalars. **Arguments:** `caller`: the function."""
    require_top(body)
    require_outside(body, caller, "steady.proportions")
    require_scalars(numbers("body", body), MANY)


def require_one_scene(scene: Scene, **values: Any) -> None:
    """Raise `ValueError` unless the numbers of the scene, and the values, are scalars."""
    require_scalars(numbers("scene", scene, functions=False) | values, MANY)


def require_scene_of_a_top(scene: Any) -> None:
    """Raise `ValueError` unless this is a scene of a `Top`."""
    require_kind(scene, "scene", Scene)
    require_top(scene.body)


def require_plane(scene: Any) -> None:
    """Raise `ValueError` unless this is a scene of a `Top` on a level plane."""
    require_scene_of_a_top(scene)
    if not scene.level:
        raise ValueError(
            f"surface = {shown(scene.surface)} must be a Plane without tilt: on other arenas, no top tumbles steadily"
        )


def require_standing(scene: Any, spin: Any, inverted: Any) -> None:
    """Raise `ValueError` unless the body of a scene can stand and spin, and the other arguments are legal."""
    require_kind(scene, "scene", Scene)
    if isinstance(scene.body, AbstractRigidBody):
        kind = type(scene.body).__name__
        raise ValueError(
            f"body = {kind} must be a body of revolution, such as a Top or a SpheroidBody, to stand and spin"
        )
    require(spin, "spin")
    require_flag(inverted, "inverted")


def require_inclination(theta: Any) -> None:
    """Raise `ValueError` unless theta is an angle [rad] in [0, pi], or several."""
    require(theta, "theta", at_least=0.0, at_most=math.pi, unit="rad")
