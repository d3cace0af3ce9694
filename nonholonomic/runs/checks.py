"""Checks of the arguments of a run, before anything compiles."""

from typing import Any

import numpy as np

from ..integration.checks import run_bounds
from ..validation import require_all
from .model import AbstractModel


def check_run(model: AbstractModel, t1: Any, tolerance: Any) -> None:
    """Raise `ValueError` unless the model may run, and horizon and tolerance are single legal numbers."""
    model.check()
    require_all(run_bounds(t1, tolerance))
    for name, number in {"t1": t1, "tolerance": tolerance}.items():
        if np.ndim(number) != 0:
            raise ValueError(f"{name} must be one number, not of shape {np.shape(number)}; jax.vmap or sweep runs many")


def require_event(model: AbstractModel, purpose: str = "") -> None:
    """Raise `ValueError` unless the model has an event."""
    if not model.has_event:
        raise ValueError(
            f"{purpose}event = None: the system has no event of its own; pass event=, a function of time and state"
        )
