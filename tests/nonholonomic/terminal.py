"""Standard error as a terminal."""

import io
import sys
import time

from nonholonomic import terminal


class Terminal(io.StringIO):
    """A stream that records its text and the time of each write."""

    def __init__(self):
        super().__init__()
        self.start, self.lines = time.perf_counter(), []

    def isatty(self):
        return True

    def write(self, text):
        if text.strip():
            self.lines.append((time.perf_counter() - self.start, text.strip()))
        return super().write(text)


def watched(monkeypatch):
    """Standard error as a terminal, on which everything happens ten times as fast."""
    # Importing tqdm takes longer than the fast calls here.
    terminal.bar_class()
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(terminal, "INTERVAL", 0.05)
    monkeypatch.setattr(terminal, "TICK", 0.01)
    return stream


def words(stream):
    """The first word of each line written."""
    return [text.split()[0].rstrip(":") for _, text in stream.lines]


def left(stream):
    """The text that remains on the terminal at the end."""
    rows = []
    for line in stream.getvalue().split("\n"):
        row = []
        for piece in line.split("\r"):
            row[: len(piece)] = piece
        rows.append("".join(row).strip())
    return "".join(rows)
