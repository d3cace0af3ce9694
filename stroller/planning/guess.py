"""First guesses for the optimiser: a path, driven within the given time."""

from typing import Any

import numpy as np
from jaxtyping import Float

from .search import Path, driven

#: Share of a section's time in which the stroller speeds up, and again slows down.
RAMP = 0.2

#: Time that a change of direction takes, in units of the time for one wheelbase.
CHANGE = 1.5


def progress(part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share of a section's length, and its rate, at a share of its time: smooth ramps and constant speed between."""
    top = 1.0 / (1.0 - RAMP)
    ramp = lambda u: u**3 - 0.5 * u**4  # noqa: E731
    slope = lambda u: 3.0 * u**2 - 2.0 * u**3  # noqa: E731
    u, v = np.clip(part / RAMP, 0.0, 1.0), np.clip((1.0 - part) / RAMP, 0.0, 1.0)
    middle = np.clip(part, RAMP, 1.0 - RAMP) - RAMP
    way = top * (RAMP * ramp(u) + middle + RAMP * (0.5 - ramp(v)))
    return way, top * np.minimum(slope(u), slope(v))


def sections(path: Path) -> list[slice]:
    """The pieces between changes of direction."""
    cuts = [0, *(np.flatnonzero(np.diff(path.direction)) + 1), len(path.direction)]
    return [slice(a, b) for a, b in zip(cuts, cuts[1:], strict=False)]


def timed(path: Path, knots: int, t1: float, wheelbase: float) -> tuple[Float[np.ndarray, "knots 3"], Any, Any]:
    """Poses, speeds of the rear axle [m/s] and curvatures [1/m] at evenly spaced times from 0 to `t1`."""
    parts = sections(path)
    lengths = np.array([path.length[part].sum() for part in parts])
    shares = (lengths + CHANGE * wheelbase) / (lengths + CHANGE * wheelbase).sum()
    ends = np.concatenate([[0.0], np.cumsum(shares)])
    time = np.linspace(0.0, 1.0, knots)
    section = np.clip(np.searchsorted(ends, time, side="right") - 1, 0, len(parts) - 1)
    way, rate = progress((time - ends[section]) / shares[section])
    speed = rate * lengths[section] / (shares[section] * t1)
    start = np.array([path.length[: part.start].sum() for part in parts])
    along = start[section] + way * lengths[section]
    piece_ends = np.cumsum(path.length)
    piece = np.clip(np.searchsorted(piece_ends, along), 0, len(piece_ends) - 1)
    into = along - (piece_ends - path.length)[piece]
    poses = driven(path.poses[piece], path.direction[piece], path.curvature[piece], into)
    return poses, speed * path.direction[piece], path.curvature[piece]


def smoothed(values: np.ndarray, width: int) -> np.ndarray:
    """A running mean over 2 `width` + 1 values."""
    padded = np.pad(values, width, mode="edge")
    return np.convolve(padded, np.full(2 * width + 1, 1.0 / (2 * width + 1)), mode="valid")
