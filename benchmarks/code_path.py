"""Count the files and functions of the three packages that a first call enters, and its moves between files.

python benchmarks/code_path.py [table] [simulate] [gradient]
"""

import argparse
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import jax

import tippe

ROOT = Path(tippe.__file__).parents[1]
PACKAGES = tuple(str(ROOT / package) for package in ("nonholonomic", "tippe", "stroller"))


class CodePath(NamedTuple):
    """How much of the packages a call enters: the numbers of files and functions, and of moves from one file to another."""

    files: int
    functions: int
    moves: int


def code_path(call: Callable[[], object]) -> CodePath:
    """What a call enters, in the files of the packages alone and in all its threads.

    A move is the entry into a function of another file than the function before it, in the same thread.
    """
    entered: dict[int, list[str]] = {}
    functions: set[tuple[str, str, int]] = set()

    def note(frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(PACKAGES):
            functions.add((code.co_filename, code.co_qualname, code.co_firstlineno))
            files = entered.setdefault(threading.get_ident(), [])
            if files[-1:] != [code.co_filename]:
                files.append(code.co_filename)

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    moves = sum(len(files) - 1 for files in entered.values())
    return CodePath(len({file for file, *_ in functions}), len(functions), moves)


def calls() -> dict[str, Callable[[], object]]:
    """Three questions about one top."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)

    def scene(mu: jax.Array | float) -> tippe.Scene:
        return tippe.Scene(top, friction=tippe.Viscous(mu))

    def time(mu: jax.Array | float) -> jax.Array:
        return tippe.inversion_time(scene(mu), tippe.Launch(0.1, 155.0), t1=8.0)

    return {
        "table": lambda: tippe.inversion_table(
            scene(0.3), theta=[0.1, 0.2], spin=155.0, mu=[0.2, 0.3], t1=8.0, progress=False
        ),
        "simulate": lambda: tippe.simulate(scene(0.3), tippe.Launch(0.1, 155.0), t1=8.0),
        "gradient": lambda: jax.grad(time)(0.3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("calls", nargs="*", choices=[*calls(), []], help="which calls, all by default")
    names = parser.parse_args().calls or [*calls()]
    if len(names) == 1:
        path = code_path(calls()[names[0]])
        print(f"{names[0]}: {path.files} files, {path.functions} functions, {path.moves} moves")
    else:
        # In a process of its own, every call is a first one.
        for name in names:
            subprocess.run([sys.executable, __file__, name], check=True)


if __name__ == "__main__":
    main()
