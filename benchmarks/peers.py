"""Other programs on the same scenes: each takes a task and a tolerance and returns how every launch ended.

Programs that are not installed are named and skipped. The benchmark installs none of them.
"""

import math
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from fields import Functions

#: Index of the axis' component along the normal in a top's state.
E3 = 4

#: The functions of a field on numbers.
NUMPY = Functions(np.sqrt)


class Task(NamedTuple):
    """The task: the time at which theta reaches an angle (`angle`), or `t1` (`angle` None), and the state there.

    `field` and `numbers` are those of `fields.py`; `starts` and `scales`, the magnitudes of the components, are
    (components, launches); `compared` are the indices of the compared components of the end state.
    """

    field: Callable[..., Any]
    numbers: Any
    starts: Any
    scales: Any
    t1: float
    angle: float | None
    compared: slice

    @property
    def launches(self) -> int:
        return self.starts.shape[1]

    def of(self, indices: Any) -> "Task":
        """The same for some of the launches."""
        return self._replace(starts=self.starts[:, indices], scales=self.scales[:, indices])


class Ends(NamedTuple):
    """The time at which every launch ended [s], at its angle or at `t1`, and the compared components of its state
    there."""

    time: Any
    state: Any

    @classmethod
    def from_pairs(cls, task: Task, ends: Any) -> "Ends":
        """From a pair of time and state for each launch."""
        times, states = zip(*ends, strict=True)
        return cls(np.array(times), np.array(states)[:, task.compared])

    def of(self, indices: Any) -> "Ends":
        """The same for some of the launches."""
        return Ends(self.time[indices], self.state[indices])


def available(name: str) -> bool:
    """Whether a package can be imported."""
    return find_spec(name) is not None


def heyoka_scalar(task: Task) -> Callable[[float], Any]:
    """heyoka, one launch after the other, with a terminal event."""
    import heyoka

    system, variables = _heyoka_system(heyoka, task)
    integrators = {}

    def run(tolerance: float) -> Any:
        if tolerance not in integrators:
            events = []
            if task.angle is not None:
                falling = heyoka.event_direction.negative
                events = [heyoka.t_event(variables[E3] - math.cos(task.angle), direction=falling)]
            integrators[tolerance] = heyoka.taylor_adaptive(
                system, [1.0] * len(variables), tol=tolerance, t_events=events
            )
        integrator, answers = integrators[tolerance], []
        for start in task.starts.T:
            if task.angle is not None:
                integrator.reset_cooldowns()
            integrator.time, integrator.state[:] = 0.0, start
            integrator.propagate_until(task.t1)
            answers.append((integrator.time, integrator.state.copy()))
        return Ends.from_pairs(task, answers)

    return run


def heyoka_batch(task: Task) -> Callable[[float], Any]:
    """heyoka's SIMD batches: events are not terminal there, so a batch runs in pieces until its last lane has ended."""
    import heyoka

    system, variables = _heyoka_system(heyoka, task)
    # On Intel's processors, heyoka recommends half of the width of AVX-512, and is a third slower with it.
    has_512_bits = Path("/proc/cpuinfo").exists() and "avx512f" in Path("/proc/cpuinfo").read_text()
    width = 8 if has_512_bits else heyoka.recommended_simd_size()
    # The callback stores the values outside, not in the integrator's copy.
    integrators, ends = {}, {}

    def record_event(integrator, time, sign, lane):
        if lane not in ends:
            integrator.update_d_output(np.full(width, time))
            ends[lane] = (time, integrator.d_output[:, lane].copy())

    def run(tolerance: float) -> Any:
        if tolerance not in integrators:
            events = []
            if task.angle is not None:
                falling = heyoka.event_direction.negative
                events = [heyoka.nt_event_batch(variables[E3] - math.cos(task.angle), record_event, direction=falling)]
            ones = np.ones((len(variables), width))
            options = {"tol": tolerance, "nt_events": events, "force_avx512": has_512_bits}
            integrators[tolerance] = heyoka.taylor_adaptive_batch(system, ones, **options)
        integrator, answers = integrators[tolerance], []
        for first in range(0, task.launches, width):
            lanes = np.minimum(np.arange(first, first + width), task.launches - 1)
            ends.clear()
            integrator.set_time(0.0)
            integrator.state[:] = task.starts[:, lanes]
            end = task.t1 if task.angle is None else 0.0
            while task.angle is not None and len(ends) < width and end < task.t1:
                end += 0.25
                integrator.propagate_until(end)
            if task.angle is None:
                integrator.propagate_until(end)
            answers += [ends.get(lane, (end, integrator.state[:, lane].copy())) for lane in range(width)]
        return Ends.from_pairs(task, answers[: task.launches])

    return run


def _heyoka_system(heyoka: Any, task: Task) -> tuple[Any, Any]:
    variables = heyoka.make_vars(*(f"y{i}" for i in range(len(task.starts))))
    rates = task.field(variables, task.numbers, Functions(heyoka.sqrt))
    return [(variable, rate + 0.0 * variable) for variable, rate in zip(variables, rates, strict=True)], variables


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
            for start, scales in zip(task.starts.T, task.scales.T, strict=True):
                solution = solve_ivp(
                    rate,
                    (0.0, task.t1),
                    start,
                    method=method,
                    rtol=tolerance,
                    atol=0.1 * tolerance * scales,
                    events=None if task.angle is None else reached,
                )
                answers.append((solution.t[-1], solution.y[:, -1]))
            return Ends.from_pairs(task, answers)

        return run

    return make


def _python_field(task: Task) -> Callable[..., Any]:
    return lambda t, y: np.array(task.field(y, task.numbers, NUMPY))


def _numba_field(task: Task) -> Callable[..., Any]:
    import numba

    field, numbers = numba.njit(task.field), task.numbers

    functions = Functions(numba.njit(lambda value: np.sqrt(value)))

    @numba.njit
    def rate(t, y):
        return np.array(field(y, numbers, functions))

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
        options = {"method": "Adams", "rtol": tolerance, "max_num_steps": 10**7}
        if task.angle is not None:
            options |= {"eventsfn": reached, "num_events": 1}
        answers = []
        for start, scales in zip(task.starts.T, task.scales.T, strict=True):
            solver = CVODE(right_side, atol=0.1 * tolerance * scales, **options)
            solution = solver.solve(np.array([0.0, task.t1]), start)
            answers.append((solution.t[-1], solution.y[-1]))
        return Ends.from_pairs(task, answers)

    return run


def cyrk(task: Task) -> Callable[[float], Any]:
    """CyRK's DOP853 with a numba field; it has no events, so it is used for end states only."""
    from CyRK import pysolve_ivp

    if task.angle is not None:
        raise NotImplementedError("no events")
    rate = _numba_field(task)

    def run(tolerance: float) -> Any:
        answers = []
        for start, scales in zip(task.starts.T, task.scales.T, strict=True):
            solution = pysolve_ivp(
                rate, (0.0, task.t1), start.copy(), method="DOP853", rtol=tolerance, atol=0.1 * tolerance * scales
            )
            answers.append((task.t1, solution.y[:, -1]))
        return Ends.from_pairs(task, answers)

    return run


def vmapped_diffrax(task: Task) -> Callable[[float], Any]:
    """Diffrax's Dopri8 under `vmap`, with an event that Newton's method locates on its interpolant."""
    import diffrax
    import jax
    import jax.numpy as jnp
    import optimistix

    functions = Functions(jnp.sqrt)
    term = diffrax.ODETerm(lambda t, y, args: jnp.stack(task.field(y, task.numbers, functions)))
    event = None
    if task.angle is not None:
        cosine = math.cos(task.angle)
        newton = optimistix.Newton(1e-13, 1e-13)
        event = diffrax.Event(lambda t, y, args, **_: y[E3] - cosine, newton, direction=False)

    def solve_single(start, scales, tolerance):
        control = diffrax.PIDController(tolerance, 0.1 * tolerance * scales)
        solution = diffrax.diffeqsolve(
            term,
            diffrax.Dopri8(),
            0.0,
            task.t1,
            None,
            start,
            stepsize_controller=control,
            event=event,
            max_steps=100_000,
            throw=False,
        )
        return solution.ts[0], solution.ys[0]

    batched = jax.jit(jax.vmap(solve_single, (1, 1, None)))
    starts, scales = jnp.asarray(task.starts), jnp.asarray(task.scales)

    def run(tolerance: float) -> Any:
        times, states = batched(starts, scales, tolerance)
        return Ends(np.asarray(times), np.asarray(states)[:, task.compared])

    return run


#: Name -> (packages, constructor, greatest number of launches in a benchmark).
PEERS = {
    "heyoka scalar": (("heyoka",), heyoka_scalar, 64),
    "heyoka batch": (("heyoka",), heyoka_batch, 64),
    "SciPy DOP853, numba": (("scipy", "numba"), scipy_with("DOP853", True), 2),
    "SciPy LSODA, numba": (("scipy", "numba"), scipy_with("LSODA", True), 2),
    "SciPy DOP853, NumPy": (("scipy",), scipy_with("DOP853", False), 1),
    "SciPy LSODA, NumPy": (("scipy",), scipy_with("LSODA", False), 1),
    "CVODE Adams, numba": (("sksundae", "numba"), cvode, 2),
    "CyRK DOP853, numba": (("CyRK", "numba"), cyrk, 4),
    "vmapped Diffrax Dopri8": (("diffrax",), vmapped_diffrax, 1024),
}
