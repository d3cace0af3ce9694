"""Standard error as a terminal."""

import io
import time


class Terminal(io.StringIO):
    """A stream that notes when what was written."""

    def __init__(self):
        super().__init__()
        self.start, self.lines = time.perf_counter(), []

    def isatty(self):
        return True

    def write(self, text):
        if text.strip():
            self.lines.append((time.perf_counter() - self.start, text.strip()))
        return super().write(text)
