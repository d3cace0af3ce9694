"""Derivatives of the inversion times of a table's cells with respect to parameters of the scene and the launch."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nonholonomic.derivatives import solve_ensemble_with_tangents, tangent_scale, tangents_of
from nonholonomic.hybrid import HybridOutcome, solve_hybrid_with_tangents
from nonholonomic.integration import Outcome, Settings
from nonholonomic.parameters import full_name, numbers, with_numbers
from nonholonomic.sweeps import Variable

from ..modes.inversion_problem import InversionProblem
from .inversion import is_inverted


def sensitivity_names(roots: dict[str, Any], names: Any) -> list[str]:
    """The full names of the numbers to differentiate by.

    **Arguments:** `roots`: the table's scene and launch; `names`: full names, or the ends of them that fit one only.

    **Raises:** `ValueError` unless `names` is a list of such names.
    """
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"sensitivities = {names!r} must be a list of names, such as ['scene.friction.mu']")
    known = [name for root, tree in roots.items() for name, value in numbers(root, tree).items() if value is not None]
    found = [full_name("sensitivities", name, known) for name in names]
    if len(set(found)) < len(found):
        raise ValueError(f"sensitivities = {names!r} must name every number once")
    return found


def sensitivity_columns(names: list[str]) -> list[str]:
    """The table's variables: `time_by_mu` for `scene.friction.mu`, the full name where two numbers share a name."""
    ends = [name.rsplit(".", 1)[-1] for name in names]
    return [
        "time_by_" + (end if ends.count(end) == 1 else name.replace(".", "_"))
        for name, end in zip(names, ends, strict=True)
    ]


def sensitivity_variables(names: list[str], units: dict[str, str], event: str = "inversion") -> dict[str, Variable]:
    """The table's variables, with their units; `event`: what is timed."""

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
    angle: float | None,
    t1: float,
    settings: Settings,
    *,
    count: int,
    size: int,
    last: bool,
) -> tuple[Outcome, dict[str, Any]]:
    """How every cell ended, and the derivative of its inversion time by every number, 0 where the top did not invert.

    **Arguments:** as for `inversion_table`, and

    - `columns`: full name of a parameter -> its value in every cell; `count` of the `size` cells are to be run.
    - `names`: full names of the numbers to differentiate by.

    **Returns:** the `Outcome`, and name of the variable -> derivatives (size,). Source: implicit function theorem at
    the event.
    """
    number = None if angle is None else jnp.asarray(angle, float)
    problem, tangents, sizes = _problem_and_tangents(roots, columns, names, number, size)
    outcome, slopes = solve_ensemble_with_tangents(
        problem,
        tangents,
        jnp.asarray(t1, float),
        jnp.asarray(count),
        settings,
        nonterminal=last,
    )
    inverted = is_inverted(outcome, problem, last)
    found = [np.where(inverted, slope / moved, 0.0) for slope, moved in zip(slopes, sizes, strict=True)]
    return outcome, dict(zip(sensitivity_columns(names), found, strict=True))


@eqx.filter_jit
def _problem_and_tangents(
    roots: dict[str, Any], columns: dict[str, Any], names: list[str], angle: Float[Array, ""] | None, size: int
) -> tuple[InversionProblem, tuple[Any, ...], list[Float[Array, "..."]]]:
    """The problem of the cells, its tangents along the numbers to differentiate by, and the scale of each tangent."""

    def build(*moving: Any) -> InversionProblem:
        cells = with_numbers(roots, columns | dict(zip(names, moving, strict=True)))
        return InversionProblem.of(cells["scene"], cells["launch"], angle, size)

    return _with_tangents(build, roots, columns, names)


def hybrid_sensitivities_of_cells(
    modes_of: Callable[..., Any],
    roots: dict[str, Any],
    columns: dict[str, Any],
    names: list[str],
    angle: float,
    t1: float | Float[np.ndarray, " cells"],
    settings: Settings,
    *,
    count: int,
    size: int,
    last: bool,
    counters: int,
) -> tuple[HybridOutcome, dict[str, Any], Bool[np.ndarray, " size"]]:
    """`sensitivities_of_cells` for hybrid runs.

    **Arguments:** as there, and

    - `modes_of`: returns the modes, as in `RunKind`.
    - `t1`: horizon [s]; where the `last` crossing counts, its time in every cell, at which the runs end.
    - `counters`: number of counters.

    **Returns:** the `HybridOutcome`; name of the variable -> derivatives (size,); and where these have no correct
    digits, because an event on the way was grazing. Source: saltation at every change of mode
    (`nonholonomic/hybrid/saltation.py`).
    """
    numbers = (jnp.asarray(angle, float), settings.tolerance)
    built = _modes_and_tangents(modes_of, roots, columns, names, *numbers, size, last)
    (modes, first, states), tangents, sizes = built
    tangents = tuple((one[0], one[2]) for one in tangents)
    given = (tangents, np.asarray(first), np.asarray(states), t1, count, settings)
    hybrid_outcome, found = solve_hybrid_with_tangents(modes, *given, counters=counters, ends_on_event=not last)
    slopes = [slope / np.asarray(moved) for slope, moved in zip(found.slopes, sizes, strict=True)]
    return hybrid_outcome, dict(zip(sensitivity_columns(names), slopes, strict=True)), found.grazing


@eqx.filter_jit
def _modes_and_tangents(
    modes_of: Callable[..., Any],
    roots: dict[str, Any],
    columns: dict[str, Any],
    names: list[str],
    angle: Float[Array, ""],
    tolerance: Float[Array, ""],
    size: int,
    last: bool,
) -> tuple[Any, tuple[Any, ...], list[Float[Array, "..."]]]:
    """The modes of the cells, the number of each one's first and its state there; tangents and scales as above."""

    def build(*moving: Any) -> Any:
        cells = with_numbers(roots, columns | dict(zip(names, moving, strict=True)))
        problem = InversionProblem.of(cells["scene"], cells["launch"], angle, size)
        return (*modes_of(cells["scene"], problem, tolerance, last), problem.states)

    return _with_tangents(build, roots, columns, names)


def _with_tangents(
    build: Callable[..., Any], roots: dict[str, Any], columns: dict[str, Any], names: list[str]
) -> tuple[Any, tuple[Any, ...], list[Float[Array, "..."]]]:
    """Build an object from the numbers to differentiate by; also return its tangents along them and the scale of each."""
    cells = with_numbers(roots, columns)
    values = {name: value for root, tree in cells.items() for name, value in numbers(root, tree).items()}
    point = tuple(jnp.asarray(values[name], float) for name in names)
    sizes = [tangent_scale(value) for value in point]
    tangents = [
        tuple(size if row == k else jnp.zeros_like(size) for k, size in enumerate(sizes)) for row in range(len(names))
    ]
    return build(*point), tangents_of(build, point, tangents), sizes
