"""Solutions with error bounds: two runs of an integration, their states at times and their events."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import pi
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

Scene = dict[str, Any]
Array = np.ndarray

#: Least relative error bound: some thousand roundings of a double.
ROUND_OFF = 1e-12
FINE, COARSE = 1e-13, 1e-12
#: Where theta reaches it, the top counts as inverted [rad].
ANGLE = 0.95 * pi
UP, X, Y = np.array((0.0, 0.0, 1.0)), np.array((1.0, 0.0, 0.0)), np.array((0.0, 1.0, 0.0))


def bounded(values: Any, check: Any) -> dict[str, Any]:
    """Values and their error bound, from a second computation of them."""
    values, check = np.asarray(values, float), np.asarray(check, float)
    bound = max(np.max(np.abs(values - check)), ROUND_OFF * np.max(np.abs(values)))
    return {"values": values.tolist(), "bound": float(f"{bound:.2g}")}


def bounded_event(kind: str, time: float, check: float, least: float = 0.0) -> dict[str, Any]:
    """An event with the error bound of its time."""
    bound = max(abs(time - check), ROUND_OFF * time, least)
    return {"kind": kind, "time": float(time), "bound": float(f"{bound:.2g}")}


def rounded_times(end: float, fractions: Sequence[float]) -> list[float]:
    """Times of a run that have few digits [s]."""
    return [float(f"{fraction * end:.4g}") for fraction in fractions]


def solved(field: Callable, span: tuple[float, float], y: Array, rtol: float, atol: Any, **options: Any) -> Any:
    """SciPy's DOP853, which must succeed."""
    run = solve_ivp(field, span, y, "DOP853", rtol=rtol, atol=atol, **options)
    assert run.success, run.message
    return run


def states_at(field: Callable, y: Array, times: Sequence[float], rtol: float, atol: Any) -> Array:
    """States (times, components). Each is the end of an integration, so that nothing is interpolated."""
    states = []
    for span in pairwise((0.0, *times)):
        y = solved(field, span, y, rtol, atol).y[:, -1]
        states.append(y)
    return np.array(states)


def first_event(field: Callable, y: Array, t1: float, margins: dict[str, Callable], rtol: float, atol: Any):
    """Kind and time [s] of the first fall of a margin through zero, or ("completed", t1).

    The time is the root of the margin at the end of an integration, not on an interpolant.
    """
    events = [lambda _, y, margin=margin: margin(y) for margin in margins.values()]
    for event in events:
        event.terminal, event.direction = True, -1.0
    run = solved(field, (0.0, t1), y, rtol, atol, events=events)
    if run.status == 0:
        return "completed", t1
    number = next(k for k, times in enumerate(run.t_events) if len(times))
    kind, margin = list(margins.items())[number]
    begin, start, step = run.t[-2], run.y[:, -2], run.t[-1] - run.t[-2]

    def value(t: float) -> float:
        return margin(solved(field, (begin, t), start, rtol, atol).y[:, -1])

    return kind, brentq(value, begin + 0.5 * step, begin + 1.5 * step, xtol=1e-15, rtol=1e-15)


def top_states(times: Sequence[float], values: Array, check: Array) -> dict[str, Any]:
    """States (times, 12), position, velocity, axis, angular velocity, with their bounds."""
    names = ("position", "velocity", "axis", "angular_velocity")
    parts = {name: (values[:, 3 * k : 3 * k + 3], check[:, 3 * k : 3 * k + 3]) for k, name in enumerate(names)}
    return {"times": list(times)} | {name: bounded(*part) for name, part in parts.items()}


def top_start(state: Array, contact: Array, normal: Array) -> dict[str, list[float]]:
    """A start as the files have it."""
    names = ("position", "velocity", "axis", "angular_velocity")
    vectors = dict(zip(names, state.reshape(4, 3), strict=True)) | {"contact": contact, "normal": normal}
    return {name: np.asarray(vector, float).tolist() for name, vector in vectors.items()}


def friction_of(mu: float, slip_speed: float | None) -> dict[str, Any]:
    return {"law": "coulomb", "mu": mu, "slip_speed": slip_speed} if slip_speed else {"law": "viscous", "mu": mu}
