"""Blocks computed by other processes: bit-identical results, dead workers, dead schedulers, and illegal arguments."""

import logging
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest
from cheap_sweep import CELLS, CheapJob, cheap_sweep, finished_blocks, place, resumed
from own_modes import Sleigh
from tops import rutstam_top

import nonholonomic
import stroller
import tippe
from nonholonomic.runs.table import TableJob
from nonholonomic.sweeps import Table, running
from nonholonomic.sweeps.running import ExecutorBroken, handed_out

HERE = Path(__file__).parent

#: A cluster takes long to start. In the ordinary run, one worker without a cluster computes for a scheduler, which is killed.
DASK = pytest.param("dask", marks=pytest.mark.slow)
#: In the ordinary run, a pool of Python's computes until it breaks.
POOL = pytest.param("pool", marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def processes():
    with nonholonomic.local_processes(2) as executor:
        yield executor


@pytest.fixture(scope="module")
def dask():
    """A cluster of two worker processes, which tells of every worker that dies."""
    import dask
    import distributed

    settings = {"distributed.scheduler.allowed-failures": 0, "distributed.comm.timeouts.connect": "60s"}
    # A worker that takes long to start again must not be given up.
    settings |= {"distributed.deploy.lost-worker-timeout": "300s"}
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0", "silence_logs": logging.CRITICAL}
    with (
        dask.config.set(settings),
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client.get_executor()


def assert_same_bits(first: Table, second: Table):
    assert list(first.variables) == list(second.variables)
    for name, values in first.variables.items():
        assert values.dtype == second.variables[name].dtype
        assert values.tobytes() == second.variables[name].tobytes(), name


@pytest.fixture
def many_blocks(monkeypatch):
    monkeypatch.setattr(running, "chunk_for", lambda cells: 64)


TOP = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
TIMES = {"theta": np.linspace(0.05, 0.6, 40), "spin": [80.0, 100.0, 190.0], "mu": [0.2, 0.3], "t1": 8.0}


@pytest.fixture(scope="module")
def by_threads():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(running, "chunk_for", lambda cells: 64)
        return tippe.inversion_table(TOP, **TIMES)


@pytest.mark.parametrize("way", ["serial", "processes", DASK, POOL])
def test_whoever_computes_a_table_gets_the_same_bits(way, many_blocks, by_threads, request):
    """Four blocks, in one thread, in processes of ours, in Dask's, in a pool of Python's; the reference by all cores."""
    if way == "serial":
        with ThreadPoolExecutor(1) as pool:
            table = tippe.inversion_table(TOP, executor=pool, **TIMES)
    elif way == "pool":
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            table = tippe.inversion_table(TOP, executor=pool, **TIMES)
    else:
        table = tippe.inversion_table(TOP, executor=request.getfixturevalue(way), **TIMES)
    assert {"inverted", "not_inverted", "contact_lost"} == set(np.unique(table.status))
    assert_same_bits(table, by_threads)


@pytest.mark.slow
def test_mpi_gives_the_same_bits_too(tmp_path, by_threads):
    beside_python = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    mpirun = shutil.which("mpirun", path=beside_python)
    if mpirun is None and sys.platform == "win32":
        pytest.skip("no MPI is installed")
    tests = HERE.parents[1]
    path = os.pathsep.join(str(folder) for folder in (tests.parent, tests / "shared", HERE))
    environment = os.environ | {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu", "OMPI_MCA_rmaps_base_oversubscribe": "1"}
    environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    environment |= {"PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe"}
    program = [mpirun, "-n", "2", sys.executable, "-m", "mpi4py.futures", HERE / "mpi_sweep.py", tmp_path]
    process = subprocess.run(program, env=environment, capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stderr
    assert_same_bits(Table.load(tmp_path / "table.h5"), by_threads)


def test_trajectories_and_rides_from_other_processes_have_the_same_bits(processes, many_blocks):
    arguments = {"theta": [0.1, 0.2, 1.6], "spin": [100.0, 250.0], "mu": [0.2, 0.3], "times": np.linspace(0.0, 1.5, 31)}
    local_table, remote = (tippe.trajectory_table(TOP, executor=pool, **arguments) for pool in (None, processes))
    assert_same_bits(local_table, remote)
    scene = stroller.Scene(stroller.Stroller(1.7, 0.7, 0.4, 0.05), stroller.Plane())
    axes = {"launch.place[0]": [0.0, 1.0, 2.0], "launch.place[1]": np.linspace(0.0, 8.0, 9)}
    launch = stroller.Launch((0.0, 0.0), 0.5, 1.0, 0.3)
    local_table, remote = (stroller.sweep(scene, launch, 2.0, axes=axes, executor=pool) for pool in (None, processes))
    assert_same_bits(local_table, remote)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["processes", "dask"])
def test_a_block_whose_worker_dies_is_computed_by_another(way, tmp_path, request):
    job = CheapJob(tmp_path, deadly=2, crashes=1)
    table = cheap_sweep(tmp_path / "table.h5", job=job, executor=request.getfixturevalue(way))
    assert finished_blocks(table) == set(range(7))
    first, second = job.begun(2)
    assert first != second
    assert {len(job.begun(block)) for block in (0, 1, 3, 4, 5, 6)} <= {1, 2}


@pytest.mark.parametrize("way", ["processes", DASK])
def test_a_block_that_three_workers_die_of_is_failed_and_the_others_are_not(way, tmp_path, request):
    job, path = CheapJob(tmp_path, deadly=2, crashes=99), tmp_path / "table.h5"
    message = r"cells 16 to 23 \(x 0\.326\d* to 0\.469\d*\) are given up as failed: they killed 3 workers or more"
    with pytest.warns(RuntimeWarning, match=message):
        table = cheap_sweep(path, job=job, executor=request.getfixturevalue(way))
    # Dask blames blocks that only waited at a worker that died, too; nobody else kills workers here.
    assert len(set(job.begun(2))) == len(job.begun(2)) == 3
    for copy in (table, Table.load(path)):
        is_failed = copy.status == "failed"
        assert np.flatnonzero(is_failed).tolist() == list(range(16, 24))
        assert np.isnan(copy.value[is_failed]).all()
        np.testing.assert_array_equal(copy.value[~is_failed], np.sin(copy.coords["x"][~is_failed]))


def test_a_pool_that_breaks_ends_the_sweep_and_another_goes_on(processes, tmp_path):
    """Python's own pool breaks when its first worker dies."""
    job, path = CheapJob(tmp_path, deadly=3, crashes=1, pause=0.05), tmp_path / "table.h5"
    message = r"accepts no more chunks .*; 24 of 50 cells are done, .*table\.h5 has"
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, spawn) as pool, pytest.raises(RuntimeError, match=message):
        cheap_sweep(path, job=job, executor=pool)
    assert finished_blocks(Table.load(path)) == {0, 1, 2}
    assert finished_blocks(cheap_sweep(path, job=job, executor=processes)) == set(range(7))
    assert [len(job.begun(block)) for block in range(7)] == [1, 1, 1, 2, 1, 1, 1]


def test_a_scheduler_that_dies_ends_the_sweep_and_threads_go_on(tmp_path):
    import distributed

    address, path = tmp_path / "scheduler.json", tmp_path / "table.h5"
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(HERE.parents[2]), str(HERE)]),
        "JAX_PLATFORMS": "cpu",
    }
    common = ["--scheduler-file", address, "--no-dashboard"]
    programs = {"dask_scheduler": ["--port", "0"], "dask_worker": ["--no-nanny", "--nthreads", "1"]}
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{name}", *common, *options],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for name, options in programs.items()
    ]
    job = CheapJob(tmp_path, pause=0.2)

    def kill_the_scheduler():
        while not job.begun(3):
            time.sleep(0.02)
        processes[0].send_signal(signal.SIGKILL)

    killer = threading.Thread(target=kill_the_scheduler)
    # The client's messages about its lost connection.
    logging.disable(logging.CRITICAL)
    try:
        with distributed.Client(scheduler_file=str(address), timeout=60) as client:
            killer.start()
            with pytest.raises(
                RuntimeError, match=r"cancelled its chunks; .* cells are done, .*table\.h5 has the finished chunks"
            ):
                cheap_sweep(path, job=job, executor=client.get_executor())
    finally:
        logging.disable(logging.NOTSET)
        for process in processes:
            process.kill()
            process.wait()
    killer.join()
    done = finished_blocks(Table.load(path))
    assert 2 <= len(done) < 7
    assert resumed(path) == set(range(7)) - done


def test_a_worker_of_another_version_is_refused_by_name(processes, tmp_path, monkeypatch):
    stamp = running.stamp() | {"jax": "0.0.1"}
    monkeypatch.setattr(running, "stamp", lambda: stamp)
    message = rf"the worker .*, process \d+, has jax {jax.__version__}, and 0\.0\.1 is needed"
    with pytest.raises(RuntimeError, match=message):
        cheap_sweep(None, job=CheapJob(tmp_path), executor=processes)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_sent_is_refused_before_anything_runs(processes):
    with pytest.raises(
        ValueError, match=r"executor: the work cannot be sent to another process .* must be defined at the top"
    ):
        cheap_sweep(None, executor=processes)


def test_an_error_of_a_block_is_the_sweep_s_and_starts_no_further_block(processes, tmp_path):
    (tmp_path / "block1").mkdir()
    with pytest.raises(IsADirectoryError):
        cheap_sweep(None, job=CheapJob(tmp_path, pause=0.3), executor=processes)
    time.sleep(0.8)
    assert len(list(tmp_path.iterdir())) < 7


def test_a_user_s_system_is_computed_by_other_processes(processes, monkeypatch):
    """Results are bit-identical to those of this process, which computes nothing meanwhile."""
    start, axes = (np.zeros(3), np.array([1.0, 0.0, 0.0])), {"rate[2]": [0.5, 1.0], "ahead": [0.2, 0.3]}
    expected = nonholonomic.sweep(Sleigh(), start, 2.0, axes=axes, progress=False)
    monkeypatch.setattr(TableJob, "__call__", None)
    assert_same_bits(nonholonomic.sweep(Sleigh(), start, 2.0, axes=axes, executor=processes, progress=False), expected)


def test_local_processes_have_their_cores_and_settings(processes):
    futures = [processes.submit(place) for _ in range(4)]
    settings_by_process = {process: settings for process, *settings in (future.result() for future in futures)}
    affinity = os.sched_getaffinity(0)
    for cores, platforms, cache in settings_by_process.values():
        assert len(cores) == 1
        assert cores <= affinity
        assert (platforms, cache) == ("cpu", jax.config.jax_compilation_cache_dir)
    assert os.getpid() not in settings_by_process


BAD = [(0, 1, "n = 0"), (1, -1, "threads = -1"), (1.5, 1, "n = 1.5"), ("2", 1, "n = '2'")]


@pytest.mark.parametrize(("n", "threads", "told"), BAD)
def test_bad_numbers_of_processes_are_refused(n, threads, told):
    with pytest.raises(ValueError, match=told), nonholonomic.local_processes(n, threads):
        pass


SCRIPT = """
import os, time, nonholonomic
def pid():
    return os.getpid()
{guard}
    with nonholonomic.local_processes(1) as processes:
        print(processes.submit(pid).result(), flush=True)
        time.sleep(60)
"""


def script(folder, guard):
    program = folder / "program.py"
    program.write_text(SCRIPT.format(guard=guard))
    environment = os.environ | {"PYTHONPATH": str(HERE.parents[2])}
    return subprocess.Popen(
        [sys.executable, program], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_processes_end_with_a_parent_that_is_killed(tmp_path):
    with script(tmp_path, "if __name__ == '__main__':") as parent:
        child = int(parent.stdout.readline())
        os.kill(child, 0)
        parent.kill()
        deadline = time.monotonic() + 10.0
        while time.monotonic() < deadline and Path(f"/proc/{child}/cmdline").exists():
            # What nobody waits for stays as an entry without a program.
            if not Path(f"/proc/{child}/cmdline").read_bytes():
                break
            time.sleep(0.02)
        else:
            assert not Path(f"/proc/{child}/cmdline").exists()


def test_a_script_without_a_guard_is_told_so(tmp_path):
    with script(tmp_path, "if True:") as parent:
        _, output = parent.communicate(timeout=60)
    assert (
        "RuntimeError: a process ended before it computed anything; a script that starts processes must have" in output
    )


@pytest.mark.parametrize("kills", [1, 99])
def test_a_process_that_is_killed_while_it_starts_is_started_again(kills):
    """It is killed as soon as it exists; a process that dies again and again is given up with a reason."""
    others, done = set(multiprocessing.active_children()), threading.Event()

    def kill_the_first():
        killed = set()
        while len(killed) < kills and not done.is_set():
            for process in set(multiprocessing.active_children()) - others - killed:
                process.kill()
                killed.add(process)
            time.sleep(0.001)

    killer = threading.Thread(target=kill_the_first)
    killer.start()
    try:
        with nonholonomic.local_processes(1) as executor:
            call = executor.submit(sum, [1.0, 2.0])
            if kills == 1:
                assert call.result(60.0) == 3.0
            else:
                with pytest.raises(RuntimeError, match=r"3 processes were killed while they started; .* start fewer"):
                    call.result(60.0)
    finally:
        done.set()
        killer.join()


def test_a_pool_by_fork_is_refused_at_once(tmp_path):
    fork = ProcessPoolExecutor(1, multiprocessing.get_context("fork"))
    with fork as pool, pytest.raises(ValueError, match=r"by fork, .* nonholonomic\.local_processes, or .*'spawn'"):
        cheap_sweep(tmp_path / "table.h5", job=CheapJob(tmp_path), executor=pool)
    assert not list(tmp_path.iterdir())


class Hands(Executor):
    """An executor whose futures the test ends."""

    def __init__(self):
        self.futures = {}

    def submit(self, block):
        self.futures[block] = Future()
        return self.futures[block]


def test_blocks_are_handed_out_as_others_finish():
    hands = Hands()
    results = handed_out(hands.submit, range(10), 3)
    threading.Timer(0.1, lambda: hands.futures[1].set_result("one")).start()
    assert next(results) == (1, "one")
    assert sorted(hands.futures) == [0, 1, 2, 3]
    hands.futures[3].set_result("three")
    assert next(results) == (3, "three")
    hands.futures[0].set_exception(ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert sorted(block for block, future in hands.futures.items() if future.cancelled()) == [2, 4]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"executor": 3}, "executor = 3 must be a concurrent.futures.Executor"),
        ({"progress": "no"}, "progress = 'no' must be True or False"),
    ],
)
def test_who_computes_and_what_is_shown_is_checked_before_a_file_is_there(change, message, tmp_path):
    path = tmp_path / "table.h5"
    with pytest.raises(ValueError, match=message):
        cheap_sweep(path, **change)
    with pytest.raises(ValueError, match=message):
        tippe.inversion_table(TOP, path=path, **TIMES, **change)
    assert not path.exists()


def test_an_executor_that_is_shut_down_takes_no_blocks():
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    with pytest.raises(ExecutorBroken, match="accepts no more chunks"):
        next(handed_out(lambda block: pool.submit(abs, block), range(3), 2))
    with pytest.raises(RuntimeError, match=f"0 of {CELLS} cells are done, without path=, nothing is saved"):
        cheap_sweep(None, executor=pool)
