"""Methods of a user's class that nothing calls and whose names resemble one that the class could define."""

import dataclasses
import difflib
import inspect
from types import CodeType
from typing import Any

from ..validation import warn

#: Least similarity of a name to a known one, as `difflib` measures it: "forces" and "force" have 0.91.
SIMILARITY = 0.75


def warn_of_misspelt_methods(part: Any, base: type) -> None:
    """Warn of every method of a mode or a system that resembles a method of its base class which the class does not
    define, unless another method of the class calls it; and of a reset without a margin.

    **Arguments:** `part`: an object of a user's class; `base`: `AbstractMode` or `AbstractSystem`.
    """
    kind = type(part)
    free = [name for name in vars(base) if not name.startswith("_") and getattr(kind, name) is getattr(base, name)]
    own = {name for parent in kind.__mro__[: kind.__mro__.index(base)] for name in vars(parent)}
    own -= {field.name for field in dataclasses.fields(kind)}
    methods = {name: getattr(kind, name) for name in sorted(own) if inspect.isfunction(getattr(kind, name, None))}
    for name in methods:
        matches = difflib.get_close_matches(name, free, 1, SIMILARITY)
        others = (function for other, function in methods.items() if other != name)
        if matches and not name.startswith("_") and not any(name in _names(other.__code__) for other in others):
            warn(f"{kind.__name__}.{name} is never called; did you mean {matches[0]}?")
    if "reset" not in free and "margin" in free:
        warn(
            f"{kind.__name__}.reset is never called: write margin as well, which falls to zero where the reset happens"
        )


def _names(code: CodeType) -> set[str]:
    """The names that a function and the functions inside it use."""
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))
