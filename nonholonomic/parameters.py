"""The numbers of a scene by name: `"scene.body.offset"`, `"launch.spin"`, `"launch.place[0]"` for the parts of a tuple."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np


def numbers(root: str, tree: Any) -> dict[str, Any]:
    """Every number of a tree of modules under its dotted name.

    **Arguments:**

    - `root`: name of the tree itself.
    - `tree`: an `equinox.Module`.

    **Returns:** dotted name -> number, in the order in which the modules declare them; `None` for a number that is left out.
    """
    found = {}
    for field in dataclasses.fields(tree):
        name, value = f"{root}.{field.name}", getattr(tree, field.name)
        if isinstance(value, eqx.Module):
            found |= numbers(name, value)
        elif isinstance(value, tuple):
            found |= {f"{name}[{k}]": part for k, part in enumerate(value) if _is_number(part)}
        elif value is None or _is_number(value):
            found[name] = value
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, jax.Array | np.ndarray | float)


def with_numbers(roots: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """The trees with some of their numbers replaced; the modules check the new ones.

    **Arguments:**

    - `roots`: name -> tree.
    - `values`: dotted name -> number or array of numbers.

    **Returns:** name -> tree.

    **Raises:** `ValueError` for a name that no number of the trees has.
    """
    known = [name for root, tree in roots.items() for name in numbers(root, tree)]
    for name in values:
        if name not in known:
            raise ValueError(f"unknown axis {name!r}: the numbers that can be varied are {', '.join(known)}")
    return {root: _replaced(root, tree, values) for root, tree in roots.items()}


def full_name(argument: str, name: str, known: list[str]) -> str:
    """The full name that a name means: itself, or the only full name that ends in it.

    **Arguments:** `argument`: what the name was given for; `name`: such as `"scene.friction.mu"` or `"friction.mu"`; `known`:
    the full names to choose from.

    **Raises:** `ValueError` for a name that means none of them, or several.
    """
    meant = [name] if name in known else [one for one in known if one.endswith("." + str(name))]
    if len(meant) != 1:
        what = f"could be {' or '.join(meant)}" if meant else f"must be one of {', '.join(known)}"
        raise ValueError(f"{argument}: {name!r} {what}")
    return meant[0]


def _replaced(name: str, tree: Any, values: dict[str, Any]) -> Any:
    changes = {}
    for field in dataclasses.fields(tree):
        below, value = f"{name}.{field.name}", getattr(tree, field.name)
        if below in values:
            changes[field.name] = values[below]
        elif isinstance(value, tuple):
            parts = tuple(values.get(f"{below}[{k}]", part) for k, part in enumerate(value))
            if any(f"{below}[{k}]" in values for k in range(len(value))):
                changes[field.name] = parts
        elif isinstance(value, eqx.Module) and any(one.startswith(below + ".") for one in values):
            changes[field.name] = _replaced(below, value, values)
    return dataclasses.replace(tree, **changes) if changes else tree


def description(root: str, tree: Any) -> dict[str, Any]:
    """What a tree of modules is made of, as plain data: the kind of every module, the value of every number.

    A function has nothing but its name to show.
    """
    found = {root: type(tree).__name__}
    for field in dataclasses.fields(tree):
        name, value = f"{root}.{field.name}", getattr(tree, field.name)
        if isinstance(value, eqx.Module):
            found |= description(name, value)
        elif isinstance(value, tuple):
            found[name] = [np.asarray(part).tolist() for part in value]
        else:
            found[name] = np.asarray(value).tolist() if isinstance(value, jax.Array | np.ndarray) else value
            if callable(value):
                found[name] = getattr(value, "__qualname__", repr(value))
    return found
