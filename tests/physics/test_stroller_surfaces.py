"""The stroller on torus, paraboloid, cylinder and graphs against integrations that know nothing of it, and closed forms."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import stroller_reference as reference
from hypothesis import given, settings, strategies
from scipy.integrate import solve_ivp

import stroller
from stroller import Cylinder, Damping, Graph, Launch, Paraboloid, Scene, Stroller, Torus

TIMES = np.linspace(0.0, 3.0, 13)
TOLERANCE = 1e-12


class Hills(eqx.Module):
    """Four waves of a common height [m]; of each a share, two wave numbers [1/m] and a phase."""

    height: float
    waves: np.ndarray

    def __call__(self, x, y):
        share, kx, ky, mode = self.waves
        return self.height * sum(share[k] * jnp.sin(kx[k] * x + ky[k] * y + mode[k]) for k in range(4))

    def slopes(self, x, y):
        """Gradient and Hessian, for the reference."""
        share, kx, ky, mode = np.asarray(self.waves)
        phase, number = kx * x + ky * y + mode, np.stack([kx, ky])
        height = float(self.height)
        return height * number @ (share * np.cos(phase)), -height * (number * share * np.sin(phase)) @ number.T


HILLS = Hills(0.3, np.array([[0.6, 0.5, 0.3, 0.2], [0.9, -0.4, 1.3, 0.2], [0.3, 1.1, -0.8, 1.7], [0.1, 2.0, 4.0, 5.0]]))


class Helm(eqx.Module):
    """A force and a torque that swing."""

    force: float
    torque: float

    def __call__(self, t, motion):
        return self.force * (1.0 + jnp.sin(2.0 * t)), self.torque * jnp.cos(3.0 * t)


def scene(surface, gravity=9.81, damping=(0.0, 0.0, 0.0, 0.0)):
    """One kind of scene, inside where there is an inside, so that a surface needs one program."""
    side = "inside" if "inside" in surface.sides else None
    body = Stroller(1.7, 0.3, 0.4, 0.05, steering_spring=0.2)
    return Scene(body, surface, Damping(*(jnp.asarray(number) for number in damping)), gravity, side, "absolute")


def ride(scene, launch, force=0.0, torque=0.0):
    return stroller.simulate(scene, launch, TIMES[-1], Helm(jnp.asarray(force), jnp.asarray(torque)), TIMES, TOLERANCE)


STEERED = {
    "torus": (Torus(3.0, 1.2), (0.4, -1.2), reference.torus(3.0, 1.2), -1.0),
    "graph": (Graph(HILLS), (0.3, -0.5), reference.graph(HILLS.slopes), 1.0),
}


@pytest.mark.parametrize("name", ["torus", pytest.param("graph", marks=pytest.mark.slow)])
def test_a_steered_ride_is_that_of_a_rigid_body_with_multipliers(name):
    """With gravity, damping, spring, drive and torque, fork turning with the frame: motion and all forces."""
    surface, place, level, sign = STEERED[name]
    damping = (0.3, 0.2, 0.1, 0.05)
    run = ride(scene(surface, damping=damping), Launch(place, 0.7, 1.1, 0.3, -0.4), 2.0, 0.3)

    def push(t):
        return 2.0 * (1.0 + np.sin(2.0 * t)), 0.3 * np.cos(3.0 * t)

    vehicle = reference.Vehicle(1.7, 0.3, 0.4, 0.05, 0.2, damping, 9.81, push, True, sign)
    start = reference.started(
        level, np.asarray(run.position[0]), np.asarray(run.direction[0]), sign, 0.3, 1.1, 0.3, -0.4
    )
    states, expected = reference.ride(level, vehicle, start, TIMES)
    np.testing.assert_allclose(run.position, states[:, :3], atol=1e-8)
    np.testing.assert_allclose(run.direction, states[:, 6:9], atol=1e-8)
    np.testing.assert_allclose(np.stack([run.yaw_rate, run.steering, run.steering_rate], 1), states[:, 9:], atol=1e-8)
    np.testing.assert_allclose(run.speed, np.sum(states[:, 3:6] * states[:, 6:9], axis=1), atol=1e-8)
    np.testing.assert_allclose(run.normal_force, [state.normal_force for state in expected], atol=1e-7)
    np.testing.assert_allclose(run.side_force, [(state.rear, state.front) for state in expected], atol=1e-7)
    np.testing.assert_allclose(run.energy_residual, 0.0, atol=1e-9)
    assert np.ptp(run.steering) > 0.3
    assert np.ptp(run.position, axis=0).min() > 0.1


def graph_geodesic(t, y, slopes):
    """x'' = -h_x q, y'' = -h_y q, with q = (v . h'' v) / (1 + |grad h|^2)."""
    first, second = slopes(*y[:2])
    bend = y[2:] @ second @ y[2:] / (1.0 + first @ first)
    return np.concatenate([y[2:], -bend * first])


def torus_geodesic(t, y):
    """The Christoffel symbols of a torus of radii 3 and 1.2 in azimuth and angle about the tube."""
    _, eta, mu_rate, eta_rate = y
    from_axis = 3.0 + 1.2 * np.cos(eta)
    return [
        mu_rate,
        eta_rate,
        2.4 * np.sin(eta) / from_axis * mu_rate * eta_rate,
        -from_axis * np.sin(eta) / 1.2 * mu_rate**2,
    ]


def bowl(x, y):
    return np.array([x, y]) / 0.8, np.eye(2) / 0.8


@pytest.mark.parametrize(
    ("surface", "geodesic"),
    [
        (Torus(3.0, 1.2), torus_geodesic),
        (Paraboloid(0.8), lambda t, y: graph_geodesic(t, y, bowl)),
        (Graph(HILLS), lambda t, y: graph_geodesic(t, y, HILLS.slopes)),
    ],
    ids=["torus", "paraboloid", "graph"],
)
def test_a_straight_ride_without_gravity_is_a_geodesic(surface, geodesic):
    """In two coordinates, integrated by SciPy; speed constant, and Clairaut's constant on a surface of revolution."""
    run = ride(scene(surface, gravity=0.0), Launch((0.4, 0.3), 0.7, 1.1))
    start, direction = np.asarray(run.position[0]), 1.1 * np.asarray(run.direction[0])
    rates = direction[:2]
    if isinstance(surface, Torus):
        outward = np.array([np.cos(0.4), np.sin(0.4), 0.0])
        east = np.array([-np.sin(0.4), np.cos(0.4), 0.0])
        north = -np.sin(0.3) * outward + np.cos(0.3) * np.array([0.0, 0.0, 1.0])
        np.testing.assert_allclose(
            start, (3.0 + 1.2 * np.cos(0.3)) * outward + [0.0, 0.0, 1.2 * np.sin(0.3)], atol=1e-14
        )
        rates = np.array([direction @ east / (3.0 + 1.2 * np.cos(0.3)), direction @ north / 1.2])
    expected = solve_ivp(geodesic, (0.0, TIMES[-1]), [0.4, 0.3, *rates], "DOP853", TIMES, rtol=1e-12, atol=1e-13).y.T
    np.testing.assert_allclose(run.place, expected[:, :2], atol=1e-10)
    np.testing.assert_allclose(run.speed, 1.1, rtol=1e-12)
    np.testing.assert_allclose(run.departure, 0.0, atol=1e-10)
    if not isinstance(surface, Graph):
        x, y, _ = run.position.T
        clairaut = 1.1 * (x * run.direction[:, 1] - y * run.direction[:, 0])
        np.testing.assert_allclose(clairaut, clairaut[0], rtol=1e-10)


def circle(rear, heading, radius, distance):
    """Where a turn to the left of a given radius leads from a point of the plane."""
    centre = rear + radius * np.array([-np.sin(heading), np.cos(heading)])
    angle = heading + distance / radius
    return centre + radius * np.stack([np.sin(angle), -np.cos(angle)], axis=-1)


LOCKED = 0.3 / np.tan(0.5)


def locked(scene):
    """The scene with a fork too heavy to turn, and no spring."""
    numbers = (jnp.asarray(1e12, float), jnp.asarray(0.0, float))
    return eqx.tree_at(lambda node: (node.body.steering_inertia, node.body.steering_spring), scene, numbers)


def test_a_cylinder_unrolls_and_a_huge_torus_does_so_nearly():
    """At a fixed steering angle the stroller runs a circle of the unrolled cylinder; off by 1/ring on a torus.

    Inside, its left is to the right as seen from outside.
    """
    run = ride(locked(scene(Cylinder(1.2), gravity=0.0)), Launch((0.2, 2.0), 0.7, 1.1, 0.5))
    expected = circle(np.array([0.2, 1.2 * 2.0]), 0.7, -LOCKED, 1.1 * TIMES)
    np.testing.assert_allclose(run.place * np.array([1.0, 1.2]), expected, atol=1e-10)
    errors = []
    for ring in (1e4, 1e5):
        run = ride(locked(scene(Torus(ring, 1.2), gravity=0.0)), Launch((0.2 / ring, 2.0 - 0.5 * np.pi), 0.7, 1.1, 0.5))
        unrolled = run.place * np.array([ring, 1.2]) + np.array([0.0, 0.6 * np.pi])
        errors.append(np.max(np.abs(unrolled - expected)))
    np.testing.assert_allclose(errors[0] / errors[1], 10.0, rtol=1e-2)


def test_a_graph_of_zero_is_a_plane():
    flat = scene(Graph(eqx.tree_at(lambda node: node.height, HILLS, jnp.asarray(0.0, float))))
    run = ride(locked(flat), Launch((0.2, 0.1), 0.7, 1.1, 0.5))
    np.testing.assert_allclose(run.place, circle(np.array([0.2, 0.1]), 0.7, LOCKED, 1.1 * TIMES), atol=1e-10)
    np.testing.assert_allclose(run.normal_force, 1.7 * 9.81, rtol=1e-12)
    np.testing.assert_allclose(run.wheelbase_error, 0.0)
    # Plain numbers would be constants of the program that reads off a run, and every run another program.
    assert all(eqx.is_array(part) for part in run.stats)


def within(*bounds):
    return strategies.floats(*bounds, allow_subnormal=False)


@settings(max_examples=25, deadline=None)
@given(
    height=within(0.0, 1.0),
    waves=strategies.lists(within(-2.0, 2.0), min_size=16, max_size=16),
    damping=strategies.tuples(*(within(0.0, 3.0),) * 4),
    gravity=within(0.0, 20.0),
    launch=strategies.tuples(*(within(-3.0, 3.0),) * 6),
)
def test_on_random_hills_energy_never_grows(height, waves, damping, gravity, launch):
    """Finite or flagged; the stroller stays on the ground, does not slip, and without a drive loses energy to friction only."""
    hills = Hills(height, np.reshape(waves, (4, 4)))
    x, y, heading, speed, steering, rate = launch
    run = ride(
        scene(Graph(hills), gravity=gravity, damping=damping), Launch((x, y), heading, speed, 0.4 * steering, rate)
    )
    assert run.status in ("completed", "contact_lost")
    energy, scale = np.asarray(run.energy), 1.7 * (gravity * (1.0 + height) + 10.0)
    assert np.all(np.isfinite(run.position))
    assert np.all(np.diff(energy) <= 1e-9 * scale)
    np.testing.assert_allclose(run.energy_residual, 0.0, atol=1e-9 * scale)
    np.testing.assert_allclose(run.departure, 0.0, atol=1e-9)
    np.testing.assert_allclose(run.constraint, 0.0, atol=1e-11)
