"""Predictions of a fit between the samples of its recordings, to be drawn as curves."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .data import joined
from .problem import Problem, predictions
from .recording import AbstractRecording

#: Number of points of a curve, and the greatest number of predictions for each sample.
POINTS, MOST = 1200, 16


def fine_predictions(
    problem: Problem, coordinates: Float[np.ndarray, " unknowns"]
) -> tuple[Float[np.ndarray, "slices n"], Float[np.ndarray, "slices n"]]:
    """Times and predictions at and between the samples of all recordings, and other predictions, for the coordinates of a fit.

    Every slice has as many samples as the recordings, at times that are shifted by a fraction of the distance to the next
    sample, so that the program of the fit predicts them. Without recordings there are no slices.

    **Returns:** times since the first sample of each recording [s], and predictions.
    """
    data = getattr(problem.model, "recorded", ())
    sizes = [len(source.times) for source in data if isinstance(source, AbstractRecording)]
    if not sizes:
        return np.zeros((0, 0)), np.zeros((0, 0))
    count = int(np.clip(np.ceil(POINTS / max(sizes)), 1, MOST))
    slices = []
    for k in range(count):
        shifted = tuple(_shifted(source, k / count) for source in data)
        moved = eqx.tree_at(lambda problem: problem.model, problem, problem.model.with_recorded(shifted))
        offsets = [
            float(new.times[0] - old.times[0]) if isinstance(old, AbstractRecording) else 0.0
            for new, old in zip(shifted, data, strict=True)
        ]
        offset = np.repeat(offsets, [len(source.seen) for source in data])
        slices.append((np.asarray(joined(shifted)[0].time) + offset, predictions(moved, coordinates[None])[0]))
    times, values = zip(*slices, strict=True)
    return np.stack(times), np.stack(values)


def _shifted(recording: Any, share: float) -> Any:
    """A recording at times that are moved by a share of the distance to the next sample, where the last sample stays; other
    data unchanged."""
    if not isinstance(recording, AbstractRecording):
        return recording
    times = np.asarray(recording.times)
    moved = np.append(times[:-1] + share * np.diff(times), times[-1] + share * 1e-6 * (times[-1] - times[0]))
    return dataclasses.replace(recording, times=moved)
