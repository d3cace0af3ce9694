"""Parameters from measurements: maximum likelihood, with errors and with what the measurements do not determine."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parameters import full_name
from ..validation import require
from .levenberg_marquardt import Problem, linearise, minimise
from .likelihood import Measurements
from .result import Identification, summarise
from .unknown import Free, as_free, draw_starts


def identify(
    model: Callable[[dict[str, Float[Array, " rows"]]], Float[Array, "rows n"]],
    measurements: Measurements,
    free: dict[str, Any],
    *,
    starts: int = 1,
    spread: float = 2.0,
    seed: int = 0,
    max_steps: int = 60,
    labels: tuple[str, ...] | None = None,
    progress: bool = True,
) -> Identification:
    """Find the parameters of a model that make measurements most likely.

    Levenberg-Marquardt from every start at once, on the residuals of the data (`likelihood.py`) and of the priors. It finds
    a minimum near each start, not the global one; the result is the best of them and says where the others ended.

    **Arguments:**

    - `model`: parameters, name -> (rows,), to predictions (rows, n); `jax.vmap` turns a function of one set into
      one. It is differentiated in forward mode.
    - `measurements`: `Measurements` of shape (n,).
    - `free`: name -> a `Free`, or only the value from which to start.
    - `starts`: number of points from which to fit: the one given, and others drawn around it.
    - `spread`: how far they are drawn, as a factor either way, greater than 1; `seed`: of the draw.
    - `max_steps`: a fit that needs more has not converged.
    - `labels`: (n,), names of the measurements in the result.
    - `progress`: whether to show it, on a terminal or in a notebook.

    **Returns:** an `Identification`.

    **Raises:** `ValueError` for arguments out of range.
    """
    unknowns = as_free(free)
    if not isinstance(measurements, Measurements) or measurements.value.ndim != 1:
        raise ValueError(f"measurements = {measurements!r} must be Measurements of shape (n,)")
    for name, value, least in (("starts", starts, 1), ("max_steps", max_steps, 1)):
        if not isinstance(value, int | np.integer) or value < least:
            raise ValueError(f"{name} = {value!r} must be a whole number of at least {least}")
    require(spread, "spread", above=1.0)
    count = measurements.value.size
    labels = tuple(f"#{i + 1}" for i in range(count)) if labels is None else tuple(labels)
    if len(labels) != count:
        raise ValueError(f"labels must be {count}, one for each measurement, not {len(labels)}")
    problem = Problem(model, tuple(unknowns.items()))
    begins = draw_starts(unknowns, starts, spread, seed)
    shape = eqx.filter_eval_shape(problem.predict, jnp.asarray(begins)).shape
    if shape != (starts, count):
        raise ValueError(f"model must predict {(starts, count)} for {starts} sets, not {shape}")
    ends = minimise(problem, jnp.asarray(begins), measurements, max_steps=max_steps, progress=progress)
    there = linearise(problem, ends.coordinates, measurements)
    if not math.isfinite(float(jnp.min(there.deviance))):
        raise ValueError("model: no start led to finite predictions")
    return summarise(
        problem, measurements, labels, begins, np.asarray(ends.coordinates), np.asarray(ends.converged), there
    )


def joined(data: tuple[Any, ...]) -> tuple[Measurements, tuple[str, ...]]:
    """The measurements of several data sets, each with `measurements` and `labels`, one after the other, and their labels."""
    measurements = [one.measurements for one in data]
    labels = tuple(
        f"{i + 1}: {label}" if len(data) > 1 else label for i, one in enumerate(data) for label in one.labels
    )
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *measurements), labels


def free_numbers(
    free: Any, roots: dict[str, Any], known: list[str], replace: Callable[[dict[str, Any], dict[str, Any]], Any]
) -> dict[str, Free]:
    """The unknowns of a scene: their full names, and a lower bound of 0 for parameters that cannot be negative.

    **Arguments:**

    - `free`: name, or its unambiguous end, -> a `Free` or where to start.
    - `roots`: name -> tree of modules, `known`: the full names of their parameters.
    - `replace`: (roots, name -> number) -> roots; it raises `ValueError` for values that the modules refuse.

    **Returns:** full name -> `Free`.

    **Raises:** `ValueError` for an unknown name, or starts that the modules refuse.
    """
    given = {}
    for short, one in as_free(free).items():
        name = full_name("free", short, known)
        if name in given:
            raise ValueError(f"free: {name!r} is named twice")
        given[name] = one
    replace(roots, {name: one.start for name, one in given.items()})
    lower = {}
    for name, one in given.items():
        try:
            replace(roots, {name: -(abs(one.start) or 1.0)})
        except ValueError:
            lower[name] = 0.0
    return as_free(given, lower)
