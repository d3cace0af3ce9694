"""Flights higher than the arena's least radius of curvature, where it has several nearest points: when and where they land.

The reference is a flight in closed form, the centre of mass on a parabola and the axis on a cone about L (`tippe.md`, section
3), and the distance of the sphere's centre from the arena by brute force: the least over a dense grid of places, refined. It
shares nothing with the simulator.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from scipy.optimize import brentq, minimize

import tippe

MASS, RADIUS, GRAVITY = 0.01, 0.012, 9.81
OFFSET, I1 = 0.3 * RADIUS, 0.36 * MASS * RADIUS**2


def thrown(surface: tippe.Graph | tippe.Spheroid | tippe.Paraboloid, launch: tippe.Launch, t1: float, tolerance: float):
    """A small top thrown across an arena."""
    top = tippe.Top(MASS, RADIUS, OFFSET, I1, 0.4 * MASS * RADIUS**2)
    scene = tippe.Scene(top, surface, tippe.Coulomb(0.3, 0.05), contact="hybrid", restitution=0.5)
    return tippe.simulate(scene, launch, t1, tolerance=tolerance)


def flown(run, time: float):
    """The path of the sphere's centre in the flight that is under way at a time [s], in closed form."""
    sample = run.at([time])
    e, L = (np.asarray(part)[0] for part in (sample.axis, sample.angular_momentum))
    centre, u = (np.asarray(part)[0] for part in (sample.position, sample.velocity))
    rate = np.linalg.norm(L) / I1
    direction = L / np.linalg.norm(L)
    parallel, binormal = (direction @ e) * direction, np.cross(direction, e)
    s, u = centre - OFFSET * e, u - OFFSET * rate * binormal

    def path(t: float):
        t = t - time
        axis = parallel + np.cos(rate * t) * (e - parallel) + np.sin(rate * t) * binormal
        return s + u * t - np.array([0.0, 0.0, 0.5 * GRAVITY * t * t]) + OFFSET * axis

    return path


def landing(path, distance, start: float, end: float) -> float:
    """When the sphere is first at the arena again [s]."""
    times = np.linspace(start, end, 400)
    gaps = np.array([distance(path(t)) for t in times]) - RADIUS
    k = np.flatnonzero(gaps < 0.0)[0]
    return brentq(lambda t: distance(path(t)) - RADIUS, times[k - 1], times[k], xtol=1e-13)


def ripples(s):
    """Height of the ripples a way s [m] across them."""
    return 0.006 * np.sin(np.hypot(60.0, 10.0) * s)


def from_ripples(centre) -> float:
    """Distance of a point from the ripples, which are straight."""
    s, z = centre[:2] @ np.array([60.0, 10.0]) / np.hypot(60.0, 10.0), centre[2]

    def square(x):
        return (x - s) ** 2 + (ripples(x) - z) ** 2

    grid = s + np.linspace(-0.15, 0.15, 3001)
    start_guess = grid[np.argmin(square(grid))]
    return np.sqrt(minimize(lambda x: square(x[0]), [start_guess], tol=1e-16).fun)


def from_ellipse(equatorial: float, polar: float):
    """Distance of a point inside from a spheroid."""

    def distance(centre) -> float:
        r, z = np.hypot(*centre[:2]), centre[2]

        def square(eta):
            return (equatorial * np.cos(eta) - r) ** 2 + (polar * np.sin(eta) - z) ** 2

        grid = np.linspace(-np.pi / 2, np.pi / 2, 3001)
        start_guess = grid[np.argmin(square(grid))]
        return np.sqrt(minimize(lambda x: square(x[0]), [start_guess], tol=1e-16).fun)

    return distance


def from_bowl(p: float):
    """Distance of a point above it from a paraboloid."""

    def distance(centre) -> float:
        r, z = np.hypot(*centre[:2]), centre[2]
        roots = np.roots([1.0 / (2.0 * p * p), 0.0, 1.0 - z / p, -r])
        real_roots = roots[np.abs(roots.imag) < 1e-9].real
        return np.sqrt(np.min((real_roots - r) ** 2 + (real_roots**2 / (2.0 * p) - z) ** 2))

    return distance


def check(run, distance, flight: int) -> None:
    """A flight ends where it should, the energy never grows, and the top stays clear of the arena."""
    start, end = run.hops[flight]
    middle = 0.5 * (start + end)
    assert_close(end, landing(flown(run, middle), distance, middle, end + 0.1), atol=2e-9)
    energy, work = np.asarray(run.energy), np.asarray(run.work)
    assert_close(energy, energy[0] + work, atol=1e-9 * energy[0])
    assert np.all(np.diff(work) < 1e-12 * energy[0])
    clear = np.array([distance(centre) for centre in np.asarray(run.position)]) - RADIUS
    assert_close(np.asarray(run.distance[0]), clear, atol=1e-8)


def over_ripples(tolerance: float):
    """A throw over crests 45 mm in radius, along which a dozen points are about as near at the top of the flight."""
    ground = tippe.Graph(lambda x, y: 0.006 * jnp.sin(60.0 * x + 10.0 * y))
    return thrown(ground, tippe.Launch(0.4, 100.0, place=(0.0, 0.0), velocity=(3.5, 0.3)), 0.3, tolerance)


@pytest.mark.slow
def test_a_flight_over_ripples_lands_at_the_same_time_at_all_tolerances():
    """At .247905 s, by the reference below; by Newton's nearest point it landed at .0893, .1489 or .2479 s, with twice the
    energy."""
    for tolerance in (1e-6, 1e-8, 1e-9, 1e-11):
        run = over_ripples(tolerance)
        assert run.status == "completed"
        assert_close(run.hops[0, 1], 0.247905296, atol=5e-9)
        assert run.stats["energy_residual"] < 1e-7 * 0.065


@pytest.mark.slow
def test_a_flight_over_ripples_lands_where_the_parabola_meets_them():
    """And the distance is the least on the whole way."""
    check(over_ripples(1e-9), from_ripples, 0)


@pytest.mark.slow
@pytest.mark.parametrize("closed", [True, False], ids=["spheroid", "implicit"])
def test_flights_across_a_flat_spheroid_land_on_it(closed):
    """Inside semi-axes of .3 and .1 m, by its own formulas and as a function: no position is outside."""
    if closed:
        surface, place = tippe.Spheroid(0.3, 0.1), (0.0, 0.6)
    else:
        surface = tippe.Implicit(lambda x, y, z: 1.0 - (x * x + y * y) / 0.09 - z * z / 0.01)
        place = (0.3 * np.sin(0.6), 0.0, -0.1 * np.cos(0.6))
    run = thrown(surface, tippe.Launch(0.5, 100.0, place=place, velocity=(3.5, 0.0)), 0.6, 1e-9)
    assert run.status == "completed"
    assert len(run.hops) > 3
    for flight in range(3):
        check(run, from_ellipse(0.3, 0.1), flight)


@pytest.mark.slow
def test_a_flight_out_of_a_bowl_lands_on_its_wall():
    """Across the axis far above the focus of a paraboloid."""
    run = thrown(tippe.Paraboloid(0.1), tippe.Launch(0.4, 100.0, place=(0.1, 0.0), velocity=(-3.0, 0.2)), 0.6, 1e-9)
    assert run.status == "completed"
    assert float(np.max(np.asarray(run.position)[:, 2])) > 0.2
    check(run, from_bowl(0.1), 0)


class Mistaken(tippe.Paraboloid):
    """A bowl that states half of its heights."""

    def elevation(self, position):
        return 0.5 * position[2]


@pytest.mark.slow
def test_a_run_whose_energy_does_not_balance_is_unresolved():
    """The same run in a bowl that states its heights is whole."""
    launch = tippe.Launch(0.4, 100.0, place=(0.1, 0.0), velocity=(0.0, 0.2))
    exact, wrong_run = (thrown(kind(0.3), launch, 0.05, 1e-9) for kind in (tippe.Paraboloid, Mistaken))
    assert [exact.status, wrong_run.status] == ["completed", "unresolved"]
    assert "unresolved" not in str(exact)
    assert "unresolved: the energy residual of" in str(wrong_run)
