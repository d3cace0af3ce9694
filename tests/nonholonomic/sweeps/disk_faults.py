"""Sweeps that end at a chosen operation on the disk."""

import io
import itertools
import os

import numpy as np
import pytest
from cheap_sweep import cheap_sweep, finished_blocks

from nonholonomic.sweeps import Table


class Killed(BaseException):
    """The end of the process at a chosen moment."""


#: Disk operations: for the folder of the blocks and its note, for each block, and for the table's file.
FOR_THE_FOLDER, FOR_A_BLOCK, FOR_THE_FILE = 4, 4, 3


def fail_on_disk(monkeypatch, moment, torn, error):
    """Have a sweep end at an operation on the disk: before a sync or a renaming, or in a block, of which a part is written."""
    count = itertools.count()

    def failing(function):
        def operation(*arguments):
            if next(count) == moment:
                raise error
            return function(*arguments)

        return operation

    def saved(stream, savez=np.savez, **arrays):
        buffer = io.BytesIO()
        savez(buffer, **arrays)
        is_due = next(count) == moment
        stream.write(buffer.getvalue()[: int(torn * len(buffer.getvalue())) if is_due else None])
        if is_due:
            raise error

    monkeypatch.setattr(os, "fsync", failing(os.fsync))
    monkeypatch.setattr(os, "replace", failing(os.replace))
    monkeypatch.setattr(np, "savez", saved)


def half_finished(path):
    """A sweep that ended after three blocks."""
    with pytest.MonkeyPatch.context() as patch:
        fail_on_disk(patch, FOR_THE_FOLDER + 3 * FOR_A_BLOCK, torn=0.5, error=Killed())
        with pytest.raises(Killed):
            cheap_sweep(path)
    assert len(finished_blocks(Table.load(path))) == 3
