"""Tables of trajectories: single runs and batches, axes, ends, files, and what is refused."""

import json
import re

import diffrax
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import written_blocks
import xarray
from close import assert_close
from tops import rutstam_top

import tippe
from nonholonomic.sweeps import running as sweeping

# The same number of times, the same quantities and one size of block wherever it can be, so that one program serves.
TIMES = np.linspace(0.0, 1.5, 31)
THETA, SPIN, MU = [0.1, 0.2, 1.6], [100.0, 250.0], [0.2, 0.3]
VECTORS = ("axis", "position", "velocity", "angular_momentum", "slip")
SCALARS = ("theta", "eta", "azimuth", "spin", "energy", "jellett", "normal_force")


@pytest.fixture(scope="module")
def scene() -> tippe.Scene:
    return tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))


@pytest.fixture(scope="module")
def table(scene, tmp_path_factory) -> tippe.Table:
    """The one that most tests look at; its file is beside it."""
    path = tmp_path_factory.mktemp("tables") / "table.h5"
    table = tippe.trajectory_table(scene, theta=THETA, spin=SPIN, mu=MU, times=TIMES, path=path)
    return table, path


def single(scene, theta, spin, mu=0.3, times=TIMES, t1=TIMES[-1]):
    scene = tippe.Scene(scene.body, scene.surface, tippe.Viscous(mu))
    return tippe.simulate(scene, tippe.Launch(theta, spin), t1, times)


def test_every_cell_is_a_single_run(table, scene):
    """Among them runs that lose contact: what is after that is not a number."""
    table, _ = table
    assert list(table.coords) == ["launch.theta", "mu", "launch.spin", "time"]
    assert table.shape == (3, 2, 2)
    assert table.theta.shape == table.eta.shape == (3, 2, 2, 31)
    assert set(table.status.ravel()) == {"completed", "contact_lost"}
    for i, theta in enumerate(THETA):
        run = single(scene, theta, 250.0)
        assert_close(table.theta[i, 1, 1, : len(run.t)], run.theta, atol=1e-7)
        assert np.isnan(table.theta[i, 1, 1, len(run.t) :]).all()
        assert np.isnan(table.eta[i, 1, 1, len(run.t) :]).all()
        assert_close(table.end_time[i, 1, 1], run.end_time, atol=1e-7)
        assert table.status[i, 1, 1].replace("_end", " t1") == run.status
    assert_close(table.theta[1, 0, 0], single(scene, 0.2, 100.0, mu=0.2).theta, atol=1e-7)


def test_dense_samples_lie_inside_steps(table, scene):
    """Interpolated samples agree with samples at the ends of steps, also in runs that lose contact, and need fewer steps."""
    few, _ = table
    many = tippe.trajectory_table(scene, theta=THETA, spin=SPIN, mu=MU, times=np.linspace(0.0, TIMES[-1], 1501))
    for name in ("theta", "eta"):
        assert_close(many[name][..., ::50], few[name], atol=2e-8)
    assert np.array_equal(many.status, few.status)
    assert_close(many.end_time, few.end_time, rtol=1e-8)
    completed = few.status == "completed"
    assert np.all(many.steps[completed] < 600)
    lost = many.theta[few.status == "contact_lost"]
    ends = few.end_time[few.status == "contact_lost"]
    assert np.array_equal(np.isfinite(lost), many.coords["time"] <= ends[:, None])


def test_a_run_that_needs_more_than_the_most_steps_has_failed(table, scene):
    """What it reached is there."""
    short_table = tippe.trajectory_table(scene, theta=THETA, spin=SPIN, mu=MU, times=TIMES, max_steps=20)
    assert (short_table.status == "failed").all()
    assert (short_table["steps"] == 20).all()
    is_reached = np.isfinite(short_table.theta)
    assert 0 < is_reached.sum() < is_reached.size
    np.testing.assert_array_equal(short_table.theta[is_reached], table[0].theta[is_reached])
    assert json.loads(short_table.attributes["request"])["max_steps"] == 20
    assert json.loads(table[0].attributes["request"])["max_steps"] == 2_000_000


def test_another_solver_has_the_same_samples(table, scene):
    other = tippe.trajectory_table(scene, theta=THETA, spin=SPIN, mu=MU, times=TIMES, solver=diffrax.Dopri8())
    assert json.loads(other.attributes["request"])["solver"] == "Dopri8"
    assert not np.array_equal(other.steps, table[0].steps)
    assert_close(other.theta, table[0].theta, atol=1e-6)


def test_a_batch_by_vmap_is_the_same(table, scene):
    """It steps like a table that needs directions and no path: `jit` leaves out what is not read."""
    table, _ = table
    with_direction = tippe.trajectory_table(
        scene, theta=0.2, spin=SPIN, mu=0.3, times=TIMES, quantities=["theta", "azimuth"]
    )

    @jax.jit
    @jax.vmap
    def read(spin):
        run = tippe.simulate(scene, tippe.Launch(0.2, spin), TIMES[-1], TIMES)
        return run.theta, run.end_time, run.stats["accepted"]

    theta, end, accepted = read(jnp.asarray(table.coords["launch.spin"]))
    assert_close(table.theta[1, 1], theta, atol=1e-7)
    assert_close(table.end_time[1, 1], end, atol=1e-7)
    assert_close(table.theta[1, 1], with_direction.theta, atol=1e-7)
    # With the path they would be 516 and not 524 in one of the cells.
    assert np.all(np.abs(with_direction.steps - with_direction.rejected - accepted) <= 2)
    # Without directions the frame turns with the top.
    assert np.all(np.abs(table.steps[1, 1] - table.rejected[1, 1] - accepted) > 2)


@pytest.mark.parametrize(
    "arena",
    [
        pytest.param(tippe.Cylinder(0.3), id="cylinder"),
        pytest.param(tippe.Sphere(0.3), id="sphere", marks=pytest.mark.slow),
    ],
)
def test_every_quantity_is_that_of_a_single_run_and_comes_back_from_a_file(arena, tmp_path):
    """In a cylinder and a sphere some are read off the arena's path, which the runs then carry."""
    scene, names = tippe.Scene(rutstam_top(), arena, tippe.Viscous(0.3)), SCALARS + VECTORS
    table = tippe.trajectory_table(scene, theta=[0.1, 0.3], spin=120.0, eta=0.2, times=TIMES, quantities=names)
    for i, theta in enumerate((0.1, 0.3)):
        run = tippe.simulate(scene, tippe.Launch(theta, 120.0, 0.2), TIMES[-1], TIMES)
        for name in names:
            values, expected = table.variables[name][i], np.asarray(getattr(run, name))
            assert values.shape == expected.shape
            assert_close(values, expected, atol=1e-6 * np.abs(expected).max())
    assert table.dims("position") == ("launch.theta", "time", "component")
    assert table.dims("slip") == ("launch.theta", "time", "tangent")
    assert table.dims("energy") == ("launch.theta", "time")
    table.save(tmp_path / "saved.h5")
    loaded_table = tippe.Table.load(tmp_path / "saved.h5")
    assert list(loaded_table.coords) == list(table.coords)
    assert loaded_table.coords["component"].tolist() == table.coords["component"].tolist() == ["x", "y", "z"]
    np.testing.assert_array_equal(loaded_table.position, table.position)
    with xarray.open_dataset(tmp_path / "saved.h5", engine="h5netcdf") as data:
        assert data["velocity"].dims == ("launch.theta", "time", "component")
        assert data["component"].attrs["flag_meanings"] == "x y z"
        assert_close(data["velocity"], table.velocity)


def test_further_axes_and_none(scene):
    axes = {"launch.azimuth": [0.0, 1.0, -2.0], "scene.body.offset": [0.005, 0.006]}
    turned_table = tippe.trajectory_table(scene, theta=0.2, spin=100.0, times=TIMES, axes=axes)
    assert list(turned_table.coords) == ["launch.azimuth", "offset", "time"]
    # The plane looks the same in every direction.
    assert_close(turned_table.theta, np.broadcast_to(turned_table.theta[0], turned_table.theta.shape), atol=1e-7)
    single_table = tippe.trajectory_table(scene, theta=0.2, spin=100.0, times=TIMES)
    assert single_table.shape == ()
    assert single_table.theta.shape == (31,)
    assert single_table.status == "completed"
    assert_close(single_table.theta, turned_table.theta[0, 1], atol=1e-7)
    assert "theta [rad] x time (31)" in str(single_table)


def test_the_file_opens_in_xarray_as_the_table_does(table):
    table, path = table
    loaded_table = tippe.Table.load(path)
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        for dataset in (data, table.to_xarray(), loaded_table.to_xarray()):
            assert dataset["theta"].dims == ("launch.theta", "mu", "launch.spin", "time")
            assert dataset["end_time"].dims == ("launch.theta", "mu", "launch.spin")
            assert dataset["theta"].attrs["units"] == "rad"
            assert dataset["time"].attrs["units"] == "s"
            assert dataset["mu"].attrs["units"] == "s m-1"
            cell = dataset["theta"].sel({"launch.theta": 0.2, "mu": 0.3, "launch.spin": 100.0})
            assert_close(cell.sel(time=1.5), table.theta[1, 1, 0, -1])
        assert data["status"].attrs["flag_meanings"].split()[0] == "completed"
    assert set(table.to_xarray()["status"].values.ravel()) == {"completed", "contact_lost"}
    assert loaded_table.inner == table.inner
    for name in table.variables:
        np.testing.assert_array_equal(loaded_table.variables[name], table.variables[name])


def test_an_interrupted_table_resumes_and_a_damaged_block_is_computed_again(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(sweeping, "chunk_for", lambda cells: 64)
    monkeypatch.setattr(sweeping, "workers", lambda: 1)
    path = tmp_path / "table.h5"
    arguments = {"theta": np.linspace(0.1, 1.6, 20), "spin": [*SPIN, 90.0, 130.0], "mu": MU, "times": TIMES}

    chunks = written_blocks.recorded(monkeypatch, most=1)
    with pytest.raises(KeyboardInterrupt):
        tippe.trajectory_table(scene, path=path, **arguments)
    part = tippe.Table.load(path)
    assert (part.status == "pending").sum() == 96
    assert np.isfinite(part.theta[part.status == "completed"]).all()
    assert np.isnan(part.theta[part.status == "pending"]).all()

    second_writes = written_blocks.recorded(monkeypatch)
    complete_table = tippe.trajectory_table(scene, path=path, **arguments)
    assert sorted(chunks + second_writes) == [0, 1, 2]
    with h5py.File(path, "r+") as file:
        file["theta"][9, 1, 3, 7] += 1e-12
    with pytest.raises(OSError, match="1 of its 3 chunks do not match"):
        tippe.Table.load(path)
    with pytest.warns(RuntimeWarning, match="1 finished chunks"):
        repaired = tippe.trajectory_table(scene, path=path, **arguments)
    assert sorted(chunks + second_writes) == [0, 1, 1, 2]
    fresh_table = tippe.trajectory_table(scene, **arguments)
    for table in (complete_table, repaired, tippe.Table.load(path)):
        np.testing.assert_array_equal(table.theta, fresh_table.theta)
        np.testing.assert_array_equal(table.status, fresh_table.status)
    with pytest.raises(ValueError, match=r"another run: quantities is \['theta', 'eta'\] in the file"):
        tippe.trajectory_table(scene, path=path, quantities=["theta"], **arguments)
    with pytest.raises(ValueError, match="another run: the axis time differs"):
        tippe.trajectory_table(scene, path=path, **arguments | {"times": TIMES * 0.9})


def test_it_is_drawn_over_time(table):
    table, _ = table
    drawing = table.plot("theta").axes[0]
    assert drawing.get_xlabel() == "time [s]"
    assert len(drawing.get_lines()) == 3
    assert_close(drawing.get_lines()[1].get_ydata(), table.theta[1, 0, 0])


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"times": []}, "times = [] must be a list of at least one number"),
        ({"times": 1.0}, "times = 1.0 must be a list of at least one number; np.linspace makes evenly spaced ones"),
        ({"times": [0.0, 1.0, 0.5]}, "times[2] = 0.5 must be greater than times[1] = 1.0: times must increase"),
        ({"times": [-0.1, 1.0]}, "times = -0.1 must be at least 0.0"),
        ({"times": [0.0, float("nan")]}, "times = nan must be finite"),
        ({"times": [0.0]}, "times[-1] = 0.0 must be greater than 0.0 (it is the horizon)"),
        ({"times": "soon"}, "times = 'soon' is not a number"),
        ({"theta": [0.1, 4.0]}, "theta = 4.0 must be at most"),
        ({"theta": None}, "theta"),
        ({"spin": [[1.0]]}, "launch.spin must be a number or a non-empty list"),
        ({"mu": [0.1, -0.1]}, "mu = -0.1 must be at least 0.0"),
        ({"max_steps": 0}, "max_steps = 0 must be a whole number of at least 1"),
        ({"tolerance": 0.5}, "tolerance = 0.5 must be at most 0.01"),
        ({"quantities": "theta"}, "quantities = 'theta' must be a list of names"),
        ({"quantities": ()}, "quantities = () must be a list of names"),
        ({"quantities": ["theta", "mood"]}, "quantities: 'mood' must be one of theta, eta"),
        ({"quantities": ["theta", "theta"]}, "quantities: 'theta' must be named only once"),
        ({"axes": {3: [1.0]}}, "axes = {3: [1.0]} must be a dictionary"),
        ({"axes": {"scene.body.colour": [1.0]}}, "axes: 'scene.body.colour'"),
        ({"axes": {"launch.theta": [0.1]}}, "'launch.theta' has its own argument"),
        ({"scene": "a top"}, "scene = 'a top' must be a Scene"),
    ],
    ids=str,
)
def test_what_is_refused_before_anything_compiles(scene, change, told, monkeypatch):
    monkeypatch.setattr("tippe.runs.verbs.compute_table", lambda *_: pytest.fail("it was run"))
    arguments = {"scene": scene, "theta": 0.1, "spin": 100.0, "times": TIMES} | change
    with pytest.raises(ValueError, match=re.escape(told)):
        tippe.trajectory_table(arguments.pop("scene"), **arguments)


#: Scenes whose runs have several modes; the horizon includes a change of mode.
IN_MODES = {
    "flights": (
        tippe.Plane(),
        tippe.Viscous(0.3),
        {"contact": "hybrid", "restitution": 0.4},
        [280.0, 290.0],
        0.1,
        "hops",
    ),
    "sticks": (tippe.Plane(), tippe.SetValuedCoulomb(0.3), {}, [100.0, 101.0], 0.35, "sticks"),
    "flights in a cylinder": (
        tippe.Cylinder(0.3),
        tippe.Viscous(0.3),
        {"contact": "hybrid", "restitution": 0.4},
        [280.0, 290.0],
        0.1,
        "hops",
    ),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "flights" else pytest.mark.slow) for name in IN_MODES]
)
def test_runs_of_several_modes_are_those_of_simulate(name):
    """In contact, in the air, slipping and rolling."""
    surface, friction, options, spins, theta, counter = IN_MODES[name]
    scene, times = tippe.Scene(rutstam_top(), surface, friction, **options), np.linspace(0.0, 0.6, 7)
    names = ["theta", "position", "normal_force", "energy", "work", "slip"]
    table = tippe.trajectory_table(scene, theta=theta, spin=spins, times=times, quantities=names, tolerance=1e-8)
    assert (table.status == "completed").all()
    for k, spin in enumerate(spins):
        run = tippe.simulate(scene, tippe.Launch(theta, spin), times[-1], times, tolerance=1e-10)
        for quantity in names:
            expected = np.asarray(getattr(run, quantity))
            assert_close(table[quantity][k], expected, atol=1e-4 * np.max(np.abs(expected)))
        count = len(run.hops) if counter == "hops" else run.stats["sticks"]
        assert table[counter][k] == count
