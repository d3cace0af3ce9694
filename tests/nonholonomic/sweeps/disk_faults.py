"""Sweeps that end at a chosen operation on the disk."""

import io
import itertools
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from cheap_sweep import VARIABLES, cheap_sweep, finished_blocks

from nonholonomic.sweeps import Table
from nonholonomic.sweeps._store import UNFINISHED, Stream


class Killed(BaseException):
    """The end of the process at a chosen moment."""


#: Disk operations: for the folder of the unfinished table and its file, for each block, and for the table's file.
FOR_THE_FOLDER, FOR_A_BLOCK, FOR_THE_FILE = 4, 2 * len(VARIABLES) + 3, 2


def fail_on_disk(monkeypatch, moment, torn, error):
    """Have a sweep end at an operation on the disk: before a sync or a renaming, or while a part of a block is written."""
    count = itertools.count()

    def failing(function):
        def operation(*arguments):
            if next(count) == moment:
                raise error
            return function(*arguments)

        return operation

    def written(stream, data, write=Stream.write):
        # HDF5 writes only to a file that has another name as yet.
        if Path(stream.name).name == UNFINISHED and next(count) == moment:
            io.FileIO.write(stream, data[: int(torn * len(data))])
            raise error
        return write(stream, data)

    monkeypatch.setattr(os, "fsync", failing(os.fsync))
    monkeypatch.setattr(os, "replace", failing(os.replace))
    monkeypatch.setattr(Stream, "write", written)


def half_finished(path):
    """A sweep that ended after the first three blocks."""
    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(1) as executor:
        fail_on_disk(patch, FOR_THE_FOLDER + 3 * FOR_A_BLOCK, torn=0.5, error=Killed())
        with pytest.raises(Killed):
            cheap_sweep(path, executor=executor)
    assert finished_blocks(Table.load(path)) == {0, 1, 2}
