"""Runs of several modes against a closed form: balls that fall, rebound and come to rest."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

from nonholonomic.hybrid import (
    BETWEEN,
    AbstractBatchedMode,
    AbstractHoppingMode,
    Transition,
    TransitionPath,
    solve_hybrid,
    solve_hybrid_dense,
    solve_hybrid_with_samples,
)
from nonholonomic.integration import AbstractProblem, Settings
from nonholonomic.integration.problem import CROSSED, REACHED_END, RUNNING, UNRESOLVED

GRAVITY, CLOSING = 9.81, 1e-3

CELLS, PADDING = 40, 8

FALLING, RESTING = range(2)

SETTINGS = Settings(1e-10)


class Motion(AbstractProblem):
    """Height [m], velocity [m/s] and number of bounces under an acceleration [m/s^2]; the guard is the height, if any."""

    state: jnp.ndarray
    acceleration: jnp.ndarray
    falls: bool

    def start(self):
        return self.state, jnp.ones_like(self.state)

    def field(self, time, state):
        return jnp.stack([state[1], self.acceleration + 0.0 * state[1], 0.0 * state[2]])

    def event_function(self, state):
        return None

    def domain_margin(self, time, state):
        return state[0] if self.falls else 1.0 + 0.0 * state[0]


class Fall(AbstractBatchedMode):
    """Down to the ground; then up again in closed form, to rest, or to the end at the last bounce."""

    restitution: jnp.ndarray
    bounces: jnp.ndarray

    def problem(self, state):
        return Motion(state, jnp.asarray(-GRAVITY), True)

    def reset_map(self, state, left):
        height, velocity, count = state
        speed = jnp.sqrt(velocity**2 + 2.0 * GRAVITY * height)
        # The ground is found to round-off of a step; the rest of the way, of either sign, is known.
        overrun = (speed + velocity) / GRAVITY
        rebound, count = self.restitution * speed, count + 1.0
        last, at_rest = count >= self.bounces, rebound < CLOSING
        rise = jnp.where(last | at_rest, 0.0, jnp.minimum(rebound / GRAVITY, left - overrun))
        end = self.between((overrun, rebound, count), overrun + rise)
        end = jnp.where(at_rest & ~last, end * jnp.array([[0.0], [0.0], [1.0]]), end)
        cut = rise < rebound / GRAVITY
        return Transition(
            mode=jnp.where(at_rest, RESTING, FALLING),
            state=end,
            elapsed=overrun + rise,
            status=jnp.where(last, CROSSED, jnp.where(cut & ~at_rest, REACHED_END, RUNNING)),
            crossing_time=jnp.where(last, overrun, jnp.inf),
            counts=jnp.ones((1, *count.shape), int),
            record=TransitionPath(
                (overrun + rise)[None], (overrun[None], rebound[None], count[None]), jnp.full((1, *count.shape), 3)
            ),
        )

    def between(self, motion, elapsed):
        overrun, rebound, count = motion
        time = elapsed - overrun
        height = rebound * time - 0.5 * GRAVITY * time**2
        return jnp.stack([height, rebound - GRAVITY * time, count + 0.0 * time])


class Rest(AbstractBatchedMode):
    """On the ground."""

    def problem(self, state):
        return Motion(state, jnp.asarray(0.0), False)

    def reset_map(self, state, left):
        """Nothing ends it."""
        none = jnp.zeros(left.shape, int)
        return Transition(none, state, 0.0 * left, none, jnp.full_like(left, jnp.nan), none[None])


class Ball(NamedTuple):
    """The closed form: dropped from a height [m]."""

    height: float
    restitution: float

    @property
    def speed(self) -> float:
        return float(np.sqrt(2.0 * GRAVITY * self.height))

    @property
    def rests_after(self) -> int:
        """How many bounces it takes until the rebound is slower than `CLOSING`."""
        return int(np.ceil(np.log(CLOSING / self.speed) / np.log(self.restitution)))

    def bounce(self, number: int) -> float:
        """When it strikes the ground for the n-th time [s]."""
        return self.speed / GRAVITY * (1.0 + 2.0 * sum(self.restitution**k for k in range(1, number)))

    def state(self, time: float) -> list[float]:
        """Height, velocity and number of bounces."""
        count = sum(self.bounce(number) < time for number in range(1, self.rests_after + 1))
        if count == self.rests_after:
            return [0.0, 0.0, count]
        rebound, elapsed = self.speed * self.restitution**count, time - (self.bounce(count) if count else 0.0)
        if count == 0:
            return [self.height - 0.5 * GRAVITY * time**2, -GRAVITY * time, 0.0]
        return [rebound * elapsed - 0.5 * GRAVITY * elapsed**2, rebound - GRAVITY * elapsed, count]


HEIGHTS = np.linspace(0.3, 2.0, CELLS)
RESTITUTIONS = np.linspace(0.9, 0.2, CELLS)
BALLS = [Ball(height, restitution) for height, restitution in zip(HEIGHTS, RESTITUTIONS, strict=True)]


def padded(values):
    return np.concatenate([values, np.full(PADDING, values[-1])])


def table(t1, bounces, most_rounds=200):
    heights = padded(HEIGHTS)
    modes = (Fall(jnp.asarray(padded(RESTITUTIONS)), jnp.asarray(padded(bounces), float)), Rest())
    state = np.stack([heights, 0.0 * heights, 0.0 * heights])
    start = np.full(CELLS + PADDING, FALLING)
    return solve_hybrid(modes, start, state, t1, CELLS, SETTINGS, counters=1, most_rounds=most_rounds)


def test_a_rare_mode_is_compiled_when_a_run_enters_it():
    """A run of no cells compiles the other modes only, and the results are those of modes that are not rare."""
    traced = []

    class RareRest(Rest):
        @property
        def rare(self):
            return True

        def problem(self, state):
            traced.append(state.shape)
            return super().problem(state)

    modes = (Fall(jnp.asarray(padded(RESTITUTIONS)), jnp.full(CELLS + PADDING, np.inf)), RareRest())
    heights, start = padded(HEIGHTS), np.full(CELLS + PADDING, FALLING)
    state = np.stack([heights, 0.0 * heights, 0.0 * heights])
    solve_hybrid(modes, start, state, 20.0, 0, SETTINGS, counters=1)
    assert not traced
    runs = solve_hybrid(modes, start, state, 20.0, CELLS, SETTINGS, counters=1)
    assert traced
    np.testing.assert_array_equal(runs.state, table(20.0, np.full(CELLS, np.inf)).state)


def single(ball, t1, bounces=np.inf):
    modes = (Fall(jnp.array([ball.restitution]), jnp.array([float(bounces)])), Rest())
    return solve_hybrid_dense(modes, FALLING, jnp.array([ball.height, 0.0, 0.0]), t1, SETTINGS, counters=1)


def test_the_times_of_bounces_of_many_balls():
    """Each ends at a bounce of its own, the first to the fourth, before it would come to rest."""
    bounces = 1 + np.arange(CELLS) % 4
    outcome = table(50.0, bounces)
    times = [ball.bounce(number) for ball, number in zip(BALLS, bounces, strict=True)]
    assert (outcome.status[:CELLS] == CROSSED).all()
    assert_close(outcome.end_time[:CELLS], times, rtol=2e-14)
    assert_close(outcome.crossing_time[:CELLS], times, rtol=2e-14)
    assert_close(outcome.state[0, :CELLS], 0.0, atol=1e-14)
    speeds = [ball.speed * ball.restitution**number for ball, number in zip(BALLS, bounces, strict=True)]
    assert_close(outcome.state[1, :CELLS], speeds, rtol=2e-14)
    assert outcome.counts[0, :CELLS].tolist() == outcome.state[2, :CELLS].tolist() == bounces.tolist()


@pytest.mark.parametrize("t1", [0.2, 0.9, 1.7, 30.0])
def test_the_states_of_many_balls_at_a_horizon(t1):
    """Falling, rising or at rest after up to 80 bounces, each cell in a mode of its own."""
    outcome = table(t1, np.full(CELLS, np.inf))
    expected = np.array([ball.state(t1) for ball in BALLS]).T
    assert (outcome.status == REACHED_END).all()
    assert (outcome.end_time[:CELLS] == t1).all()
    assert_close(outcome.state[:, :CELLS], expected, atol=2e-13)
    assert outcome.counts[0, :CELLS].tolist() == expected[2].tolist()
    at_rest = [ball.rests_after == count for ball, count in zip(BALLS, expected[2], strict=True)]
    assert (outcome.mode[:CELLS] == np.where(at_rest, RESTING, FALLING)).all()
    assert all(at_rest) == (t1 == 30.0)


def test_a_single_ball_at_any_time():
    ball = BALLS[20]
    path = single(ball, 4.0)
    ends = [piece.end for piece in path.mode_segments]
    assert_close(ends[:-1], [ball.bounce(number) for number in range(1, ball.rests_after + 1)], rtol=1e-14)
    assert path.counts.tolist() == [ball.rests_after]
    assert path.status == REACHED_END
    assert path.end_time == path.times[-1] == 4.0
    assert np.all(np.diff(path.times) > 0.0)
    times = np.linspace(0.0, 4.0, 1001)
    expected = np.array([ball.state(time) for time in times]).T
    # The dense output of a fall has the round-off of its polynomial.
    assert_close(path.at(times), expected, atol=5e-13)
    is_rising = path.numbers(times) == BETWEEN
    assert_close(path.at(times[is_rising]), expected[:, is_rising], atol=1e-13)
    assert set(path.numbers(times)) == {FALLING, RESTING, BETWEEN}
    assert path.at(np.zeros(0)).shape == (3, 0)


def sampled(kind, times, tangents=()):
    """All balls at the given times: (shown, times, balls) and the mode; and what `solve_hybrid_with_samples` returns."""
    heights = padded(HEIGHTS)
    modes = (kind(jnp.asarray(padded(RESTITUTIONS)), jnp.full(CELLS + PADDING, jnp.inf)), Rest())
    state, first = np.stack([heights, 0.0 * heights, 0.0 * heights]), np.full(CELLS + PADDING, FALLING)
    options = (modes, first, state, jnp.asarray(times), 4.0, CELLS, SETTINGS)
    samples, slopes = solve_hybrid_with_samples(*options, counters=1, tangents=tangents)
    return np.transpose(samples.states[:CELLS], (2, 1, 0)), samples, slopes


class Hop(NamedTuple):
    """A flight of a ball from the ground to the ground or to the horizon."""

    speed: jnp.ndarray
    count: jnp.ndarray
    elapsed: jnp.ndarray
    passed: jnp.ndarray
    open: jnp.ndarray


class Bounces(Fall, AbstractHoppingMode):
    """All bounces in closed form."""

    most_hops = 100

    def lost(self, state):
        height, velocity, count = state
        speed = jnp.sqrt(velocity**2 + 2.0 * GRAVITY * height)
        rebound, overrun = self.restitution * speed, (speed + velocity) / GRAVITY
        return Hop(rebound, count + 1.0, overrun, 0.0 * count, rebound >= CLOSING)

    def hop(self, stretch, left):
        whole = 2.0 * stretch.speed / GRAVITY
        passed = jnp.minimum(whole, left - stretch.elapsed)
        end = stretch._replace(elapsed=stretch.elapsed + passed, passed=passed)
        rebound, lands = self.restitution * stretch.speed, passed == whole
        after = (rebound, stretch.count + 1.0, end.elapsed, 0.0 * passed, lands & (rebound >= CLOSING))
        following = Hop(*(jnp.where(lands, a, b) for a, b in zip(after, (*end[:4], False), strict=True)))
        return end, Hop(*(jnp.where(stretch.open, a, b) for a, b in zip(following, stretch, strict=True)))

    def motion_in(self, stretch):
        return 0.0 * stretch.elapsed, stretch.speed, stretch.count

    def closed(self, stretch):
        rests = stretch.speed < CLOSING
        state = self.between(self.motion_in(stretch), stretch.passed) * jnp.stack([~rests, ~rests, rests | True])
        return Transition(
            jnp.where(rests, RESTING, FALLING),
            state,
            stretch.elapsed,
            jnp.where(rests, RUNNING, REACHED_END),
            jnp.full_like(stretch.speed, jnp.inf),
            stretch.count.astype(int)[None],
        )


@pytest.mark.parametrize("kind", [Fall, Bounces])
def test_many_balls_at_given_times(kind):
    """Falling, on recorded or unrecorded ways between two modes, and at rest."""
    times = np.linspace(0.0, 4.0, 60)
    rows, samples, _ = sampled(kind, times)
    expected = np.array([[ball.state(time) for time in times] for ball in BALLS]).T
    assert_close(rows, expected, atol=2e-12)
    numbers = np.asarray(samples.number[:CELLS])
    assert set(numbers.ravel()) == {FALLING, RESTING, BETWEEN}
    assert np.all(numbers[:, 0] == FALLING)


@pytest.mark.parametrize("kind", [Fall, pytest.param(Bounces, marks=pytest.mark.slow)])
def test_many_balls_at_times_of_their_own(kind):
    times = np.linspace(0.0, 4.0, 60)
    own_times = times[:, None] * np.linspace(0.5, 1.0, CELLS + PADDING)
    own_rows, _, _ = sampled(kind, own_times)
    expected = np.array([[ball.state(time) for time in own_times[:, k]] for k, ball in enumerate(BALLS)])
    assert_close(own_rows, np.moveaxis(expected, (0, 1, 2), (2, 1, 0)), atol=2e-12)


@pytest.mark.parametrize("kind", [pytest.param(Fall, marks=pytest.mark.slow), Bounces])
def test_the_slopes_of_many_balls_at_given_times(kind):
    """By the restitution, between and after bounces: the closed form's differences."""
    times = np.array([0.5, 1.0, 1.5])
    unit = jnp.asarray(padded(np.ones(CELLS)))
    tangents = (((kind(unit, jnp.zeros(CELLS + PADDING)), Rest()), None),)
    _, _, (slopes,) = sampled(kind, times, tangents)
    changes = [
        [
            [Ball(ball.height, ball.restitution + change).state(time)[row] for change in (-1e-6, 1e-6)]
            for row in range(2)
        ]
        for ball in BALLS
        for time in times
    ]
    expected = (np.diff(changes, axis=-1)[..., 0] / 2e-6).reshape(CELLS, 3, 2)
    away = np.array(
        [[min(abs(ball.bounce(k) - time) for k in range(1, 60)) > 1e-4 for time in times] for ball in BALLS]
    )
    assert away.mean() > 0.9
    computed = np.asarray(slopes.states[:CELLS, :, :2])
    assert_close(computed[away], expected[away], rtol=1e-4, atol=1e-5)


def test_a_single_ball_ends_as_it_does_in_a_table():
    bounces = np.full(CELLS, 3)
    outcome = table(1.2, bounces)
    assert set(outcome.status) == {CROSSED, REACHED_END}
    for number in (0, 20, 39):
        path = single(BALLS[number], 1.2, 3)
        assert path.status == outcome.status[number]
        assert_close(path.end_time, outcome.end_time[number], rtol=1e-14)
        assert_close(path.state, outcome.state[:, number], atol=1e-13)
        assert path.counts.tolist() == [outcome.counts[0, number]]


def test_what_needs_too_many_rounds_is_given_up():
    outcome = table(30.0, np.full(CELLS, np.inf), most_rounds=10)
    # One round for each fall, and one at rest.
    gives_up = [ball.rests_after + 1 > 10 for ball in BALLS]
    assert (outcome.status[:CELLS] == np.where(gives_up, UNRESOLVED, REACHED_END)).all()
    assert 0 < sum(gives_up) < CELLS
