"""Periodic orbits of scenes against quadratures, closed forms and long runs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import CART
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from tops import rutstam_top

import stroller
import tippe
from nonholonomic import periodic_orbit


def turns_back(t, motion):
    return motion.theta_rate


def nutation(top, theta, spin, gravity=9.81):
    """Period [s] of theta and the angle of precession in it, by quadrature: without friction, from rest but for the spin.

    With L_n and L_3 about the normal and the axis, (I1 + m a^2 sin^2) theta'^2 = 2 (E - L_3^2 / (2 I3) - V),
    V = (L_n - L_3 cos)^2 / (2 I1 sin^2) - m g a cos, and phi' = (L_n - L_3 cos) / (I1 sin^2).
    """
    mass, a, I1, I3 = (float(part) for part in (top.mass, top.offset, top.I1, top.I3))
    axial = I3 * spin
    normal = axial * np.cos(theta)

    def potential(angle):
        lean = (normal - axial * np.cos(angle)) ** 2 / (2.0 * I1 * np.sin(angle) ** 2)
        return lean - mass * gravity * a * np.cos(angle)

    other = brentq(lambda angle: potential(angle) - potential(theta), 0.3, theta - 1e-6, xtol=1e-15)
    middle, half = 0.5 * (theta + other), 0.5 * (theta - other)
    phase = np.pi * ((np.arange(400) + 0.5) / 400.0 - 0.5)
    angle = middle + half * np.sin(phase)
    left = (2.0 * (potential(theta) - potential(angle)) / (I1 + mass * a**2 * np.sin(angle) ** 2)) ** 0.5
    times = half * np.cos(phase) / left * np.pi / 400.0
    precession = (normal - axial * np.cos(angle)) / (I1 * np.sin(angle) ** 2)
    return 2.0 * times.sum(), 2.0 * (times * precession).sum()


def test_the_nutation_of_a_top_without_friction():
    """Orbits up to a shift of place and azimuth, in a family for each of the normal and axial momentum and the energy."""
    top = rutstam_top()
    orbit = periodic_orbit(tippe.Scene(top), tippe.Launch(0.5, 100.0, azimuth=0.7), turns_back)
    period, angle = nutation(top, 0.5, 100.0)
    np.testing.assert_allclose(orbit.period, period, rtol=1e-10)
    assert orbit.names[:1] + orbit.names[3:] == (
        "theta",
        "angular_velocity_t1",
        "angular_velocity_t2",
        "angular_velocity_n",
    )
    np.testing.assert_allclose(orbit.state, [0.5, 0.0, 0.0, 100.0 * np.sin(0.5), 0.0, 100.0 * np.cos(0.5)], atol=1e-8)
    # The velocity of the centre of mass keeps its direction while the axis turns.
    pair = np.exp(1j * angle * np.array([1.0, -1.0]))
    np.testing.assert_allclose(np.sort_complex(orbit.multipliers), np.sort_complex([*pair, 1.0, 1.0, 1.0]), atol=1e-5)
    assert orbit.family == 3
    # The numbers of the state are those of a launch.
    theta, *rest = np.asarray(orbit.state)
    launch = tippe.Launch(theta, 0.0, velocity=tuple(rest[:2]), angular_velocity=tuple(rest[2:]))
    run = tippe.simulate(tippe.Scene(top), launch, 0.1, times=[float(orbit.period)])
    np.testing.assert_allclose(run.theta[0], theta, atol=1e-8)


def test_a_section_that_tells_shifted_motions_apart_is_refused():
    """Otherwise a top that has precessed by a part of a turn between two crossings seems to have returned."""
    scene, launch = tippe.Scene(rutstam_top()), tippe.Launch(0.5, 100.0)
    message = (
        "event: the section tells apart motions that the scene allows to shift, .* use a function of theta, velocity_t1"
    )
    for section in (
        lambda t, motion: jnp.sin(motion.azimuth - 0.3),
        lambda t, motion: motion.position[0] - 0.001,
        lambda t, motion: motion.velocity[0],
    ):
        with pytest.raises(ValueError, match=message):
            periodic_orbit(scene, launch, section)
    with pytest.raises(ValueError, match="use a function of speed, steering, steering_rate"):
        periodic_orbit(
            stroller.Scene(SPRUNG), stroller.Launch((0.0, 0.0), 0.3, 1.0), lambda t, motion: motion.heading - 1.0
        )


class Shaken(eqx.Module):
    """A constant drive, and a torque on the fork with a period of 2 s."""

    force: float
    torque: float = 0.1

    def __call__(self, t, motion):
        return self.force, self.torque * jnp.sin(jnp.pi * t)


SPRUNG = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05, steering_spring=0.5)


def ride(force, steering_damping=0.05, speed=1.0, **options):
    scene = stroller.Scene(SPRUNG, friction=stroller.Damping(2.0, 1.0, 0.2, steering_damping))
    launch = stroller.Launch((1.0, 0.0), 0.3, speed)
    return periodic_orbit(scene, launch, period=2.0, input=Shaken(force), **options)


def fork(damping):
    """The angle and its rate of a fork alone, J_f phi'' + c phi' + k phi = torque sin(pi t), and the absolute value and the
    angle of its multipliers."""
    inertia, spring = SPRUNG.steering_inertia, SPRUNG.steering_spring
    amplitude = 0.1 / (spring - inertia * jnp.pi**2 + 1j * jnp.pi * damping)
    rate = jnp.sqrt(spring / inertia - (0.5 * damping / inertia) ** 2)
    return jnp.stack([amplitude.imag, (1j * jnp.pi * amplitude).imag, jnp.exp(-damping / inertia), 2.0 * rate])


def test_a_stroller_whose_fork_is_shaken():
    # At rest, the fork alone swings.
    still = ride(0.0, speed=0.0)
    angle, rate, decay, phase = fork(0.05)
    np.testing.assert_allclose(still.state, [0.0, angle, rate], atol=1e-11)
    assert still.names == ("speed", "steering", "steering_rate")
    pair = decay * jnp.exp(1j * phase)
    assert np.min(np.abs(still.multipliers - pair)) < 1e-9
    assert still.stable

    moving = ride(4.0)
    scene = stroller.Scene(SPRUNG, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    run = stroller.simulate(
        scene, stroller.Launch((0.0, 0.0), 0.0, 1.0), 80.0, Shaken(4.0), times=[80.0], tolerance=1e-12
    )
    expected = [run.speed[0], run.steering[0], run.steering_rate[0]]
    np.testing.assert_allclose(moving.state, expected, rtol=1e-8)

    branch = moving.branch("force", 5.0, step=0.5)
    np.testing.assert_allclose(branch.states[-1], ride(5.0).state, rtol=1e-9)
    assert branch.stable.all()
    with pytest.raises(ValueError, match="is a part of the start"):
        moving.branch("speed", 2.0)
    with pytest.raises(ValueError, match="is left out in the scene"):
        moving.branch("centre", 0.1)


@pytest.mark.slow
def test_derivatives_of_a_stroller_by_numbers():
    slopes = jax.jit(jax.jacfwd(lambda damping: ride(0.0, damping, speed=0.0).state))(0.05)
    np.testing.assert_allclose(slopes, [0.0, *jax.jacfwd(fork)(0.05)[:2]], atol=1e-9)
    slope = jax.grad(lambda force: ride(force).state[0])(4.0)
    difference = (ride(4.001).state[0] - ride(3.999).state[0]) / 0.002
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


@pytest.mark.slow
def test_several_launches_lead_to_one_orbit():
    scene = stroller.Scene(SPRUNG, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    launches = [stroller.Launch((0.0, 0.0), 0.0, speed) for speed in (1.0, 1.3)]
    (orbit,) = periodic_orbit(scene, launches, period=2.0, input=Shaken(4.0))
    np.testing.assert_allclose(orbit.state, ride(4.0).state, rtol=1e-9)
    batch = jax.jit(jax.vmap(lambda force: ride(force).state))(jnp.array([4.0, 5.0]))
    np.testing.assert_allclose(batch, [ride(4.0).state, ride(5.0).state], rtol=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_nutation_by_numbers():
    def period(offset, spin):
        top = eqx.tree_at(lambda top: top.offset, rutstam_top(), offset)
        return periodic_orbit(tippe.Scene(top), tippe.Launch(0.5, spin), turns_back).period

    def exact(offset, spin):
        return nutation(eqx.tree_at(lambda top: top.offset, rutstam_top(), offset), 0.5, spin)[0]

    slopes = jax.grad(period, (0, 1))(rutstam_top().offset, 100.0)
    near, far = ((exact(0.006 + h, 100.0) - exact(0.006 - h, 100.0)) / (2.0 * h) for h in (3e-5, 6e-5))
    by_offset = (4.0 * near - far) / 3.0
    by_spin = (exact(0.006, 100.01) - exact(0.006, 99.99)) / 0.02
    np.testing.assert_allclose(slopes, [by_offset, by_spin], rtol=1e-6)


def rocks(t, motion):
    return motion.theta_rate


@pytest.mark.slow
def test_an_ellipsoid_that_rocks():
    """In the plane across its long axis, (I + m r^2) theta'^2 / 2 + m g h is constant, with the distance r of the centre of
    mass from the contact and its height h. Half a period later the body leans to the other side."""
    inertia, amplitude, gravity = 2e-4, 0.1, 9.81
    body = tippe.Ellipsoid(1.0, (0.2, 0.03, 0.02), (0.0, 0.0, -0.01), np.diag([inertia, 1.6e-3, 1.7e-3]))
    scene = tippe.Scene(body, friction=tippe.NoSlip())

    def other_side(state):
        return state.at[1].add(-jnp.pi)

    launch = tippe.Launch(amplitude, 0.0, azimuth=0.5 * np.pi)
    orbit = periodic_orbit(scene, launch, rocks, symmetry=other_side)

    def height(angle):
        return np.hypot(0.03 * np.sin(angle), 0.02 * np.cos(angle)) - 0.01 * np.cos(angle)

    angle = amplitude * np.sin(0.5 * np.pi * (np.arange(200) + 0.5) / 200.0)
    normal = np.stack([np.sin(angle), np.cos(angle)])
    squares = np.array([[0.03**2], [0.02**2]])
    lever = squares * normal / np.sqrt(np.sum(squares * normal**2, axis=0)) - np.array([[0.0], [0.01]])
    rate = np.sqrt(2.0 * gravity * (height(amplitude) - height(angle)) / (inertia + np.sum(lever**2, axis=0)))
    half = 2.0 * np.sum(np.sqrt(amplitude**2 - angle**2) / rate) * 0.5 * np.pi / 200.0
    np.testing.assert_allclose(orbit.period, half, rtol=1e-10)
    np.testing.assert_allclose(orbit.state[:2], [amplitude, 0.5 * np.pi], atol=1e-9)
    assert orbit.names[:3] == ("theta", "azimuth", "angular_velocity_t1")


@pytest.mark.slow
def test_a_top_that_rolls():
    """The velocity follows from the other numbers. Jellett's and Routh's constants and the energy make a family."""
    scene = tippe.Scene(rutstam_top(), friction=tippe.SetValuedCoulomb(0.8))
    launch = tippe.Launch(0.5, 30.0, velocity=(0.0, -30.0 * np.sin(0.5) * 0.02))
    orbit = periodic_orbit(scene, launch, turns_back, t1=1.0)
    assert orbit.family == 3
    np.testing.assert_allclose(np.sort(np.abs(orbit.multipliers)), [0.0, 0.0, 1.0, 1.0, 1.0], atol=1e-4)
    times = np.array([1.0, 2.0]) * float(orbit.period)
    run = tippe.simulate(scene, launch, 0.3, times=times, tolerance=1e-12)
    np.testing.assert_allclose(run.theta, 0.5, atol=1e-9)
    np.testing.assert_allclose(run.theta_rate, 0.0, atol=1e-8)


def middle(t, motion):
    return motion.velocity[0]


@pytest.mark.slow
def test_a_top_that_swings_in_a_cylinder():
    """A double pendulum in the plane: the angles eta of the centre and psi of the axis, from the vertical."""
    top = rutstam_top()
    mass, a, I1, g, rho = (float(x) for x in (top.mass, top.offset, top.I1, 9.81, 0.3 - float(top.radius)))
    launch = tippe.Launch(0.0285, 0.0, eta=0.3, azimuth=np.pi)
    orbit = periodic_orbit(tippe.Scene(top, tippe.Cylinder(0.3)), launch, middle)
    theta, eta, azimuth = (float(x) for x in orbit.state[:3])
    assert abs(eta - 0.3) < 0.1
    np.testing.assert_allclose(np.cos(azimuth), -1.0, atol=1e-8)
    np.testing.assert_allclose(orbit.state[3:], 0.0, atol=1e-6)

    def field(t, y):
        eta, psi, eta_rate, psi_rate = y
        c, s = np.cos(psi - eta), np.sin(psi - eta)
        matrix = mass * np.array([[rho**2, rho * a * c], [rho * a * c, a**2 + I1 / mass]])
        force = mass * np.array(
            [rho * a * s * psi_rate**2 - g * rho * np.sin(eta), -rho * a * s * eta_rate**2 - g * a * np.sin(psi)]
        )
        return [eta_rate, psi_rate, *np.linalg.solve(matrix, force)]

    start = [eta, eta + theta, 0.0, 0.0]
    end = solve_ivp(field, (0.0, float(orbit.period)), start, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(end, start, atol=1e-7)


def test_what_is_no_orbit_of_a_scene():
    scene = tippe.Scene(rutstam_top())
    launch = tippe.Launch(0.5, 100.0)
    motion = tippe.steady.tumbling(scene, 1.0)
    about_axis = motion.spin - motion.precession * np.cos(1.0)
    steady = tippe.Launch(1.0, about_axis, angular_velocity=(0.0, 0.0, motion.precession))
    with pytest.raises(
        ValueError, match=r"is an equilibrium; a steady motion is no orbit, and tippe\.steady has those"
    ):
        periodic_orbit(scene, steady, turns_back)
    with pytest.raises(ValueError, match=r"theta = 0\.0 must be greater than 0\.0 \(the axis must lean"):
        periodic_orbit(scene, tippe.Launch(0.0, 100.0), turns_back)
    with pytest.raises(ValueError, match="the section of a scene needs event="):
        periodic_orbit(scene, launch)
    with pytest.raises(ValueError, match="are found on planes, cylinders and spheres"):
        periodic_orbit(tippe.Scene(rutstam_top(), tippe.Paraboloid(1.0)), launch, turns_back)
    circling = stroller.Scene(CART, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    with pytest.raises(ValueError, match="pass period="):
        periodic_orbit(circling, stroller.Launch((0.0, 0.0), 0.0, 1.0), lambda t, m: m.speed, input=Shaken(1.0))
