"""Files that are cut, changed or foreign: no wrong number read, none of another's bytes changed."""

import errno
import json
import os
import resource
import shutil
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from cheap_sweep import BLOCK, VARIABLES, cheap_sweep, finished_blocks, resumed
from disk_faults import half_finished

from nonholonomic.sweeps import Table, saved_cells
from nonholonomic.sweeps._store import ChunkStore, Stored, difference_between
from nonholonomic.sweeps.grid import Layout
from nonholonomic.views import Page

pytestmark = pytest.mark.oldest


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """The bytes of a finished file and of a saved table."""
    folder = tmp_path_factory.mktemp("images")
    cheap_sweep(folder / "whole.h5").save(folder / "saved.h5")
    return {name: (folder / f"{name}.h5").read_bytes() for name in ("whole", "saved")}


def contents(path):
    """Everything that a table holds, or `None` if it is refused."""
    try:
        table = Table.load(path)
    except OSError as error:
        assert f"cannot read {path}" in str(error)  # noqa: PT017
        return None
    arrays = {name: (values.dtype.str, values.tobytes()) for name, values in (table.coords | table.variables).items()}
    return arrays, table.units, table.words, table.attributes


def check_flips(images, folder, places_of):
    """A file with one flipped bit is read with its original contents, or refused."""
    refusals = 0
    for name, image in images.items():
        path = folder / f"{name}.h5"
        path.write_bytes(image)
        right = contents(path)
        for place, bit in places_of(image):
            damaged = bytearray(image)
            damaged[place] ^= 1 << bit
            path.write_bytes(damaged)
            content = contents(path)
            refusals += content is None
            assert content in (None, right), place
    return refusals


def test_a_flipped_bit(images, tmp_path):
    random = np.random.default_rng(1)
    refusals = check_flips(
        images,
        tmp_path,
        lambda image: zip(random.integers(len(image), size=60), random.integers(8, size=60), strict=True),
    )
    assert 20 < refusals < 100


@pytest.mark.slow
def test_a_bit_flipped_in_every_byte(images, tmp_path):
    random = np.random.default_rng(2)
    refusals = check_flips(
        images, tmp_path, lambda image: ((place, int(random.integers(8))) for place in range(len(image)))
    )
    assert refusals > 5000


def check_flips_of_blocks(folder, places_of):
    """An unfinished table with a flipped bit: readers return its contents or refuse, and a sweep repairs it."""
    start = folder / "start" / "table.h5"
    start.parent.mkdir()
    half_finished(start)
    right, refusals = contents(start), 0
    (file,) = (folder / "start" / "table.h5.blocks").iterdir()
    with h5py.File(file, "r") as table:
        numbers = [(table[name].id.get_offset(), 3 * BLOCK * table[name].dtype.itemsize) for name in VARIABLES]
        numbers += [(table["checksums"][name].id.get_offset(), 3 * 4) for name in VARIABLES]
    of_blocks = [place for start, size in numbers for place in range(start, start + size)]
    for place, bit in places_of(file.read_bytes(), of_blocks):
        shutil.rmtree(folder / "now", ignore_errors=True)
        shutil.copytree(folder / "start", folder / "now")
        path = folder / "now" / "table.h5"
        damaged = bytearray(file.read_bytes())
        damaged[place] ^= 1 << bit
        (folder / "now" / "table.h5.blocks" / file.name).write_bytes(damaged)
        content = contents(path)
        assert content in (None, right), place
        refusals += content is None
        if place in of_blocks:
            assert content is None
            assert len(resumed(path)) == 5
    return refusals


def test_a_bit_flipped_in_a_block(tmp_path):
    random = np.random.default_rng(6)

    def places(image, of_blocks):
        places = [*random.choice(of_blocks, size=9), *random.integers(len(image), size=3)]
        return zip(places, random.integers(8, size=12), strict=True)

    assert 9 <= check_flips_of_blocks(tmp_path, places) <= 12


@pytest.mark.slow
def test_a_bit_flipped_in_every_byte_of_a_block(tmp_path):
    random = np.random.default_rng(7)
    places = lambda image, _: ((place, int(random.integers(8))) for place in range(0, len(image), 7))  # noqa: E731
    assert check_flips_of_blocks(tmp_path, places) > 300


def test_a_changed_number_is_refused_by_a_reader_and_repaired_by_a_sweep(tmp_path):
    """A flipped bit anywhere in a block: the sweep warns and computes only that block again."""
    path = tmp_path / "table.h5"
    cheap_sweep(path)
    with h5py.File(path, "r+") as file:
        file["value"][2 * BLOCK + 1] += 1e-16
    with pytest.raises(OSError, match=r"cannot read .*table\.h5: it is damaged: 1 of its 7 chunks do not match"):
        Table.load(path)
    with pytest.warns(RuntimeWarning, match=r"table\.h5 is damaged: 1 finished chunks .* computed again"):
        cheap_sweep(path)
    with h5py.File(path, "r+") as file:
        file["value"][2 * BLOCK + 1] += 1e-16
    assert resumed(path) == {2}


@pytest.mark.parametrize("error", [OSError(errno.EIO, os.strerror(errno.EIO)), None], ids=["error", "short"])
def test_an_unreadable_block_alone_is_computed_again(error, tmp_path, monkeypatch):
    """Of an unfinished table, and of a finished one; readers refuse both by the table's name."""
    path, read = tmp_path / "table.h5", np.fromfile

    def from_disk(file, kind, count, offset):
        if place <= offset + count * kind.itemsize - 1 and offset <= place:
            if error is not None:
                raise error
            count -= 1
        return read(file, kind, count, offset=offset)

    half_finished(path)
    for is_unfinished in (True, False):
        place = Stored(path, is_unfinished).places["count"] + BLOCK * 8
        with monkeypatch.context() as patch:
            patch.setattr(np, "fromfile", from_disk)
            with pytest.raises(OSError, match=rf"cannot read {path}"):
                Table.load(path)
            with pytest.warns(RuntimeWarning, match=rf"{path} is damaged: 1 finished chunks .* computed again"):
                store = ChunkStore(path, Stored(path, is_unfinished).layout)
            store.close()
            assert store.finished == set(range(3 if is_unfinished else 7)) - {1}
        # The disk has recovered.
        assert len(resumed(path)) == (4 if is_unfinished else 0)


def test_files_of_earlier_versions_are_refused_by_this_reason(tmp_path):
    """They have no layout; in some, each chunk was a file beside an unfinished table."""
    path, folder = tmp_path / "table.h5", tmp_path / "table.h5.blocks"
    whole = tmp_path / "whole.h5"
    half_finished(path)
    cheap_sweep(whole)
    for file_path in (folder / "table.h5", whole):
        with h5py.File(file_path, "r+") as file:
            del file["checksums"].attrs["layout"]
    (folder / "0.npz").touch()
    for table_path, place in ((path, f"{path}, unfinished in {folder}"), (whole, f"{whole}")):
        text = rf"cannot read {place}: .* \(another program wrote it, or an earlier version, which can resume it\)"
        for read in (Table.load, lambda path: cheap_sweep(path, pytest.fail)):
            with pytest.raises(OSError, match=text):
                read(table_path)
    assert sorted(file.name for file in folder.iterdir()) == ["0.npz", "table.h5"]


def test_a_finished_table_is_read_whatever_is_in_the_folder_of_its_chunks(tmp_path):
    path, unfinished = tmp_path / "table.h5", tmp_path / "table.h5.blocks" / "table.h5"
    cheap_sweep(path)
    unfinished.parent.mkdir()
    unfinished.write_text("not a table")
    assert resumed(path) == set()
    assert saved_cells(path) == 50
    assert unfinished.read_text() == "not a table"
    # If the table is damaged, its chunks may be in the other file.
    with h5py.File(path, "r+") as file:
        file["value"][2 * BLOCK + 1] += 1e-16
    with pytest.raises(OSError, match=rf"cannot read {path}, unfinished in {unfinished.parent}: it is not a table"):
        cheap_sweep(path, pytest.fail)
    assert unfinished.read_text() == "not a table"


def check_cuts(images, folder, lengths_of):
    """Readers and sweeps refuse a truncated file; the sweep computes nothing."""
    for name, image in images.items():
        path = folder / f"{name}.h5"
        for length in lengths_of(image):
            path.write_bytes(image[:length])
            assert contents(path) is None
            with pytest.raises(OSError, match=f"cannot read .*{name}"):
                cheap_sweep(path, pytest.fail)


def test_a_file_cut_short(images, tmp_path):
    random = np.random.default_rng(4)
    check_cuts(images, tmp_path, lambda image: [0, 1, len(image) - 1, *random.integers(len(image), size=7)])


@pytest.mark.slow
def test_a_file_cut_at_a_hundred_lengths(images, tmp_path):
    random = np.random.default_rng(5)
    check_cuts(images, tmp_path, lambda image: random.integers(len(image), size=100))


def test_a_changed_layout_is_refused_however_long_it_is(tmp_path):
    """HDF5 has no checksum for attributes of more than 64 KB."""
    for size in (1, 100_000):
        path = tmp_path / f"{size}.h5"
        request = json.dumps({"data": size * "x"})
        Table({"x": np.arange(3.0)}, {"value": np.ones(3)}, {"x": "m"}, {"request": request}).save(path)
        image = bytearray(path.read_bytes())
        image[image.index(b'"units": {"x": "m"}') + 15] ^= 1
        path.write_bytes(image)
        assert contents(path) is None


def test_a_file_with_a_hole(images, tmp_path):
    """Zeros where the numbers of finished blocks were, as after a copy that broke off: refused, and repaired by a sweep."""
    path = tmp_path / "whole.h5"
    path.write_bytes(images["whole"])
    with h5py.File(path, "r") as file:
        place = file["value"].id.get_offset()
    image = bytearray(images["whole"])
    image[place : place + 8 * 2 * BLOCK] = bytes(8 * 2 * BLOCK)
    path.write_bytes(image)
    assert contents(path) is None
    assert resumed(path) == {0, 1}


def test_foreign_files_and_folders_are_left_alone(images, tmp_path):
    """Refused by name, and not changed."""
    text = tmp_path / "text.h5"
    text.write_text("not a table")
    empty = tmp_path / "empty.h5"
    empty.touch()
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["x"] = np.arange(3.0)
    half = tmp_path / "half.h5"
    with h5py.File(half, "w") as file:
        file.attrs["request"] = file.attrs["axes"] = "{}"
        file.create_group("checksums")
    for path in (text, empty, foreign, half):
        content_before = path.read_bytes()
        assert contents(path) is None
        with pytest.raises(OSError, match=f"cannot read {path}"):
            cheap_sweep(path, pytest.fail)
        assert path.read_bytes() == content_before
    copy = tmp_path / "saved.h5"
    copy.write_bytes(images["saved"])
    with pytest.raises(ValueError, match=r"saved\.h5 holds .*: it was not written by a sweep in 7 chunks"):
        cheap_sweep(copy, pytest.fail)
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(OSError, match="folder: it is a folder"):
        cheap_sweep(folder, pytest.fail)
    assert copy.read_bytes() == images["saved"]
    # The first is not writable; the second is not a folder.
    for path in (Path("/proc/table.h5"), text / "table.h5"):
        with pytest.raises(OSError, match=f"cannot write {path}"):
            cheap_sweep(path, pytest.fail)


def test_a_user_s_own_files_beside_a_table_stay(tmp_path):
    """A lock, and a folder that has the name of the folder of the chunks: it is refused, or kept with what is in it."""
    path, lock, folder = tmp_path / "table.h5", tmp_path / "table.h5.lock", tmp_path / "table.h5.blocks"
    lock.write_text("mine")
    folder.mkdir()
    for name in ("0.npz", "notes.txt"):
        note = folder / name
        note.write_text("mine")
        with pytest.raises(
            OSError, match=rf"cannot write {path}: the folder .*table\.h5\.blocks, holds .*{name}; give"
        ):
            cheap_sweep(path, pytest.fail)
        assert [file.name for file in folder.iterdir()] == [name]
        note.unlink()
    half_finished(path)
    for name in ("notes.txt", "first.npz", "99.npz"):
        (folder / name).write_text("mine")
    assert len(finished_blocks(Table.load(path))) == 3
    assert len(resumed(path)) == 4
    assert resumed(path) == set()
    assert sorted(file.name for file in folder.iterdir()) == ["99.npz", "first.npz", "notes.txt"]
    assert lock.read_text() == "mine"
    shutil.rmtree(folder)
    folder.write_text("mine")
    path.unlink()
    with pytest.raises(
        OSError, match=rf"cannot write {path}: File exists; .*table\.h5\.blocks must be a folder or absent"
    ):
        cheap_sweep(path, pytest.fail)
    assert folder.read_text() == "mine"


def test_a_symbolic_link_stays_one(tmp_path):
    """Everything that is written through a link: a sweep, also one that is resumed, a saved table, and a page."""
    (tmp_path / "far").mkdir()
    for name, write in {
        "sweep.h5": lambda path: (half_finished(path), resumed(path)),
        "saved.h5": lambda path: cheap_sweep(None).save(path),
        "page.html": Page("<html>").save,
    }.items():
        link, target = tmp_path / name, tmp_path / "far" / f"real_{name}"
        link.symlink_to(target)
        write(link)
        write(link) if name == "page.html" else None
        assert link.is_symlink()
        assert sorted(file.name for file in target.parent.iterdir() if name in file.name) == [target.name]
        assert target.stat().st_size > 5
    assert finished_blocks(Table.load(tmp_path / "sweep.h5")) == set(range(7))
    assert not [file for file in tmp_path.iterdir() if not file.is_symlink() and file.is_file()]


def test_a_full_disk_leaves_no_half_file(tmp_path):
    """A page and a table that do not fit: the old file stays as it was, and no other file remains."""
    table, page = cheap_sweep(None), Page("x" * 100_000)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for name, save in {"page.html": page.save, "table.h5": table.save}.items():
        path = tmp_path / name
        save(path)
        content_before = path.read_bytes()
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
        try:
            with pytest.raises(OSError, match=f"cannot write {path}: File too large"):
                save(path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert path.read_bytes() == content_before
    assert sorted(file.name for file in tmp_path.iterdir()) == ["page.html", "table.h5"]


def hostile_files():
    """Changes of a file with right checksums, each of which another program could have written."""

    def with_layout(file, text):
        file["checksums"].attrs["layout"] = np.bytes_(text.encode())
        file["checksums"].attrs["checksum of the layout"] = zlib.crc32(text.encode())

    def of_layout(file, **changes):
        with_layout(file, json.dumps(json.loads(file["checksums"].attrs["layout"]) | changes))

    def no_cells_in_a_chunk(file):
        of_layout(file, chunk=0)

    def more_numbers_than_fit(file):
        del file["value"]
        file.create_dataset("value", shape=(10**13,), dtype=float, chunks=(10**4,))
        del file["x"]
        file.create_dataset("x", shape=(10**13,), dtype=float, chunks=(10**4,))

    def a_code_without_a_word(file):
        codes = file["status"][()]
        codes[0] = 100
        file["status"][...] = codes
        file["checksums"]["status"][0] = zlib.crc32(codes[:BLOCK].data)

    def words_of_another_kind(file):
        of_layout(file, words={"status": 3})

    def a_request_of_another_kind(file):
        of_layout(file, attributes={"request": "[1, 2]"})

    def a_grid_in_place_of_an_axis(file):
        del file["x"]
        file["x"] = np.zeros((5, 10))
        file["checksums"]["x"][0] = zlib.crc32(np.zeros((5, 10)))

    def too_deep(file):
        with_layout(file, "[" * 30_000)

    def another_shape(file):
        of_layout(file, inner={"value": ["x"]})

    def a_loop(file):
        del file["value"]
        file["value"] = h5py.SoftLink("/value")

    return [value for name, value in locals().items() if callable(value) and value not in (with_layout, of_layout)]


@pytest.mark.parametrize("change", hostile_files(), ids=lambda change: change.__name__)
def test_a_hostile_file_is_refused_by_name(change, images, tmp_path):
    path = tmp_path / "hostile.h5"
    path.write_bytes(images["whole"])
    with h5py.File(path, "r+") as file:
        change(file)
    assert contents(path) is None
    with pytest.raises(OSError, match=f"cannot read {path}"):
        cheap_sweep(path, pytest.fail)


@pytest.mark.parametrize("path", ["", "a\0b", 3])
def test_what_is_not_a_path_is_refused(path):
    for read in (Table.load, lambda path: cheap_sweep(path, pytest.fail), cheap_sweep(None).save):
        with pytest.raises(ValueError, match=r"path = .* must be the path of a file"):
            read(path)


def test_a_number_that_is_missing_in_a_request_is_the_same_again():
    first, second = (Layout({}, {}, {}, {"request": f'{{"data": [NaN, {x}]}}'}, {}, {}, 1, {}) for x in (1.0, 2.0))
    assert difference_between(first, first) is None
    assert "data is [nan, 1.0] in the file and [nan, 2.0]" in str(difference_between(first, second))
