"""Start sweeps, kill them at random moments (SIGKILL), and hold what is left to the truth: `kill_sweeps.py FOLDER ROUNDS`.

The sweeps run in forks of this process, so that a round costs a fraction of a second. The test suite runs this as a program
of its own, because a process that has begun to use JAX must not fork.
"""

import os
import random
import signal
import sys
import time
from pathlib import Path

from cheap_sweep import cheap_sweep, finished_blocks, resumed

from nonholonomic.sweeps import Table


def child(path: Path, log: Path) -> int:
    """Fork a sweep that notes in `log` each block that it begins; the number of the process."""
    number = os.fork()
    if number == 0:
        try:
            with log.open("a", buffering=1) as stream:

                def note(block):
                    stream.write(f"{block}\n")
                    time.sleep(0.02)

                cheap_sweep(path, note)
            os._exit(0)
        finally:
            os._exit(1)
    return number


def main(folder: Path, rounds: int) -> None:
    """Kill `rounds` sweeps; print how many of them were killed at work and how many files were filled."""
    luck = random.Random(0)
    sweeps = kills = cut = files = 0
    max_delay = 0.3
    path, log, blocks_before = folder / "0.h5", folder / "log", set()
    while kills < rounds:
        log.write_text("")
        start_time = time.monotonic()
        number = child(path, log)
        time.sleep(luck.uniform(0.0, max_delay))
        os.kill(number, signal.SIGKILL)
        _, status = os.waitpid(number, 0)
        sweeps += 1
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0, "a sweep ended with an error"
            max_delay = max(0.05, 0.9 * (time.monotonic() - start_time))
        else:
            assert os.WTERMSIG(status) == signal.SIGKILL
            kills += 1
            max_delay *= 1.05
        starts = [int(line) for line in log.read_text().split()]
        assert not set(starts) & blocks_before, "a finished block was computed again"
        begun_at_all = path.exists() or path.with_name(f"{path.name}.blocks").joinpath("table.h5").exists()
        blocks_after = finished_blocks(Table.load(path)) if begun_at_all else set()
        assert blocks_before <= blocks_after <= blocks_before | set(starts), "a finished block was lost"
        cut += bool(starts) and len(blocks_after) < 7
        blocks_before = blocks_after
        if len(blocks_after) >= luck.randint(3, 7):
            assert resumed(path) == set(range(7)) - blocks_after
            files += 1
            path, blocks_before = folder / f"{files}.h5", set()
    print(f"{sweeps} sweeps, {kills} killed, {cut} of them amid their blocks, {files} files filled")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
