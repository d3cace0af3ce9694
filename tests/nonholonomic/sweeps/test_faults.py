"""Sweeps that are killed, disks that are full, files that are cut, changed or foreign: no block lost, no wrong number read."""

import errno
import itertools
import json
import os
import resource
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from cheap_sweep import BLOCK, cheap_sweep, finished_blocks, resumed

from nonholonomic.sweeps import Table
from nonholonomic.sweeps import running as sweeping
from nonholonomic.sweeps._blockfile import BlockFile

pytestmark = pytest.mark.newest

KILLER = Path(__file__).with_name("kill_sweeps.py")


def kill_sweeps(folder, rounds):
    root = KILLER.parents[3]
    environment = os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{KILLER.parent}", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-W", "ignore", KILLER, folder, str(rounds)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    _, killed, cut, files = (int(part.split()[0]) for part in done.stdout.split(","))
    return killed, cut, files


def test_sweeps_killed_at_random_moments(tmp_path):
    """SIGKILL, and again on resuming: what was finished stays, is right, and is not computed again."""
    killed, *_ = kill_sweeps(tmp_path, 5)
    assert killed == 5


@pytest.mark.slow
def test_sweeps_killed_at_a_hundred_random_moments(tmp_path):
    killed, cut, files = kill_sweeps(tmp_path, 100)
    assert killed == 100
    assert cut > 20
    assert files > 10


class Blow(BaseException):
    """The end of the process at a chosen moment."""


def strike(monkeypatch, moment, torn, error):
    """Have the writing of blocks end at the given operation: a write, of which a part is carried out, or a sync."""
    count = itertools.count()

    class Stream:
        def __init__(self, stream):
            self.stream = stream

        def __getattr__(self, name):
            return getattr(self.stream, name)

        def write(self, data):
            if next(count) == moment:
                self.stream.write(data[: int(torn * len(data))])
                raise error
            return self.stream.write(data)

    once = BlockFile._open

    def opened(self, layout):
        once(self, layout)
        self._stream = Stream(self._stream)

    def synced(handle, sync=os.fsync):
        if next(count) == moment:
            raise error
        sync(handle)

    monkeypatch.setattr(BlockFile, "_open", opened)
    monkeypatch.setattr("nonholonomic.sweeps._blockfile.os.fsync", synced)


@pytest.mark.parametrize("error", [Blow(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))], ids=["killed", "full"])
def test_every_moment_of_writing_a_block(tmp_path, error):
    """Struck down in each operation of the first three blocks, in the middle of it or before: no block is lost."""
    writes_of_a_block = 3 + 1 + 1 + 1 + 1
    for moment in range(2, 3 * writes_of_a_block + 2):
        path = tmp_path / f"{moment}.h5"
        with pytest.MonkeyPatch.context() as patch:
            # Making the file takes two syncs, of the file and of its folder.
            strike(patch, moment, torn=(moment % 3) / 2.0, error=error)
            with pytest.raises(Blow if isinstance(error, Blow) else OSError) as raised:
                cheap_sweep(path)
        if not isinstance(error, Blow):
            assert str(raised.value) == f"cannot write {path}: No space left on device"
        after = finished_blocks(Table.load(path))
        assert len(after) in ((moment - 2) // writes_of_a_block, (moment - 2) // writes_of_a_block + 1)
        assert resumed(path) == set(range(7)) - after


def record(path, monkeypatch):
    """Run a sweep; the file before its blocks, and its writes (place, bytes), cut into what each sync had confirmed."""
    start, batches = [], [[]]
    once = BlockFile._open

    class Stream:
        def __init__(self, stream):
            self.stream = stream

        def __getattr__(self, name):
            return getattr(self.stream, name)

        def write(self, data):
            batches[-1].append((self.stream.tell(), bytes(data)))
            return self.stream.write(data)

    def opened(self, layout):
        once(self, layout)
        start.append(path.read_bytes())
        self._stream = Stream(self._stream)
        monkeypatch.setattr("nonholonomic.sweeps._blockfile.os.fsync", lambda handle: batches.append([]))

    monkeypatch.setattr(BlockFile, "_open", opened)
    cheap_sweep(path)
    monkeypatch.undo()
    return start[0], batches


def check_power_cuts(tmp_path, monkeypatch, rounds):
    """What a sync had confirmed is on the disk; of the rest any writes are, in any order, whole or in part."""
    random = np.random.default_rng(3)
    start, batches = record(tmp_path / "whole.h5", monkeypatch)
    assert len(batches) == 15
    path = tmp_path / "cut.h5"
    for _ in range(rounds):
        moment = int(random.integers(len(batches)))
        image = bytearray(start)
        for place, data in (write for batch in batches[:moment] for write in batch):
            image[place : place + len(data)] = data
        for place, data in batches[moment]:
            kept = int(random.choice([0, random.integers(len(data) + 1), len(data)]))
            image[place : place + kept] = data[:kept]
        path.write_bytes(image)
        assert moment // 2 <= len(finished_blocks(Table.load(path))) <= moment // 2 + moment % 2
        resumed(path)
        path.unlink()


def test_the_power_fails(tmp_path, monkeypatch):
    check_power_cuts(tmp_path, monkeypatch, 10)


@pytest.mark.slow
def test_the_power_fails_a_hundred_times(tmp_path, monkeypatch):
    check_power_cuts(tmp_path, monkeypatch, 100)


@pytest.mark.parametrize("room", [0, 1000, 5000, 9000])
def test_a_disk_too_small_for_the_file(tmp_path, room):
    """The whole file is made before anything is computed, so that is when it must be told; nothing is left behind."""
    path, computed = tmp_path / "table.h5", []
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    try:
        with pytest.raises(OSError, match=r"cannot write .*table\.h5: File too large"):
            cheap_sweep(path, computed.append)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not computed
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """The bytes of a finished file, of one half finished and of a saved table."""
    folder = tmp_path_factory.mktemp("images")
    table = cheap_sweep(folder / "whole.h5")
    table.save(folder / "saved.h5")
    stop = Blow()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeping, "workers", lambda: 1)
        strike(patch, 2 + 3 * 7 + 1, torn=0.5, error=stop)
        with pytest.raises(Blow):
            cheap_sweep(folder / "part.h5")
    assert len(finished_blocks(Table.load(folder / "part.h5"))) == 3
    return {name: (folder / f"{name}.h5").read_bytes() for name in ("whole", "part", "saved")}


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
    """A file with one bit flipped is read as it was or refused; a sweep either refuses it too or repairs it."""
    refused = 0
    for name, image in images.items():
        path = folder / f"{name}.h5"
        path.write_bytes(image)
        right = contents(path)
        for place, bit in places_of(image):
            changed = bytearray(image)
            changed[place] ^= 1 << bit
            path.write_bytes(changed)
            found = contents(path)
            refused += found is None
            # A mark that has gone out makes a block pending, which is no wrong number.
            if found is not None and name != "saved":
                assert finished_blocks(Table.load(path)) <= set(range(7))
                assert found[1:] == right[1:]
            elif found is not None:
                assert found == right or (np.isnan(Table.load(path).value).all())
    return refused


def test_a_flipped_bit(images, tmp_path):
    random = np.random.default_rng(1)
    refused = check_flips(
        images,
        tmp_path,
        lambda image: zip(random.integers(len(image), size=60), random.integers(8, size=60), strict=True),
    )
    assert 30 < refused < 150


@pytest.mark.slow
def test_a_bit_flipped_in_every_byte(images, tmp_path):
    random = np.random.default_rng(2)
    refused = check_flips(
        images, tmp_path, lambda image: ((place, int(random.integers(8))) for place in range(len(image)))
    )
    assert refused > 5000


def test_a_changed_number_is_refused_by_a_reader_and_repaired_by_a_sweep(tmp_path):
    """Wherever in the numbers of a block: the sweep says so and computes that block again, and no other."""
    path = tmp_path / "table.h5"
    cheap_sweep(path)
    with h5py.File(path, "r+") as file:
        file["value"][2 * BLOCK + 1] += 1e-16
    with pytest.raises(OSError, match=r"cannot read .*table\.h5: it is damaged: 1 of its 7 blocks do not match"):
        Table.load(path)
    with pytest.warns(RuntimeWarning, match=r"table\.h5 is damaged: 1 finished blocks .* computed again"):
        cheap_sweep(path)
    with h5py.File(path, "r+") as file:
        file["value"][2 * BLOCK + 1] += 1e-16
    assert resumed(path) == {2}
    with h5py.File(path, "r+") as file:
        file["x"].attrs["units"] = "h"
    with pytest.raises(OSError, match=r"damaged: 7 of its 7 blocks"):
        Table.load(path)


def check_cuts(images, folder, lengths_of):
    """A file cut short is refused, by a reader and by a sweep, which computes nothing."""
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
        file.create_group("block")
    for path in (text, empty, foreign, half):
        before = path.read_bytes()
        assert contents(path) is None
        with pytest.raises(OSError, match=f"cannot read {path}"):
            cheap_sweep(path, pytest.fail)
        assert path.read_bytes() == before
    saved = tmp_path / "saved.h5"
    saved.write_bytes(images["saved"])
    with pytest.raises(ValueError, match=r"saved\.h5 was not written by a sweep in 7 blocks"):
        cheap_sweep(saved, pytest.fail)
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(OSError, match="folder: it is a folder"):
        cheap_sweep(folder, pytest.fail)
    assert saved.read_bytes() == images["saved"]
    # No one may write in the first; the second is no folder.
    for path in (Path("/proc/table.h5"), text / "table.h5"):
        with pytest.raises(OSError, match=f"cannot write {path}"):
            cheap_sweep(path, pytest.fail)


def test_one_of_many_writers(tmp_path):
    """Many try to fill in one file at once and again: each is refused or does it alone, and the file is right."""
    path, refused, failed = tmp_path / "table.h5", [], []
    at_work, gate = set(), threading.Barrier(8)

    def writer():
        gate.wait()
        for _ in range(10):
            try:
                layout = sweeping.BlockFile(path, LAYOUT)
            except OSError as error:
                refused.append(str(error))
                continue
            at_work.add(threading.get_ident())
            if len(at_work) > 1:
                failed.append(set(at_work))
            layout.write(0, 0, {"value": np.zeros(BLOCK)})
            at_work.discard(threading.get_ident())
            layout.close()

    attributes = {"request": "{}", "axes": '["x"]', "versions": "{}"}
    LAYOUT = sweeping.Layout({"x": np.arange(8.0)}, {"value": np.float64}, {}, {}, attributes, [0])
    threads = [threading.Thread(target=writer) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
    assert refused
    assert all("another process is writing it" in message for message in refused)
    assert (Table.load(path).value == 0.0).all()


def test_a_reader_beside_the_writer_sees_whole_blocks(tmp_path):
    """A table that is read while a sweep fills it in has blocks that are complete, or pending."""
    path, seen = tmp_path / "table.h5", []
    once = BlockFile._put

    def look(self, name, index, values):
        once(self, name, index, values)
        seen.append(len(finished_blocks(Table.load(path))))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BlockFile, "_put", look)
        cheap_sweep(path)
    assert seen == sorted(seen)
    assert seen[-1] == 7


def test_another_version_is_told_or_refused(tmp_path, monkeypatch):
    """Another version of this package may have other equations; other libraries have other last digits."""
    path = tmp_path / "table.h5"
    now = sweeping.versions()
    with monkeypatch.context() as patch:
        strike(patch, 20, torn=0.0, error=Blow())
        patch.setattr(sweeping, "versions", lambda: now | {"jax": "0.0.1", "python": "2.7"})
        with pytest.raises(Blow):
            cheap_sweep(path)
    with pytest.warns(RuntimeWarning, match=rf"was begun with jax 0\.0\.1, now {now['jax']}: digits may differ"):
        table = cheap_sweep(path)
    # The table says what its file says; now that all is there, no one need be told again.
    assert json.loads(table.attributes["versions"])["jax"] == "0.0.1"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cheap_sweep(path)
    with monkeypatch.context() as patch:
        patch.setattr(sweeping, "versions", lambda: now | {"nonholonomic": "99.0"})
        with pytest.raises(ValueError, match=r"another run: nonholonomic is .* there and 99\.0 here"):
            cheap_sweep(path)
