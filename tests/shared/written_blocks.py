"""Which blocks of a table are written, and runs that are interrupted between two of them."""

from nonholonomic.sweeps import running

WRITE = running.ChunkStore.write


def recorded(monkeypatch, most=None):
    """The list of the blocks that are written from now on; with `most` of them written the run is interrupted."""
    chunks = []

    def write(self, block, values):
        if len(chunks) == most:
            raise KeyboardInterrupt
        chunks.append(block)
        WRITE(self, block, values)

    monkeypatch.setattr(running.ChunkStore, "write", write)
    return chunks
