"""Other programs on the same scenes: each takes a task and a tolerance and returns the answer of every launch.

A peer that is not installed is named and skipped. None of them is installed by the benchmark.
"""

import math
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from fields import Numbers, cylinder, plane

#: Where the axis' component along the normal stands in the state.
E3 = 4


class Task(NamedTuple):
    """What is computed: the time at which theta reaches an angle (`angle`), or the axis at `t1` (`angle` None)."""

    name: str
    numbers: Numbers
    starts: Any
    t1: float
    angle: float | None

    @property
    def field(self) -> Callable[..., Any]:
        return cylinder if self.numbers.rho else plane

    @property
    def scales(self) -> Any:
        """Magnitudes of the components, as `tippe.Scene.scales` has them."""
        p = self.numbers
        rate = math.sqrt(p.gravity / p.radius)
        momentum = max(float(np.max(np.linalg.norm(self.starts[5:8], axis=0))), p.I1 * rate)
        place = [1.0] * (self.starts.shape[0] - 8)
        return np.array([rate * p.radius] * 2 + [1.0] * 3 + [momentum] * 3 + place)


def available(name: str) -> bool:
    """Whether a package can be imported."""
    return find_spec(name) is not None


def heyoka_scalar(task: Task) -> Callable[[float], Any]:
    """heyoka, one launch after the other, with a terminal event."""
    import heyoka

    system, variables = _heyoka_system(heyoka, task)
    made = {}

    def run(tolerance: float) -> Any:
        if tolerance not in made:
            events = []
            if task.angle is not None:
                falling = heyoka.event_direction.negative
                events = [heyoka.t_event(variables[E3] - math.cos(task.angle), direction=falling)]
            made[tolerance] = heyoka.taylor_adaptive(system, [1.0] * len(variables), tol=tolerance, t_events=events)
        integrator, answers = made[tolerance], []
        for start in task.starts.T:
            if task.angle is not None:
                integrator.reset_cooldowns()
            integrator.time, integrator.state[:] = 0.0, start
            integrator.propagate_until(task.t1)
            answers.append(integrator.state[2:5].copy() if task.angle is None else integrator.time)
        return np.array(answers)

    return run


def heyoka_batch(task: Task) -> Callable[[float], Any]:
    """heyoka's SIMD batches: events are not terminal there, so a batch runs on in pieces until its last lane is there."""
    import heyoka

    system, variables = _heyoka_system(heyoka, task)
    width, made, times = heyoka.recommended_simd_size(), {}, {}

    def found(integrator, time, sign, lane):
        times.setdefault(lane, time)

    def run(tolerance: float) -> Any:
        if tolerance not in made:
            events = []
            if task.angle is not None:
                falling = heyoka.event_direction.negative
                events = [heyoka.nt_event_batch(variables[E3] - math.cos(task.angle), found, direction=falling)]
            blank = np.ones((len(variables), width))
            made[tolerance] = heyoka.taylor_adaptive_batch(system, blank, tol=tolerance, nt_events=events)
        integrator, answers = made[tolerance], []
        for first in range(0, task.starts.shape[1], width):
            lanes = np.minimum(np.arange(first, first + width), task.starts.shape[1] - 1)
            times.clear()
            integrator.set_time(0.0)
            integrator.state[:] = task.starts[:, lanes]
            end = task.t1 if task.angle is None else 0.0
            while task.angle is not None and len(times) < width and end < task.t1:
                end += 0.25
                integrator.propagate_until(end)
            if task.angle is None:
                integrator.propagate_until(end)
                answers += list(integrator.state[2:5].T.copy())
            else:
                # The callback keeps the state of its closure, not of the integrator's copy of it.
                answers += [times.get(lane, np.inf) for lane in range(width)]
        return np.array(answers)[: task.starts.shape[1]]

    return run


def _heyoka_system(heyoka: Any, task: Task) -> tuple[Any, Any]:
    names = ("u1", "u2", "e1", "e2", "e3", "L1", "L2", "L3", "sn", "cn")[: task.starts.shape[0]]
    variables = heyoka.make_vars(*names)
    rates = task.field(variables, task.numbers, heyoka.sqrt)
    return [(one, rate + 0.0 * one) for one, rate in zip(variables, rates, strict=True)], variables


def scipy_with(method: str, compiled: bool) -> Callable[[Task], Callable[[float], Any]]:
    """SciPy's `solve_ivp` with a field in NumPy scalars, or compiled by numba."""

    def make(task: Task) -> Callable[[float], Any]:
        from scipy.integrate import solve_ivp

        rate = _numba_field(task) if compiled else _python_field(task)

        def reached(t, y):
            return y[E3] - math.cos(task.angle)

        reached.terminal, reached.direction = True, -1.0

        def run(tolerance: float) -> Any:
            answers = []
            for start in task.starts.T:
                found = solve_ivp(
                    rate,
                    (0.0, task.t1),
                    start,
                    method=method,
                    rtol=tolerance,
                    atol=0.1 * tolerance * task.scales,
                    events=None if task.angle is None else reached,
                )
                answers.append(found.y[2:5, -1] if task.angle is None else _first(found.t_events[0]))
            return np.array(answers)

        return run

    return make


def _first(times: Any) -> float:
    return times[0] if len(times) else math.inf


def _python_field(task: Task) -> Callable[..., Any]:
    return lambda t, y: np.array(task.field(y, task.numbers, np.sqrt))


def _numba_field(task: Task) -> Callable[..., Any]:
    import numba

    field, numbers = numba.njit(task.field), task.numbers

    @numba.njit
    def root(value):
        return np.sqrt(value)

    @numba.njit
    def rate(t, y):
        return np.array(field(y, numbers, root))

    rate(0.0, task.starts[:, 0].copy())
    return rate


def cvode(task: Task) -> Callable[[float], Any]:
    """SUNDIALS' CVODE (BDF) through scikit-sundae, with a numba field."""
    from sksundae.cvode import CVODE

    rate = _numba_field(task)

    def right_side(t, y, out):
        out[:] = rate(t, y)

    def reached(t, y, events):
        events[0] = y[E3] - math.cos(task.angle)

    reached.terminal, reached.direction = [True], [-1]

    def run(tolerance: float) -> Any:
        options = {"method": "Adams", "rtol": tolerance, "atol": 0.1 * tolerance * task.scales, "max_num_steps": 10**7}
        if task.angle is not None:
            options |= {"eventsfn": reached, "num_events": 1}
        answers = []
        for start in task.starts.T:
            found = CVODE(right_side, **options).solve(np.array([0.0, task.t1]), start)
            if task.angle is None:
                answers.append(found.y[-1, 2:5])
            else:
                answers.append(found.t_events[0] if found.t_events is not None else math.inf)
        return np.array(answers)

    return run


def cyrk(task: Task) -> Callable[[float], Any]:
    """CyRK's DOP853 with a numba field; it has no events, so it serves end states only."""
    from CyRK import pysolve_ivp

    if task.angle is not None:
        raise NotImplementedError("no events")
    rate = _numba_field(task)

    def run(tolerance: float) -> Any:
        answers = []
        for start in task.starts.T:
            found = pysolve_ivp(
                rate, (0.0, task.t1), start.copy(), method="DOP853", rtol=tolerance, atol=0.1 * tolerance * task.scales
            )
            answers.append(found.y[2:5, -1])
        return np.array(answers)

    return run


#: Name -> (package, how to make it, how many launches it can bear in a benchmark).
PEERS = {
    "heyoka scalar": ("heyoka", heyoka_scalar, 64),
    "heyoka batch": ("heyoka", heyoka_batch, 64),
    "SciPy DOP853, numba": ("numba", scipy_with("DOP853", True), 2),
    "SciPy LSODA, numba": ("numba", scipy_with("LSODA", True), 2),
    "SciPy DOP853, NumPy": ("scipy", scipy_with("DOP853", False), 1),
    "CVODE Adams, numba": ("sksundae", cvode, 2),
    "CyRK DOP853, numba": ("CyRK", cyrk, 4),
}
