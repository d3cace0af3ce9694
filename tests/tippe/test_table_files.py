"""Files of inversion tables: written, resumed, killed, refused."""

import json
import os
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
import written_blocks
import xarray
from close import assert_close
from tops import rutstam_top

import tippe
from nonholonomic import Status
from nonholonomic.sweeps import running as sweeping

THETA, SPIN = [0.08, 0.1, 0.12], [90.0, 110.0]


@pytest.fixture(scope="module")
def table(rutstam_scene_module) -> tippe.Table:
    return tippe.inversion_table(rutstam_scene_module, theta=THETA, spin=SPIN, t1=12.0)


@pytest.fixture(scope="module")
def rutstam_scene_module() -> tippe.Scene:
    return tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))


def test_the_file_opens_in_xarray_with_names_and_units(rutstam_scene_module, tmp_path, table):
    path = tmp_path / "table.h5"
    written_table = tippe.inversion_table(rutstam_scene_module, theta=THETA, spin=SPIN, t1=12.0, path=path)
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        assert data["time"].dims == ("theta", "spin")
        assert data["time"].attrs["units"] == "s"
        assert data["spin"].attrs["units"] == "rad s-1"
        assert_close(data["theta"], THETA)
        assert_close(data["time"].sel(theta=0.1, spin=110.0), table.time[1, 1], rtol=1e-12)
        assert data["status"].attrs["flag_meanings"].split()[Status.INVERTED] == "inverted"
        request = json.loads(data.attrs["request"])
        assert request["scene.body.mass"] == 0.02
        assert request["scene.friction"] == "Viscous"
        assert request["tolerance"] == 1e-9
        assert "jax" in json.loads(data.attrs["versions"])
    loaded_table = tippe.Table.load(path)
    assert list(loaded_table.coords) == list(written_table.coords)
    for name in ("time", "status", "end_theta", "steps"):
        np.testing.assert_array_equal(loaded_table.variables[name], written_table.variables[name])


def test_save_and_load_return_the_same(table, tmp_path):
    table.save(tmp_path / "saved.h5")
    loaded_table = tippe.Table.load(tmp_path / "saved.h5")
    np.testing.assert_array_equal(loaded_table.time, table.time)
    np.testing.assert_array_equal(loaded_table.status, table.status)
    assert loaded_table.units == table.units
    assert loaded_table.words == table.words
    # The numbers that stand for the words are the same in every file.
    with h5py.File(tmp_path / "saved.h5", "r") as file:
        words = file["status"].attrs["flag_meanings"].decode().split()
        assert words == [status.word for status in sorted(Status)[1:]]
    assert json.loads(loaded_table.attributes["request"]) == json.loads(table.attributes["request"])


def test_an_interrupted_sweep_resumes_and_recomputes_no_finished_block(rutstam_scene_module, tmp_path, monkeypatch):
    monkeypatch.setattr(sweeping, "chunk_for", lambda cells: 8)
    monkeypatch.setattr(sweeping, "workers", lambda: 1)
    path, arguments = (
        tmp_path / "table.h5",
        {"theta": np.linspace(0.05, 0.3, 8), "spin": [80.0, 100.0, 120.0], "t1": 2.0},
    )
    chunks = written_blocks.recorded(monkeypatch, most=1)
    with pytest.raises(KeyboardInterrupt):
        tippe.inversion_table(rutstam_scene_module, path=path, **arguments)
    part = tippe.Table.load(path)
    assert (part.status == "pending").sum() == 16
    second_writes = written_blocks.recorded(monkeypatch)
    complete_table = tippe.inversion_table(rutstam_scene_module, path=path, **arguments)
    assert sorted(second_writes + chunks) == [0, 1, 2]
    monkeypatch.setattr(sweeping.ChunkStore, "write", written_blocks.WRITE)
    fresh_table = tippe.inversion_table(rutstam_scene_module, **arguments)
    np.testing.assert_array_equal(complete_table.status, fresh_table.status)
    assert_close(complete_table.end_theta, fresh_table.end_theta, atol=1e-12)
    tippe.inversion_table(rutstam_scene_module, path=path, **arguments)
    assert sorted(second_writes + chunks) == [0, 1, 2]


KILLED = """
import sys, numpy as np, tippe
from nonholonomic.sweeps import running as sweep
sweep.chunk_for = lambda cells: 4
sweep.workers = lambda: 1
mass, radius = 0.02, 0.02
top = tippe.Top(mass, radius, 0.006, 131 / 350 * mass * radius**2, 0.4 * mass * radius**2)
scene = tippe.Scene(top, tippe.Plane(), tippe.Viscous(0.3))
print("started", flush=True)
tippe.inversion_table(scene, theta=np.linspace(0.05, 0.3, 400), spin=[80.0, 100.0], t1=5.0, path=sys.argv[1])
"""


def blocks_of(path):
    """The finished blocks of a table that is not."""
    try:
        cells = tippe.Table.load(path).status.reshape(200, 4)
    except FileNotFoundError:
        return set()
    return set(np.flatnonzero((cells != "pending").all(axis=1)).tolist())


@pytest.mark.slow
def test_a_killed_sweep_leaves_a_file_that_opens_and_resumes(tmp_path):
    """SIGKILL in the middle: what is marked finished is right, and the rest is pending."""
    path = tmp_path / "table.h5"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE)
    finished = 0
    deadline = time.monotonic() + 120.0
    while finished < 3 and time.monotonic() < deadline:
        time.sleep(0.02)
        finished = len(blocks_of(path))
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    part = tippe.Table.load(path)
    blocks = blocks_of(path)
    assert 3 <= len(blocks) < 200
    cells = part.status.ravel().reshape(200, 4)
    assert (cells[sorted(blocks)] != "pending").all()
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
    fresh_table = tippe.inversion_table(scene, theta=np.linspace(0.05, 0.3, 400), spin=[80.0, 100.0], t1=5.0)
    finished_cells = part.status != "pending"
    np.testing.assert_array_equal(part.status[finished_cells], fresh_table.status[finished_cells])
    assert_close(part.end_theta[finished_cells], fresh_table.end_theta[finished_cells], atol=1e-9)


@pytest.mark.slow
def test_a_table_killed_again_and_again_is_the_one_that_was_not(tmp_path, monkeypatch):
    """Five times SIGKILL, each after some more blocks; the table that is resumed at last is the same to the last bit."""
    path, random, finished = tmp_path / "table.h5", np.random.default_rng(0), set()
    for _ in range(5):
        process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.DEVNULL)
        chunk_limit, blocks = len(finished) + int(random.integers(1, 30)), finished
        while len(blocks) < chunk_limit and process.poll() is None:
            time.sleep(random.uniform(0.0, 0.02))
            blocks = blocks_of(path)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
        cells = tippe.Table.load(path).status.reshape(200, 4)
        cells_after = set(np.flatnonzero((cells != "pending").all(axis=1)).tolist())
        assert finished <= cells_after
        assert chunk_limit <= len(cells_after) < 200
        assert (cells[[block not in cells_after for block in range(200)]] == "pending").all()
        finished = cells_after
    monkeypatch.setattr(sweeping, "chunk_for", lambda cells: 4)
    top = tippe.Top(0.02, 0.02, 0.006, 131 / 350 * 0.02 * 0.02**2, 0.4 * 0.02 * 0.02**2)
    scene = tippe.Scene(top, tippe.Plane(), tippe.Viscous(0.3))
    arguments = {"theta": np.linspace(0.05, 0.3, 400), "spin": [80.0, 100.0], "t1": 5.0}
    resumed = tippe.inversion_table(scene, path=path, **arguments)
    fresh_table = tippe.inversion_table(scene, **arguments)
    for name, values in fresh_table.variables.items():
        np.testing.assert_array_equal(resumed.variables[name], values)


def test_a_file_of_another_scene_is_refused_by_name(rutstam_scene_module, tmp_path):
    path, arguments = tmp_path / "table.h5", {"theta": THETA, "spin": SPIN, "t1": 0.1}
    tippe.inversion_table(rutstam_scene_module, path=path, **arguments)
    other_scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.2))
    with pytest.raises(
        ValueError, match=r"table\.h5 holds the result of another run: scene\.friction\.mu is 0\.3 in the file"
    ):
        tippe.inversion_table(other_scene, path=path, **arguments)
    with pytest.raises(ValueError, match="the axis spin differs"):
        tippe.inversion_table(rutstam_scene_module, path=path, **(arguments | {"spin": [90.0, 111.0]}))


def test_unwritable_corrupt_and_foreign_files_are_named(rutstam_scene_module, tmp_path):
    arguments = {"theta": THETA, "spin": SPIN, "t1": 0.1}
    with pytest.raises(OSError, match=r"cannot write .*nowhere"):
        tippe.inversion_table(rutstam_scene_module, path=tmp_path / "nowhere" / "table.h5", **arguments)
    noise = tmp_path / "noise.h5"
    noise.write_bytes(b"not a table" * 100)
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["x"] = 1.0
    cut = tmp_path / "cut.h5"
    tippe.inversion_table(rutstam_scene_module, path=cut, **arguments)
    cut.write_bytes(cut.read_bytes()[:2000])
    for path in (noise, foreign, cut):
        with pytest.raises(OSError, match=f"cannot read .*{path.name}"):
            tippe.Table.load(path)
        with pytest.raises(OSError, match=f"cannot read .*{path.name}"):
            tippe.inversion_table(rutstam_scene_module, path=path, **arguments)
    with pytest.raises(OSError, match="no such file"):
        tippe.Table.load(tmp_path / "missing.h5")


def test_a_file_has_one_writer(rutstam_scene_module, tmp_path):
    """While one sweep computes a file, another is refused."""
    path, arguments = tmp_path / "table.h5", {"theta": THETA, "spin": SPIN, "t1": 0.1}
    original = sweeping.ChunkStore.write

    def and_try_again(self, block, values):
        with pytest.raises(OSError, match="another thread is writing it"):
            tippe.inversion_table(rutstam_scene_module, path=path, **arguments)
        original(self, block, values)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeping.ChunkStore, "write", and_try_again)
        table = tippe.inversion_table(rutstam_scene_module, path=path, **arguments)
    assert (table.status == "not_inverted").all()
    assert list(tmp_path.iterdir()) == [path]


def test_a_table_of_one_cell_is_written_and_read(rutstam_scene_module, tmp_path):
    """Without lists a table has no axes; the second call reads the file and computes nothing."""
    path = tmp_path / "one.h5"
    written_table, table_again = (
        tippe.inversion_table(rutstam_scene_module, theta=0.1, spin=110.0, t1=12.0, path=path) for _ in range(2)
    )
    table = tippe.Table.load(path)
    assert table.time.shape == ()
    assert float(table.time) == float(written_table.time) == float(table_again.time) < 12.0
