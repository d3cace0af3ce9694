"""What a stroller on any surface is asked: places, tables, derivatives, fits."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stroller
from stroller import (
    Cylinder,
    Damping,
    Frictionless,
    Graph,
    Implicit,
    Launch,
    Paraboloid,
    Plane,
    Scene,
    Sphere,
    Spheroid,
    Stroller,
    Torus,
)
from stroller.__main__ import GROUNDS, main, parser, scenes
from stroller.runs.model import RideModel

BODY = Stroller(1.7, 0.3, 0.4, 0.05)


class Hill(eqx.Module):
    """One hill [m] of some width [m]."""

    height: float
    width: float = 1.5

    def __call__(self, x, y):
        return self.height * jnp.exp(-(x * x + y * y) / (2.0 * self.width**2))


class Ball(eqx.Module):
    """Positive inside an ellipsoid of revolution."""

    equatorial: float
    polar: float

    def __call__(self, x, y, z):
        return 1.0 - (x * x + y * y) / self.equatorial**2 - (z / self.polar) ** 2


HILL = Scene(BODY, Graph(Hill(0.8)), Damping(0.3, 0.1, 0.1, 0.05))
LAUNCH = Launch((-2.0, 0.3), 0.1, 2.5, 0.2)


@pytest.mark.parametrize(
    ("surface", "place"),
    [
        (Plane(0.2), (0.4, -0.3)),
        (Cylinder(1.2), (0.4, -0.3)),
        (Sphere(1.4), (0.4, -0.3)),
        (Torus(3.0, 1.2), (0.4, -0.3)),
        (Graph(Hill(0.8)), (0.4, -0.3)),
        (Implicit(Ball(1.4, 1.0)), (1.4 * np.cos(0.4), 1.4 * np.sin(0.4), 0.0)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_place_may_be_a_point_in_space(surface, place):
    """Moved to the surface if it is off by round-off, refused if by more."""
    scene = Scene(BODY, surface, Frictionless())
    position = surface.chart(tuple(jnp.asarray(part) for part in place))[0]
    point = np.array(surface.in_fixed_frame(position))
    launch_nearby = Launch(tuple(point + 1e-11), 0.7, 1.0)
    scene.check(launch_nearby)
    assert bool(RideModel.of(scene, launch_nearby, None).legal())
    np.testing.assert_allclose(scene.state(launch_nearby), scene.state(Launch(place, 0.7, 1.0)), atol=3e-11)
    launch_off_ground = Launch(tuple(point + 1e-4), 0.7, 1.0)
    with pytest.raises(
        ValueError, match=r"distance from the surface = .* must be at (most|least) .*on the surface up to"
    ):
        scene.check(launch_off_ground)
    assert not bool(RideModel.of(scene, launch_off_ground, None).legal())


def test_numbers_of_a_place_are_named_as_the_surface_names_them():
    def names(surface, place):
        model = RideModel.of(Scene(BODY, surface), Launch(place, 0.0, 1.0), None)
        labels = model.label([f"launch.place[{k}]" for k in range(len(place))])
        return [(name, unit) for name, unit, _ in labels.values()]

    assert names(Cylinder(1.0), (0.0, 0.0)) == [("y0", "m"), ("eta0", "rad")]
    assert names(Torus(2.0, 1.0), (0.0, 0.0)) == [("mu0", "rad"), ("eta0", "rad")]
    assert names(Paraboloid(1.0), (0.0, 0.0)) == [("x0", "m"), ("y0", "m")]
    assert names(Sphere(1.0), (0.0, 0.0, 1.0)) == [("x0", "m"), ("y0", "m"), ("z0", "m")]


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Scene(BODY, Graph(Hill(1.0)), side="inside"), r"side = 'inside' must be 'above' on a Graph"),
        (lambda: Scene(BODY, Implicit(Ball(1.0, 1.0)), side="outside"), r"must be 'positive' on a Implicit"),
        (lambda: Scene(BODY, Torus(2.0, 1.0), heading="projected"), r"heading = 'projected' must be 'intrinsic'"),
        (
            lambda: Scene(BODY, Implicit(Ball(1.0, 1.0))).check(LAUNCH),
            r"place = .* must be \(x \[m\], y \[m\], z \[m\]\)",
        ),
        (lambda: Scene(BODY, Sphere(1.0)).check(Launch((0.0, 2.0), 0.0, 1.0)), r"place\[1\] = 2\.0 must be at most"),
        (lambda: Launch((0.0, 0.0, 1.0, 2.0), 0.0, 1.0), r"place = .* must be a pair of numbers, or"),
    ],
)
def test_what_a_surface_has_not_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_lanes_with_their_own_places_and_hills_are_single_scenes():
    """The field of a table's cells, of which every number of launch, surface and body is its own."""
    heights, places = np.array([0.5, 0.9, -0.4]), np.array([[-2.0, 0.1, 1.0], [0.3, 0.2, -0.5]])
    batch = eqx.tree_at(lambda hill: hill.surface.height.height, HILL, jnp.asarray(heights))
    problem = RideModel.of(batch, Launch(tuple(places), 0.1, 2.5, 0.2), None).problem(3, ())
    field = eqx.filter_jit(lambda problem: problem.field(jnp.zeros(3), problem.states))(problem)
    for k, height in enumerate(heights):
        hill = eqx.tree_at(lambda scene: scene.surface.height.height, HILL, jnp.asarray(height))
        single = RideModel.of(hill, Launch(tuple(places[:, k]), 0.1, 2.5, 0.2), None).problem(None, None)
        np.testing.assert_allclose(problem.states[:, k], single.states, atol=1e-14)
        np.testing.assert_allclose(field[:, k], single.field(jnp.zeros(()), single.states), atol=1e-13)


def test_command_line_knows_every_named_surface():
    for side in ("inside", "outside"):
        options = parser().parse_args(["--surface", *GROUNDS, "--side", side])
        surfaces = scenes(options)
        assert len(surfaces) == 2 * len(GROUNDS)
        for scene, launch in surfaces.values():
            scene.check(launch)
            assert float(scene.contact(scene.state(launch))) > 0.0


@pytest.mark.slow
def test_table_over_places_and_hills(tmp_path):
    """Cells are the single rides; the file says what the ground was."""
    axes = {"scene.surface.height.height": [0.5, 0.9], "launch.place[1]": [0.3, -0.6, 0.0]}
    table = stroller.sweep(HILL, LAUNCH, 2.0, axes=axes, path=tmp_path / "hills.h5")
    assert list(table.coords) == ["height", "y0"]
    assert json.loads(table.attributes["request"])["scene.surface.height"] == "Hill"
    hill = eqx.tree_at(lambda scene: scene.surface.height.height, HILL, jnp.asarray(0.9))
    run = stroller.simulate(hill, Launch((-2.0, -0.6), 0.1, 2.5, 0.2), 2.0)
    np.testing.assert_allclose([float(table[name][1, 1]) for name in "xyz"], run.position[-1], atol=1e-7)


@pytest.mark.slow
def test_derivatives_by_the_ground():
    """By a module's number and by one that a function closes over, against a finite difference; and many at once."""

    def end(height, ground):
        surface = Graph(ground(height))
        return stroller.simulate(Scene(BODY, surface, HILL.friction), LAUNCH, 2.0, tolerance=1e-11).position[-1, 1]

    def closed(height):
        return lambda x, y: height * jnp.exp(-(x * x + y * y) / 4.5)

    step = 1e-4
    expected = (float(end(0.8 + step, Hill)) - float(end(0.8 - step, Hill))) / (2.0 * step)
    for ground in (Hill, closed):
        np.testing.assert_allclose(jax.grad(lambda height, kind=ground: end(height, kind))(0.8), expected, rtol=1e-6)
    batch = jax.vmap(lambda height: end(height, Hill))(jnp.array([0.5, 0.8]))
    np.testing.assert_allclose(batch[1], end(0.8, Hill), rtol=1e-9)


def test_the_error_of_the_wheelbase_on_a_sphere_is_that_of_its_curvature():
    scene = Scene(BODY, Sphere(4.0), Damping(0.3, 0.1, 0.1, 0.05))

    def run(speed):
        return stroller.simulate(scene, Launch((0.3, 0.2), 0.4, speed), 0.5, times=[0.25, 0.5])

    expected = BODY.wheelbase**2 / (6.0 * 4.0**2)
    np.testing.assert_allclose(run(1.0).wheelbase_error, np.full(2, expected), rtol=1e-9)
    batch = jax.vmap(run)(jnp.array([0.5, 1.0, 1.5]))
    np.testing.assert_allclose(batch.wheelbase_error, np.full((3, 2), expected), rtol=1e-9)
    # Each run of a batch is compared with its own start.
    np.testing.assert_allclose(batch.energy_residual, 0.0, atol=1e-7)


@pytest.mark.slow
def test_a_hill_is_found_from_a_ride_over_it():
    times = np.linspace(0.2, 2.0, 10)
    path = stroller.simulate(HILL, LAUNCH, 2.0, times=times).position
    recording = stroller.Recording(LAUNCH, times, path, 1e-3)
    fit = stroller.identify(HILL, recording, {"scene.surface.height.height": 0.6}, progress=False)
    np.testing.assert_allclose(fit.estimates["scene.surface.height.height"], 0.8, atol=1e-5)


def test_a_table_names_the_parts_of_a_place_as_the_surface_does():
    """An implicit ground has three coordinates; a cylinder has two, of different units."""
    scene = Scene(BODY, Implicit(Ball(2.0, 1.1)))
    run = stroller.simulate(scene, Launch((0.0, 0.0, -1.1), 0.0, 0.5), 0.1, times=[0.1], tolerance=1e-6)
    data = run.to_xarray()
    assert list(data["coordinate"].values) == ["x", "y", "z"]
    assert data["place"].attrs["units"] == "m"
    np.testing.assert_array_equal(data["place"], run.place)
    assert RideModel.of(Scene(BODY, Cylinder(1.2)), LAUNCH, None).components["coordinate"] == ("y", "eta")


@pytest.mark.slow
def test_an_implicit_ground_is_that_with_the_name():
    """Inside a spheroid, from a point in space."""
    place, damping = (0.3, -0.9), Damping(0.3, 0.1, 0.1, 0.05)
    scene_by_name = Scene(BODY, Spheroid(2.0, 1.1), damping, side="inside")
    run = stroller.simulate(scene_by_name, Launch(place, 0.4, 1.5, 0.2), 3.0, tolerance=1e-11)
    scene = Scene(BODY, Implicit(Ball(2.0, 1.1)), damping)
    # Its east is the projection of x, and its left is that of the driver.
    east = np.array(scene.surface.chart(tuple(run.position[0]))[1])
    north = np.array(scene.surface.chart(tuple(run.position[0]))[2])
    heading = np.arctan2(run.direction[0] @ north, run.direction[0] @ east)
    run_again = stroller.simulate(scene, Launch(tuple(run.position[0]), heading, 1.5, 0.2), 3.0, tolerance=1e-11)
    assert run_again.place.shape == (201, 3)
    np.testing.assert_allclose(run_again.position, run.position, atol=1e-8)
    np.testing.assert_allclose(run_again.side_force, run.side_force, atol=1e-7)


@pytest.mark.slow
def test_main_job_on_other_surfaces(tmp_path, capsys):
    assert main(["--t1", "2", "--surface", "torus", "paraboloid", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "inside the torus, with friction" in printed
    assert "paraboloid, without friction" in printed
    audit = [line.split() for line in printed.splitlines() if "midpoint" in line]
    assert all(float(columns[-5]) < 1e-11 for columns in audit)
