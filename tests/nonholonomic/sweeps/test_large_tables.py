"""Tables larger than memory: blocks only are held, the numbers stay in the file, and illegal cells are found beforehand."""

import itertools
import os
import time
import tracemalloc

import numpy as np
import pytest
from tops import rutstam_top

import tippe
from nonholonomic.sweeps import Table, Variable, axis, running, sweep
from nonholonomic.sweeps.grid import Layout, cells_to_check, columns, size_of

X, Y = axis("x", "x", "s", np.linspace(0.0, 1.0, 1000)), axis("y", "y", "m", np.arange(500.0))
VARIABLES = {
    "value": Variable("m", np.float64),
    "pair": Variable("m", np.float64, inner=("two",)),
    "status": Variable("1", np.int8, ("low", "high", "failed")),
}


def job(columns, count):
    value = columns["x"] + columns["y"]
    return {"value": value, "pair": np.stack([value, -value], 1), "status": (value > 250.0).astype(np.int8)}


def large_sweep(path, **options):
    inner = [axis("two", "two", "1", [1.0, 2.0])]
    return sweep(job, [Y, X], VARIABLES, {"what": "a test"}, path=path, inner=inner, chunk=4096, **options)


@pytest.fixture
def in_its_file(monkeypatch):
    monkeypatch.setattr("nonholonomic.sweeps._store.MAX_BYTES_IN_MEMORY", 1000)


def test_a_table_in_its_file_takes_the_memory_of_some_blocks(tmp_path, monkeypatch, in_its_file):
    """12.5 MB of numbers; three variables of 4096 cells are 0.1 MB."""
    monkeypatch.setattr(running, "HANDED_OUT", 8)
    # Syncing over a hundred blocks takes seconds and no memory.
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    large_sweep(tmp_path / "first.h5")
    tracemalloc.start()
    table = large_sweep(tmp_path / "table.h5")
    _, peak_memory = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_memory < 5e6
    right = Y.values[:, None] + X.values
    assert table.shape == (500, 1000)
    np.testing.assert_array_equal(table.value, right)
    np.testing.assert_array_equal(table.pair, np.stack([right, -right], -1))
    np.testing.assert_array_equal(table.status, np.where(right > 250.0, "high", "low"))


def test_a_table_in_its_file_is_read_piece_by_piece(tmp_path, monkeypatch, in_its_file):
    table = large_sweep(tmp_path / "table.h5")
    assert str(table).splitlines()[1:] == [f"  {name}: in {tmp_path / 'table.h5'}" for name in VARIABLES]
    assert "status" in table._repr_html_()
    assert list(table.variables) == ["value", "pair", "status"]
    with pytest.raises(AttributeError, match="the table has no 'tme'; it has value, pair, status"):
        _ = table.tme
    table.save(tmp_path / "copy.h5")
    monkeypatch.undo()
    table_in_memory = Table.load(tmp_path / "copy.h5")
    lazy_dataset, dataset_in_memory = table.to_xarray(chunks={"y": 100}), table_in_memory.to_xarray()
    with lazy_dataset:
        for name in VARIABLES:
            assert lazy_dataset[name].chunks[0] == (100,) * 5
            assert lazy_dataset[name].dims == dataset_in_memory[name].dims == table.dims(name)
        assert int((lazy_dataset["status"] == "high").sum()) == int((table_in_memory.status == "high").sum())
        np.testing.assert_array_equal(lazy_dataset["pair"][3, 4], table_in_memory.pair[3, 4])
    assert table_in_memory.to_xarray(chunks={"y": 50})["value"].chunks[0] == (50,) * 10
    np.testing.assert_array_equal(table.value, table_in_memory.value)


def test_a_number_that_changed_in_the_file_is_refused_when_it_is_asked_for(tmp_path, in_its_file):
    path = tmp_path / "table.h5"
    table = large_sweep(path)
    image = bytearray(path.read_bytes())
    image[image.index(np.float64(499.0 + X.values[7]).tobytes())] ^= 1
    path.write_bytes(image)
    assert table.status.shape == (500, 1000)
    with pytest.raises(OSError, match=r"damaged: 1 of its 123 chunks"):
        _ = Table.load(path).value


@pytest.mark.parametrize(
    ("cells", "together"), [(1, 1), (10**5, 1), (10**6, 1), (2 * 10**6, 2), (10**7, 16), (10**8, 64), (10**9, 64)]
)
def test_large_grids_have_larger_blocks(cells, together):
    """About a thousand, until a block takes 2 MB."""
    kinds = dict.fromkeys(["time", "end_time", "end_theta", "steps", "rejected"], np.dtype(float))
    layout = Layout({"x": np.empty(cells, np.bool_)}, kinds, {}, {}, {}, {}, 512, {})
    assert running.chunks_together(layout) == together


def test_a_small_grid_is_checked_whole_and_a_large_one_at_its_edges_and_corners():
    (only_cells,) = cells_to_check([X, axis("z", "z", "1", [1.0, 2.0])])
    assert len(only_cells["x"]) == 2000
    looked_at = list(cells_to_check([X, Y, axis("z", "z", "1", [3.0, 1.0, 2.0])]))
    assert sum(len(chunk["x"]) for chunk in looked_at) == 1000 + 500 + 3 + 8
    assert set(zip(*looked_at[-1].values(), strict=True)) == set(
        itertools.product((0.0, 1.0), (0.0, 499.0), (1.0, 3.0))
    )
    assert [columns([Y, X], 1000, 2)[name].tolist() for name in ("y", "x")] == [[1.0, 1.0], [0.0, X.values[1]]]
    assert size_of([X, Y]) == 500_000


def test_a_billion_cells_are_refused_at_once(monkeypatch):
    """Values that are illegal only in combination, in one corner of the grid."""
    monkeypatch.setattr("tippe.runs.verbs.compute_table", lambda *_, **__: pytest.fail("it was run"))
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3))
    axes = {"scene.body.radius": np.linspace(0.02, 0.01, 100), "scene.body.offset": np.linspace(0.001, 0.011, 100)}
    start_time = time.process_time()
    with pytest.raises(ValueError, match=r"offset = 0\.011 must be less than 0\.01"):
        tippe.inversion_table(
            scene, theta=np.linspace(0.1, 1.0, 1000), spin=np.linspace(80.0, 120.0, 100), t1=1.0, axes=axes
        )
    assert time.process_time() - start_time < 1.0


def test_an_illegal_cell_inside_a_large_grid_ends_the_sweep_when_its_turn_comes(monkeypatch, tmp_path):
    monkeypatch.setattr("nonholonomic.sweeps.grid.CHECKED_WHOLE", 1)
    monkeypatch.setattr(running, "chunk_for", lambda cells: 64)
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
    # The law of the checks is as that of a module, but not monotone.
    bounds = tippe.Viscous.bounds

    def odd(self):
        yield from bounds(self)
        if (
            np.ndim(self.mu)
            and np.size(self.mu) > 3
            and np.any((np.asarray(self.mu) > 0.24) & (np.asarray(self.mu) < 0.26))
        ):
            raise ValueError("mu = 0.25 must not be so odd")

    monkeypatch.setattr(tippe.Viscous, "bounds", odd)
    arguments = {"theta": 0.1, "spin": np.linspace(80.0, 120.0, 128), "mu": [0.3, 0.25, 0.2], "t1": 0.1}
    with pytest.raises(ValueError, match=r"mu = 0\.25 must not be so odd"):
        tippe.inversion_table(scene, path=tmp_path / "table.h5", **arguments)


def test_more_cells_than_memory_holds_are_refused_at_once(tmp_path):
    """A table of 10^10 cells: refused without a file for lack of memory, and with a file for lack of disk space."""
    axes = [axis(name, name, "1", np.arange(1e5)) for name in ("x", "y")]
    text = r"path = None: 1e\+10 cells take 2\d\d GB, and this machine has .* GB of memory; pass path= to keep them in a file"
    with pytest.raises(ValueError, match=text):
        sweep(
            job, axes, {"value": VARIABLES["value"], "count": Variable("1", np.int64), "more": VARIABLES["value"]}, {}
        )
