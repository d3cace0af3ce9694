"""Checks of the parts of a scene, which must allow one another."""

from typing import Any

from nonholonomic.geometry import AbstractSurface, Plane
from nonholonomic.text import likely_fix
from nonholonomic.validation import require_kind, shown

from .body import AbstractBody
from .friction import A_LAW, AbstractFriction, NoSlip
from .rigid_body import AbstractRigidBody
from .top import Top


def check_parts(scene: Any) -> None:
    """Raise `ValueError` if a part of a scene is of the wrong kind, or does not allow another part or an option."""
    if not isinstance(scene.body, AbstractBody | AbstractRigidBody):
        kinds = f"a Top, a SpheroidBody, a ConvexBody, an Ellipsoid or a RigidBody{likely_fix(scene.body)}"
        raise ValueError(f"body = {shown(scene.body)} must be {kinds}")
    require_kind(scene.surface, "surface", AbstractSurface, ", such as tippe.Plane() or tippe.Cylinder(0.3)")
    require_kind(scene.friction, "friction", AbstractFriction, A_LAW)
    # This raises an error if the surface has no such side.
    scene.surface.sign(scene.side, "inside")
    if scene.contact not in ("stop", "hybrid"):
        raise ValueError(f"contact = {shown(scene.contact)} must be 'stop' or 'hybrid'")
    if scene.restitution is not None and scene.contact == "stop":
        raise ValueError(
            f"restitution = {shown(scene.restitution)} needs contact='hybrid', because a run without flights has no impacts"
        )
    if isinstance(scene.friction, NoSlip) and not isinstance(scene.body, AbstractRigidBody):
        raise ValueError(
            f"friction = NoSlip() must be another law for a {type(scene.body).__name__}, such as Coulomb; describe the "
            "body as an Ellipsoid or a RigidBody to roll it"
        )
    if not isinstance(scene.body, Top):
        _check_convex(scene)
        return
    if scene.friction.set_valued and scene.body.stem is not None:
        raise ValueError(
            f"friction = {shown(scene.friction)} must be a law with a single mode for a top with a stem, such as Coulomb: "
            "with two contacts it is undetermined which one sticks"
        )
    if scene.contact == "stop" and scene.body.stem is not None:
        raise ValueError(
            "a top with a stem needs contact='hybrid', as in Scene(top, contact='hybrid'): it hops from its sphere onto its "
            "stem; the default, 'stop', ends a run where the contact is lost"
        )


def _check_convex(scene: Any) -> None:
    """Raise `ValueError` for options that need a sphere, whose contact follows from the place of its centre."""
    kind = type(scene.body).__name__
    kind = f"an {kind}" if kind[0] in "AEIOU" else f"a {kind}"
    if not isinstance(scene.surface, Plane) and isinstance(scene.body, AbstractBody):
        allowed_bodies = "a Top runs on any arena, as an Ellipsoid or a RigidBody does"
        raise ValueError(f"surface = {shown(scene.surface)} must be a Plane for {kind}; {allowed_bodies}")
    if scene.contact != "stop":
        raise ValueError(f"contact = {shown(scene.contact)} must be 'stop' for {kind}; only a Top can fly")
    if scene.friction.set_valued and isinstance(scene.body, AbstractBody):
        raise ValueError(
            f"friction = {shown(scene.friction)} must be a law with a single mode for {kind}, such as Coulomb; describe the "
            "body as an Ellipsoid or a RigidBody to stick and slip"
        )
