"""Sweeps that are killed, disks that are full, files that are cut, changed or foreign: no block lost, no wrong number read."""

import errno
import io
import itertools
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import threading
import warnings
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from cheap_sweep import BLOCK, cheap_sweep, finished_blocks, resumed

from nonholonomic.sweeps import Table, running
from nonholonomic.sweeps._blocks import Blocks
from nonholonomic.sweeps.layout import Layout

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


#: What is done on the disk: for the folder of the blocks and what it is for, for each block, and for the table's file.
FOR_THE_FOLDER, FOR_A_BLOCK, FOR_THE_FILE = 4, 4, 3


def strike(monkeypatch, moment, torn, error):
    """Have a sweep end at an operation on the disk: before a sync or a renaming, or in a block, of which a part is written."""
    count = itertools.count()

    def struck(function):
        def operation(*arguments):
            if next(count) == moment:
                raise error
            return function(*arguments)

        return operation

    def saved(stream, savez=np.savez, **arrays):
        whole = io.BytesIO()
        savez(whole, **arrays)
        falls = next(count) == moment
        stream.write(whole.getvalue()[: int(torn * len(whole.getvalue())) if falls else None])
        if falls:
            raise error

    monkeypatch.setattr(os, "fsync", struck(os.fsync))
    monkeypatch.setattr(os, "replace", struck(os.replace))
    monkeypatch.setattr(np, "savez", saved)


@pytest.mark.parametrize("error", [Blow(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))], ids=["killed", "full"])
def test_every_moment_of_writing(tmp_path, error):
    """Struck down in each operation of the first three blocks, in the middle of it or before, and of the file: none is lost."""
    ends = FOR_THE_FOLDER + 7 * FOR_A_BLOCK
    for moment in (*range(FOR_THE_FOLDER, FOR_THE_FOLDER + 3 * FOR_A_BLOCK + 1), *range(ends, ends + FOR_THE_FILE)):
        path = tmp_path / f"{moment}.h5"
        with pytest.MonkeyPatch.context() as patch:
            strike(patch, moment, torn=(moment % 3) / 2.0, error=error)
            with pytest.raises(Blow if isinstance(error, Blow) else OSError) as raised:
                cheap_sweep(path)
        if not isinstance(error, Blow):
            assert re.fullmatch(rf"cannot write {path}(\.blocks/\d\.npz)?: No space left on device", str(raised.value))
        after = finished_blocks(Table.load(path))
        written = (moment - FOR_THE_FOLDER) // FOR_A_BLOCK
        assert len(after) in (written, written + 1)
        assert resumed(path) == set(range(7)) - after
        assert list(tmp_path.iterdir()) == [path]
        path.unlink()


def record(path, monkeypatch):
    """Run a sweep; what it does on the disk: the contents of renamed files, whether a sync had confirmed them, and syncs of
    folders."""
    done, synced = [], set()

    def sync(handle, fsync=os.fsync):
        fsync(handle)
        place = Path(f"/proc/self/fd/{handle}").resolve()
        if place.is_dir():
            done.append(("sync", place.name))
        else:
            synced.add((place, place.read_bytes()))

    def replace(start, end, replace=os.replace):
        content = Path(start).read_bytes()
        confirmed = (Path(start).resolve(), content) in synced
        replace(start, end)
        done.append(("rename", Path(end).parent.name, Path(end).name, content, confirmed))

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(os, "replace", replace)
    cheap_sweep(path)
    monkeypatch.undo()
    return done


def after_the_cut(done, random):
    """The files after the power failed, and how many blocks had been confirmed: what a sync has not may be there, or a part."""
    files, confirmed = {}, 0
    for place, (what, folder, *file) in enumerate(done):
        if what == "rename":
            name, content, whole = file
            kept = ("sync", folder) in done[place:]
            confirmed += kept and name.endswith(".npz")
            if kept or random.integers(2):
                files[folder, name] = content if whole else content[: random.integers(len(content))]
    return files, confirmed


def check_power_cuts(tmp_path, monkeypatch, rounds):
    random = np.random.default_rng(3)
    path, blocks = tmp_path / "table.h5", tmp_path / "table.h5.blocks"
    done = record(path, monkeypatch)
    assert len(done) == 1 + 2 + 7 * 2 + 2
    seen = set()
    for _ in range(rounds):
        for file in tmp_path.iterdir():
            shutil.rmtree(file) if file.is_dir() else file.unlink()
        moment = int(random.integers(len(done) + 1))
        files, confirmed = after_the_cut(done[:moment], random)
        for (folder, name), content in files.items():
            place = tmp_path / name if folder == tmp_path.name else blocks / name
            place.parent.mkdir(exist_ok=True)
            # When the file is there the blocks are removed, one by one.
            if place == path or moment < len(done) or random.integers(2):
                place.write_bytes(content)
        begun = path.exists() or (blocks / "table.h5").exists()
        found = finished_blocks(Table.load(path)) if begun else set()
        assert confirmed <= len(found) <= confirmed + 1
        seen.add(len(found))
        assert resumed(path) == set(range(7)) - found
        assert list(tmp_path.iterdir()) == [path]
    return seen


def test_the_power_fails(tmp_path, monkeypatch):
    assert len(check_power_cuts(tmp_path, monkeypatch, 15)) > 4


@pytest.mark.slow
def test_the_power_fails_a_hundred_times(tmp_path, monkeypatch):
    assert len(check_power_cuts(tmp_path, monkeypatch, 100)) == 8


@pytest.mark.parametrize("room", [0, 1000, 5000])
def test_a_disk_too_small_for_anything(tmp_path, room):
    """It is told before anything is computed; nothing is left behind."""
    path = tmp_path / "table.h5"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    try:
        with pytest.raises(OSError, match=r"cannot write .*table\.h5: .*File too large"):
            cheap_sweep(path, pytest.fail)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_a_disk_too_small_for_the_table(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    told = r"cannot write .*table\.h5: 1e-06 GB are free, and it takes 1\.7e-06 GB on the way"
    with pytest.raises(OSError, match=told):
        cheap_sweep(tmp_path / "table.h5", pytest.fail)
    assert not list(tmp_path.iterdir())


def half_finished(path):
    """A sweep that was struck down after three blocks."""
    with pytest.MonkeyPatch.context() as patch:
        strike(patch, FOR_THE_FOLDER + 3 * FOR_A_BLOCK, torn=0.5, error=Blow())
        with pytest.raises(Blow):
            cheap_sweep(path)
    assert len(finished_blocks(Table.load(path))) == 3


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
    """A file with one bit flipped is read as it was, or refused."""
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
            assert found in (None, right), place
    return refused


def test_a_flipped_bit(images, tmp_path):
    random = np.random.default_rng(1)
    refused = check_flips(
        images,
        tmp_path,
        lambda image: zip(random.integers(len(image), size=60), random.integers(8, size=60), strict=True),
    )
    assert 20 < refused < 100


@pytest.mark.slow
def test_a_bit_flipped_in_every_byte(images, tmp_path):
    random = np.random.default_rng(2)
    refused = check_flips(
        images, tmp_path, lambda image: ((place, int(random.integers(8))) for place in range(len(image)))
    )
    assert refused > 5000


def check_flips_of_blocks(folder, places_of):
    """One bit flipped in what there is of an unfinished table: a reader has the truth or refuses it, a sweep mends it."""
    start = folder / "start" / "table.h5"
    start.parent.mkdir()
    half_finished(start)
    right, refused = contents(start), 0
    for file in sorted((folder / "start" / "table.h5.blocks").iterdir()):
        for place, bit in places_of(file.read_bytes()):
            shutil.rmtree(folder / "now", ignore_errors=True)
            shutil.copytree(folder / "start", folder / "now")
            path = folder / "now" / "table.h5"
            changed = bytearray(file.read_bytes())
            changed[place] ^= 1 << bit
            (folder / "now" / "table.h5.blocks" / file.name).write_bytes(changed)
            found = contents(path)
            assert found in (None, right), (file.name, place)
            refused += found is None
            if file.suffix == ".npz":
                assert len(resumed(path)) == 4 + (found is None)
    return refused


def test_a_bit_flipped_in_a_block(tmp_path):
    random = np.random.default_rng(6)
    places = lambda image: zip(random.integers(len(image), size=3), random.integers(8, size=3), strict=True)  # noqa: E731
    assert 4 < check_flips_of_blocks(tmp_path, places) <= 12


@pytest.mark.slow
def test_a_bit_flipped_in_every_byte_of_a_block(tmp_path):
    random = np.random.default_rng(7)
    places = lambda image: ((place, int(random.integers(8))) for place in range(0, len(image), 7))  # noqa: E731
    assert check_flips_of_blocks(tmp_path, places) > 300


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
        file.create_group("checksums")
    for path in (text, empty, foreign, half):
        before = path.read_bytes()
        assert contents(path) is None
        with pytest.raises(OSError, match=f"cannot read {path}"):
            cheap_sweep(path, pytest.fail)
        assert path.read_bytes() == before
    saved = tmp_path / "saved.h5"
    saved.write_bytes(images["saved"])
    with pytest.raises(ValueError, match=r"saved\.h5 holds .*: it was not written by a sweep in 7 blocks"):
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
                blocks = Blocks(path, LAYOUT)
            except OSError as error:
                refused.append(str(error))
                continue
            at_work.add(threading.get_ident())
            if len(at_work) > 1:
                failed.append(set(at_work))
            blocks.write(0, {"value": np.zeros(BLOCK)})
            at_work.discard(threading.get_ident())
            blocks.close()

    attributes = {"request": "{}", "axes": '["x"]', "versions": "{}"}
    LAYOUT = Layout({"x": np.arange(8.0)}, {"value": np.dtype(float)}, {}, attributes, {}, {}, BLOCK)
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
    """A table that is read while a sweep computes it has blocks that are complete, or pending."""
    path, seen = tmp_path / "table.h5", []

    def look(start, end, replace=os.replace):
        replace(start, end)
        seen.append(len(finished_blocks(Table.load(path))))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", look)
        cheap_sweep(path)
    assert seen == [*range(8), 7]


def test_another_version_is_told_or_refused(tmp_path, monkeypatch):
    """Another version of this package may have other equations; other libraries have other last digits."""
    path = tmp_path / "table.h5"
    now = running.versions()
    with monkeypatch.context() as patch:
        strike(patch, 20, torn=0.0, error=Blow())
        patch.setattr(running, "versions", lambda: now | {"jax": "0.0.1", "python": "2.7"})
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
        patch.setattr(running, "versions", lambda: now | {"nonholonomic": "99.0"})
        with pytest.raises(ValueError, match=r"another run: nonholonomic is .* there and 99\.0 here"):
            cheap_sweep(path)
