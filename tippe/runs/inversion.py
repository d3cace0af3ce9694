"""Inversion: launches that end when the axis reaches an angle, and the checks of what is asked about them."""

import math
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import CROSSED, LOOSEST, REACHED_END, Outcome, run_bounds
from nonholonomic.parameters import numbers
from nonholonomic.validation import Bound, all_bounds, legal, nan_unless, require_all, require_scalars
from nonholonomic.xla_cpu import compiled_setup

from ..model.launch import Launch
from ..model.scene import Scene
from ..modes.inversion_problem import InversionProblem


@eqx.filter_jit
def permitted(
    structure: Any, unchecked: bool, leaves: tuple[Float[Array, "..."], ...]
) -> tuple[Bool[Array, "..."], Float[Array, "..."], Float[Array, ""]]:
    """Which cells have legal numbers; the horizons, 0 for the others; and the tolerance of the block.

    One tolerance serves a block: the smallest of a batch.

    **Arguments:** `structure`, `leaves`: of scene, launch, angle, horizon and tolerance; `unchecked`: whether some of them
    were traced when they were checked.
    """
    scene, launch, angle, t1, tolerance = jax.tree.unflatten(structure, leaves)
    may = jnp.asarray(True)
    if unchecked:
        bounds = (
            *all_bounds(scene),
            *all_bounds(launch),
            *scene.start_bounds(launch),
            *event_bounds(angle),
            *run_bounds(t1, tolerance),
        )
        may = legal(bounds)
        t1, tolerance = jnp.where(may, t1, 0.0), jnp.where(may, tolerance, LOOSEST)
    return may, t1, jnp.min(tolerance)


# One program where it is called on its own, not one for every comparison.
@compiled_setup
def nan_if_illegal(found: Float[Array, ""], structure: Any, unchecked: bool, leaves: list[Any]) -> Float[Array, ""]:
    """What was found, or NaN, and so every derivative of it, where numbers are not legal. **Arguments:** as for `permitted`."""
    return nan_unless(permitted(structure, unchecked, leaves)[0], found) if unchecked else found


def is_inverted(outcome: Outcome | HybridOutcome, problem: InversionProblem, last: bool) -> Bool[Array, " cells"]:
    """Which cells count as inverted: those that reached the angle, or that end above it where the last crossing counts."""
    if not last:
        return outcome.status == CROSSED
    above = problem.event_function(jnp.asarray(outcome.state)) <= 0.0
    return (outcome.status == REACHED_END) & above & jnp.isfinite(outcome.crossing_time)


def check_run(scene: Any, launch: Any, t1: Any, tolerance: Any) -> None:
    """Raise `ValueError` unless these are a scene, a launch, a positive horizon and a tolerance in range."""
    if not isinstance(scene, Scene):
        raise ValueError(f"scene = {scene!r} must be a Scene")
    if not isinstance(launch, Launch):
        raise ValueError(f"launch = {launch!r} must be a Launch")
    require_all(run_bounds(t1, tolerance))
    values = numbers("scene", scene) | numbers("launch", launch) | {"t1": t1, "tolerance": tolerance}
    require_scalars(values, "inversion_table takes lists")
    scene.check_start(launch)


def event_bounds(angle: Any) -> Iterator[Bound]:
    """The range of the angle [rad] to be reached."""
    yield Bound(angle, "angle", above=0.0, at_most=math.pi)


def check_smooth(scene: Scene, caller: str) -> None:
    """Raise `ValueError` for a scene whose runs have phases, which derivatives do not go through."""
    if scene.contact == "hybrid":
        raise ValueError(f"contact = 'hybrid' must be 'stop' for {caller}; inversion_table goes through flights")
    if scene.friction.set_valued:
        kind = type(scene.friction).__name__
        raise ValueError(f"friction = {kind} must be a law without phases for {caller}; inversion_table has them")


def check_event(angle: Any, crossing: Any, known: tuple[str, ...] = ("first", "last")) -> None:
    """Raise `ValueError` unless the angle is in (0, pi] and the crossing one of the known words."""
    require_all(event_bounds(angle))
    if np.ndim(angle) != 0:
        raise ValueError(f"angle must be one number, not of shape {np.shape(angle)}")
    if crossing not in known:
        raise ValueError(f"crossing = {crossing!r} must be {' or '.join(map(repr, known))}")
