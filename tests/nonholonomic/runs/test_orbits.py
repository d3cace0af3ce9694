"""Periodic orbits against closed forms and published values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_modes import GRAVITY, Pendulum
from scipy.special import ellipk

from nonholonomic import AbstractMode, AbstractSystem, Hybrid, periodic_orbit


class Kicked(AbstractMode):
    """A spring with negative damping against a wall at its middle, which returns a part of the speed and adds a kick."""

    growth: float
    restitution: float
    kick: float = 0.3

    def field(self, t, y):
        return jnp.array([y[1], 2.0 * self.growth * y[1] - y[0]])

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return jnp.array([0.0, self.kick - self.restitution * y[1]]), 0


def wall(t, y):
    return y[0]


def kicked(growth, restitution):
    """Period, speed after the wall and multiplier: half a turn multiplies the speed by exp(growth T)."""
    period = jnp.pi / jnp.sqrt(1.0 - growth**2)
    multiplier = restitution * jnp.exp(growth * period)
    return jnp.array([period, 0.3 / (1.0 - multiplier), multiplier])


def found(growth, restitution):
    orbit = periodic_orbit(Hybrid([Kicked(growth, restitution)]), [0.0, 0.8], wall)
    return jnp.array([orbit.period, orbit.state[1], orbit.multipliers[0].real])


def test_an_orbit_through_a_reset_and_its_derivatives():
    values, expected = found(0.1, 0.4), kicked(0.1, 0.4)
    np.testing.assert_allclose(values, expected, rtol=1e-11)
    slopes = jax.jit(jax.jacrev(found, (0, 1)))(0.1, 0.4)
    np.testing.assert_allclose(slopes, jax.jacfwd(kicked, (0, 1))(0.1, 0.4), rtol=1e-8, atol=1e-10)
    # In a batch.
    restitutions = jnp.array([0.3, 0.4])
    batch = jax.vmap(lambda restitution: found(0.1, restitution))(restitutions)
    np.testing.assert_allclose(batch, [kicked(0.1, one) for one in restitutions], rtol=1e-11)


def test_an_illegal_number_in_a_program_and_a_list_with_a_traced_number():
    def orbit(speed, tolerance):
        return periodic_orbit(Hybrid([Kicked(0.1, 0.4)]), [0.0, speed], wall, tolerance=tolerance)

    batch = jax.jit(jax.vmap(orbit))(jnp.array([0.8, 0.8]), jnp.array([1e-10, -1.0]))
    np.testing.assert_allclose(batch.state[:, 1], [kicked(0.1, 0.4)[1], np.nan], rtol=1e-11)
    assert [int(batch.reason[0]), jax.tree.map(lambda part: part[1], batch).status] == [0, "illegal"]
    with pytest.raises(ValueError, match="a batch have `reason`"):
        _ = batch.status


class Walker(AbstractMode):
    """The simplest walker: angles of the stance leg and of the hip, and their rates (Garcia et al. 1998)."""

    slope: float

    def field(self, t, y):
        theta, phi, theta_rate, phi_rate = y
        acceleration = jnp.sin(theta - self.slope)
        swing = acceleration + (theta_rate**2 - jnp.cos(theta - self.slope)) * jnp.sin(phi)
        return jnp.array([theta_rate, phi_rate, acceleration, swing])

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return y, 1


class Landing(Walker):
    """The second half of a step. In the first half, the foot that swings passes through the ground."""

    def margin(self, t, y):
        return 2.0 * y[0] - y[1]

    def reset(self, t, y):
        theta, c = y[0], jnp.cos(2.0 * y[0])
        return jnp.array([-theta, -2.0 * theta, c * y[2], c * (1.0 - c) * y[2]]), 0


def heel(t, y):
    return 2.0 * y[0] - y[1]


def walker(slope):
    return Hybrid([Walker(slope), Landing(slope)])


def test_the_simplest_walker():
    theta, rate = 0.2, -0.2
    start = [theta, 2.0 * theta, rate, (1.0 - np.cos(2.0 * theta)) * rate]
    orbit = periodic_orbit(walker(0.009), start, heel)
    np.testing.assert_allclose(orbit.state[jnp.array([0, 2])], [0.2003109005443, -0.1998324730050], atol=1e-12)
    np.testing.assert_allclose(orbit.period, 3.882463752851, atol=1e-11)
    np.testing.assert_allclose(orbit.multipliers[:2].real, -0.19009984, atol=1e-8)
    np.testing.assert_allclose(np.abs(orbit.multipliers[:2].imag), 0.55759878, atol=1e-8)
    assert orbit.stable
    assert orbit.error < 1e-9
    assert "stable periodic orbit with a period of 3.88246375285" in repr(orbit)

    # Steps of two lengths. The slope is one number of both modes.
    branch = orbit.branch("slope", 0.0165, step=1e-3)
    assert [point.kind for point in branch.special] == ["period doubling"]
    np.testing.assert_allclose(branch.special[0].value, 0.0150884379, atol=2e-10)
    limping = branch.switched()
    assert limping.stable
    np.testing.assert_allclose(limping.period, 2.0 * branch.special[0].orbit.period, rtol=1e-3)
    assert "in 2 returns" in repr(limping)


class Driven(AbstractMode):
    damping: float
    frequency: float

    def field(self, t, y):
        return jnp.array([y[1], jnp.cos(self.frequency * t) - y[0] - 2.0 * self.damping * y[1]])


def test_a_driven_oscillator_and_its_derivatives_by_the_frequency():
    def orbit(frequency):
        period = 2.0 * jnp.pi / frequency
        orbit = periodic_orbit(Hybrid([Driven(0.2, frequency)]), [0.0, 0.0], period=period)
        return jnp.append(orbit.state, orbit.multipliers[0].real)

    def exact(frequency):
        amplitude = 1.0 / (1.0 - frequency**2 + 0.4j * frequency)
        exponent = (-0.2 + 1j * jnp.sqrt(1.0 - 0.2**2)) * 2.0 * jnp.pi / frequency
        return jnp.array([amplitude.real, (1j * frequency * amplitude).real, jnp.exp(exponent).real])

    values, slopes = orbit(1.3), jax.jacfwd(orbit)(1.3)
    np.testing.assert_allclose(values, exact(1.3), atol=1e-12)
    for tolerance in (1e-5, 1e-7, 1e-9):
        rough = periodic_orbit(Hybrid([Driven(0.2, 1.3)]), [0.0, 0.0], period=2.0 * np.pi / 1.3, tolerance=tolerance)
        errors = np.abs(rough.state - exact(1.3)[:2])
        assert np.all(errors <= rough.error)
        assert rough.error < 1e3 * tolerance
    np.testing.assert_allclose(slopes, jax.jacfwd(exact)(1.3), atol=1e-8)
    # Half of the drive's period, or a period that does not follow the frequency.
    system, period = Hybrid([Driven(0.2, 1.3)]), 2.0 * np.pi / 1.3
    with pytest.raises(ValueError, match="the drive does not repeat after the period; pass period=, that of the drive"):
        periodic_orbit(system, [0.0, 0.0], period=0.5 * period)
    driven = periodic_orbit(system, [0.0, 0.0], period=period)
    with pytest.raises(
        ValueError, match=r"where frequency = 1\.4, the drive does not repeat after that of the orbit; pass"
    ):
        driven.branch("frequency", 1.4)
    with pytest.raises(
        ValueError, match=r"where frequency = 1\.4, the drive does not repeat after this period; pass period="
    ):
        driven.branch("frequency", 1.4, period=lambda frequency: period + 0.0 * frequency)


class Table(AbstractMode):
    """A ball on a vibrating table; the phase of the table is that of the impact half a period after time 0."""

    amplitude: float
    frequency: float
    restitution: float
    phase: float

    def table(self, t):
        return self.amplitude * jnp.sin(self.frequency * t + self.phase)

    def field(self, t, y):
        return jnp.array([y[1], -GRAVITY])

    def margin(self, t, y):
        return y[0] - self.table(t)

    def reset(self, t, y):
        speed = self.amplitude * self.frequency * jnp.cos(self.frequency * t + self.phase)
        return jnp.array([self.table(t), (1.0 + self.restitution) * speed - self.restitution * y[1]]), 0


def test_a_ball_on_a_vibrating_table():
    """The exact map of the impacts (phase, speed V) with V = g T / 2 and the speed U = V (1 - e) / (1 + e) of the table has the
    determinant e^2 and the trace 1 - e + (2 e V - (1 + e) A w^2 T sin(phase)) / (U + V)."""
    frequency, restitution = 30.0, 0.6
    period = 2.0 * np.pi / frequency
    speed = 0.5 * GRAVITY * period
    of_table = speed * (1.0 - restitution) / (1.0 + restitution)
    amplitude = 1.2 * of_table / frequency
    phase = np.arccos(of_table / (amplitude * frequency))
    drag = (1.0 + restitution) * amplitude * frequency**2 * period * np.sin(phase)
    trace = 1.0 - restitution + (2.0 * restitution * speed - drag) / (of_table + speed)
    expected = np.roots([1.0, -trace, restitution**2])
    system = Hybrid([Table(amplitude, frequency, restitution, phase + np.pi)])
    apex = amplitude * np.sin(phase) + GRAVITY * period**2 / 8.0
    orbit = periodic_orbit(system, [apex + 1e-3, 0.01], period=period)
    np.testing.assert_allclose(orbit.state, [apex, 0.0], atol=1e-11)
    np.testing.assert_allclose(np.sort_complex(orbit.multipliers), np.sort_complex(expected), atol=1e-8)
    assert orbit.stable == (max(abs(expected)) < 1.0)
    just_after = [amplitude * np.sin(phase), speed]
    with pytest.raises(ValueError, match="a reset falls on the end of the period; shift the phase"):
        periodic_orbit(Hybrid([Table(amplitude, frequency, restitution, phase)]), just_after, period=period)


def turning(t, y):
    return y[1]


def amplitude(state):
    """The greatest angle of a pendulum with a length of 1 m."""
    return np.arccos(np.cos(state[0]) - state[1] ** 2 / (2.0 * GRAVITY))


def test_an_orbit_of_a_family():
    orbit = periodic_orbit(Pendulum(), ([1.0], [0.0]), turning)
    exact = 4.0 * np.sqrt(1.0 / GRAVITY) * ellipk(np.sin(0.5 * float(orbit.state[0])) ** 2)
    np.testing.assert_allclose(orbit.period, exact, rtol=1e-11)
    np.testing.assert_allclose(orbit.multipliers, [1.0], atol=1e-8)
    assert orbit.family == 1
    assert orbit.stable
    assert "family" in repr(orbit)
    with pytest.raises(
        ValueError, match="the orbit is one of a family, for a fixed number; pass free= to periodic_orbit"
    ):
        orbit.branch("length", 2.0)

    # Two multipliers 1 of one family of driven orbits, split by round-off.
    driven = periodic_orbit(Pendulum(), ([1.0], [0.0]), period=float(orbit.period))
    assert driven.family == 1
    assert driven.stable
    # Full steps lead to an orbit a turn away; the amplitude of this one is 0.849.
    near = periodic_orbit(Pendulum(), ([0.5], [0.0]), period=2.1)
    np.testing.assert_allclose(
        4.0 * np.sqrt(1.0 / GRAVITY) * ellipk(np.sin(0.5 * amplitude(near.state)) ** 2), 2.1, rtol=1e-9
    )
    assert np.abs(near.state[0]) < 0.85
    distance = np.max(np.abs(near.state - jnp.array([0.5, 0.0])))
    assert f", {distance:.2g} away from the guess" in repr(near)


def test_derivatives_of_a_family_by_the_start_and_a_number():
    def period(angle, length):
        start = ([angle], [0.0 * angle])
        return periodic_orbit(Pendulum(length), start, turning).period

    slopes = jax.jit(jax.grad(period, (0, 1)))(1.0, 1.0)
    exact = [4.0 * np.sqrt(1.0 / GRAVITY) * ellipk(np.sin(0.5 * angle) ** 2) for angle in (0.999, 1.0, 1.001)]
    np.testing.assert_allclose(slopes, [(exact[2] - exact[0]) / 0.002, 0.5 * exact[1]], rtol=1e-6)


class Rotor(AbstractMode):
    """A rotor that approaches the speed of its motor."""

    speed: float
    rate: float = 0.2

    def field(self, t, y):
        return jnp.array([y[1], self.rate * (self.speed - y[1])])


def turned(t, y):
    return 2.0 * jnp.pi - y[0]


def test_an_orbit_up_to_a_symmetry():
    def shift(y):
        return y - jnp.array([2.0 * jnp.pi, 0.0])

    orbit = periodic_orbit(Hybrid([Rotor(3.0)]), [0.0, 2.0], turned, symmetry=shift)
    np.testing.assert_allclose(orbit.state, [0.0, 3.0], atol=1e-11)
    np.testing.assert_allclose(orbit.period, 2.0 * np.pi / 3.0, rtol=1e-11)
    np.testing.assert_allclose(orbit.multipliers, [np.exp(-0.2 * 2.0 * np.pi / 3.0)], rtol=1e-9)


class Blade(AbstractSystem):
    """A blade that is pushed ahead against drag, and turned to and fro: place, heading and their rates."""

    push: float = 3.0
    drag: float = 2.0
    dimension = 3

    def metric(self, q):
        return jnp.diag(jnp.array([1.0, 1.0, 0.5]))

    def constraints(self, q):
        return jnp.array([[-jnp.sin(q[2]), jnp.cos(q[2]), 0.0]])

    def force(self, t, q, rate):
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        ahead = self.push - self.drag * (c * rate[0] + s * rate[1])
        return jnp.array([c * ahead, s * ahead, jnp.sin(t) - self.drag * rate[2]])


def test_an_orbit_obeys_its_constraints():
    """Runs keep by how much they violate them, up to the turn: an orbit aside of them was found, with a multiplier of 1."""

    def seen_from_the_blade(y):
        c, s = jnp.cos(y[2]), jnp.sin(y[2])
        return jnp.array([0.0, 0.0, 0.0, c * y[3] + s * y[4], c * y[4] - s * y[3], y[5]])

    guess = ([0.0, 0.0, 0.0], [1.0, 0.0, 0.1])
    orbit = periodic_orbit(Blade(), guess, period=2.0 * np.pi, symmetry=seen_from_the_blade)
    np.testing.assert_allclose(orbit.state, [0.0, 0.0, 0.0, 1.5, 0.0, (1.0 / (2.0 + 0.5j)).imag], atol=1e-9)
    np.testing.assert_allclose(np.abs(orbit.multipliers[:2]), np.exp([-4.0 * np.pi, -8.0 * np.pi]), atol=1e-9)
    assert int(orbit.family) == 0


def test_numbers_inside_a_symmetry():
    def period(turns):
        def shift(y):
            return y - jnp.array([2.0 * jnp.pi * turns, 0.0])

        return periodic_orbit(
            Hybrid([Rotor(3.0)]), [0.0, 2.0], lambda t, y: turned(t, y / turns), symmetry=shift
        ).period

    np.testing.assert_allclose(jax.grad(period)(1.0), 2.0 * np.pi / 3.0, rtol=1e-9)
    with pytest.raises(ValueError, match=r"symmetry\(y\) must return a state of 2 components"):
        periodic_orbit(Hybrid([Rotor(3.0)]), [0.0, 2.0], turned, symmetry=lambda y: y[:1])


class Radial(AbstractMode):
    """A rotation with limit cycles of the radii 1 and 2."""

    def field(self, t, y):
        square = jnp.sum(y**2)
        growth = 0.01 * (1.0 - square) * (4.0 - square)
        return jnp.array([growth * y[0] - y[1], y[0] + growth * y[1]])


class Equilibrium(AbstractMode):
    """A limit cycle of the radius `size` around the equilibrium 0, at any height."""

    size: float = 1.0

    def field(self, t, y):
        growth = 0.1 * (1.0 - (y[0] ** 2 + y[1] ** 2) / self.size**2)
        return jnp.array([growth * y[0] - y[1], y[0] + growth * y[1], 0.0 * y[2]])


def rises(t, y):
    return y[1]


@pytest.mark.parametrize("options", [{}, {"free": ["y0"]}])
def test_a_guess_where_the_section_is_crossed_the_other_way(options):
    """The function rises at the first guess; with `free`, the guess is on the section, and the family is still found."""
    start = [0.9, 0.0, 0.3] if options else [-0.9, 0.0, 0.3]
    orbit = periodic_orbit(Hybrid([Equilibrium()]), start, rises, direction="rise", **options)
    np.testing.assert_allclose(orbit.state, [1.0, 0.0, 0.3], atol=1e-11)
    np.testing.assert_allclose(orbit.multipliers, [1.0, np.exp(-0.4 * np.pi)], atol=1e-9)
    assert orbit.family == 1
    assert orbit.stable


def test_an_equilibrium_is_no_orbit_and_a_small_orbit_is_found():
    system = Hybrid([Equilibrium()])
    with pytest.raises(ValueError, match="the state is an equilibrium"):
        periodic_orbit(system, [0.001, 0.0, 0.3], rises, direction="rise")
    with pytest.raises(ValueError, match="the state is an equilibrium"):
        periodic_orbit(system, [0.001, 0.0, 0.3], period=3.0)
    with pytest.raises(ValueError, match=r"misses it by 0\.01; the components that are not free"):
        periodic_orbit(system, [0.9, 0.01, 0.3], rises, direction="rise", free=["y0"])
    small = periodic_orbit(Hybrid([Equilibrium(1e-9)]), [0.7e-9, 0.0, 0.0], rises, direction="rise")
    np.testing.assert_allclose(small.state[0], 1e-9, rtol=1e-10)
    # A guess just before the section returns to it almost at once.
    near = periodic_orbit(system, [0.9, -1e-9, 0.3], rises, direction="rise")
    np.testing.assert_allclose(near.state, [1.0, 0.0, 0.3], atol=1e-11)


def test_distinct_orbits_are_counted_once():
    guesses = [[0.9, 0.0], [1.1, 0.0], [1.9, 0.0], [2.05, 0.0]]
    orbits = periodic_orbit(Hybrid([Radial()]), guesses, lambda t, y: -y[1])
    radii = sorted(float(abs(orbit.state[0])) for orbit in orbits)
    np.testing.assert_allclose(radii, [1.0, 2.0], atol=1e-10)
    assert [bool(orbit.stable) for orbit in orbits] == [True, False]


def test_what_is_wrong_is_said():
    system = Hybrid([Kicked(0.1, 0.4)])
    with pytest.raises(ValueError, match=r"does not cross the section again within t1 = 50 s"):
        periodic_orbit(system, [0.0, 0.8], lambda t, y: y[0] + 5.0, t1=50.0)
    with pytest.raises(ValueError, match="pass the section or the period"):
        periodic_orbit(system, [0.0, 0.8], wall, period=3.0)
    with pytest.raises(ValueError, match="depends on time"):
        periodic_orbit(Hybrid([Driven(0.2, 1.0)]), [0.0, 0.8], turning)
    with pytest.raises(ValueError, match="free = "):
        periodic_orbit(system, [0.0, 0.8], wall, free=["speed"])
