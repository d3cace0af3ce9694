"""Sweeps and the main job."""

import dataclasses
import json
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import stroller
from stroller import Damping, Launch, Plane, Scene, Sphere, Spheroid, Steady, Stroller, Table
from stroller import __main__ as job
from stroller.__main__ import main
from stroller.friction import Drag
from stroller.runs.model import RideModel

BODY = Stroller(mass=1.7, wheelbase=0.7, inertia=0.4, steering_inertia=0.05)
LAUNCH = Launch((0.3, -0.6), 0.5, 1.5, 0.2, 0.1)
BOWL = Scene(BODY, Spheroid(2.0, 1.1), Damping(0.3, 0.2, 0.1, 0.15), side="inside", fork="absolute")
AXES = {
    "launch.speed": [1.0, 1.5],
    "launch.steering": [0.2, 0.3],
    "scene.body.wheelbase": [0.6, 0.7],
    "scene.friction.rolling": [0.1, 0.3],
    "scene.surface.polar": [0.9, 1.1],
    "input.force": [0.0, 0.5],
}


@pytest.fixture(scope="module")
def bowl(tmp_path_factory):
    """Speed, steering, wheelbase, friction, shape and drive in one call, and the file it wrote."""
    path = tmp_path_factory.mktemp("sweep") / "bowl.h5"
    return stroller.sweep(BOWL, LAUNCH, 3.0, input=Steady(), axes=AXES, path=path), path


@pytest.mark.oldest
@pytest.mark.parametrize("cell", [(0, 0, 0, 0, 0, 0), (1, 0, 1, 1, 1, 1), (1, 1, 0, 1, 0, 1)])
def test_cells_are_the_single_rides(bowl, cell):
    """Every cell of the table is what `simulate` gives for its numbers."""
    table, _ = bowl
    speed, steering, wheelbase, rolling, polar, force = (
        values[k] for values, k in zip(AXES.values(), cell, strict=True)
    )
    scene = Scene(
        dataclasses.replace(BODY, wheelbase=wheelbase),
        Spheroid(2.0, polar),
        Damping(rolling, 0.2, 0.1, 0.15),
        side="inside",
        fork="absolute",
    )
    launch = Launch((0.3, -0.6), 0.5, speed, steering, 0.1)
    run = stroller.simulate(scene, launch, 3.0, Steady(force), times=[3.0], tolerance=1e-11)
    np.testing.assert_allclose([table.x[cell], table.y[cell], table.z[cell]], run.position[0], atol=1e-8)
    np.testing.assert_allclose(table.end_speed[cell], run.speed[0], atol=1e-8)
    np.testing.assert_allclose(table.heading[cell], run.heading[0], atol=1e-8)
    np.testing.assert_allclose(table.energy[cell], run.energy[0], atol=1e-8)


@pytest.mark.oldest
def test_table_is_labelled_and_its_file_opens_in_xarray(bowl):
    table, path = bowl
    assert list(table.coords) == ["speed", "steering", "wheelbase", "rolling", "polar", "force"]
    assert table.shape == (2,) * 6
    assert np.all(table.status == "completed")
    assert np.all(np.abs(table.residual) < 1e-8)
    with xarray.open_dataset(path, engine="h5netcdf") as dataset:
        np.testing.assert_array_equal(dataset["end_speed"].values, table.end_speed)
        assert dataset["wheelbase"].attrs["units"] == "m"
    np.testing.assert_array_equal(Table.load(path).x, table.x)


class Driver(eqx.Module):
    """A drive force through smooth knots over time."""

    knots: jax.Array
    force: jax.Array
    gain: float = 1.0

    def __call__(self, t, motion):
        weights = jnp.exp(-20.0 * (t - self.knots) ** 2)
        return self.gain * jnp.sum(weights * self.force) / jnp.sum(weights), -motion.steering


class Curve(stroller.AbstractFriction):
    """A resistance as measured, by speed."""

    speeds: jax.Array
    drags: jax.Array

    def drag(self, wheels):
        return Drag(rear=-jnp.interp(wheels.rear_speed, self.speeds, self.drags))


@pytest.mark.parametrize("count", [8, pytest.param(300, marks=pytest.mark.slow)])
def test_inputs_and_laws_with_arrays_are_evaluated_ride_by_ride(count):
    """As many rides as knots were once paired with them; the curve is a straight line, on which the law is `Damping`."""
    driver = Driver(jnp.linspace(0.0, 1.0, count), jnp.linspace(1.0, 3.0, count))
    speeds, launch = np.linspace(0.5, 2.0, 8), Launch((0.0, 0.0), 0.3, 1.0)
    axes, curve = {"launch.speed": speeds}, np.array([0.0, 1.0, 3.0])
    # Of an input with many numbers, none can be varied.
    of_force = {"input.force[3]": [float(driver.force[3]), 4.0]} if count == 8 else {}
    of_curve = of_force | {"drags[1]": [0.5, 0.6]}
    tables = [
        stroller.sweep(Scene(BODY, friction=law), launch, 1.0, input=driver, axes=axes | more, progress=False)
        for law, more in ((Damping(0.5), {}), (Curve(curve, 0.5 * curve), of_curve))
    ]
    assert list(tables[1].coords) == ["speed", *(["force[3]"] if count == 8 else []), "drags[1]"]
    end_speed = np.asarray(tables[1].end_speed).reshape(8, -1, 2)
    np.testing.assert_allclose(end_speed[:, 0, 0], tables[0].end_speed, rtol=1e-12)
    assert np.all(np.diff(end_speed, axis=1) > 0.0)
    assert np.all(np.diff(end_speed, axis=2) < 0.0)
    for k in (0, 7):
        ride = dataclasses.replace(launch, speed=speeds[k])
        run = stroller.simulate(Scene(BODY, friction=Damping(0.5)), ride, 1.0, driver, times=[1.0], tolerance=1e-11)
        np.testing.assert_allclose(tables[0].end_speed[k], run.speed[0], rtol=1e-8)


def test_a_sweep_without_axes_is_a_single_ride():
    """Straight on, on a level plane without friction, as far as speed times time."""
    table = stroller.sweep(Scene(BODY), Launch((0.0, 0.0), 0.0, 2.0), 0.5, axes={})
    assert table.shape == ()
    assert table.status == "completed"
    np.testing.assert_allclose([table.x, table.y, table.end_speed], [1.0, 0.0, 2.0], atol=1e-12)


@pytest.mark.oldest
def test_a_ride_that_needs_more_than_the_most_steps_has_failed(bowl):
    table = stroller.sweep(Scene(BODY), LAUNCH, 3.0, axes={}, max_steps=3)
    assert (str(table.status), int(table["steps"])) == ("failed", 3)
    assert json.loads(table.attributes["request"])["max_steps"] == 3
    assert json.loads(bowl[0].attributes["request"])["max_steps"] == 2_000_000


def test_lost_contact_is_marked_with_its_time():
    """Outside a sphere from its top: contact ends at cos = 2/3 (1 + v0^2 / (2 g R)), the time is that of `simulate`."""
    scene, launch = Scene(BODY, Sphere(1.4)), Launch((0.0, np.pi / 2), 0.0, 0.5)
    table = stroller.sweep(scene, launch, 1.4, axes={"launch.speed": [0.05, 0.5]})
    assert list(table.status) == ["completed", "contact_lost"]
    assert table.contact_time[0] == np.inf
    assert table.end_time[1] == 1.4
    contact_time = float(table.contact_time[1])
    run = stroller.simulate(scene, launch, 1.4, times=[contact_time, 1.4], tolerance=1e-11)
    expected = 1.4 * 2.0 / 3.0 * (1.0 + 0.5**2 / (2.0 * 9.81 * 1.4))
    np.testing.assert_allclose(run.position[0, 2], expected, rtol=1e-8)
    np.testing.assert_allclose(table.z[1], run.position[1, 2], atol=1e-8)


@pytest.fixture(scope="module")
def places():
    """Rides on a level plane from many places."""
    axes = {"launch.place[0]": [0.0, 1.0, 2.0], "launch.place[1]": np.linspace(0.0, 8.0, 9)}
    return stroller.sweep(Scene(BODY, Plane()), Launch((0.0, 0.0), 0.5, 1.0, 0.3), 2.0, axes=axes)


def test_places_are_axes_too(places):
    """On a level plane the ride does not depend on where it starts."""
    table = places
    assert list(table.coords) == ["x0", "y0"]
    distance = table.x - table.coords["x0"][:, None]
    np.testing.assert_allclose(distance, distance[0, 0], atol=1e-12)
    R = 0.7 / np.tan(0.3)
    np.testing.assert_allclose(distance[0, 0], R * (np.sin(0.5 + 2.0 / R) - np.sin(0.5)), atol=1e-8)


def test_a_map_shows_its_values_and_is_grey_only_where_there_is_none(places):
    drawing = places.plot("energy").axes[0]
    (image,) = drawing.collections
    np.testing.assert_array_equal(image.get_array(), places.energy.T)
    assert drawing.get_legend() is None
    # The ground never has to pull, so no cell has a time at which it did.
    drawing = places.plot("contact_time").axes[0]
    assert [text.get_text() for text in drawing.get_legend().get_texts()] == ["completed"]


def test_axes_of_one_name_are_told_apart():
    labels = RideModel.of(BOWL, LAUNCH, None).label(["launch.steering", "scene.friction.steering"])
    assert [label[:2] for label in labels.values()] == [("launch_steering", "rad"), ("friction_steering", "N m s")]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(axes={"scene.body.colour": [1.0]}), r"axes: 'scene\.body\.colour'"),
        (dict(axes={"launch.speed": []}), r"speed must be a number or a non-empty list"),
        (dict(axes={"scene.body.mass": [1.0, -1.0]}), r"mass = .* must be greater than 0\.0"),
        (dict(axes={"launch.place[1]": [0.0, 2.0]}), r"place\[1\] = .* must be at most 1\.57"),
        (dict(axes={}, tolerance=1.0), r"tolerance = 1\.0 must be at most"),
        (dict(axes={}, max_steps=0), r"max_steps = 0 must be a whole number of at least 1"),
        (dict(axes=None), r"axes = None must be a dictionary"),
        (dict(axes={3: [1.0]}), r"axes = \{3: \[1\.0\]\} must be a dictionary, name of a number -> values"),
        (dict(axes={}, t1=[1.0, 2.0]), r"t1 must be one number, not of shape \(2,\); axes of sweep take lists"),
        (dict(axes={}, launch=Launch((0.0, 0.1), 0.0, [1.0, 2.0])), r"launch\.speed must be one number, not of shape"),
        (dict(axes={}, launch=1.0), r"launch = 1\.0 must be a Launch"),
    ],
)
def test_bad_sweeps_are_refused(change, message):
    arguments = {"launch": LAUNCH, "t1": 1.0} | change
    with pytest.raises(ValueError, match=message):
        stroller.sweep(BOWL, **arguments)


@pytest.mark.slow
def test_main_job(tmp_path, capsys, monkeypatch):
    """`python -m stroller` prints an audit that closes and writes its file and picture; the same command reads them."""
    monkeypatch.setattr(job, "enable_compilation_cache", lambda: tmp_path / "kept")
    (tmp_path / "kept").mkdir()
    arguments = ["--t1", "2", "--surface", "spheroid"]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    audit = [line.split() for line in printed.splitlines() if "midpoint" in line]
    assert len(audit) == 2
    assert all(float(columns[-5]) < 1e-11 for columns in audit)
    # The plan comes first, and the audit of the rides behind it, here and on the page.
    assert printed.startswith("Parking: Plan of 15 s: reaches the goal")
    assert printed.index("candidates") < printed.index("residual") < printed.index("midpoint")
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("parked.png", "rides.png"))
    page = (tmp_path / "index.html").read_text()
    assert 'id="floats"' in page
    assert re.findall(r'"title": "([^"]+)"', page) == ["plan of 15 s: reaches the goal", "inside the spheroid"]
    assert audit[0][-1] in page
    assert page.index("<pre>Plan of 15 s") < page.index("Energy against work")
    assert f"To see it, open {tmp_path / 'index.html'}" in printed
    with xarray.open_dataset(tmp_path / "rides.h5", engine="h5netcdf") as dataset:
        assert {"ride": 2, "time": 201}.items() <= dict(dataset.sizes).items()
        energy = dataset["energy"].values
        np.testing.assert_allclose(energy, energy[:, :1] + dataset["work"].values, atol=1e-8)
        assert float(jnp.max(dataset["friction_power"].values[1])) < 0.0
    monkeypatch.setattr(job, "computed", lambda options: {})
    assert main([*arguments, "--out", str(tmp_path / "again")]) == 0
    again = capsys.readouterr().out
    assert again[: again.index("4 runs")] == printed[: printed.index("4 runs")]
    assert "where an earlier run stored the results of these options" in again
    for name in ("rides.h5", "parked.png", "rides.png", "index.html"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / name).read_bytes()


def test_main_job_refuses_bad_input(tmp_path, capsys):
    assert main(["--mass", "-1", "--out", str(tmp_path)]) == 2
    assert "mass = -1.0 must be greater than 0.0" in capsys.readouterr().err


def test_a_table_of_another_input_does_not_resume(tmp_path):
    def ends(force):
        options = dict(axes={"launch.speed": [1.0, 1.5]}, path=tmp_path / "rides.h5", progress=False)
        options["input"] = lambda t, motion: (force * jnp.cos(t), 0.0)
        return stroller.sweep(Scene(BODY), LAUNCH, 0.5, **options).end_speed

    speeds = ends(1.0)
    assert np.array_equal(ends(1.0), speeds)
    with pytest.raises(ValueError, match="the code of the system, its event or its input has changed"):
        ends(2.0)
