"""Event times of users' own systems against closed forms, with their derivatives."""

import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from compilations import compilations
from never_run import LAUNCH, TOP
from own_modes import GRAVITY, Ball, Bounces, Sleigh, bounce

from nonholonomic import AbstractMode, Hybrid, event_time, simulate

START = jnp.array([1.0, 0.0, 0.0])


def fifth_bounce(height, restitution, gravity):
    """Time of the fifth bounce, which ends on a jump of the event function."""
    ball = Hybrid([Ball(restitution, gravity)], event=Bounces(5.0))
    return event_time(ball, jnp.stack([height, 0.0 * height, 0.0 * height]), 20.0)


def test_the_time_of_the_fifth_bounce_and_its_gradient():
    """sqrt(2 h / g) (1 + 2 (e + ... + e^4)), by height, restitution and gravity; a reset jumps over the event."""
    point = (jnp.asarray(1.0), jnp.asarray(0.8), jnp.asarray(GRAVITY))
    time, slopes = jax.jit(jax.value_and_grad(fifth_bounce, (0, 1, 2)))(*point)
    expected = jax.grad(lambda *numbers: bounce(*numbers, 5), (0, 1, 2))(*point)
    assert_close(time, bounce(*point, 5), rtol=1e-13)
    assert_close(jnp.stack(slopes), jnp.stack(expected), rtol=1e-12)


def test_a_batch_of_balls_is_one_block():
    heights = jnp.linspace(0.5, 2.0, 8)
    times = jax.jit(jax.vmap(fifth_bounce, (0, None, None)))(heights, 0.8, GRAVITY)
    assert_close(times, jax.vmap(lambda height: bounce(height, 0.8, GRAVITY, 5))(heights), rtol=1e-13)


class Linear(eqx.Module):
    """An event function that is a number plus multiples of height, velocity and time: one program serves all events."""

    numbers: jax.Array

    def __call__(self, t, y):
        return self.numbers[0] + self.numbers[1] * y[0] + self.numbers[2] * y[1] + self.numbers[3] * t


@pytest.mark.parametrize(
    ("numbers", "start", "expected"),
    [
        # The event is the end of the mode.
        ((0.0, 1.0, 0.0, 0.0), [1.0, 0.0, 0.0], bounce(1.0, 0.8, GRAVITY, 1)),
        # Starts on the event: the start does not count, and the ball rises first.
        ((0.0, 1.0, 0.0, 0.0), [0.0, 3.0, 0.0], 6.0 / GRAVITY),
        # Starts on the event and falls: the next fall through zero is the apex after the bounce.
        ((0.0, 0.0, 1.0, 0.0), [1.0, 0.0, 0.0], 1.8 * bounce(1.0, 0.8, GRAVITY, 1)),
        # Starts beyond the event, and crosses it downwards on the second fall.
        ((-0.5, 1.0, 0.0, 0.0), [0.4, 0.0, 0.0], jnp.inf),
        # Is zero at the start and stays zero, without a fall.
        ((0.0, 0.0, 0.0, 0.0), [1.0, 0.0, 0.0], jnp.inf),
        # A function of time alone.
        ((0.7, 0.0, 0.0, -1.0), [1.0, 0.0, 0.0], 0.7),
    ],
)
def test_the_event_is_the_first_fall_through_zero_after_the_start(numbers, start, expected):
    event = Linear(jnp.array(numbers))
    assert_close(event_time(Hybrid([Ball()], event=event), jnp.array(start), 2.0), expected, rtol=1e-12)


def test_an_event_may_close_over_what_is_differentiated():
    """The ball falls through a level after its second bounce; the level is that of an enclosing gradient."""

    def time(level):
        return event_time(Hybrid([Ball()]), START, 9.0, event=lambda t, y: jnp.where(y[2] > 1.5, y[0] - level, -1.0))

    def exact(level):
        speed = 0.64 * jnp.sqrt(2.0 * GRAVITY)
        return bounce(1.0, 0.8, GRAVITY, 2) + (speed + jnp.sqrt(speed**2 - 2.0 * GRAVITY * level)) / GRAVITY

    # The run starts beyond the event, and waits there until it has passed the level upwards.
    value, slope = jax.value_and_grad(time)(0.1)
    expected, expected_slope = jax.value_and_grad(exact)(0.1)
    assert_close(value, expected, rtol=1e-12)
    assert_close(slope, expected_slope, rtol=1e-12)
    # A new lambda for another level.
    assert compilations(jax.value_and_grad(time), 0.12) == 0


class Decay(AbstractMode):
    """y' = -rate y."""

    rate: jax.Array

    def field(self, t, y):
        return -self.rate * y


class Level(eqx.Module):
    """An event: the first component falls to a level."""

    level: float

    def __call__(self, t, y):
        return y[0] - self.level


def half_life(rate, level):
    return event_time(Hybrid([Decay(rate)], event=Level(level)), jnp.ones(1), 9.0)


def with_change(time):
    """A time with its derivatives by rate and level, and how they change with the rate."""
    return lambda *numbers: jax.jvp(jax.value_and_grad(time, (0, 1)), numbers, (1.0, 0.0))


def test_a_state_that_rests_on_its_event_has_none():
    assert np.isinf(half_life(jnp.asarray(0.0), 1.0))
    assert_close(half_life(jnp.asarray(2.0), 0.5), 0.5 * jnp.log(2.0), rtol=1e-12)


derivatives_of_half_life = jax.jit(with_change(half_life))


def test_a_new_but_equal_event_compiles_nothing_again():
    """An array in a compiled part of the event is a constant like any other: another one is another event."""

    def time(part):
        parts = np.array([0.0, part])
        event = jax.jit(lambda y: y[0] - parts[1] * jnp.asarray(parts)[1])
        return event_time(Hybrid([Decay(jnp.asarray(2.0))]), jnp.ones(1), 9.0, event=lambda t, y: event(y))

    assert_close(time(0.5), jnp.log(2.0), rtol=1e-12)
    assert compilations(time, 0.5) == 0
    assert_close(time(0.25), jnp.log(4.0), rtol=1e-10)


def test_what_functions_read_from_outside_may_change():
    """An element of a closure's array, an attribute of an object and of a class, and a default, read through a method."""
    levels, settings = np.array([0.5]), types.SimpleNamespace(share=1.0)

    class Slowed(AbstractMode):
        pace = 2.0

        def slowed(self, y, by=(1.0,)):
            return y * self.pace / by[0]

        def field(self, t, y):
            return -settings.share * self.slowed(y)

    def time(event=lambda t, y: y[0] - levels[0]):
        return event_time(Hybrid([Slowed()]), jnp.ones(1), 9.0, event)

    assert_close(time(), np.log(2.0) / 2.0, rtol=1e-10)
    levels[0] = 0.25
    assert_close(time(), np.log(4.0) / 2.0, rtol=1e-10)
    Slowed.pace = 4.0
    assert_close(time(), np.log(4.0) / 4.0, rtol=1e-10)
    Slowed.slowed.__defaults__ = ((0.5,),)
    assert_close(time(), np.log(4.0) / 8.0, rtol=1e-10)
    assert compilations(time) == 0
    settings.share = 0.5
    assert_close(time(), np.log(4.0) / 4.0, rtol=1e-10)


def test_other_numbers_of_a_start_or_a_tuple_compile_nothing_again():
    class Mixed(AbstractMode):
        rates: tuple[float, float]

        def field(self, t, y):
            return -(self.rates[0] + self.rates[1]) * y

    def end(start, rates):
        return simulate(Hybrid([Mixed(rates)]), start, 1.0, times=[1.0]).state[-1]

    assert_close(end([1.0], (1.0, 2.0)), np.exp(-3.0), rtol=1e-8)
    assert compilations(end, [2.0], (1.0, 2.0)) == 0
    assert compilations(end, [2.0], (1.5, 2.5)) == 0
    assert_close(end([2.0], (1.5, 2.5)), 2.0 * np.exp(-4.0), rtol=1e-8)


pace = 1.0


def test_a_name_of_an_attribute_is_no_number_from_outside(monkeypatch):
    """In a loop over `pace`, the number of the mode of the same name changes alone."""

    class Paced(AbstractMode):
        pace: float

        def field(self, t, y):
            return -self.pace * y

    def time(value):
        monkeypatch.setitem(globals(), "pace", value)
        return event_time(Hybrid([Paced(value)]), jnp.ones(1), 9.0, lambda t, y: y[0] - 0.5)

    assert_close(time(1.0), np.log(2.0), rtol=1e-10)
    assert compilations(time, 2.0) == 0


def test_a_smooth_system_has_second_derivatives():
    """t = ln(1 / level) / rate: first and second derivatives by both."""
    point = (jnp.asarray(2.0), jnp.asarray(0.5))

    def exact(rate, level):
        return -jnp.log(level) / rate

    (time, slopes), (_, curvatures) = derivatives_of_half_life(*point)
    (value, gradient), (_, expected) = jax.jit(with_change(exact))(*point)
    assert_close(time, value, rtol=1e-12)
    assert_close(jnp.stack(slopes), jnp.stack(gradient), rtol=1e-10)
    assert_close(jnp.stack(curvatures), jnp.stack(expected), rtol=1e-7)


def test_a_derivative_by_a_python_number_is_traced_once():
    calls = []

    class Counted(AbstractMode):
        rate: jax.Array

        def field(self, t, y):
            calls.append(t)
            return -self.rate * y

    slope = jax.grad(lambda rate: event_time(Hybrid([Counted(rate)]), jnp.ones(1), 9.0, lambda t, y: y[0] - 0.5))
    assert_close(slope(0.3), -np.log(2.0) / 0.3**2, rtol=1e-7)
    # The checks, the run and its derivative take 19; to trace the derivative again would take 9 more.
    assert len(calls) < 24


def test_no_event_is_infinite_and_has_no_derivative():
    (time, slopes), _ = derivatives_of_half_life(jnp.asarray(0.01), jnp.asarray(0.5))
    assert np.isinf(time)
    assert slopes[0] == 0.0


class Pull(AbstractMode):
    """A linear field with a matrix of numbers, through LAPACK: no kernel of its own can hold it."""

    matrix: jax.Array

    def field(self, t, y):
        return -jnp.linalg.solve(self.matrix, y)


def test_arrays_and_any_operation_of_jax_may_be_used():
    """y' = -A^-1 y with A = diag(a, b): y1 falls to 1/2 at a ln 2; by a matrix, whose other entries matter not here."""

    def time(matrix):
        return event_time(Hybrid([Pull(matrix)], event=Level(0.5)), jnp.array([1.0, 1.0]), 5.0)

    matrix = jnp.diag(jnp.array([0.5, 2.0]))
    value, slopes = jax.jit(jax.value_and_grad(time))(matrix)
    assert_close(value, 0.5 * jnp.log(2.0), rtol=1e-12)
    # With y' = -y1 / a + (A12 / (a b)) y2, A12 > 0 slows the fall; A21 acts on the second component alone.
    assert_close(slopes[0, 0], jnp.log(2.0), rtol=1e-9)
    assert_close(slopes[1], 0.0, atol=1e-12)


def sleigh_turn(speed):
    """When the sleigh has turned by half a radian."""
    start = (jnp.zeros(3), jnp.array([1.0, 0.0, 0.0]) * speed + jnp.array([0.0, 0.0, 1.3]))
    return event_time(Sleigh(), start, 4.0, event=lambda t, y: 0.5 - y[2])


@pytest.mark.slow
def test_a_sleigh_from_metric_and_constraint():
    """Its equations v' = a w^2, (I + m a^2) w' = -m a v w, integrated by a method of another program (SciPy)."""
    from scipy.integrate import solve_ivp

    sleigh = Sleigh()
    turning = sleigh.inertia + sleigh.mass * sleigh.ahead**2

    def exact(speed):
        def field(t, y):
            return [sleigh.ahead * y[1] ** 2, -sleigh.mass * sleigh.ahead * y[0] * y[1] / turning, y[1]]

        def half(t, y):
            return y[2] - 0.5

        half.terminal = True
        return solve_ivp(field, (0, 4), [speed, 1.3, 0.0], "DOP853", events=half, rtol=1e-13, atol=1e-13).t_events[0][0]

    time, slope = jax.jvp(sleigh_turn, (0.8,), (1.0,))
    assert_close(time, exact(0.8), rtol=1e-10)
    assert_close(slope, (exact(0.801) - exact(0.799)) / 0.002, rtol=1e-6)


def test_wrong_functions_are_refused_before_anything_compiles():
    class Wrong(Ball):
        def field(self, t, y):
            return y[1]

    class Odd(Ball):
        def reset(self, t, y):
            return y

    with pytest.raises(ValueError, match=r"modes\[0\]\.field\(t, y\) must return an array of shape \(3,\)"):
        simulate(Hybrid([Wrong()]), START, 1.0)
    with pytest.raises(ValueError, match=r"modes\[0\]\.reset\(t, y\) must return \(state, number"):
        simulate(Hybrid([Odd()]), START, 1.0)
    with pytest.raises(ValueError, match=r"event\(t, y\) must return one number"):
        event_time(Hybrid([Ball()]), START, 1.0, event=lambda t, y: y)
    with pytest.raises(ValueError, match="event = None: the system has no event"):
        event_time(Hybrid([Ball()]), START, 1.0)
    with pytest.raises(ValueError, match="modes is empty"):
        Hybrid([])
    with pytest.raises(ValueError, match="wrap modes in nonholonomic"):
        simulate(Ball(), START, 1.0)
    with pytest.raises(ValueError, match="violates the constraints"):
        simulate(Sleigh(), (np.zeros(3), np.array([0.0, 1.0, 0.0])), 1.0)
    with pytest.raises(ValueError, match=r"start: q must be of shape \(3,\)"):
        simulate(Sleigh(), (np.zeros(2), np.zeros(3)), 1.0)


def changed(**functions):
    """A ball of which some functions are replaced."""
    return Hybrid([type("Changed", (Ball,), functions)()])


OF_RUN = r"; its arguments are the time t, a number, and the state y, an array of shape \(3,\)"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: simulate(changed(field=lambda self, y, t: jnp.stack([y[1], -1.0, 0.0])), START, 1.0),
            r"modes\[0\]\.field\(t, y\) raised IndexError: Too many indices: .*" + OF_RUN,
        ),
        (
            lambda: simulate(changed(field=lambda self, y: y), START, 1.0),
            r"modes\[0\]\.field\(t, y\) raised TypeError: .* takes 2 positional arguments but 3 were given" + OF_RUN,
        ),
        (
            lambda: event_time(Hybrid([Ball()]), START, 1.0, event=lambda t, y: y.height),
            r"event\(t, y\) raised AttributeError: .* no attribute height" + OF_RUN,
        ),
        (
            lambda: event_time(Hybrid([Ball()], event=lambda t, y: y.height), START, 1.0),
            r"event\(t, y\) raised AttributeError: .* no attribute height" + OF_RUN,
        ),
        (
            lambda: simulate(
                type("Pushed", (Sleigh,), {"force": lambda self, q, rate: rate})(), (np.zeros(3),) * 2, 1.0
            ),
            r"force\(t, q, rate\) raised TypeError: .*; its arguments are the time t, a number, and the coordinates q and "
            r"their rates, each of shape \(3,\)",
        ),
    ],
)
def test_an_error_in_a_function_names_the_function_and_its_arguments(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert not isinstance(caught.value.__cause__, ValueError)


@pytest.mark.parametrize(
    ("reset", "message"),
    [
        (lambda self, t, y: [y, 0], "not a list of 2 values"),
        (lambda self, t, y: y, r"not an array of shape \(3,\)"),
        (lambda self, t, y: (y,), "not a tuple of 1 value$"),
        (lambda self, t, y: (y[0], 0), r"its state is a number of type float64, not an array of shape \(3,\)"),
        (lambda self, t, y: ([y[0]], 0), r"its state is a list of 1 value, not an array of shape \(3,\)"),
        (lambda self, t, y: (y, 0.5), "its number is a number of type float64, not a whole number"),
    ],
)
def test_a_wrong_reset_is_described_in_words(reset, message):
    with pytest.raises(ValueError, match=r"modes\[0\]\.reset\(t, y\) must return \(state, number .*" + message):
        simulate(changed(reset=reset), START, 1.0)


def test_a_field_that_returns_a_list_is_described_in_words():
    with pytest.raises(
        ValueError, match=r"must return an array of shape \(3,\), like the start, not a list of 3 values"
    ):
        simulate(changed(field=lambda self, t, y: [y[1], -1.0, 0.0]), START, 1.0)


def test_an_event_of_a_scene_reads_quantities_by_name():
    with pytest.raises(ValueError, match=r"event: motion\[0\]: .* have names, such as motion\.theta"):
        event_time(TOP, LAUNCH, 1.0, event=lambda t, motion: motion[0])


def test_the_last_crossing_may_be_at_a_reset():
    """The event is at the second bounce, and the run continues through it."""
    ball = Hybrid([Ball()])
    time = event_time(ball, START, 1.6, event=lambda t, y: 1.5 - y[2], crossing="last")
    ground = np.sqrt(2.0 * START[0] / GRAVITY)
    assert_close(time, ground * (1.0 + 2.0 * 0.8), rtol=1e-9)


def test_a_time_that_is_nan_is_explained():
    class Lost(Ball):
        def reset(self, t, y):
            return y, jnp.array(5)

    with pytest.warns(UserWarning, match=r"the run ended as 'failed' at 0\.45152\d s; nonholonomic\.simulate returns"):
        time = event_time(Hybrid([Lost()], event=Bounces(3.0)), START, 2.0)
    assert np.isnan(time)


def test_a_start_may_be_a_list_of_traced_numbers():
    fall = jax.vmap(lambda height: event_time(Hybrid([Ball()], event=Bounces(1.0)), [height, 0.0, 0.0], 2.0))
    heights = jnp.array([0.5, 1.0])
    assert_close(fall(heights), jnp.sqrt(2.0 * heights / GRAVITY), rtol=1e-12)


class Counting(AbstractMode):
    """A falling ball, whose third component counts the bounces."""

    restitution: float

    def field(self, t, y):
        return jnp.array([y[1], -9.81, 0.0])

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return jnp.array([0.0, -self.restitution * y[1], y[2] + 1.0]), 0


@pytest.mark.parametrize("crossing", ["first", "last"])
def test_the_time_of_an_event_at_a_reset_has_the_derivative_of_the_reset(crossing):
    """The third bounce, at sqrt(2 / g) (1 + 2 e + 2 e^2)."""

    def time(restitution):
        bounces = Hybrid([Counting(restitution)], lambda t, y: 2.5 - y[2])
        return event_time(bounces, jnp.array([1.0, 0.0, 0.0]), 1.9, crossing=crossing)

    value, slope = jax.value_and_grad(time)(0.8)
    assert_close(value, np.sqrt(2.0 / 9.81) * (1.0 + 1.6 + 1.28), rtol=1e-8)
    assert_close(slope, np.sqrt(2.0 / 9.81) * (2.0 + 3.2), rtol=1e-6)
