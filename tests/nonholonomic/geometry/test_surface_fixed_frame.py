"""Grounds in the fixed frame against their charts: normals, their rates, curvature, heights."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholonomic.geometry import Plane, Sphere, Spheroid

GROUNDS = [Sphere(1.4), Spheroid(2.0, 1.1), Spheroid(0.9, 1.6), Spheroid.from_oblate(2.0, 0.8)]
PLACE = (jnp.asarray(0.7), jnp.asarray(-0.4))


def position(ground, place):
    return jnp.stack(ground.chart(place)[0])


@pytest.mark.parametrize("ground", GROUNDS, ids=str)
def test_normal_and_tangents_are_those_of_the_chart(ground):
    """n = east x north, and east and north are the unit vectors of the chart's derivatives."""
    by_mu, by_eta = (jax.jacfwd(lambda x, k=k: position(ground, _with(k, x)))(PLACE[k]) for k in (0, 1))
    _, east, north = ground.chart(PLACE)
    np.testing.assert_allclose(jnp.stack(east), by_mu / jnp.linalg.norm(by_mu), atol=1e-15)
    np.testing.assert_allclose(jnp.stack(north), by_eta / jnp.linalg.norm(by_eta), atol=1e-15)
    normal = jnp.stack(ground.normal(ground.chart(PLACE)[0]))
    np.testing.assert_allclose(normal, jnp.cross(jnp.stack(east), jnp.stack(north)), atol=1e-15)


def _with(k, x):
    return (x, PLACE[1]) if k == 0 else (PLACE[0], x)


@pytest.mark.parametrize("ground", GROUNDS, ids=str)
def test_rate_of_the_normal_is_its_derivative(ground):
    r, east, north = ground.chart(PLACE)
    velocity = tuple(0.8 * a - 0.5 * b for a, b in zip(east, north, strict=True))
    _, expected = jax.jvp(ground.normal, (r,), (velocity,))
    np.testing.assert_allclose(ground.normal_rate(r, velocity), expected, atol=1e-15)


@pytest.mark.parametrize("ground", GROUNDS, ids=str)
def test_gaussian_curvature_is_the_determinant_of_the_shape_operator(ground):
    r, east, north = ground.chart(PLACE)
    rates = [jnp.stack(ground.normal_rate(r, one)) for one in (east, north)]
    shape = [[rate @ jnp.stack(one) for one in (east, north)] for rate in rates]
    np.testing.assert_allclose(ground.gaussian_curvature(r), np.linalg.det(np.array(shape)), rtol=1e-14)


def test_gaussian_curvature_of_the_oblate_spheroid():
    """`stroller.md`, section 0: K = sinh^2(xi) / (a^2 D^2), D = sinh^2(xi) + sin^2(eta)."""
    a, xi, eta = 2.0, 0.8, -0.4
    ground = Spheroid.from_oblate(a, xi)
    D = math.sinh(xi) ** 2 + math.sin(eta) ** 2
    r = ground.chart((jnp.asarray(0.3), jnp.asarray(eta)))[0]
    np.testing.assert_allclose(ground.gaussian_curvature(r), math.sinh(xi) ** 2 / (a * D) ** 2, rtol=1e-14)


@pytest.mark.parametrize("ground", [*GROUNDS, Plane(), Plane(0.3)], ids=str)
def test_place_and_position_go_back_and_forth(ground):
    r = ground.chart(PLACE)[0]
    np.testing.assert_allclose(ground.place_at(r), PLACE, rtol=1e-14)
    departure = ground.offset(r)
    assert departure is None or abs(float(departure)) < 1e-15


@pytest.mark.parametrize("ground", [*GROUNDS, Plane(0.3)], ids=str)
def test_elevation_is_the_height_in_the_fixed_frame(ground):
    r = ground.chart(PLACE)[0]
    lowest = 0.0 if isinstance(ground, Plane) else -float(ground.semi_axes[1])
    np.testing.assert_allclose(ground.elevation(r), ground.in_fixed_frame(r)[2] - lowest, rtol=1e-14)


def test_a_level_plane_carries_no_terms():
    """Plane() and Plane(tilt=0.0) are one pytree without leaves; a tilted one has one."""
    assert jax.tree.leaves(Plane()) == jax.tree.leaves(Plane(tilt=0.0)) == []
    assert jax.tree.structure(Plane()) == jax.tree.structure(Plane(tilt=0.0))
    assert len(jax.tree.leaves(Plane(tilt=0.1))) == 1
    assert Plane().elevation((1.0, 2.0, None)) is None
    assert Plane(tilt=0.1).normal_rate((1.0, 2.0, None), (1.0, 0.0, None)) == (None, None, None)


def test_a_tilt_may_be_traced_through_zero():
    slope = jax.grad(lambda tilt: Plane(tilt).elevation((jnp.asarray(2.0), jnp.asarray(1.0), None)))(0.0)
    np.testing.assert_allclose(slope, 2.0)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Plane(tilt=2.0), r"tilt = 2\.0 must be at most 1\.57"),
        (lambda: Plane(tilt="steep"), r"tilt = 'steep' is not a number"),
        (lambda: Spheroid(0.0, 1.0), r"equatorial = 0\.0 must be greater than 0\.0"),
        (lambda: Spheroid(1.0, -1.0), r"polar = -1\.0 must be greater than 0\.0"),
        (lambda: Spheroid.from_oblate(1.0, 0.0), r"xi = 0\.0 must be greater than 0\.0"),
        (lambda: Spheroid.from_oblate(-1.0, 1.0), r"a = -1\.0 must be greater than 0\.0"),
    ],
)
def test_bad_numbers_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
