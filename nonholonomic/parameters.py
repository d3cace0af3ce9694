"""The numbers of a scene by name: `"scene.body.offset"`, `"launch.spin"`."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np


def numbers(root: str, tree: Any) -> dict[str, Any]:
    """Every number of a tree of modules under its dotted path.

    **Arguments:**

    - `root`: name of the tree itself.
    - `tree`: an `equinox.Module`.

    **Returns:** path -> number, in the order in which the modules declare them; `None` for a number that is left out.
    """
    found = {}
    for field in dataclasses.fields(tree):
        path, value = f"{root}.{field.name}", getattr(tree, field.name)
        if isinstance(value, eqx.Module):
            found |= numbers(path, value)
        elif value is None or isinstance(value, jax.Array | np.ndarray | float):
            found[path] = value
    return found


def with_numbers(roots: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """The trees with some of their numbers replaced; the modules check the new ones.

    **Arguments:**

    - `roots`: name -> tree.
    - `values`: path -> number or array of numbers.

    **Returns:** name -> tree.

    **Raises:** `ValueError` for a path that names no number of the trees.
    """
    known = [path for root, tree in roots.items() for path in numbers(root, tree)]
    for path in values:
        if path not in known:
            raise ValueError(f"unknown axis {path!r}: the numbers that can be varied are {', '.join(known)}")
    return {root: _replaced(root, tree, values) for root, tree in roots.items()}


def full_path(argument: str, name: str, known: list[str]) -> str:
    """The path that a name means: the name itself, or the one path that ends in it.

    **Arguments:** `argument`: what the name was given for; `name`: such as `"scene.friction.mu"` or `"friction.mu"`; `known`:
    the paths to choose from.

    **Raises:** `ValueError` for a name that means none of the paths, or several.
    """
    meant = [name] if name in known else [path for path in known if path.endswith("." + str(name))]
    if len(meant) != 1:
        what = f"could be {' or '.join(meant)}" if meant else f"must be one of {', '.join(known)}"
        raise ValueError(f"{argument}: {name!r} {what}")
    return meant[0]


def _replaced(path: str, tree: Any, values: dict[str, Any]) -> Any:
    changes = {}
    for field in dataclasses.fields(tree):
        below, value = f"{path}.{field.name}", getattr(tree, field.name)
        if below in values:
            changes[field.name] = values[below]
        elif isinstance(value, eqx.Module) and any(name.startswith(below + ".") for name in values):
            changes[field.name] = _replaced(below, value, values)
    return dataclasses.replace(tree, **changes) if changes else tree


def description(root: str, tree: Any) -> dict[str, Any]:
    """What a tree of modules is made of, as plain data: the kind of every module and the value of every number."""
    found = {root: type(tree).__name__}
    for field in dataclasses.fields(tree):
        path, value = f"{root}.{field.name}", getattr(tree, field.name)
        if isinstance(value, eqx.Module):
            found |= description(path, value)
        else:
            found[path] = np.asarray(value).tolist() if isinstance(value, jax.Array | np.ndarray) else value
    return found
