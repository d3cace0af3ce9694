"""Derivatives of the inversion times of a table's cells with respect to parameters of the scene and the launch."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.derivatives import tangent_scale, tangents_of
from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import Outcome, Settings
from nonholonomic.parameters import full_name, numbers, with_numbers
from nonholonomic.sweeps import Variable
from nonholonomic.validation import shown

from ..modes.inversion_problem import InversionProblem, StemContact
from .inversion import Inversions


def sensitivity_names(roots: dict[str, Any], names: Any) -> list[str]:
    """The full names of the parameters with respect to which to differentiate.

    **Arguments:** `roots`: the table's scene and launch; `names`: full names, or ends of names that are unique.

    **Raises:** `ValueError` unless `names` is a list of such names.
    """
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"sensitivities = {shown(names)} must be a list of names, such as ['scene.friction.mu']")
    number_names = [
        name for root, tree in roots.items() for name, value in numbers(root, tree).items() if value is not None
    ]
    full_names = [full_name("sensitivities", name, number_names) for name in names]
    if len(set(full_names)) < len(full_names):
        raise ValueError(f"sensitivities = {shown(names)} must name every parameter only once")
    return full_names


def sensitivity_columns(names: list[str]) -> list[str]:
    """The table's variables: `time_by_mu` for `scene.friction.mu`, the full name if two parameters share a name."""
    ends = [name.rsplit(".", 1)[-1] for name in names]
    return [
        "time_by_" + (end if ends.count(end) == 1 else name.replace(".", "_"))
        for name, end in zip(names, ends, strict=True)
    ]


def sensitivity_variables(names: list[str], units: dict[str, str], event: str = "inversion") -> dict[str, Variable]:
    """The table's variables, with their units; `event`: description of the event."""

    def unit(name: str) -> str:
        of_number = units.get(name.rsplit(".", 1)[-1], "1")
        return "s" if of_number == "1" else f"s ({of_number})-1"

    return {
        slope: Variable(unit(name), np.float64, long_name=f"{event} time by {name}")
        for slope, name in zip(sensitivity_columns(names), names, strict=True)
    }


def sensitivities_of_cells(
    roots: dict[str, Any],
    columns: dict[str, Any],
    names: list[str],
    angle: float | StemContact | None,
    t1: float,
    settings: Settings,
    *,
    count: int,
    size: int,
    last: bool,
) -> tuple[Outcome | HybridOutcome, dict[str, Any], Any]:
    """The outcome of every cell, and the derivative of its crossing time with respect to every parameter, 0 if there is
    no crossing.

    **Arguments:** as for `inversion_table`, and

    - `columns`: full name of a parameter -> its value in every cell; only `count` of the `size` cells are run.
    - `names`: full names of the parameters with respect to which to differentiate.

    **Returns:** the outcome; name of the variable -> derivatives (size,); and the cells whose derivatives are NaN
    because an earlier event was grazing.
    """
    event = angle if angle is None or isinstance(angle, StemContact) else jnp.asarray(angle, float)
    inversions, tangents, scales = _with_tangents(roots, columns, names, event, settings.tolerance, size, last)
    outcome, slopes, grazing = inversions.solve_with_tangents(tangents, t1, count, settings)
    by_number = [np.asarray(slope) / np.asarray(scale) for slope, scale in zip(slopes, scales, strict=True)]
    return outcome, dict(zip(sensitivity_columns(names), by_number, strict=True)), grazing


@eqx.filter_jit
def _with_tangents(
    roots: dict[str, Any],
    columns: dict[str, Any],
    names: list[str],
    angle: Float[Array, ""] | StemContact | None,
    tolerance: Float[Array, ""],
    size: int,
    last: bool,
) -> tuple[Inversions, tuple[Any, ...], list[Float[Array, "..."]]]:
    """The launches of all cells, the tangents along the named parameters, and the scale of each tangent."""

    def build(*moving: Any) -> Inversions:
        cells = with_numbers(roots, columns | dict(zip(names, moving, strict=True)))
        problem = InversionProblem.of(cells["scene"], cells["launch"], angle, size)
        return Inversions.of(cells["scene"], problem, tolerance, last)

    cells = with_numbers(roots, columns)
    values = {name: value for root, tree in cells.items() for name, value in numbers(root, tree).items()}
    point = tuple(jnp.asarray(values[name], float) for name in names)
    scales = [tangent_scale(value) for value in point]
    tangents = [
        tuple(scale if row == k else jnp.zeros_like(scale) for k, scale in enumerate(scales))
        for row in range(len(names))
    ]
    return build(*point), tangents_of(build, point, tangents), scales
