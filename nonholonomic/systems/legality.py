"""Whether runs of a user's system may start: rules for concrete and traced numbers, and their messages."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..formulations import AbstractSystem, Hamel
from .mode import Hybrid
from .system import formulation_of

#: The margin, in units of the greatest component of the start, below zero by more than which a start is outside its mode; and
#: the largest relative violation of the constraints. In single precision, both are greater.
OUTSIDE = VIOLATION = 1e-9

#: Round-off of the rules in units of the precision of a number of size 1.
ROUND_OFF = 64.0

#: The rules in the order in which the first broken one is reported.
RULES = ("start", "finite", "symmetry", "rank", "metric", "constraints", "frame", "margin")

#: Arrays by name; those of several cells have the cells along the first axis.
Arrays = dict[str, Any]


def parts_of_start(system: Hybrid | AbstractSystem, start: Any) -> Arrays:
    """What the rules compare: the start, the least margin of the first mode, and the functions of a mechanical one.

    **Arguments:** `start`: a state, or {"q": coordinates, "rate": rates}.
    """
    first: Any = system.modes[system.first] if isinstance(system, Hybrid) else system
    y = jnp.concatenate([start["q"], start["rate"]]) if isinstance(start, dict) else start
    parts, arguments = {"y": y}, (y,)
    if isinstance(first, AbstractSystem):
        q, rate = arguments = jnp.split(y, 2)
        has_metric = type(first).lagrangian is AbstractSystem.lagrangian
        parts["metric"] = first.metric(q) if has_metric else jax.hessian(first.lagrangian, argnums=1)(q, rate)
        parts["constraints"] = W = first.constraints(q)
        if W.shape[0] and first.freedom and isinstance(formulation_of(first), Hamel):
            parts["frame"] = W @ first.frame(q)[:, : first.freedom]
    margins = jax.tree.leaves(first.margin(jnp.zeros((), y.dtype), *arguments))
    return parts | ({"margin": functools.reduce(jnp.minimum, map(jnp.min, margins))} if margins else {})


def rooms(parts: Arrays, xp: Any) -> Arrays:
    """The room that each rule leaves: name of a rule in `RULES` -> a number below zero, or NaN, where the start breaks it.

    **Arguments:** `parts`: those of one start or of many; `xp`: `numpy` or `jax.numpy`. For a few starts, NumPy saves the
    time to compile.
    """
    y = parts["y"]
    round_off = ROUND_OFF * float(jnp.finfo(y.dtype).eps)
    exact = max(VIOLATION, round_off)
    left = {"start": 0.0 * xp.sum(y, axis=-1)}
    if "metric" in parts:
        left |= _rooms_of_rates(parts, xp, round_off, exact)
    if "margin" in parts:
        left["margin"] = parts["margin"] + max(OUTSIDE, round_off) * xp.maximum(1.0, _greatest(xp, y, 1))
    return left


def _greatest(xp: Any, values: Any, axes: int) -> Any:
    """The greatest magnitude along the last axes."""
    return xp.max(xp.abs(values), axis=tuple(range(-axes, 0)), initial=0.0)


def _rooms_of_rates(parts: Arrays, xp: Any, round_off: float, exact: float) -> Arrays:
    """The room that the rules of metric, constraints and frame leave."""
    G, W, n = parts["metric"], parts["constraints"], parts["metric"].shape[-1]
    left = {"finite": 0.0 * (xp.sum(G, axis=(-1, -2)) + xp.sum(W, axis=(-1, -2)))}
    # In units in which each coordinate with a mass has a mass of 1, the rules do not depend on the user's units.
    # Pages and components know no primitive for a diagonal.
    identity = xp.eye(n, dtype=G.dtype)
    unit = xp.sqrt(xp.abs(xp.sum(G * identity, axis=-1)))
    unit = xp.where(unit > 0.0, unit, 1.0)
    scaled = G / (unit[..., :, None] * unit[..., None, :])
    left["symmetry"] = exact - _greatest(xp, scaled - scaled.swapaxes(-1, -2), 2)
    # Projectors on the allowed directions and on the others, by orthonormal rows: batches of LAPACK inside a compiled program
    # can deadlock.
    allowed, others = xp.broadcast_to(identity, G.shape), xp.zeros_like(G)
    independent = xp.ones_like(left["finite"])
    for k in range(W.shape[-2]):
        row = _unit(xp, W[..., k, :] / unit)
        part = _projected(allowed, row)
        independent = xp.minimum(independent, xp.sqrt(xp.sum(part * part, axis=-1)))
        # The second projection removes the round-off of the first.
        part = _unit(xp, _projected(allowed, _unit(xp, part)))
        square = part[..., :, None] * part[..., None, :]
        allowed, others = allowed - square, others + square
    if W.shape[-2]:
        rate, greatest = parts["y"][..., n:], _greatest(xp, W, 2)
        left["rank"] = independent - round_off ** (2.0 / 3.0)
        left["constraints"] = exact * greatest * _greatest(xp, rate, 1) - _greatest(xp, _projected(W, rate), 1)
        if "frame" in parts:
            left["frame"] = exact * greatest - _greatest(xp, parts["frame"], 2)
    left["metric"] = _least_pivot(xp, allowed @ scaled @ allowed + others) - n * round_off
    return left


def _projected(matrix: Any, vector: Any) -> Any:
    return (matrix @ vector[..., None])[..., 0]


def _unit(xp: Any, vector: Any) -> Any:
    return vector / xp.sqrt(xp.sum(vector * vector, axis=-1))[..., None]


def _least_pivot(xp: Any, matrix: Any) -> Any:
    """The least pivot of a symmetric matrix, which is positive if and only if the matrix is positive definite."""
    least = matrix[..., 0, 0]
    while matrix.shape[-1] > 1:
        pivot, column = matrix[..., 0, 0], matrix[..., 1:, 0]
        matrix = matrix[..., 1:, 1:] - column[..., :, None] * (column / pivot[..., None])[..., None, :]
        least = xp.minimum(least, matrix[..., 0, 0])
    return least


def problem_of_start(parts: dict[str, np.ndarray], rule: str, mode: str) -> str:
    """What is wrong with a start that breaks a rule. **Arguments:** `mode`: prefix of the names of functions."""
    if rule == "start":
        return f"start = {parts['y']} must be finite"
    if rule == "margin":
        return f"start: the margin of the first mode is {parts['margin']:.4g}, below zero; start where the margin is positive"
    W, G = parts["constraints"], parts["metric"]
    n, k = len(G), len(W)
    if rule == "finite":
        name, value = ("constraints", W) if np.isfinite(G).all() else ("metric", G)
        return f"{mode}{name}(q) = {value.tolist()} at the start must be finite"
    if rule == "symmetry":
        return f"{mode}metric(q) = {G.tolist()} at the start must be symmetric"
    if rule == "constraints":
        rate = parts["y"][n:]
        error = np.max(np.abs(W @ rate))
        return f"start: rate = {rate} violates the constraints by {error:.3g}; constraints(q) @ rate must be 0"
    if rule == "frame":
        return (
            f"{mode}frame(q): the constraints must annihilate its first {n - k} columns, and do so only up to "
            f"{np.max(np.abs(parts['frame'])):.3g}; leave it out to run with Lagrange multipliers"
        )
    lengths = np.linalg.norm(W, axis=1, keepdims=True)
    spanned = np.linalg.svd(W / np.where(lengths > 0.0, lengths, 1.0)) if k else (None, np.zeros(0), np.eye(n))
    if rule == "rank":
        return (
            f"{mode}constraints(q) has {k} rows of rank {(spanned[1] > VIOLATION).sum()} at the start, and its rows must be "
            "independent: leave out those that follow from the others"
        )
    allowed = spanned[2][k:]
    least = np.linalg.eigvalsh(allowed @ G @ allowed.T)[0]
    return (
        f"{mode}metric(q) must be positive for all rates that the constraints allow, and its least eigenvalue for them is "
        f"{least:.4g} at the start: a mass or a moment of inertia may be zero or negative, or the coordinates singular there"
    )
