"""Hard cases for a simulator in one table, each with its error against a reference.

    python benchmarks/hard_cases.py [--only upright_exactly ...] [--csv hard_cases.csv]

Each row states the difficulty, the result, the error against something independent (a closed form, another formulation,
an eigenvalue), the bound of the error, the steps, the CPU time and the status. The script exits with 1 if a row exceeds
its bound, after printing all rows.

To add a row, write a function without arguments in a file of `benchmarks/hard/` that returns a `hard.row.Row`, and name
it in that file's `rows()`. `--only` takes its name. Add a new file to `SUBJECTS` below. Measure the error, then set the
bound to about ten times the error; for an order of convergence, the error is its distance from the expected order. NaN
exceeds every bound. Keep a row under a minute: `tests/physics/test_hard_cases.py` runs them all.
"""

import argparse
import sys
import time
from pathlib import Path

from hard import arenas, friction, hybrid, limits, sensitive, sticking
from measure import machine, table, write_csv

SUBJECTS = (limits, friction, hybrid, arenas, sticking, sensitive)


def main() -> int:
    """Run the rows, print the table, and return the exit status."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    functions = {function.__name__: function for subject in SUBJECTS for function in subject.rows()}
    command.add_argument("--only", nargs="+", choices=list(functions), metavar="name", help=", ".join(functions))
    command.add_argument("--csv", type=Path, help="file for the same table")
    options = command.parse_args()
    start_time = time.perf_counter()
    print(machine())
    rows = {}
    for name in options.only or functions:
        print(f"{time.perf_counter() - start_time:6.0f} s: {name}", file=sys.stderr, flush=True)
        rows[name] = functions[name]()
    cells = [row.cells(name) for name, row in rows.items()]
    print(table(cells))
    if options.csv is not None:
        write_csv(options.csv, cells)
    failures = [name for name, row in rows.items() if not row.ok]
    print(f"\n{time.perf_counter() - start_time:.0f} s in all; {', '.join(failures) or 'no row'} broke its bound")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
