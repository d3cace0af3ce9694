"""Warnings, which point to the user's line."""

import sys
import warnings
from types import FrameType

#: Packages whose lines a warning does not point to: ours, and those through which our functions are called.
NO_CODE_OF_A_USER = ("nonholonomic", "tippe", "stroller", "equinox", "jax", "jaxtyping", "beartype", "typeguard")
NO_CODE_OF_A_USER += ("contextlib", "dataclasses", "functools", "importlib", "concurrent", "threading")


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the user's line that led here, so that Python shows the warning once for each such line."""
    frame = _users_frame()
    if frame is None:
        # In a thread that we have started: its first line.
        frame = sys._getframe(1)
        while frame.f_back is not None:
            frame = frame.f_back
    registry = frame.f_globals.setdefault("__warningregistry__", {})
    place = (frame.f_code.co_filename, frame.f_lineno, frame.f_globals.get("__name__"))
    warnings.warn_explicit(message, category, *place, registry)


def is_called_by_a_user() -> bool:
    """Whether a user's line led here; in a thread that we have started, none does."""
    return _users_frame() is not None


def _users_frame() -> FrameType | None:
    """The innermost frame of a user's code."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in NO_CODE_OF_A_USER:
        frame = frame.f_back
    return frame
