"""Recorded runs: samples of a quantity at some times, as measurements."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ..validation import require
from .likelihood import Measurements


def check_recording(times: Any, value: Any, quantity: str, quantities: dict[str, tuple[str, ...]]) -> None:
    """Raise `ValueError` unless a recording has a known quantity, increasing times and as many samples.

    **Arguments:**

    - `times`: (times,) [s], from 0 or later; `value`: (times,), or (times, columns) for a quantity of several.
    - `quantity`: its name; `quantities`: name -> names of its columns, of all known ones.
    """
    if quantity not in quantities:
        raise ValueError(f"quantity = {quantity!r} must be one of {', '.join(map(repr, quantities))}")
    require(times, "times", at_least=0.0)
    moments = np.asarray(times, dtype=float)
    if moments.ndim != 1 or np.any(np.diff(moments) <= 0.0) or not moments[-1] > 0.0:
        raise ValueError(f"times = {times!r} must be an increasing list with a positive end")
    columns = len(quantities[quantity])
    shape = (len(times), *((columns,) if columns > 1 else ()))
    if np.shape(value) != shape:
        raise ValueError(f"value must be of shape {shape} for {quantity!r}, not {np.shape(value)}")


def samples(value: Any, error: Any) -> Measurements:
    """The samples as `Measurements`, with one error for all or one for each."""
    return Measurements(value.reshape(-1), jnp.broadcast_to(error, jnp.shape(value)).reshape(-1))


def sample_labels(times: Any, columns: tuple[str, ...]) -> tuple[str, ...]:
    """A label for each sample, such as `theta(0.1 s)`."""
    return tuple(f"{column}({time:.4g} s)" for time in np.asarray(times) for column in columns)
