"""Periodic orbits: fixed points of the return map, by Newton's method with its exact Jacobian.

The return map leads from a state to the state at the next crossing of a section, or after a given period. Its derivatives pass
through the resets (`hybrid/saltation.py`). Newton's method goes on at a hundredth of the tolerance in its last step, which
bounds the error. The derivatives of an orbit follow from the implicit function theorem: (1 - J) dy = dP.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..compilation.tracing import named_errors, with_own_numbers
from ..derivatives import differentiable_solve, tangent_scale, tangents_by
from ..derivatives.variation import delay
from ..geometry.vector import nearest_turn
from ..hybrid import solve_hybrid
from ..hybrid.saltation import VariationalMode, along, with_variations
from ..integration.problem import CROSSED, FAILED, REACHED_END, TIGHTEST, UNRESOLVED, Settings
from ..parameters import Parameters, as_one
from ..terminal import status_line
from ..text import described, shown
from ..validation import as_number, explaining, is_traced, require_outside
from .branch import Orbit
from .continuation import FINER, ILLEGAL, NEAR, RANK, REASONS, SAME_ORBIT
from .crossings import SAME, on_margin, require_section, section_of
from .event import Event, EventTime, modes_of
from .model import AbstractModel, AbstractSceneModel, Start, check_run, model_of, settings_for_lanes

#: The most Newton steps; the residual at which they have converged, in units of the tolerance.
MOST_NEWTON, CONVERGED = 30, 30.0

#: The longest Newton step, in units of the size of the guess or of its orbit.
LEASH = 0.5

#: Relative steps of a number for the differences that give the derivatives of multipliers, and their weights.
STENCIL, STENCIL_STEP = ((1.0, 8.0), (-1.0, -8.0), (2.0, -1.0), (-2.0, 1.0)), 1e-3

#: Ratio of the error bound to the last Newton step.
SAFETY = 5.0

#: How much of the slope of a section may lie along shifts, as a part of it.
UNSHIFTED = 1e-6

#: The number of parts of an orbit.
PARTS = 9


class Return(NamedTuple):
    """A return.

    - `time` [s], `state`: when and where, (cells,) and (components, cells); `rate`: of the state there.
    - `by_state`, `time_by_state`: derivatives by the start, (cells, components, components) and (cells, components);
      `by_numbers`, `time_by_numbers`: those by each other number, (cells, components) and (cells,).
    - `in_motion`: whether it is not at a reset; `reason`: as for `Orbit`, where there is no return; `resets`: their number.
    """

    time: Array
    state: Array
    rate: Array
    by_state: Array
    time_by_state: Array
    by_numbers: list[Array]
    time_by_numbers: list[Array]
    in_motion: Array
    reason: Array
    resets: Array


class Newton(NamedTuple):
    """The state of Newton's iteration, and its last return.

    - `count`: number of returns so far; `state`: (components, cells); `stage`: 1 after all cells have converged, 2 after a step
      at the finer tolerance, 3 after the check of the drive; `reason`: as for `Orbit`, where the search has been given up;
      `iterations`.
    - `in_motion`, `time`, `by_state`: of the last return; `inverse`: of 1 - J.
    - `residual`, `step`: by how much the last return missed, and the length of the last step.
    """

    count: Array
    state: Array
    stage: Array
    reason: Array
    iterations: Array
    in_motion: Array
    time: Array
    by_state: Array
    inverse: Array
    residual: Array
    step: Array


class OrbitSolve(EventTime):
    """Periodic orbits of cells. The leaves are those of an `EventTime`, in which the horizon, or the period, can move.

    - `starts`: the leaves that are components of the start.
    - `is_driven`: whether the period is given; `free`: the components that may change.
    - `with_multipliers`: whether the derivatives of the multipliers are computed.
    """

    starts: tuple[int, ...] = eqx.field(static=True)
    is_driven: bool = eqx.field(static=True)
    free: tuple[int, ...] = eqx.field(static=True)
    with_multipliers: bool = eqx.field(static=True, default=True)

    @classmethod
    def of_model(
        cls, model: AbstractModel, t1: Array, settings: Settings, is_driven: bool, free: tuple[int, ...]
    ) -> tuple[Any, ...]:
        """The solve and its leaves. **Arguments:** as for `EventTime.of`, and fields."""
        timed, *leaves = EventTime.of(model, t1, settings, False)
        of_start = {id(number) for number in model.reduced_start}
        starts = tuple(k for k, leaf in enumerate(leaves) if id(leaf) in of_start)
        fields = vars(timed) | {"movable": timed.movable + 1}
        return (cls(**fields, starts=starts, is_driven=is_driven, free=free), *leaves)

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        # A user's classes may not be pickled, but the numbers of an orbit can.
        return type(None), ()

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.zeros(jnp.shape(value), bool)

    def for_parts(self, wanted: tuple[int, ...]) -> "OrbitSolve":
        # The real and the imaginary parts of the multipliers.
        return dataclasses.replace(self, with_multipliers=any(k % PARTS in (2, 3) for k in wanted if k >= PARTS))

    def with_start(self, leaves: Sequence[Array], state: Float[Array, "components cells"]) -> tuple[Array, ...]:
        """The leaves with other starts."""
        moved = list(leaves)
        for k, component in zip(self.starts, state, strict=True):
            moved[k] = component
        return tuple(moved)

    def components(self, leaves: Sequence[Array], rows: Array, mode: Array, mapped: bool = True) -> Array:
        """States of the engine in the components of a start, (components, cells), by default mapped by the symmetry."""
        model = self.model(leaves)
        state = model.reduced(rows, mode)
        if model.symmetry is not None and mapped:
            form, values = model.symmetry.form, model.symmetry.values
            axes = tuple(0 if jnp.ndim(value) else None for value in values)
            symmetric = jax.vmap(lambda state, *values: form.tree(values)["symmetry"](state), (-1, *axes), -1)
            state = symmetric(state, *values)
        near = zip(model.reduced_names, state, model.reduced_start, strict=True)
        return jnp.stack([nearest_turn(part, start) if name in model.angles else part for name, part, start in near])

    def at_section(self, mode: VariationalMode, state: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """By how much runs in a mode end before the section [s], and the states at the section, with their variations."""
        primal, *variations = mode.parts(state)
        numbers, build = mode.active_numbers()

        def moved(primal: Array, begin: Array, *numbers: Array) -> tuple[Array, Array]:
            problem, zero = build(*numbers).problem(primal), jnp.zeros_like(begin)
            rates = problem.field(zero, primal)
            if self.is_driven:
                # If the mode begins later, the state has advanced less.
                return zero, primal - begin * rates
            value, rate = jax.lax.stop_gradient(jax.jvp(problem.event_function, (primal,), (rates,)))
            shift = -value / jnp.where(rate == 0.0, jnp.inf, rate) + delay(problem.event_function, primal, rates)
            return begin + shift, primal + shift * rates

        point = (primal[:-1], jnp.zeros_like(primal[-1]), *numbers)
        directions = mode.directions([part[:-1] for part in variations], [part[-1] for part in variations])
        return along(moved, point, directions)

    def returned(
        self, leaves: tuple[Array, ...], cells: int, others: tuple[int, ...], tolerance: Array, left: Array
    ) -> Return:
        """The next return of every cell.

        **Arguments:** `others`: the leaves of the model, apart from the start, along which to differentiate; `left`: horizon
        [s], 0 for cells that are not run.
        """
        active, settings = (*self.starts, *others), self.settings.with_tolerance(tolerance)

        def build(leaves: tuple[Array, ...], cells: int | None) -> Start:
            assert cells is not None
            model = self.model(leaves)
            return modes_of(model, cells, tolerance, model.comparable)

        (modes, first, states), tangents, gather = tangents_by(build, active, leaves, cells)
        pairs = tuple((of_modes, of_states) for of_modes, _, of_states in tangents)
        modes, start = with_variations(modes, states, pairs, tolerance, not self.is_driven)
        size = len(states)
        options = {"counters": 1 + max(1, len(self.model(leaves).counters)), "n_blocks": 1 + len(pairs), "traced": True}
        ended = solve_hybrid(modes, first, start, left, cells, settings, **options)
        rows = jnp.reshape(ended.state, (1 + len(pairs), size + 1, cells))
        # A run that has ended at a reset which jumps over the zero is in no mode.
        point, slopes, mode = rows[0, :size], rows[1:], ended.mode % len(modes)
        rate, in_motion, at_edge = jnp.zeros_like(point), jnp.zeros(cells, bool), jnp.zeros(cells, bool)
        for number, of_mode in enumerate(modes):
            is_here, primal = ended.mode == number, of_mode.parts(ended.state)[0]
            (_, moved), (delays, changes) = self.at_section(of_mode, ended.state)
            problem = of_mode.mode.problem(primal[:-1])
            own_mode: Any = of_mode.mode
            # A run that ends in a reset map has no time in a mode.
            in_mode = jnp.where(primal[-1] > 0.0, primal[-1], ended.end_time)
            at_reset = is_here & on_margin(problem, in_mode, moved)
            at_edge |= at_reset | (is_here & (primal[-1] <= SAME * ended.end_time))
            if getattr(own_mode, "margins", 0) and not self.is_driven:
                through, *by = (dataclasses.replace(part, continues=True) for part in (own_mode, *of_mode.tangents))
                continued = dataclasses.replace(of_mode, mode=through, tangents=tuple(by))
                transition = continued.reset_map(ended.state.at[:size].set(moved), jnp.full(cells, jnp.inf))
                after = jnp.reshape(transition.state, rows.shape)
                point, slopes = jnp.where(at_reset, after[0, :size], point), jnp.where(at_reset, after[1:], slopes)
                mode, is_here = jnp.where(at_reset, transition.mode, mode), is_here & ~at_reset
            in_motion |= is_here
            point = jnp.where(is_here, moved, point)
            rate = jnp.where(is_here, problem.field(jnp.zeros(cells), primal[:-1]), rate)
            slopes = jnp.where(is_here, jnp.concatenate([changes, delays[:, None]], axis=1), slopes)
        slopes = jnp.where(ended.counts[-1] > 0, jnp.nan, slopes)
        gathered = gather([(slope[-1], jnp.moveaxis(slope[:size], -1, 0)) for slope in slopes])
        changes = [by[1].T for by in gathered]
        point, changes, rate = self._in_components(leaves, active, [point, mode], changes, rate)
        count, delays = len(self.starts), [by[0] for by in gathered]
        wanted, missing = (REACHED_END, 5) if self.is_driven else (CROSSED, 1)
        has_failed = (ended.status == FAILED) | (ended.status == UNRESOLVED)
        faults = [has_failed, ended.status != wanted, at_edge & self.is_driven, ended.counts[-1] > 0]
        reason = jnp.select([*faults, mode != first], [6, missing, 8, 7, 2], 0)
        by_state, time_by_state = (jnp.stack(parts[:count], axis=-1) for parts in (changes, delays))
        time = ended.end_time if self.is_driven else ended.crossing_time
        by_numbers = (changes[count:], delays[count:])
        resets = jnp.sum(ended.counts[:-1], axis=0)
        return Return(time, point, rate, by_state, time_by_state, *by_numbers, in_motion, reason, resets)

    def _in_components(
        self, leaves: tuple[Array, ...], active: tuple[int, ...], ended: list[Array], changes: list[Array], rate: Array
    ) -> tuple[Array, list[Array], Array]:
        """The state of a return in components, its derivative by each active leaf, (cells, components), and its rate.
        **Arguments:** `ended`: the state and the mode of the engine."""

        def read(point: Array, *moving: Array) -> Array:
            values = list(leaves)
            for k, leaf in zip(active, moving, strict=True):
                values[k] = leaf
            return self.components(values, point, ended[1])

        moving = [jnp.broadcast_to(leaves[k], rate.shape[1:]) for k in active]
        still = [jnp.zeros_like(leaf) for leaf in moving]
        state, push = jax.linearize(read, ended[0], *moving)
        units = [[*still[:k], jnp.ones_like(leaf), *still[k + 1 :]] for k, leaf in enumerate(moving)]
        slopes = [push(change, *unit).T for change, unit in zip(changes, units, strict=True)]
        return state, slopes, push(rate, *still)

    def on_section(self, leaves: tuple[Array, ...], cells: int, state: Array) -> tuple[Array, Array, Array]:
        """States moved along the motion onto a section nearby, by how much [s], and whether the event function falls there.
        Where the function rises, the states stay."""
        total, falls = jnp.zeros(cells), jnp.zeros(cells, bool)
        # With a component that is not free, a start must be on the section.
        model = self.model(leaves)
        has_section = not self.is_driven and model.symmetry is None and len(self.free) == len(self.starts)
        for _ in range(3 * has_section):
            moved = self.with_start(leaves, state)
            modes, first, states = modes_of(self.model(moved), cells, jnp.min(leaves[-1]), model.comparable)
            for number, mode in enumerate(modes):
                problem = mode.problem(states)
                rates = problem.field(jnp.zeros(cells), states)
                value, rate = jax.jvp(problem.event_function, (states,), (rates,))
                is_here = first == number
                falls = jnp.where(is_here, rate < 0.0, falls)
                shift = jnp.where(is_here & falls, -value / jnp.where(rate < 0.0, rate, -1.0), 0.0)
                states, total = states + shift * rates, total + shift
            state = self.components(moved, states, first, mapped=False)
        return state, total, falls

    def newton(self, cells: int, leaves: tuple[Array, ...], repeats: bool = True) -> Newton:
        """Newton's iteration of all cells, from the starts. **Arguments:** `repeats`: whether a drive should repeat."""
        is_legal, t1, settings = self.permitted(leaves)
        tolerance = settings.tolerance
        finer = jnp.maximum(tolerance / FINER, TIGHTEST)
        size, free = len(self.starts), jnp.asarray(self.free)
        start = jnp.stack([jnp.broadcast_to(leaves[k], (cells,)) for k in self.starts])
        is_timed = self.is_driven and self.model(leaves).depends_on_time
        # A symmetry may map a drive to that of the next period.
        is_checked = repeats and is_timed and self.model(leaves).symmetry is None

        def step(old: Newton) -> Newton:
            is_bad, state = old.reason > 0, old.state
            tolerance_now = jnp.where(old.stage > 0, finer, tolerance)
            moved, shift, falls = self.on_section(leaves, cells, state)
            is_near = falls & (jnp.abs(shift) < NEAR * old.time)
            state = jnp.where(old.in_motion & is_near & ~is_bad, moved, state)
            verifies = old.stage == 2
            left = jnp.where(is_bad, 0.0, jnp.where(verifies, 2.0 * t1, t1))
            new = self.returned(self.with_start(leaves, state), cells, (), tolerance_now, left)
            miss = new.state - state
            matrix = (jnp.eye(size) - new.by_state)[:, :, free]
            is_sound = jnp.isfinite(matrix).all(axis=(1, 2)) & jnp.isfinite(miss).all(axis=0)
            left_vectors, values, right_vectors = jnp.linalg.svd(
                jnp.where(is_sound[:, None, None], matrix, jnp.eye(size)[:, free]), full_matrices=False
            )
            is_own = is_regular(values)
            factors = jnp.where(is_own, 1.0 / jnp.where(is_own, values, 1.0), 0.0)
            inverse = jnp.einsum("ckf,ck,cnk->cfn", right_vectors, factors, left_vectors)
            change = jnp.zeros_like(state).at[free].set(jnp.einsum("cfn,nc->fc", inverse, miss))
            # A guess is moved onto the section, unless the section is at a reset or a component is not free.
            settles = (old.count == 0) & new.in_motion & (not self.is_driven) & (len(self.free) == size)
            settled = jnp.where(falls & (jnp.abs(shift) < NEAR * new.time), moved, new.state)
            # The size of the orbit: its state, or the radius of a circle with its speed and period.
            extent = jnp.max(jnp.abs(new.rate), axis=0) * new.time
            own, *sizes, residual, length = (
                jnp.max(jnp.abs(part), axis=0) for part in (start, state, new.state, miss, change)
            )
            # Near a fold, Newton's step leads many turns away.
            longest = LEASH * jnp.maximum(own, extent / (2.0 * math.pi))
            change = jnp.where(length > longest, longest / length, 1.0) * change
            scale = jnp.maximum(jnp.maximum(*sizes), extent / (2.0 * math.pi))
            converged = residual <= CONVERGED * tolerance * scale
            converged &= ~settles & (length <= jnp.sqrt(tolerance) * scale)
            rests = extent <= CONVERGED * tolerance * jnp.maximum(scale, own)
            rests &= new.in_motion & ~settles & (not is_timed)
            misses = ~is_sound | (~converged & (old.count >= MOST_NEWTON))
            reason = jnp.select([is_bad, new.reason > 0, rests, misses], [old.reason, new.reason, 4, 3], 0)
            following = jnp.where(settles, settled, state + change)
            # An orbit also returns after two periods, unless the drive has another one.
            growth = jnp.maximum(1.0, jnp.max(jnp.abs(new.by_state), axis=(1, 2)))
            is_same = (new.reason == 0) & (residual <= (SAME_ORBIT + CONVERGED * tolerance) * scale * growth)
            checked = old._replace(stage=old.stage + 1, reason=jnp.where(is_bad | is_same, old.reason, 9))
            corrected = Newton(
                old.count + 1,
                jnp.where(reason > 0, state, following),
                jnp.where(old.stage == 1, 2, jnp.all(converged | (reason > 0)).astype(int)),
                reason,
                old.iterations + (reason == 0),
                new.in_motion,
                new.time + jnp.einsum("cn,nc->c", new.time_by_state, change),
                new.by_state,
                inverse,
                jnp.where(is_bad, old.residual, residual),
                length,
            )
            return jax.tree.map(lambda old, new: jnp.where(verifies, old, new), checked, corrected)

        zeros, whole, none = jnp.zeros(cells), jnp.zeros(cells, int), jnp.zeros((), int)
        reason = jnp.where(is_legal, whole, ILLEGAL)
        matrices = (jnp.zeros((cells, size, size)), jnp.zeros((cells, len(self.free), size)))
        of_last = (jnp.zeros(cells, bool), zeros, *matrices, zeros, zeros)
        begin = Newton(none, start, none, reason, whole, *of_last)
        return jax.lax.while_loop(lambda newton: newton.stage < 2 + is_checked, step, begin)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> tuple[Array, ...]:
        return self.parts_of(self.newton(cells, leaves))

    def parts_of(self, newton: Newton) -> tuple[Array, ...]:
        """The parts of the primal."""
        values = jnp.linalg.eigvals(newton.by_state)
        order = jnp.argsort(-jnp.abs(values), axis=-1)
        values = jnp.take_along_axis(values, order, axis=-1)[:, : len(self.starts) - (not self.is_driven)]
        bound = jnp.maximum(SAFETY * newton.step, 1e-14 * jnp.max(jnp.abs(newton.state), axis=0))
        singular = jnp.linalg.svd(jnp.eye(len(self.starts)) - newton.by_state, compute_uv=False)
        counts = (jnp.sum(~is_regular(singular), axis=1), newton.iterations, newton.reason)
        orbit = (newton.time, newton.state.T, values.real, values.imag, bound)
        orbit = [jnp.where(newton.reason.reshape(-1, *[1] * (part.ndim - 1)) > 0, jnp.nan, part) for part in orbit]
        return (*orbit, newton.residual, *(count.astype(float) for count in counts))

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[tuple[Array, ...], list[Any]]:
        if nested:
            raise ValueError("second derivatives of periodic orbits are not available; take differences of a gradient")
        newton, size, free = self.newton(cells, leaves), len(self.starts), jnp.asarray(self.free)
        others = tuple(k for k in active if k != self.horizon and k not in self.starts)
        at_orbit = self.with_start(leaves, newton.state)
        t1 = jnp.where(newton.reason > 0, 0.0, leaves[self.horizon])
        finer = jnp.maximum(jnp.min(leaves[-1]) / FINER, TIGHTEST)
        last = self.returned(at_orbit, cells, others, finer, t1)
        by_numbers = dict(zip(others, zip(last.by_numbers, last.time_by_numbers, strict=True), strict=True))
        zeros, changes, matrix = jnp.zeros((cells, size)), {}, jnp.eye(size) - newton.by_state
        is_family = jnp.trace(newton.inverse @ matrix[:, :, free], axis1=1, axis2=2) < len(self.free) - 0.5
        start = jnp.stack([jnp.broadcast_to(leaves[k], (cells,)) for k in self.starts])
        distance, extent = (jnp.max(jnp.abs(part), axis=0) for part in (newton.state - start, newton.state))
        is_vague = is_family & (distance > SAME_ORBIT * extent)
        for k in active:
            fixed, (by, delay) = zeros, by_numbers.get(k, (zeros, jnp.zeros(cells)))
            if k == self.horizon and self.is_driven:
                by, delay = last.rate.T, jnp.ones(cells)
            elif k in self.starts:
                # The start is moved onto the section, and to the nearest orbit of a family.
                place = self.starts.index(k)
                unit = zeros.T.at[place].set(1.0)
                _, moved = jax.jvp(lambda state: self.on_section(leaves, cells, state)[0], (newton.state,), (unit,))
                moved = jnp.where(newton.in_motion, moved, unit).T
                fixed = jnp.where(is_family[:, None] | (place not in self.free), moved, 0.0)
            push = by - jnp.einsum("cij,cj->ci", matrix, fixed)
            change = fixed.at[:, free].add(jnp.einsum("cfn,cn->cf", newton.inverse, push))
            # There is no derivative if no orbit follows the number.
            back = jnp.einsum("cij,cj->ci", matrix, change)
            sizes = jnp.max(jnp.abs(by) + jnp.abs(change), axis=1) + extent / tangent_scale(leaves[k])
            is_lost = is_vague | (jnp.max(jnp.abs(by - back), axis=1) > SAME_ORBIT * sizes)
            change = jnp.where(is_lost[:, None], jnp.nan, change)
            changes[k] = (delay + jnp.einsum("cn,cn->c", last.time_by_state, change), change)
        values = self.parts_of(newton)
        multipliers = [(None, None)] * len(active)
        if self.with_multipliers:
            multipliers = self._multiplier_slopes(active, cells, at_orbit, values[2] + 1j * values[3], changes)
        slopes = [(*changes[k], *pair, *[None] * (PARTS - 4)) for k, pair in zip(active, multipliers, strict=True)]
        return values, slopes

    def _multiplier_slopes(
        self, active: tuple[int, ...], cells: int, leaves: tuple[Array, ...], values: Array, changes: dict[int, Any]
    ) -> list[tuple[Array, Array]]:
        """The derivatives of the multipliers by each active leaf, from orbits for neighbouring values of the leaf."""
        count, moved = len(STENCIL) * len(active), []
        for k, leaf in enumerate(leaves):
            blocks = jnp.broadcast_to(leaf, (len(active), len(STENCIL), cells))
            for row, number in enumerate(active):
                size = STENCIL_STEP * tangent_scale(leaves[number])
                by = changes[number][1][:, self.starts.index(k)] if k in self.starts else float(k == number)
                steps = [place * size * by for place, _ in STENCIL]
                blocks = blocks.at[row].add(jnp.stack([jnp.broadcast_to(step, (cells,)) for step in steps]))
            moved.append(blocks.reshape(-1))
        parts = self.parts_of(self.newton(count * cells, tuple(moved), repeats=False))
        near = (parts[2] + 1j * parts[3]).reshape(len(active), len(STENCIL), cells, -1)
        # The multipliers in the order of those of the orbit.
        places = jnp.argmin(jnp.abs(near[..., None, :] - values[:, :, None]), axis=-1)
        near = jnp.take_along_axis(near, places, axis=-1)
        weights = jnp.array([weight for _, weight in STENCIL])
        sizes = jnp.stack([jnp.broadcast_to(STENCIL_STEP * tangent_scale(leaves[k]), (cells,)) for k in active])
        slopes = jnp.einsum("s,rscm->rcm", weights, near) / (12.0 * sizes[:, :, None])
        return [(slope.real, slope.imag) for slope in slopes]


def is_regular(values: Float[Array, "cells values"]) -> Bool[Array, "cells values"]:
    """Which singular values of 1 - J, the largest first, belong to no family."""
    return values > RANK * jnp.maximum(1.0, 1e-2 * values[:, :1])


def depth(part: Any) -> int:
    """The number of axes of a start, which may consist of lists with traced numbers; 2 for several launches."""
    part = jax.tree.leaves(part)[:1] if isinstance(part, eqx.Module) else part
    return 1 + max(map(depth, part), default=0) if isinstance(part, list | tuple) else np.ndim(part)


def distinct_orbits(system: object, guesses: Any, event: Event, options: dict[str, Any]) -> list[Orbit]:
    """The distinct orbits that several guesses lead to, in the order of the guesses."""
    require_outside((system, guesses), "periodic_orbit of several guesses", "jax.vmap of periodic_orbit")
    guesses = guesses if isinstance(guesses, tuple | eqx.Module) else jnp.asarray(guesses, float)
    batch = jax.vmap(lambda guess: periodic_orbit(system, guess, event, **options))(jax.tree.map(as_number, guesses))
    orbits: list[Orbit] = []
    for k in np.flatnonzero(np.asarray(batch.reason) == 0):
        orbit = jax.tree.map(lambda part, k=k: part[k], batch)
        values = np.append(orbit.state, orbit.period)
        others = [np.append(other.state, other.period) for other in orbits]
        if not any(np.allclose(values, other, SAME_ORBIT, SAME_ORBIT) for other in others):
            orbits.append(orbit)
    return orbits


def require_unshifted(model: AbstractSceneModel) -> None:
    """Raise `ValueError` if the event function of a section differs between starts with the same reduced state."""
    numbers = [name for name in model.known if name.startswith("launch")]

    @jax.jit
    def slopes(*point: Array) -> tuple[Array, Array]:
        def at_start(*point: Array) -> tuple[Array, Array]:
            moved = model.replaced(dict(zip(numbers, point, strict=True)))
            modes, first, states = modes_of(moved, 1, jnp.asarray(1e-9), model.comparable)
            values = jnp.stack([jnp.asarray(mode.problem(states).event_function(states)) for mode in modes])
            return moved.reduced(states, first)[:, 0], values[first[0], 0]

        by_state, by_value = jax.jacfwd(at_start, tuple(range(len(point))))(*point)
        return jnp.stack(by_state, axis=-1), jnp.stack(by_value)

    # Aside of the start, at which the motion may be at rest or symmetric.
    near = (jnp.asarray(model.value(name), float) + 0.02 * (1 + k) for k, name in enumerate(numbers))
    by_state, by_value = map(np.asarray, slopes(*near))
    left = by_value - by_state.T @ np.linalg.lstsq(by_state.T, by_value)[0]
    if np.linalg.norm(left) > UNSHIFTED * np.linalg.norm(by_value):
        raise ValueError(
            "event: the section tells apart motions that the scene allows to shift, such as by their place or direction, so "
            f"that they do not return to it; use a function of {', '.join(model.reduced_names)} and of what follows from them"
        )


@explaining
@status_line("looking for a periodic orbit")
def periodic_orbit(
    system: object,
    start: object,
    event: Event = None,
    *,
    period: Float[ArrayLike, ""] | None = None,
    free: Sequence[str] | None = None,
    symmetry: Callable[[Array], Array] | None = None,
    direction: str = "fall",
    t1: float = 1000.0,
    tolerance: float = 1e-10,
    solver: diffrax.AbstractERK | None = None,
    input: object = None,
    jumps: object = None,
) -> Any:
    """A periodic orbit, by Newton's method on the return map; works under `jit`, `vmap`, `grad` and `jvp`.

    The return map leads from a state to the state at the next crossing of a section, where an event function falls through
    zero, or after a given period. If the section is at a reset, the state is that after the reset. The map's Jacobian is exact,
    also through resets. The derivatives of the period, the state and the multipliers with respect to every parameter use the
    implicit function theorem; those of the multipliers are differences of exact derivatives at neighbouring orbits, with errors
    of about 1000 times the tolerance.

    The orbit of a scene repeats up to the shifts that the scene allows: of place and direction on a level plane, along a
    cylinder, and around a surface of revolution. Its `state` has the other numbers of a launch: of a stroller, such as `speed`;
    of a top, such as `theta` and `angular_velocity_n`, where t1 is along the lean of the axis on a level plane, and the spin is
    a part of the angular velocity. The section of a scene must not tell apart shifted motions, and the axis of a top must
    lean there. A top that precesses steadily is at rest up to a shift, and no orbit; `tippe.steady` has these motions.

    A step of Newton's method is at most as long as half the size of the guess or of its orbit; the text of an `Orbit` says how
    far it is away from the guess. If a quantity is conserved or the motion can be shifted, orbits form families, and Newton's
    method takes the shortest step, to an orbit of the family near the guess. Derivatives, also by the start, are then those at
    a start on an orbit, such as the `state` of an `Orbit`, and NaN for other starts.

    **Arguments:**

    - `system`, `input`, `jumps`: as for `event_time`; tops run on planes, cylinders and spheres, bodies of any shape on level
      planes, and both with `contact="stop"`.
    - `start`: a guess of a state on the orbit, near the section, in the first mode, or a launch. Several guesses have the shape
      (guesses, components), or twice (guesses, coordinates) for an `AbstractSystem`, or are a list of launches.
    - `event`, `direction`: the section, as for `crossings`; by default the event of the `Hybrid`. A scene needs an `event`.
    - `period`: the period [s] of a driven system, in place of a section. The drive begins at time 0, and repeats after it.
      The orbit may also repeat after a part of this period.
    - `free`: names of the components that Newton's method changes, such as `["y0"]`; by default all. The others must be
      those of an orbit: a guess that is off the section is moved onto it only if all are free.
    - `symmetry`: function of the state at a return that maps it to the start of the next period, for orbits that repeat up to a
      shift or a reflection.
    - `t1`: longest time [s] until a return.
    - `tolerance`: relative tolerance of the integration; that of the last step is a hundredth of it.
    - `solver`: as for `event_time`.

    **Returns:** an `Orbit`; for several guesses a list of the distinct orbits, without the guesses that led to none. Inside a
    transformation, numbers are NaN and `reason` is positive if there is no orbit.

    **Raises:** `ValueError` if Newton's method finds no orbit, with the reason; for arguments out of range, a section of a
    system whose functions depend on time, and second derivatives.

    **Example:** the limit cycle of van der Pol's oscillator.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Oscillator(nonholonomic.AbstractMode):
    ...     mu: float
    ...
    ...     def field(self, t, y):
    ...         return jnp.array([y[1], self.mu * (1.0 - y[0] ** 2) * y[1] - y[0]])
    >>> def section(t, y):
    ...     return y[1]
    >>> orbit = nonholonomic.periodic_orbit(nonholonomic.Hybrid([Oscillator(1.0)]), [2.0, 0.0], section)
    >>> print(f"{orbit.period:.8f} s, {orbit.state[0]:.8f}, {orbit.multipliers[0].real:.6f}, {orbit.stable}")
    6.66328686 s, 2.00861986, 0.000860, True

    ```
    """
    if period is not None and event is not None:
        raise ValueError("event and period: pass the section or the period of a drive, not both")
    # A tuple consists of coordinates and rates.
    first = start[0] if isinstance(start, list) and start else None
    start = as_one(start, "start", type(first)) if isinstance(first, eqx.Module) else start
    if all(depth(part) == 2 for part in start) if isinstance(start, tuple) else depth(start) == 2:
        options = {"free": free, "symmetry": symmetry, "direction": direction, "t1": t1, "tolerance": tolerance}
        options |= {"period": period, "solver": solver, "input": input, "jumps": jumps}
        return distinct_orbits(system, start, event, options)
    model: AbstractModel = model_of(system, start, section_of(event, direction, "after"), input, jumps)
    if period is not None:
        model = model.without_event()
    else:
        require_section(model, event)
        if model.depends_on_time:
            raise ValueError("event: the system depends on time; pass period=, that of the drive, in place of event=")
    horizon = t1 if period is None else period
    check_run(model, horizon, tolerance)
    model = model.normalised()
    if period is None and isinstance(model, AbstractSceneModel) and not is_traced(model):
        require_unshifted(model)
    names = model.reduced_names
    unknown = [name for name in free or () if name not in names]
    if unknown or (free is not None and (isinstance(free, str) or not len(free))):
        raise ValueError(f"free = {shown(free)} must be a list of some of {', '.join(names)}")
    if symmetry is not None:
        state = jnp.zeros(len(names))
        with named_errors("symmetry(y)", f"a state of {len(names)} components"):
            mapped = with_own_numbers(symmetry, state)
            shape = jax.eval_shape(mapped, state)
        if getattr(shape, "shape", None) != state.shape:
            raise ValueError(f"symmetry(y) must return a state of {len(names)} components, not {described(shape)}")
        model = dataclasses.replace(model, symmetry=Parameters.of({"symmetry": mapped}))
    places = tuple(k for k, name in enumerate(names) if free is None or name in free)
    settings = settings_for_lanes(tolerance, solver)
    search, *leaves = OrbitSolve.of_model(model, as_number(horizon), settings, period is not None, places)
    time, state, *parts = differentiable_solve(search, *leaves)
    real, imaginary, error, residual, *counts = parts
    family, iterations, reason = (jnp.asarray(count).astype(int) for count in counts)
    numbers, leaves = (time, state, real + 1j * imaginary, error, residual), tuple(map(jnp.asarray, leaves))
    orbit = Orbit(*numbers, family, iterations, reason, names, leaves, search)
    if not is_traced(reason) and np.ndim(reason) == 0 and int(reason):
        hint = "" if period is None or model.smooth else "; a reset near the end of the period has such an effect"
        if free is not None:
            hint = "; the components that are not free must be those of an orbit, on the section"
        run = {"start": " from there", "run": " of the run from there", "t1": f" = {t1:.6g} s"}
        why = REASONS[int(reason)].format(**run, residual=float(residual), hint=hint, at_rest=model.at_rest)
        raise ValueError(f"start: no periodic orbit was found: after {int(iterations)} Newton steps, {why}")
    return orbit
