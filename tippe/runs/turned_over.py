"""What counts as turned over by default: standing on the stem or, for a body without a stem, an angle."""

import math
from typing import Any

from jaxtyping import Array, Float

from nonholonomic.validation import as_number

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
    if angle is None and scene.has_stem:
        return scene.body.stem_angle
    return as_number(INVERTED if angle is None else angle)
