"""Pseudo-arclength continuation of periodic orbits: that of a fixed point of the return map while a number changes.

The unknowns are the free components of the state and the number, each in units of its scale. A point of the branch is
predicted along the tangent, and corrected by Newton's method in the hyperplane across the tangent, with the exact Jacobian of
the return map by the state and the number. One compiled program serves all points, also of orbits of several returns. Source:
Keller, Numerical solution of bifurcation and nonlinear eigenvalue problems, 1977; Kuznetsov, Elements of Applied Bifurcation
Theory, ch. 10.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..compilation.xla_cpu import compiled_for_one
from ..integration.problem import TIGHTEST

#: Kinds of special points, in the order of the first entries of `Point.tests`.
KINDS = FOLD, DOUBLING, TORUS, CROSSING = "fold", "period doubling", "Neimark-Sacker", "branch point"
GRAZING, REGULAR = "grazing", "regular"

#: Why there is no orbit, by `Orbit.reason`, or why a branch ends, from the number of resets on; {start} and {run} name the run.
REASONS = (
    "",
    "the run{start} ends, or does not cross the section again within t1{t1}{at_rest}",
    "the return{start} ends in another mode than the first",
    "a return{start} still misses it by {residual:.2g}{hint}",
    "the state is an equilibrium{at_rest}",
    "the run{start} ends before the period",
    "the integration{run} fails",
    "a reset{run} is grazing, and the return map has no derivative",
    "a reset falls on the end of the period; shift the phase of the drive",
    "the drive does not repeat after the period; pass period=, that of the drive, in s",
    "a number is illegal",
    "the number of resets in a period changes, so a margin touches zero",
    "Newton's method does not converge, even with the smallest steps",
)
ILLEGAL, CHANGES, DIVERGES = 10, 11, 12


class NoPoint(Exception):
    """There is no point of a branch, or no further one; `reason`: why, as the place in `REASONS`."""

    def __init__(self, reason: int):
        super().__init__(REASONS[reason].format(start="", run="", t1="", at_rest=""))
        self.reason = reason


#: The largest step as a part of the range of the number; the smallest, as a part of the largest.
STEPS, SMALLEST = 50, 1e-9

#: The most Newton steps for a point, the number at which the length of a step stays, and the residual at which they have
#: converged, in units of the tolerance.
MOST_NEWTON, USUAL, CONVERGED = 8, 4, 0.3

#: The last step of Newton's method for an orbit is finer than the tolerance by this factor, and all of a branch.
FINER = 100.0

#: The smallest cosine of the angle between the tangents at neighbouring points.
STRAIGHT = 0.9

#: Test functions nearer to zero than this have no sign.
NO_SIGN = 1e-9

#: Singular values of the Jacobian by the unknowns below this, as a part of the largest, belong to a family of orbits.
RANK = 1e-7

OF_A_FAMILY = (
    "the orbit is one of a family, for a fixed number; pass free= to periodic_orbit, so that it is the only one"
)

#: Singular values below this, as a part of the largest, are round-off.
ROUND_OFF = 1e-10

#: Orbits whose periods and states differ by less than this are the same, as are returns after two periods and a double one.
SAME_ORBIT = 1e-6

#: A state this near the section, in units of the time of a return, is moved onto it.
NEAR = 0.05

#: The distances from a branch at which another branch is looked for, in units of the scale of the state; and how near to 1 a
#: multiplier of a doubled orbit is near its beginning.
ASIDE, NEARLY_ONE = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4), 0.5


class Returns(NamedTuple):
    """Several returns as one map, from a `start` that was moved onto the section.

    - `time` [s], `state`: of the last return; `by`, `time_by`: their derivatives by the start and, last, the number.
    - `in_motion`, `reason`, `resets`: as for `Return`.
    """

    start: Array
    time: Array
    state: Array
    by: Array
    time_by: Array
    in_motion: Array
    reason: Array
    resets: Array


@compiled_for_one
def several_returns(
    search: Any, leaves: tuple[Array, ...], others: tuple[int, ...], numbers: tuple[Array, ...]
) -> Returns:
    """Some returns from a state.

    **Arguments:** `others`: the leaves that are the number; `numbers`: the state; the derivative of the horizon by the number;
    the time [s] before the section or beyond, at less than which a state is moved onto it; the tolerance; and the number of
    returns.
    """
    state, rate, near, tolerance, count = numbers

    def following(k: Array, old: Returns) -> Returns:
        moved, shift, falls = search.on_section(leaves, 1, old.state[:, None])
        state = jnp.where(falls[0] & (jnp.abs(shift[0]) < near), moved[:, 0], old.state)
        left = jnp.where(old.reason > 0, 0.0, leaves[search.horizon])
        new = search.returned(search.with_start(leaves, state[:, None]), 1, others, tolerance, left)
        by_number = sum((part[0] for part in new.by_numbers), jnp.zeros_like(state))
        delay = sum((part[0] for part in new.time_by_numbers), jnp.zeros(()))
        if search.is_driven:
            by_number, delay = by_number + rate * new.rate[:, 0], rate
        return Returns(
            jnp.where(k == 0, state, old.start),
            old.time + new.time[0],
            new.state[:, 0],
            (new.by_state[0] @ old.by).at[:, -1].add(by_number),
            (old.time_by + new.time_by_state[0] @ old.by).at[-1].add(delay),
            new.in_motion[0],
            jnp.where(old.reason > 0, old.reason, new.reason[0]),
            old.resets + new.resets[0],
        )

    zero, whole, size = jnp.zeros(()), jnp.zeros((), int), len(state)
    slopes = (jnp.eye(size, size + 1), jnp.zeros(size + 1))
    return jax.lax.fori_loop(0, count, following, Returns(state, zero, state, *slopes, whole > 0, whole, whole))


#: The returns from a point, the derivative of the residual by the unknowns, and the unknowns, moved onto the section.
Linear: TypeAlias = tuple[Returns, np.ndarray, np.ndarray]


class Point(NamedTuple):
    """A point of a branch.

    - `unknowns`: the free components of the state and the number, in units of their scales; `matrix`: the derivative of the
      residual by them, and `tangent`: of the branch.
    - `orbit`: the orbit, of NumPy arrays; `value`: the number; `jacobian`: of the return map.
    - `tests`: functions that change their signs at the `KINDS`, at the last value of the number and at the first.
    - `resets`: number of resets in a period.
    """

    unknowns: np.ndarray
    matrix: np.ndarray
    tangent: np.ndarray
    orbit: Any
    value: float
    jacobian: np.ndarray
    tests: np.ndarray
    resets: int


class Continuation(NamedTuple):
    """The continuation of an orbit.

    - `orbit`: a single orbit; `others`: the leaves that are the number; `period`: as for `Orbit.branch`.
    - `first`, `last`: values of the number; `scale`: of the state; `returns`: number of returns in a period; `in_motion`:
      whether they are not at a reset.
    """

    orbit: Any
    others: tuple[int, ...]
    period: Callable[[Array], Array] | None
    first: float
    last: float
    scale: float
    returns: int
    in_motion: bool = True

    @property
    def units(self) -> np.ndarray:
        """The units of the unknowns."""
        return np.array([self.scale] * len(self.orbit.search.free) + [self.last - self.first])

    @property
    def begin(self) -> np.ndarray:
        """The unknowns at the orbit."""
        return np.append(np.array(self.orbit.state)[list(self.orbit.search.free)], self.first) / self.units

    def repeats(self) -> bool:
        """Whether a drive repeats after its period at the last value of the number: unless two periods from the orbit lead
        elsewhere than one of twice the length."""
        unknowns = np.append(self.begin[:-1], self.last / (self.last - self.first))
        once, twice = self.evaluated(unknowns, 2), self._replace(returns=2 * self.returns).evaluated(unknowns)
        distance, growth = np.abs(once.state - twice.state).max(), max(1.0, np.abs(twice.by[:, :-1]).max())
        same = SAME_ORBIT * growth * max(self.scale, np.abs(twice.state).max())
        return bool(once.reason or twice.reason or distance <= same)

    def evaluated(self, unknowns: np.ndarray, periods: int = 1) -> Returns:
        """The returns from a state, for a value of the number. **Arguments:** `periods`: of the drive, in a return."""
        search, (*moved, value) = self.orbit.search, unknowns * self.units
        leaves, rate = [np.asarray(leaf) for leaf in self.orbit.leaves], 0.0
        for k in self.others:
            leaves[k] = np.asarray(value)
        if self.period is not None:
            horizon, slope = jax.jvp(self.period, (jnp.asarray(value),), (jnp.ones(()),))
            leaves[search.horizon], rate = np.asarray(horizon), float(slope)
        leaves[search.horizon] = leaves[search.horizon] * float(periods)
        state, tolerance = np.array(self.orbit.state), max(float(leaves[-1]) / FINER, TIGHTEST)
        state[list(search.free)] = moved
        near = NEAR * float(self.orbit.period) / self.orbit.returns * self.in_motion
        numbers = tuple(map(np.asarray, (state, rate, near, tolerance, self.returns)))
        return jax.tree.map(np.asarray, several_returns(search, tuple(leaves), self.others, numbers))

    def linearized(self, unknowns: np.ndarray) -> Linear:
        """The returns, the derivative of the residual by the unknowns, and the unknowns at the start that was moved; raises
        `NoPoint` if a return fails."""
        new, free = self.evaluated(unknowns), list(self.orbit.search.free)
        matrix = (np.eye(len(new.by), len(new.by) + 1) - new.by)[:, [*free, -1]] * (self.units / self.scale)
        if new.reason > 0 or not np.isfinite(matrix).all():
            raise NoPoint(int(new.reason) or DIVERGES)
        return new, matrix, np.append(new.start[free] / self.scale, unknowns[-1])

    def corrected(self, guess: np.ndarray, tangent: np.ndarray) -> Point:
        """The point of the branch in the hyperplane through a guess across the tangent; raises `NoPoint` if there is none."""
        unknowns, tolerance = guess, float(self.orbit.leaves[-1])
        for iteration in range(1, MOST_NEWTON + 1):
            linear = new, matrix, unknowns = self.linearized(unknowns)
            miss, rows = (new.state - new.start) / self.scale, np.vstack([matrix, tangent])
            change = np.linalg.lstsq(rows, np.append(miss, tangent @ (guess - unknowns)), rcond=ROUND_OFF)[0]
            unknowns = unknowns + change
            size = max(1.0, float(np.abs(new.by[:, :-1]).max()))
            if max(np.abs(miss).max() / size, np.abs(change).max() * tolerance**0.5) <= CONVERGED * tolerance:
                along = np.linalg.svd(matrix)[2][-1]
                along = along if along @ tangent >= 0.0 else -along
                return self.point(linear, along, change, iteration)
        raise NoPoint(DIVERGES)

    def point(self, linear: Linear, tangent: np.ndarray, change: np.ndarray, steps: int) -> Point:
        """The point after the last step of Newton's method, the `change` of the unknowns from where it was linearized."""
        new, matrix, begin = linear
        unknowns = begin + change
        search, (*moved, value) = self.orbit.search, unknowns * self.units
        free, jacobian, span = list(search.free), np.asarray(new.by)[:, :-1], self.last - self.first
        state, last_step = np.array(new.start), np.zeros(len(new.start) + 1)
        state[free], last_step[[*free, -1]] = moved, change * self.units
        period = new.time + new.time_by @ last_step
        values = np.linalg.eigvals(jacobian).astype(complex)
        values = values[np.argsort(-np.abs(values), kind="stable")]
        pairs = (values[:, None] * values)[np.triu_indices(len(values), 1)]
        # The multipliers of conservative motions come in pairs whose product is 1.
        rotation = 1.0 if self.orbit.family else np.prod(pairs - 1.0).real
        rows = np.vstack([matrix, tangent])
        crossing = np.linalg.det(rows) if rows.shape[0] == rows.shape[1] else 1.0
        bounds = ((value - self.last) / span, (value - self.first) / span)
        tests = np.array([tangent[-1], np.prod(values + 1.0).real, rotation, crossing, *bounds])
        multipliers = values[: len(values) - (not search.is_driven)]
        error = max(5.0 * float(np.abs(change).max()), 1e-14) * self.scale
        numbers = {search.horizon: period / self.returns} if search.is_driven else {}
        numbers |= dict.fromkeys(self.others, float(value)) | dict(zip(search.starts, state, strict=True))
        orbit = dataclasses.replace(
            self.orbit,
            period=period,
            state=state,
            multipliers=multipliers,
            error=error,
            residual=error,
            iterations=steps,
            leaves=tuple(numbers.get(k, leaf) for k, leaf in enumerate(self.orbit.leaves)),
            returns=self.returns,
        )
        return Point(unknowns, matrix, tangent, orbit, float(value), jacobian, tests, int(new.resets))

    def between(self, old: Point, new: Point, distance: float) -> Point:
        """The point that cubic interpolation gives: near a branch point, Newton's method may converge to the other branch."""
        length = float(old.tangent @ (new.unknowns - old.unknowns))
        slope, chord = new.tangent / (new.tangent @ old.tangent), (new.unknowns - old.unknowns) / length
        bend, twist = 3.0 * chord - 2.0 * old.tangent - slope, old.tangent + slope - 2.0 * chord
        part = distance / length
        tangent = old.tangent + 2.0 * part * bend + 3.0 * part**2 * twist
        unknowns = old.unknowns + distance * (old.tangent + part * bend + part**2 * twist)
        return self.point(self.linearized(unknowns), tangent / np.linalg.norm(tangent), np.zeros_like(unknowns), 0)

    def located(self, old: Point, new: Point, length: float, test: int) -> tuple[float, Point]:
        """Where a test function vanishes between two points: the distance from the first, and the point."""
        from scipy.optimize import brentq

        points = {0.0: old, length: new}

        def value(distance: float) -> float:
            if distance not in points:
                is_crossing = test == KINDS.index(CROSSING)
                guess = old.unknowns + distance * old.tangent
                points[distance] = (
                    self.between(old, new, distance) if is_crossing else self.corrected(guess, old.tangent)
                )
            return float(points[distance].tests[test])

        if abs(new.tests[test]) <= NO_SIGN:
            return length, new
        root: float = brentq(value, 0.0, length, xtol=1e-13)  # type: ignore[assignment]
        value(root)
        return root, points[root]

    def specials(self, old: Point, new: Point, length: float) -> list[tuple[float, int, Point]]:
        """The zeros of the test functions between two points, in order; raises `NoPoint` if one cannot be located."""
        zeros = []
        for test, (before, after) in enumerate(zip(old.tests, new.tests, strict=True)):
            if abs(before) <= NO_SIGN or (abs(after) > NO_SIGN and before * after > 0.0):
                continue
            try:
                distance, point = self.located(old, new, length, test)
            except NoPoint:
                raise NoPoint(DIVERGES) from None
            # Two real multipliers whose product is 1 are no Neimark-Sacker point.
            if test != KINDS.index(TORUS) or is_rotating(point.orbit.multipliers):
                zeros.append((distance, test, point))
        return sorted(zeros, key=lambda zero: zero[:2])

    def followed(self, step: float, count: int) -> "tuple[list[Point], list[str], str]":
        """The points of the branch, their kinds, and why it ends. **Arguments:** `step`: largest, as a part of the range of the
        number; `count`: number of points."""
        begin = self.begin
        singular = np.linalg.svd(self.linearized(begin)[1], compute_uv=False)
        if singular[len(begin) - 2] <= RANK * max(1.0, singular[0]):
            raise ValueError(OF_A_FAMILY)
        try:
            points = [self.corrected(begin, np.eye(len(begin))[-1])]
        except NoPoint as error:
            raise ValueError(f"the orbit: there is no branch from {self.first:.10g}: {error}") from None
        kinds, length, is_free = [REGULAR], 0.25 * step, True
        while len(points) < count:
            old = points[-1]
            try:
                new = self.corrected(old.unknowns + length * old.tangent, old.tangent)
                if new.resets != old.resets:
                    raise NoPoint(CHANGES)
                if new.tangent @ old.tangent < STRAIGHT:
                    raise NoPoint(DIVERGES)
                zeros = self.specials(old, new, length)
            except NoPoint as error:
                length, is_free = 0.5 * length, False
                if length < SMALLEST * step:
                    kinds[-1] = GRAZING if error.reason in (7, CHANGES) else kinds[-1]
                    return points, kinds, str(error)
                continue
            for _, test, point in zeros:
                if test >= len(KINDS):
                    word = "the end of the range" if test == len(KINDS) else "its first value again"
                    return [*points, point], [*kinds, REGULAR], f"the number reaches {word}"
                points, kinds = [*points, point], [*kinds, KINDS[test]]
            if points[-1] is not new:
                points, kinds = [*points, new], [*kinds, REGULAR]
            steps = new.orbit.iterations
            factor = 1.5 if is_free and steps < USUAL else 1.0 if steps <= USUAL else 0.5
            length, is_free = min(factor * length, step), True
        return points, kinds, f"there are {count} points; pass points= for more"


def is_rotating(multipliers: np.ndarray) -> bool:
    """Whether the pair of multipliers whose product is nearest to 1 is complex."""
    rows, columns = np.triu_indices(len(multipliers), 1)
    nearest = np.argmin(np.abs(multipliers[rows] * multipliers[columns] - 1.0))
    return bool(np.imag(multipliers[rows[nearest]]) != 0.0)
