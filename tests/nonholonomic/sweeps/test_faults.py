"""Sweeps that are killed, disks that are full, many writers, other versions: no block lost."""

import errno
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from cheap_sweep import BLOCK, VARIABLES, X, cheap_sweep, expected, finished_blocks, resumed
from disk_faults import FOR_A_BLOCK, FOR_THE_FILE, FOR_THE_FOLDER, Killed, fail_on_disk

from nonholonomic.sweeps import Table, Variable, axis, grid, sweep
from nonholonomic.sweeps._store import ChunkStore, Stored, Stream
from nonholonomic.sweeps.grid import Layout

pytestmark = pytest.mark.oldest

KILLER = Path(__file__).with_name("kill_sweeps.py")


def kill_sweeps(folder, rounds):
    root = KILLER.parents[3]
    environment = os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{KILLER.parent}", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-W", "ignore", KILLER, folder, str(rounds)]
    process = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert process.returncode == 0, process.stderr
    _, kills, cut, files = (int(part.split()[0]) for part in process.stdout.split(","))
    return kills, cut, files


def test_sweeps_killed_at_random_moments(tmp_path):
    """After SIGKILL, also during a resumed run, finished blocks remain, are correct, and are not computed again."""
    kills, *_ = kill_sweeps(tmp_path, 5)
    assert kills == 5


@pytest.mark.slow
def test_sweeps_killed_at_a_hundred_random_moments(tmp_path):
    kills, cut, files = kill_sweeps(tmp_path, 100)
    assert kills == 100
    assert cut > 20
    assert files > 10


@pytest.mark.parametrize("error", [Killed(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))], ids=["killed", "full"])
def test_every_moment_of_writing(tmp_path, error):
    """Struck down in each operation of the first three blocks, in the middle of it or before, and of the file: none is lost."""
    ends = FOR_THE_FOLDER + 7 * FOR_A_BLOCK
    for moment in (*range(FOR_THE_FOLDER, FOR_THE_FOLDER + 3 * FOR_A_BLOCK + 1), *range(ends, ends + FOR_THE_FILE)):
        path = tmp_path / f"{moment}.h5"
        with pytest.MonkeyPatch.context() as patch:
            fail_on_disk(patch, moment, torn=(moment % 3) / 2.0, error=error)
            with pytest.raises(Killed if isinstance(error, Killed) else OSError) as error_info:
                cheap_sweep(path)
        if not isinstance(error, Killed):
            assert re.fullmatch(f"cannot write {path}: No space left on device", str(error_info.value))
        blocks_after = finished_blocks(Table.load(path))
        blocks_written = (moment - FOR_THE_FOLDER) // FOR_A_BLOCK
        assert len(blocks_after) in (blocks_written, blocks_written + 1)
        assert resumed(path) == set(range(7)) - blocks_after
        assert list(tmp_path.iterdir()) == [path]
        path.unlink()


def record(path, monkeypatch):
    """Run a sweep; what it does on the disk: the contents of renamed files, whether a sync had confirmed them, the contents of
    the unfinished table at each sync, and syncs of folders."""
    process, synced = [], set()

    def sync(handle, fsync=os.fsync):
        fsync(handle)
        place = Path(f"/proc/self/fd/{handle}").resolve()
        if place.is_dir():
            process.append(("sync", place.name))
            return
        synced.add((place, place.read_bytes()))
        if place.name == "table.h5":
            process.append(("write", place.read_bytes()))

    def replace(start, end, replace=os.replace):
        content = Path(start).read_bytes()
        confirmed = (Path(start).resolve(), content) in synced
        replace(start, end)
        process.append(("rename", Path(start), Path(end), content, confirmed))

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(os, "replace", replace)
    cheap_sweep(path)
    monkeypatch.undo()
    return process


def after_the_cut(process, moment, random):
    """The files after a power failure, and the number of confirmed blocks; data that was not synced may be missing or cut."""
    files, unfinished, syncs = {}, None, 0
    for place, (operation, *details) in enumerate(process[:moment]):
        if operation == "rename":
            start, end, content, image = details
            is_synced = ("sync", end.parent.name) in process[place:moment]
            if is_synced or random.integers(2):
                files.pop(start, None)
                files[end] = content if image else content[: random.integers(len(content))]
                unfinished = end
        elif operation == "write":
            (files[unfinished],) = details
            syncs += 1
    if moment < len(process) and process[moment][0] == "write":
        # Each word that is being written may be on the disk already.
        words = [
            np.frombuffer(image[: len(image) // 4 * 4], "<u4") for image in (files[unfinished], process[moment][1])
        ]
        are_new = random.integers(2, size=len(words[0])) == 1
        files[unfinished] = np.where(are_new, words[1], words[0]).tobytes() + files[unfinished][len(words[0]) * 4 :]
    return files, syncs // 2


def check_power_cuts(tmp_path, monkeypatch, rounds):
    random = np.random.default_rng(3)
    path = tmp_path / "table.h5"
    process = record(path, monkeypatch)
    assert len(process) == 1 + 2 + 7 * 2 + 2
    states = set()
    for _ in range(rounds):
        for file in tmp_path.iterdir():
            shutil.rmtree(file) if file.is_dir() else file.unlink()
        files, confirmed = after_the_cut(process, int(random.integers(len(process) + 1)), random)
        for place, content in files.items():
            place.parent.mkdir(exist_ok=True)
            place.write_bytes(content)
        finished = finished_blocks(Table.load(path)) if files else set()
        assert confirmed <= len(finished) <= confirmed + 1
        states.add(len(finished))
        assert resumed(path) == set(range(7)) - finished
        assert list(tmp_path.iterdir()) == [path]
    return states


def test_the_power_fails(tmp_path, monkeypatch):
    assert len(check_power_cuts(tmp_path, monkeypatch, 15)) > 4


@pytest.mark.slow
def test_the_power_fails_a_hundred_times(tmp_path, monkeypatch):
    assert len(check_power_cuts(tmp_path, monkeypatch, 100)) == 8


@pytest.mark.parametrize("room", [0, 1000, 5000])
def test_a_disk_too_small_for_anything(tmp_path, room):
    """The error is raised before anything is computed, and no file remains."""
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
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=800))
    message = r"cannot write .*table\.h5: 8e-07 GB are free, and the table needs 8\.5e-07 GB"
    with pytest.raises(OSError, match=message):
        cheap_sweep(tmp_path / "table.h5", pytest.fail)
    assert not list(tmp_path.iterdir())


def test_one_of_many_writers(tmp_path):
    """Many try to fill in one file at once and again: each is refused or does it alone, and the file is right."""
    path, refused, failed = tmp_path / "table.h5", [], []
    at_work, gate = set(), threading.Barrier(8)

    def writer():
        gate.wait()
        for _ in range(10):
            try:
                blocks = ChunkStore(path, LAYOUT)
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
    LAYOUT = Layout({"x": np.arange(8.0)}, {"value": np.dtype(float)}, {}, attributes, {}, {}, BLOCK, {})
    threads = [threading.Thread(target=writer) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
    assert refused
    assert all(re.search(r"another thread( or process)? is writing it", message) for message in refused)
    assert (Table.load(path).value == 0.0).all()


def test_a_reader_beside_the_writer_sees_whole_blocks(tmp_path):
    """A table that is read while a sweep computes it has blocks that are complete, or pending."""
    path, counts = tmp_path / "table.h5", []

    def looking(function):
        def operation(*arguments, **options):
            result = function(*arguments, **options)
            if path.exists() or (tmp_path / "table.h5.blocks" / "table.h5").exists():
                counts.append(len(finished_blocks(Table.load(path))))
            return result

        return operation

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", looking(os.replace))
        patch.setattr(Stream, "write", looking(Stream.write))
        patch.setattr(Stream, "check", looking(Stream.check))
        cheap_sweep(path)
    assert len(counts) > 7 * 8
    assert counts == sorted(counts)
    assert set(counts) == set(range(8))


def test_a_block_that_is_finished_while_the_file_is_opened_is_pending(tmp_path, monkeypatch):
    """After each read of marks or checksums, a writer finishes another block."""
    path = tmp_path / "table.h5"
    fail_on_disk(monkeypatch, FOR_THE_FOLDER, torn=0.0, error=Killed())
    with pytest.raises(Killed):
        cheap_sweep(path)
    monkeypatch.undo()
    layout = cheap_sweep_layout(path)
    store, blocks = ChunkStore(path, layout), iter(range(7))

    def read(dataset, *arguments, read=h5py.Dataset.__array__, **options):
        values = read(dataset, *arguments, **options)
        if dataset.name.startswith("/checksums/"):
            block = next(blocks)
            store.write(block, expected(X[block * BLOCK : (block + 1) * BLOCK]))
        return values

    with monkeypatch.context() as patch:
        patch.setattr(h5py.Dataset, "__array__", read)
        assert finished_blocks(Table.load(path)) == set()
    begun = next(blocks)
    assert begun >= len(VARIABLES) + 1
    assert finished_blocks(Table.load(path)) == set(range(begun))
    store.close()


def cheap_sweep_layout(path):
    """The layout of the unfinished table of a cheap sweep."""
    return Stored(path, is_unfinished=True).layout


@pytest.mark.parametrize("change", [lambda values: np.stack([values, values], 1), lambda values: values[:-1]])
def test_results_of_another_shape_are_refused_and_no_block_is_lost(change, tmp_path):
    """A job that is wrong in its last variable, from the fourth block on, or in the last."""
    path = tmp_path / "table.h5"
    for wrong in (3, 6):
        size = 2 if wrong == 6 else BLOCK

        def job(columns, count, wrong=wrong):
            values = expected(columns["x"])
            if count and columns["x"][0] >= X[wrong * BLOCK]:
                values["count"] = change(values["count"][:count])
            return values

        with ThreadPoolExecutor(1) as executor:
            text = rf"cannot write {path}: count of cells {wrong * BLOCK} to .* must have the shape \({size},\), not \("
            with pytest.raises(ValueError, match=text):
                cheap_sweep(path, job=job, executor=executor)
        assert finished_blocks(Table.load(path)) == set(range(wrong))
    assert resumed(path) == {6}


def sweep_of_words(path, words, variable="status"):
    """A sweep that is interrupted after its first block, or resumed and finished."""
    variables = {variable: Variable("1", np.int8, words)}
    job = lambda columns, count: {variable: (columns["x"] > 0.5).astype(np.int8)}  # noqa: E731
    return sweep(job, [axis("x", "x", "s", X)], variables, {"what": "words"}, path=path, chunk=BLOCK, progress=False)


@pytest.mark.parametrize(("variable", "words"), [("status", ["low", "high"]), ("ending", ("reached_end", "failed"))])
def test_words_of_a_list_and_of_a_tuple_resume(variable, words, tmp_path):
    path = tmp_path / "table.h5"
    with pytest.MonkeyPatch.context() as patch:
        fail_on_disk(patch, FOR_THE_FOLDER + 8, torn=0.0, error=Killed())
        with pytest.raises(Killed):
            sweep_of_words(path, words, variable)
    table = sweep_of_words(path, words, variable)
    np.testing.assert_array_equal(table[variable], np.where(X > 0.5, words[1], words[0]))
    np.testing.assert_array_equal(sweep_of_words(path, words, variable)[variable], table[variable])


def test_other_words_are_told_and_words_with_spaces_are_refused(tmp_path):
    path = tmp_path / "table.h5"
    sweep_of_words(path, ("low", "high"))
    text = "the words of status are 'low, high' in the file and 'low, large' here"
    with pytest.raises(ValueError, match=rf"table\.h5 holds the result of another run: {text}; give another path"):
        sweep_of_words(path, ("low", "large"))
    for words in (("low", "very high"), ("low", "")):
        for write in (lambda path, words=words: sweep_of_words(path, words), sweep_of_words(None, words).save):
            with pytest.raises(ValueError, match=r"the words of status must not have spaces or be empty: \('low', "):
                write(tmp_path / "other.h5")
            assert list(tmp_path.iterdir()) == [path]


def test_another_version_is_told_or_refused(tmp_path, monkeypatch):
    """Another version of this package may have other equations; other libraries have other last digits."""
    path = tmp_path / "table.h5"
    versions = grid.versions()
    with monkeypatch.context() as patch:
        fail_on_disk(patch, 20, torn=0.0, error=Killed())
        patch.setattr(grid, "versions", lambda: versions | {"jax": "0.0.1", "python": "2.7"})
        with pytest.raises(Killed):
            cheap_sweep(path)
    with pytest.warns(RuntimeWarning, match=rf"was begun with jax 0\.0\.1, now {versions['jax']}: digits may differ"):
        table = cheap_sweep(path)
    # The table reads from its file; the file is complete, so there is no further warning.
    assert json.loads(table.attributes["versions"])["jax"] == "0.0.1"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cheap_sweep(path)
    with monkeypatch.context() as patch:
        patch.setattr(grid, "versions", lambda: versions | {"nonholonomic": "99.0"})
        with pytest.raises(ValueError, match=r"another run: nonholonomic is .* in the file and 99\.0 here"):
            cheap_sweep(path)


def test_a_request_must_be_plain_data():
    """The text of a long array leaves out most of it, so two different requests would be one."""
    with pytest.raises(TypeError, match="ndarray is not JSON serializable"):
        sweep(
            lambda columns, count: expected(columns["x"]),
            [axis("x", "x", "s", X)],
            VARIABLES,
            {"what": np.arange(2000.0)},
            progress=False,
        )
