"""A sweep that costs nothing to compute, and the question whether a file of it tells the truth."""

import warnings
from pathlib import Path

import numpy as np

from nonholonomic.sweeps import Table, Variable, axis, sweep

CELLS, BLOCK = 50, 8
X = np.linspace(0.0, 1.0, CELLS)
VARIABLES = {
    "value": Variable("m", np.float64),
    "status": Variable("1", np.int8, ("low", "high")),
    "count": Variable("1", np.int64),
}


def expected(x):
    """The results at x."""
    return {"value": np.sin(x), "status": (x > 0.5).astype(np.int8), "count": (1000.0 * x).astype(int)}


def cheap_sweep(path, run=None):
    """A sweep over `X` in seven blocks; `run` is told of each block that is computed."""

    def compute(columns, count):
        if run is not None and count:
            run(int(np.flatnonzero(columns["x"][0] == X)[0]) // BLOCK)
        return expected(columns["x"])

    return sweep(compute, [axis("x", "x", "s", X)], VARIABLES, {"what": "a test"}, path=path, block=BLOCK)


def finished_blocks(table: Table) -> set[int]:
    """The blocks that a table has, after a check that each is there as a whole or not at all, with the right numbers."""
    np.testing.assert_array_equal(table.coords["x"], X)
    right = expected(X)
    words = np.array(VARIABLES["status"].words)[right["status"]]
    found = set()
    for block, first in enumerate(range(0, CELLS, BLOCK)):
        here = slice(first, first + BLOCK)
        if (table.status[here] == "pending").all():
            assert np.isnan(table.value[here]).all()
            assert (table.count[here] == -1).all()
        else:
            np.testing.assert_array_equal(table.value[here], right["value"][here])
            np.testing.assert_array_equal(table.status[here], words[here])
            np.testing.assert_array_equal(table.count[here], right["count"][here])
            found.add(block)
    return found


def resumed(path: Path) -> set[int]:
    """Resume a sweep, check its result and its file, and tell which blocks it computed."""
    computed = []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "(?s).*is damaged: .* are computed again", RuntimeWarning)
        table = cheap_sweep(path, computed.append)
    assert len(computed) == len(set(computed))
    assert finished_blocks(table) == finished_blocks(Table.load(path)) == set(range(7))
    return set(computed)
