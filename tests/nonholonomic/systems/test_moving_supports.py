"""Mechanical systems whose constraints have a drift, or whose functions depend on time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from close import assert_close
from own_modes import GRAVITY, Sleigh, Turntable

from nonholonomic import AbstractSystem, Hybrid, periodic_orbit, simulate, sweep
from nonholonomic.runs.model import model_of
from nonholonomic.systems.form import check_start
from nonholonomic.systems.mechanics import Lagrange, energy_balance, is_driven

LENGTH = 0.5


class Lifted(AbstractSystem):
    """A pendulum from its upright position whose pivot moves up and down as a cos(w t), by the drift of a constraint."""

    amplitude: float = 0.02
    frequency: float = 180.0
    dimension = 2
    names = ("angle", "height")

    def metric(self, q):
        lever = -LENGTH * jnp.sin(q[0])
        return jnp.array([[LENGTH**2, lever], [lever, 1.0]])

    def potential(self, q):
        return GRAVITY * (q[1] + LENGTH * jnp.cos(q[0]))

    def constraints(self, q):
        return jnp.array([[0.0, 1.0]])

    def drift(self, t, q):
        return -self.amplitude * self.frequency * jnp.sin(self.frequency * t)[None]


class Weighed(AbstractSystem):
    """The same pendulum in the frame of its pivot, where the weight changes."""

    amplitude: float = 0.02
    frequency: float = 180.0
    dimension = 1

    def metric(self, q):
        return jnp.array([[LENGTH**2]])

    def potential(self, t, q):
        lift = -self.amplitude * self.frequency**2 * jnp.cos(self.frequency * t)
        return (GRAVITY + lift) * LENGTH * jnp.cos(q[0])


class Stated(Weighed):
    """The same pendulum, by its Lagrangian in space, with a term linear in the rate."""

    def lagrangian(self, t, q, rate):
        height, phase = self.amplitude * jnp.cos(self.frequency * t), self.frequency * t
        lift = -self.amplitude * self.frequency * jnp.sin(phase) - LENGTH * jnp.sin(q[0]) * rate[0]
        along = LENGTH * jnp.cos(q[0]) * rate[0]
        return 0.5 * (along**2 + lift**2) - GRAVITY * (height + LENGTH * jnp.cos(q[0]))


class Hoisted(AbstractSystem):
    """A pendulum whose length grows at a speed: its metric and potential depend on time."""

    speed: float = 0.2
    dimension = 1

    def length(self, t):
        return 1.0 + self.speed * t

    def metric(self, t, q):
        return self.length(t) ** 2 * jnp.eye(1)

    def potential(self, t, q):
        return -GRAVITY * self.length(t) * jnp.cos(q[0])


class Shaker(AbstractSystem):
    """A mass on a spring whose other end, of another mass, is moved as a (1 - cos(w t))."""

    frequency: float = 2.0
    stiffness: float = 3.0
    amplitude: float = 0.4
    dimension = 2
    names = ("place", "end")

    def metric(self, q):
        return jnp.diag(jnp.array([1.5, 0.7]))

    def potential(self, q):
        return 0.5 * self.stiffness * (q[0] - q[1]) ** 2

    def constraints(self, t, q):
        return jnp.array([[0.0, 1.0]]) * (2.0 + jnp.sin(t))

    def drift(self, t, q):
        return self.amplitude * self.frequency * jnp.sin(self.frequency * t)[None] * (2.0 + jnp.sin(t))


class Ramp(AbstractSystem):
    """A blade whose heading turns at a given rate: constraints that depend on time, without a drift."""

    dimension = 2

    def metric(self, q):
        return jnp.eye(2)

    def constraints(self, t, q):
        return jnp.array([[-jnp.sin(0.7 * t), jnp.cos(0.7 * t)]])


class Fenced(Turntable):
    """A ball on a turntable that strikes a wall."""

    def margin(self, t, q, rate):
        return 0.5 - q[0]

    def reset(self, t, q, rate):
        return q, rate * jnp.array([-0.5, 1.0, 1.0, 1.0])


class OnTable(Turntable):
    """The ball on a turntable, its place in the coordinates of the table."""

    def constraints(self, t, q):
        c, s = jnp.cos(self.turn * t), jnp.sin(self.turn * t)
        return jnp.array([[c, -s, 0.0, -self.radius], [s, c, self.radius, 0.0]])

    def drift(self, q):
        return jnp.zeros(2)

    def lagrangian(self, q, rate):
        velocity = rate[:2] + self.turn * jnp.array([-q[1], q[0]])
        return 0.5 * self.mass * (velocity @ velocity + 0.4 * self.radius**2 * rate[2:] @ rate[2:])


class Racket(AbstractSystem):
    """A ball above a racket that moves up and down, in two coordinates."""

    dimension = 2

    def metric(self, q):
        return 3.0 * jnp.eye(2)

    def potential(self, q):
        return 3.0 * GRAVITY * q[1]

    def margin(self, t, q, rate):
        return q[1] - 0.05 * jnp.sin(20.0 * t)

    def reset(self, t, q, rate):
        return q, self.impact(t, q, rate, 0.6)


TURN, PLACE, VELOCITY = 1.3, 0.3 + 0.1j, 0.2 - 0.1j


def rolling(turn):
    return Turntable(turn).start(PLACE.real, PLACE.imag, VELOCITY.real, VELOCITY.imag)


def circle(turn, t):
    """Place and velocity of a homogeneous ball on a table that turns: it goes round at 2/7 of the rate of the table."""
    rate = 2.0 / 7.0 * turn
    velocity = VELOCITY * np.exp(1j * rate * t)
    return PLACE + (velocity - VELOCITY) / (1j * rate), velocity


def test_a_ball_on_a_turntable_runs_in_a_circle_and_the_table_pays_for_it():
    """The force on the ball is its mass times its acceleration; its power is that at the velocity of the table."""
    run = simulate(Turntable(TURN), rolling(TURN), 10.0, times=np.linspace(0.0, 10.0, 501))
    place, velocity = circle(TURN, run.t)
    assert_close(run["x"] + 1j * run["y"], place, rtol=1e-10)
    force, table = 2.0 * 2j / 7.0 * TURN * velocity, 1j * TURN * place
    assert_close(run["support_power"], (force * table.conj()).real, rtol=1e-9, atol=1e-11)
    work = scipy.integrate.simpson(run["support_power"], x=run.t)
    assert_close(run["energy"][-1] - run["energy"][0], work, rtol=1e-8)
    assert run.to_table()["energy"].shape == (501,)


def test_in_the_coordinates_of_the_table_the_motion_is_the_same():
    """The Lagrangian has a term linear in the rates and the constraints depend on time, as the rotations of the ball are about
    axes at rest."""
    table, t = OnTable(TURN), 0.4
    place, velocity = circle(TURN, t)
    back = np.exp(-1j * TURN * t)
    # Relative to the table, by the rule of products.
    seen, rate = back * place, back * (velocity - 1j * TURN * place)
    expected = back * (2j / 7.0 * TURN * velocity - 2j * TURN * velocity - TURN**2 * place)
    turning = back.conjugate() * rate / table.radius
    q, rates = (
        jnp.array([seen.real, seen.imag, 0.0, 0.0]),
        jnp.array([rate.real, rate.imag, -turning.imag, turning.real]),
    )
    acceleration = jax.jit(lambda: Lagrange(table).acceleration(t, q, rates))()
    assert_close(acceleration[0] + 1j * acceleration[1], expected, rtol=1e-12)


def test_the_power_of_the_supports_is_that_of_the_multipliers():
    """Also with a force; the equations with multipliers are solved as one linear system."""
    table = Turntable(TURN, drag=0.3)
    q, rate = table.start(0.3, 0.1, 0.2, -0.1)
    G, W, force = table.metric(q), table.constraints(q), table.force(0.0, q, rate)
    equations = np.block([[G, -W.T], [W, np.zeros((2, 2))]])
    *acceleration, first, second = np.linalg.solve(equations, np.concatenate([force, table.drift(rate[:2])]))
    power = jax.jit(lambda: energy_balance(table, None, 0.0, q, rate))()[1]
    assert_close(power, np.array([first, second]) @ table.drift(q), rtol=1e-12)
    assert_close(jax.jit(lambda: Lagrange(table).acceleration(0.0, q, rate))(), np.array(acceleration), rtol=1e-12)


def test_an_impact_keeps_the_drift():
    fenced = Fenced(TURN)
    q, rate = fenced.start(0.5, 0.1, 0.2, -0.1)
    after = jax.jit(lambda: fenced.impact(0.0, q, rate, 0.7))()
    assert_close(after[0], -0.7 * 0.2, rtol=1e-12)
    assert_close(fenced.constraints(q) @ after, fenced.drift(q), rtol=1e-12)


def check_slope(end, number):
    """Of the steps of the central difference, the best one counts."""
    steps = np.array([1e-2, 1e-3, 1e-4, 1e-5])
    ends, slopes = jax.jit(jax.vmap(jax.value_and_grad(end)))(
        np.concatenate([[number], number + steps, number - steps])
    )
    differences = (ends[1:5] - ends[5:]) / (2.0 * steps)
    assert np.min(np.abs(differences - slopes[0])) < 1e-8 * abs(slopes[0])


def test_derivatives_by_the_frequency_of_a_drive_are_those_of_differences():
    def end(frequency):
        run = simulate(Shaker(frequency), ([0.0, 0.0], [0.0, 0.0]), 2.0, times=[2.0], tolerance=1e-12)
        return run["place"][0]

    check_slope(end, 2.0)


@pytest.mark.slow
def test_derivatives_by_the_turn_of_the_table_are_those_of_differences():
    """The start changes with the table."""
    check_slope(lambda turn: simulate(Turntable(turn), rolling(turn), 2.0, times=[2.0], tolerance=1e-12)["x"][0], TURN)


def test_the_rates_after_a_reset_obey_the_constraints_with_their_drift():
    run = simulate(Fenced(TURN), rolling(TURN), 2.0, times=[2.0])
    assert int(run.switches) == 1
    assert run["x_rate"] < 0.0
    q, rate = np.split(run.state[0], 2)
    assert_close(Fenced().constraints(q) @ rate, Fenced(TURN).drift(q), rtol=1e-10)


def multipliers(amplitude, frequency):
    """Those of l theta'' = (g - a w^2 cos(w t)) theta, Mathieu's equation, over a period of the pivot."""

    def field(t, y):
        push = (GRAVITY - amplitude * frequency**2 * np.cos(frequency * t)) / LENGTH
        return [y[2], y[3], push * y[0], push * y[1]]

    end = scipy.integrate.solve_ivp(
        field, (0.0, 2.0 * np.pi / frequency), [1.0, 0.0, 0.0, 1.0], "DOP853", rtol=1e-13, atol=1e-13
    )
    return np.linalg.eigvals(end.y[:, -1].reshape(2, 2))


def test_kapitzas_pendulum_is_stable_upright_where_its_pivot_moves_fast():
    """On both sides of a^2 w^2 = 2 g l; the height of the pivot has the multiplier 1, and its rate, which the drift gives,
    has 0."""
    for amplitude, is_stable in ((0.02, True), (0.0165, False)):
        assert (amplitude * 180.0) ** 2 > 2.0 * GRAVITY * LENGTH or not is_stable
        system, start = Lifted(amplitude), ([0.0, amplitude], [0.0, 0.0])
        orbit = periodic_orbit(system, start, period=2.0 * np.pi / 180.0, free=["angle", "angle_rate"])
        expected = np.concatenate([multipliers(amplitude, 180.0), [1.0, 0.0]])
        # The characteristic polynomial does not depend on the order.
        assert_close(np.poly(orbit.multipliers), np.poly(expected), rtol=1e-8, atol=1e-8)
        assert (np.max(np.abs(orbit.multipliers)) < 1.0 + 1e-6) == is_stable


def test_a_drift_a_potential_and_a_lagrangian_give_the_same_motion():
    t, place, speed = 0.013, 0.4, -1.3
    height, lift = 0.02 * np.cos(180.0 * t), -0.02 * 180.0 * np.sin(180.0 * t)

    @jax.jit
    def computed(q, rate):
        whole = jnp.stack([q[0], height]), jnp.stack([rate[0], lift])
        motions = [Lagrange(Weighed()).acceleration(t, q, rate), Lagrange(Stated()).acceleration(t, q, rate)]
        balances = [energy_balance(Lifted(), None, t, *whole), energy_balance(Stated(), None, t, q, rate)]
        return motions, Lagrange(Lifted()).acceleration(t, *whole), balances

    (expected, stated), lifted, ((_, power, _), (energy, *_)) = computed(jnp.array([place]), jnp.array([speed]))
    assert_close(stated, expected, rtol=1e-12)
    assert_close(lifted, [expected[0], -(180.0**2) * height], rtol=1e-12)
    force = lifted[1] - LENGTH * (np.sin(place) * lifted[0] + np.cos(place) * speed**2) + GRAVITY
    assert_close(power, force * lift, rtol=1e-12)
    # The Lagrangian's energy is its momentum times the rate less the Lagrangian.
    kinetic = 0.5 * (LENGTH**2 * speed**2 - lift**2)
    assert_close(energy, kinetic + GRAVITY * (height + LENGTH * np.cos(place)), rtol=1e-12)


def test_a_pendulum_of_changing_length_agrees_with_an_equation_written_by_hand():
    """l theta'' = -2 l' theta' - g sin(theta), in SciPy."""

    def field(t, y):
        length = 1.0 + 0.2 * t
        return [y[1], (-2.0 * 0.2 * y[1] - GRAVITY * np.sin(y[0])) / length]

    times = np.array([2.5, 5.0])
    expected = scipy.integrate.solve_ivp(field, (0.0, 5.0), [1.0, 0.5], "DOP853", times, rtol=1e-13, atol=1e-13).y.T
    run = simulate(Hoisted(), ([1.0], [0.5]), 5.0, times=times, tolerance=1e-11)
    assert_close(run.state, expected, rtol=1e-9)
    # The hoist lets the pendulum down: the power is -dL/dt.
    angle, rate, length = *expected.T, 1.0 + 0.2 * times
    assert_close(run["support_power"], -0.2 * (length * rate**2 + GRAVITY * np.cos(angle)), rtol=1e-8)


def test_a_driven_mass_follows_the_closed_form_in_a_table():
    """Also where the rows of the constraints are scaled by a function of time, and so the drift."""
    times, frequencies = np.array([0.5, 2.0]), np.array([0.7, 2.0, 3.0])
    options = {"times": times, "quantities": ["place", "end", "support_power"], "axes": {"frequency": frequencies}}
    table = sweep(Shaker(), ([0.0, 0.0], [0.0, 0.0]), 2.0, tolerance=1e-11, progress=False, **options)
    w, own, t = frequencies[:, None], np.sqrt(3.0 / 1.5), times
    # From 1.5 x'' = k (y - x) with y = a (1 - cos(w t)), from rest.
    response = 0.4 * own**2 / (own**2 - w**2)
    place = 0.4 * (1.0 - np.cos(own * t)) - response * (np.cos(w * t) - np.cos(own * t))
    end, speed = 0.4 * (1.0 - np.cos(w * t)), 0.4 * w * np.sin(w * t)
    assert_close(table["place"], place, rtol=1e-8)
    assert_close(table["end"], end, rtol=1e-9)
    power = (0.7 * 0.4 * w**2 * np.cos(w * t) + 3.0 * (end - place)) * speed
    assert_close(table["support_power"], power, rtol=1e-8)


class Lift(AbstractSystem):
    """A falling mass, by its height above a lift that rises at a speed: its weight does not depend on time."""

    speed: float = 2.0
    dimension = 1

    def metric(self, q):
        return jnp.eye(1)

    def lagrangian(self, t, q, rate):
        return 0.5 * (rate[0] + self.speed) ** 2 - GRAVITY * (q[0] + self.speed * t)


def test_the_energy_in_a_table_where_only_the_energy_depends_on_time():
    """E = q' dL/dq' - L, with q' = -g t and q = 1 - g t^2 / 2."""
    times, speeds = np.array([0.5, 1.0]), np.array([[1.0], [2.0]])
    options = {"times": times, "quantities": ["energy", "support_power"], "progress": False}
    table = sweep(Lift(), ([1.0], [0.0]), 1.0, axes={"speed": speeds[:, 0]}, **options)
    rate, height = -GRAVITY * times, 1.0 - 0.5 * GRAVITY * times**2 + speeds * times
    energy = (rate + speeds) * rate - 0.5 * (rate + speeds) ** 2 + GRAVITY * height
    assert_close(table["energy"], energy, rtol=1e-8)
    assert_close(table["support_power"], GRAVITY * speeds + 0.0 * times, rtol=1e-8)


def test_constraints_that_depend_on_time_turn_the_velocity():
    """With a blade that turns at 0.7 rad/s, the velocity keeps its magnitude and turns, as no force acts along it."""
    t, speed = 0.4, 2.0
    along, across = np.array([np.cos(0.28), np.sin(0.28)]), np.array([-np.sin(0.28), np.cos(0.28)])
    acceleration = Lagrange(Ramp()).acceleration(t, jnp.zeros(2), speed * along)
    assert_close(acceleration, 0.7 * speed * across, rtol=1e-12)


def test_an_impact_counts_the_motion_of_the_obstacle():
    """The times of the first impacts against the exact map of a ball on a table that vibrates: parabolas between impacts, which
    reverse the velocity relative to the table."""
    time, height, velocity, times = 0.0, 0.3, 0.0, []

    def gap(flight):
        return height + velocity * flight - 0.5 * GRAVITY * flight**2 - 0.05 * np.sin(20.0 * (time + flight))

    while len(times) < 4:
        grid = np.arange(1e-4, 1.0, 1e-4)
        after = grid[np.argmax(gap(grid) < 0.0)]
        flight = scipy.optimize.brentq(gap, after - 1e-4, after, xtol=1e-15)
        time, speed = time + flight, np.cos(20.0 * (time + flight))
        height, velocity = 0.05 * np.sin(20.0 * time), speed - 0.6 * (velocity - GRAVITY * flight - speed)
        times.append(time)
    run = simulate(Racket(), ([0.0, 0.3], [0.5, 0.0]), time + 1e-3, tolerance=1e-11)
    assert_close(run.resets["time"], times, rtol=1e-9)


def test_a_lagrangian_of_its_own_runs_with_constraints_and_in_a_mode():
    """That of the sleigh, written out, gives the accelerations of its metric."""

    class Stated(Sleigh):
        def lagrangian(self, q, rate):
            return 0.5 * rate @ self.metric(q) @ rate

    q, rate = jnp.array([0.1, 0.2, 0.4]), 1.5 * jnp.array([jnp.cos(0.4), jnp.sin(0.4), 0.5])
    for system in (Stated(), Hybrid([Stated()])):
        model_of(system, (q, rate)).check()
    accelerations = jax.jit(lambda: [Lagrange(kind()).acceleration(0.0, q, rate) for kind in (Stated, Sleigh)])()
    assert_close(*accelerations, rtol=1e-12)


def replaced(base, **functions):
    """An object of a subclass with other functions."""
    return type(base)("Replaced", (base,), functions)()


START = (np.zeros(3), np.zeros(3))
WRONG = {
    "the time last": (
        lambda: replaced(Sleigh, metric=lambda self, q, t: jnp.eye(3)),
        r"^metric\(q, t\) must be metric\(q\) or, if it depends on time, metric\(t, q\)",
    ),
    "the time under another name": (
        lambda: Hybrid([replaced(Sleigh, constraints=lambda self, time, q: jnp.eye(3)[:1])]),
        r"^modes\[0\]\.constraints\(time, q\) must be constraints\(q\) or, .* constraints\(t, q\)",
    ),
    "the time alone": (
        lambda: replaced(Sleigh, drift=lambda self, t: jnp.ones(1)),
        r"^drift\(t\) must be drift\(q\) or, if it depends on time, drift\(t, q\)",
    ),
    "a drift of another length": (
        lambda: replaced(Sleigh, drift=lambda self, t, q: jnp.ones(2)),
        r"^drift\(t, q\) must be of shape \(k,\), a number for each row of constraints, not \(2,\)",
    ),
    "a metric that is a vector": (
        lambda: replaced(Sleigh, metric=lambda self, t, q: q),
        r"^metric\(t, q\) must be of shape \(3, 3\), not \(3,\)",
    ),
    "constraints of whole numbers": (
        lambda: replaced(Sleigh, constraints=lambda self, q: jnp.array([[0, 1, 0]])),
        r"^constraints\(q\) must return floats, not int64: write 1\.0 instead of 1",
    ),
    "a frame with a drift": (
        lambda: replaced(Sleigh, drift=lambda self, q: jnp.ones(1), frame=lambda self, q: jnp.eye(3)),
        r"^frame: quasi-velocities need constraints without a drift .* leave frame out",
    ),
    "rates without the drift": (
        lambda: replaced(Sleigh, drift=lambda self, t, q: jnp.ones(1)),
        r"rate = .* violates the constraints by 1; constraints\(q\) @ rate must be drift\(t, q\)",
    ),
    "a force of one component": (
        lambda: replaced(Sleigh, force=lambda self, t, q, rate: -rate[:1]),
        r"^force\(t, q, rate\) must be of shape \(3,\), not \(1,\)",
    ),
    "a drift that is not a number": (
        lambda: replaced(Sleigh, drift=lambda self, t, q: jnp.full(1, jnp.nan)),
        r"^drift\(t, q\) = \[nan\] at the start must be finite",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_functions_are_named(name):
    build, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        simulate(build(), START, 1.0)


def test_a_section_needs_a_system_without_time():
    with pytest.raises(ValueError, match="the system depends on time; pass period="):
        periodic_orbit(Hoisted(), ([0.5], [0.0]), lambda t, y: y[1])


def test_a_number_called_drift_is_no_drift():
    class Windy(Sleigh):
        drift: float = 0.2

    check_start(Windy(), START)
    assert not is_driven(Windy())
