"""Every surface in its own axes against its chart, its derivatives, other descriptions of it, and its limits."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholonomic.geometry import Cylinder, Graph, Implicit, Paraboloid, Plane, Sphere, Spheroid, Torus
from nonholonomic.geometry.vector import tangents

RNG = np.random.default_rng(5)
LANES = 40


class Waves(eqx.Module):
    """Standing waves; the phases hold several numbers."""

    height: float
    number: float
    mode: np.ndarray

    def __call__(self, x, y):
        first, second = self.mode
        return self.height * jnp.sin(self.number * x + first) * jnp.cos(0.7 * self.number * y + second)


class Quartic(eqx.Module):
    """Positive inside a rounded cube."""

    size: float

    def __call__(self, x, y, z):
        return self.size**4 - (x**4 + y**4 + z**4 + 0.3 * x * y * z * z)


CURVED = [
    Cylinder(1.3),
    Sphere(1.4),
    Spheroid(2.0, 1.1),
    Spheroid(0.9, 1.6),
    Spheroid.from_oblate(2.0, 0.8),
    Torus(3.0, 1.2),
    Paraboloid(0.8),
    Graph(Waves(0.3, 1.1, np.array([0.4, 0.2]))),
    Graph(lambda x, y: 0.2 * x * y),
    Implicit(Quartic(1.1)),
]
SURFACES = [Plane(), Plane(0.3), *CURVED]


def places(surface, count=LANES):
    """Random places on a surface; for an implicit surface, places near a sphere, to be moved onto the surface."""
    if isinstance(surface, Implicit):
        displacement = RNG.normal(size=(3, count))
        return tuple(jnp.asarray(part) for part in 1.1 * displacement / np.linalg.norm(displacement, axis=0))
    second = math.pi if isinstance(surface, Torus | Cylinder) else 1.5
    return jnp.asarray(RNG.uniform(-3.0, 3.0, count)), jnp.asarray(RNG.uniform(-second, second, count))


def columns(vector, count=LANES):
    """A vector as (3, count), zeros where it vanishes identically."""
    return np.stack([np.broadcast_to(0.0 if part is None else part, (count,)) for part in vector])


@eqx.filter_jit
def asked(surface, place):
    """What a surface answers at a place: position, east, north, normal, place, position of that, off it by, height less z."""
    r, east, north = surface.chart(place)
    recovered_place, offsets, height = surface.place_at(r), surface.offset(r), surface.elevation(r)
    height_error = 0.0 if height is None else height - surface.in_fixed_frame(r)[2]
    return (
        r,
        east,
        north,
        surface.normal(r),
        recovered_place,
        surface.chart(recovered_place)[0],
        0.0 if offsets is None else offsets,
        height_error,
    )


def directions(count=LANES):
    return RNG.uniform(-1.0, 1.0, (2, count))


@pytest.mark.parametrize("surface", SURFACES, ids=lambda value: type(value).__name__)
def test_chart_normal_and_places_belong_together(surface):
    """East and north are unit vectors with n = east x north, and a place comes back from its position, in space too."""
    place = places(surface)
    r, east, north, normal, recovered_place, chart_position, offsets, height_error = asked(surface, place)
    position, east, north, normal = (columns(value) for value in (r, east, north, normal))
    np.testing.assert_allclose(np.sum(east**2, axis=0), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.cross(east, north, axis=0), normal, atol=1e-13)
    np.testing.assert_allclose(offsets, 0.0, atol=1e-13)
    np.testing.assert_allclose(columns(chart_position), position, atol=1e-13)
    if not isinstance(surface, Implicit):
        np.testing.assert_allclose(np.exp(1j * np.stack(recovered_place)), np.exp(1j * np.stack(place)), atol=1e-13)
    # The height is that in space but for its zero.
    assert np.ptp(np.asarray(height_error)) < 1e-13


@pytest.mark.parametrize("surface", CURVED, ids=lambda value: type(value).__name__)
def test_rate_of_the_normal_and_curvature_are_derivatives(surface):
    """Against central differences of the normal, K = n . (n'(east) x n'(north)), and moving along keeps to the surface."""
    r, east, north = surface.chart(places(surface))
    a, b = directions()
    step = 1e-4
    velocity = a * columns(east) + b * columns(north)
    rate = columns(surface.normal_rate(r, tuple(velocity)))

    def normal_at(time):
        return columns(surface.normal(tuple(columns(r) + time * velocity)))

    near, places_far = normal_at(step) - normal_at(-step), normal_at(2.0 * step) - normal_at(-2.0 * step)
    np.testing.assert_allclose(rate, (8.0 * near - places_far) / (12.0 * step), atol=2e-10)
    normal = columns(surface.normal(r))
    normal_rates = [columns(surface.normal_rate(r, value)) for value in (east, north)]
    K = np.sum(normal * np.cross(*normal_rates, axis=0), axis=0)
    curvature = surface.gaussian_curvature(r)
    np.testing.assert_allclose(0.0 if curvature is None else curvature, K, atol=1e-12 * np.max(np.abs(K)) + 1e-14)
    # The chart runs along the surface: its derivatives have no part along n.
    charted = surface.chart(surface.place_at(tuple(columns(r) + 1e-6 * velocity)))[0]
    np.testing.assert_allclose(np.sum(normal * (columns(charted) - columns(r)), axis=0), 0.0, atol=1e-10)


@eqx.filter_jit
def lifted(surface, place, d):
    """Positions at the distances d above a place, as in space; their distance and its slope, and the place found for them."""
    r = surface.chart(place)[0]
    height_error = tuple(
        (0.0 if a is None else a) + (0.0 if b is None else d * b) for a, b in zip(r, surface.normal(r), strict=True)
    )
    distance, slope = jax.jvp(surface.distance, (height_error,), (tuple(jnp.ones((3, LANES))),))
    return r, distance, slope, surface.chart(surface.in_fixed_frame(height_error))[0]


@pytest.mark.parametrize(
    "surface", [Plane(0.3), *(CURVED[k] for k in (0, 1, 3, 5, 7, 9))], ids=lambda value: type(value).__name__
)
def test_distance_is_along_the_normal(surface):
    """A point moved by d along n is at the distance d, of either sign, whose derivative is n; (x, y, z) names where it was."""
    place, d = places(surface), RNG.uniform(-0.2, 0.2, LANES)
    r, distance, slope, foot = lifted(surface, place, d)
    np.testing.assert_allclose(distance, d, atol=1e-12)
    np.testing.assert_allclose(slope, np.sum(columns(surface.normal(r)), axis=0), atol=1e-11)
    np.testing.assert_allclose(columns(foot), columns(r), atol=1e-12)


#: Surfaces, and the same by a function; where the normal is the opposite one, -1.
SAME = [
    (Sphere(1.4), Implicit(lambda x, y, z: x * x + y * y + z * z - 1.4**2), 1.0),
    (Spheroid(2.0, 1.1), Implicit(lambda x, y, z: 1.0 - (x * x + y * y) / 4.0 - (z / 1.1) ** 2), -1.0),
    (Cylinder(1.3), Implicit(lambda x, y, z: x * x + z * z - 1.3**2), 1.0),
    (Torus(3.0, 1.2), Implicit(lambda x, y, z: (jnp.sqrt(x * x + y * y) - 3.0) ** 2 + z * z - 1.2**2), 1.0),
    (Paraboloid(0.8), Graph(lambda x, y: (x * x + y * y) / 1.6), 1.0),
    (Paraboloid(0.8), Implicit(lambda x, y, z: z - (x * x + y * y) / 1.6), 1.0),
    (Plane(0.3), Graph(lambda x, y: jnp.tan(0.3) * x), 1.0),
]
#: Surfaces that differ from those beside them by less than a tolerance.
LIMITS = [
    (Sphere(1.4), Spheroid(1.4, 1.4 * (1.0 + 1e-9)), 1e-8),
    (Plane(), Graph(Waves(0.0, 1.0, np.zeros(2))), 1e-15),
    (Plane(), Graph(lambda x, y: 0.0), 1e-15),
    (Plane(), Graph(Waves(1e-9, 1.0, np.zeros(2))), 1e-8),
    (Plane(), Paraboloid(1e9), 1e-8),
]


@pytest.mark.parametrize("case", [*SAME, *((a, b, 1.0, tolerance) for a, b, tolerance in LIMITS)], ids=str)
def test_two_descriptions_of_a_surface_agree(case):
    """Normal, its rate, curvature and distance at the same points in space."""
    first, second, sign, tolerance = (*case, 2e-14)[:4]
    r, east, north = first.chart(places(first))
    in_space, a, b = first.in_fixed_frame(r), *directions()
    velocity = tuple(a * columns(first.in_fixed_frame(east)) + b * columns(first.in_fixed_frame(north)))
    np.testing.assert_allclose(
        sign * columns(second.normal(in_space)), columns(first.in_fixed_frame(columns(first.normal(r)))), atol=tolerance
    )
    rate = columns(first.normal_rate(r, first.in_own_axes(velocity)))
    np.testing.assert_allclose(
        sign * columns(second.normal_rate(in_space, velocity)), columns(first.in_fixed_frame(rate)), atol=tolerance
    )
    K = first.gaussian_curvature(r)
    np.testing.assert_allclose(
        second.gaussian_curvature(in_space), np.zeros(LANES) if K is None else K, atol=10.0 * tolerance
    )
    np.testing.assert_allclose(second.offset(in_space), 0.0, atol=10.0 * tolerance)


def test_a_huge_torus_is_a_cylinder():
    """With the ring's radius G the two differ by terms in 1/G: ten times less for ten times as much."""
    tube, places_far = Cylinder(1.3), []
    r, east, north = tube.chart((jnp.asarray(RNG.uniform(-1.0, 1.0, LANES)), places(tube)[1]))
    a, b = directions()
    velocity = tuple(a * columns(east) + b * columns(north))
    for ring in (1e3, 1e4):
        torus = Torus(ring, 1.3)
        moved = (r[0] + ring, *columns(r)[1:])
        offsets = [columns(torus.normal(moved)) - columns(tube.normal(r))]
        offsets += [columns(torus.normal_rate(moved, velocity)) - columns(tube.normal_rate(r, velocity))]
        places_far.append(
            [np.max(np.abs(error)) for error in offsets] + [np.max(np.abs(torus.gaussian_curvature(moved)))]
        )
    np.testing.assert_allclose(np.array(places_far[0]) / np.array(places_far[1]), 10.0, rtol=2e-2)


def test_gaussian_curvature_of_the_oblate_spheroid():
    """`stroller.md`, section 1: K = sinh^2(xi) / (a^2 D^2), D = sinh^2(xi) + sin^2(eta)."""
    a, xi, eta = 2.0, 0.8, -0.4
    ground = Spheroid.from_oblate(a, xi)
    D = math.sinh(xi) ** 2 + math.sin(eta) ** 2
    r = ground.chart((jnp.asarray(0.3), jnp.asarray(eta)))[0]
    np.testing.assert_allclose(ground.gaussian_curvature(r), math.sinh(xi) ** 2 / (a * D) ** 2, rtol=1e-14)


def test_gaussian_curvature_of_torus_and_paraboloid():
    """Closed forms: cos(eta) / (a (G + a cos(eta))), and 1 / (p^2 (1 + r^2/p^2)^2)."""
    mu, eta = (RNG.uniform(-3.0, 3.0, LANES) for _ in range(2))
    torus, bowl = Torus(3.0, 1.2), Paraboloid(0.8)
    r = torus.chart((jnp.asarray(mu), jnp.asarray(eta)))[0]
    expected = np.cos(eta) / (1.2 * (3.0 + 1.2 * np.cos(eta)))
    np.testing.assert_allclose(torus.gaussian_curvature(r), expected, atol=1e-14)
    r = bowl.chart((jnp.asarray(mu), jnp.asarray(eta)))[0]
    expected = 1.0 / (0.8 * (1.0 + (mu**2 + eta**2) / 0.64)) ** 2
    np.testing.assert_allclose(bowl.gaussian_curvature(r), expected, rtol=1e-13)


@pytest.mark.parametrize("surface", [shape for shape in SURFACES if not isinstance(shape, Implicit)], ids=str)
def test_elevation_is_the_height_in_the_fixed_frame(surface):
    r = surface.chart(places(surface))[0]
    lowest = {Cylinder: "radius", Torus: "tube", Sphere: "radius", Spheroid: "polar"}.get(type(surface))
    height_error = surface.in_fixed_frame(r)[2] + (0.0 if lowest is None else getattr(surface, lowest))
    elevation = surface.elevation(r)
    np.testing.assert_allclose(0.0 if elevation is None else elevation, height_error, atol=1e-14)


def test_east_is_along_y_where_the_normal_is_along_x():
    """t1 is the projection of x, of y where n is along x, and its derivatives are finite there."""
    normals = np.array([[1.0, -1.0, 0.6, 0.0], [0.0, 0.0, 0.0, 0.6], [0.0, 0.0, 0.8, 0.8]])
    t1, t2 = tangents(tuple(jnp.asarray(normals)))
    np.testing.assert_allclose(np.stack(t1).T, [[0, 1, 0], [0, 1, 0], [0.8, 0, -0.6], [1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(np.stack(t2).T[0], [0, 0, 1], atol=1e-15)
    slope = jax.jacfwd(lambda n: jnp.stack(tangents((n[0], n[1], n[2]))[0]))(jnp.asarray(normals))
    assert np.all(np.isfinite(slope))


def test_numbers_of_a_function_are_numbers_of_the_surface():
    """Leaves of a module, one for all lanes or one for each; a traced number in a closure is differentiated by as well."""
    ground = Graph(Waves(0.3, 1.1, np.array([0.4, 0.2])))
    assert [leaf.shape for leaf in jax.tree.leaves(ground)] == [()] * 4

    @jax.jit
    def heights(height, steep):
        waves = Graph(Waves(height, 1.1, ground.height.mode))
        valley = Graph(lambda x, y: steep * x * x)
        return [surface.elevation(surface.chart((0.5, -0.2))[0]) for surface in (waves, valley)]

    values, slopes = jax.jvp(heights, (0.3, 2.0), (1.0, 1.0))
    np.testing.assert_allclose(slopes, (values[0] / 0.3, 0.25), rtol=1e-13)
    many = Graph(Waves(np.linspace(0.1, 0.3, LANES), 1.1, np.array([0.4, 0.2])))
    position = many.chart((jnp.asarray(0.5), jnp.asarray(-0.2)))[0]
    np.testing.assert_allclose(position[2][-1], values[0], rtol=1e-14)
    assert jnp.shape(many.normal(position)[0]) == (LANES,)


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
        (lambda: Torus(1.0, 1.0), r"tube = 1\.0 must be less than 1\.0 \(the radius of the ring"),
        (lambda: Torus(1.0, 0.0), r"tube = 0\.0 must be greater than 0\.0"),
        (lambda: Paraboloid(-1.0), r"p = -1\.0 must be greater than 0\.0"),
        (lambda: Graph(3.0), r"height = 3\.0 must be a function of \(x, y\)"),
        (lambda: Graph(lambda x: x), r"height = .* must be a function of \(x, y\): .*1 positional argument"),
        (lambda: Graph(lambda x, y: (x, y)), r"height = .* must return one number for \(x, y\), not"),
        (lambda: Graph(lambda x, y: jnp.stack([x, y])), r"height = .* must return one number .*, not float64\[2\]"),
        (lambda: Implicit(lambda x, y, z: x > y), r"function = .* must return one number .*, not bool"),
        (lambda: Sphere(1.0).sign("under", "inside"), r"side = 'under' must be one of 'outside', 'inside', 'above'"),
        (lambda: Paraboloid(1.0).sign("inside", "inside"), r"side = 'inside' must be 'above' on a Paraboloid"),
    ],
)
def test_bad_arguments_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
