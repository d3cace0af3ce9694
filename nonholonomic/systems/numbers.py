"""The numbers of a user's system by name: `"system.modes[0].drag"`, `"start[1]"`, `"start.q[0]"`, `"event.level"`.

`"system.modes[*].drag"` is one number for all modes that have it.
"""

import dataclasses
import math
import re
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import DictKey, GetAttrKey, KeyPath, SequenceKey
from jaxtyping import Array

from ..parameters import full_name
from .form import is_number


class Named(NamedTuple):
    """The numbers of a tree, one by one, and the tree as a function of these numbers.

    `names` and `values`: names and values of the numbers, in the same order; `places`: the index of the number at each
    place in the tree; `shapes`: the shapes of the arrays that contain the numbers.
    """

    names: tuple[str, ...]
    values: tuple[Array, ...]
    places: tuple[int, ...]
    shapes: tuple[tuple[int, ...], ...]
    structure: Any
    static: Any

    @classmethod
    def of(cls, tree: dict[str, Any], shared: Iterable[str] = ()) -> "Named":
        """The numbers of several named trees. **Arguments:** `shared`: names such as `"system.modes[*].drag"`, each of
        which becomes one number, with the value in the first of the modes."""
        numbers, static = eqx.partition(tree, is_number)
        leaves, structure = jax.tree_util.tree_flatten_with_path(numbers)
        names, values, shapes = [], [], []
        for path, leaf in leaves:
            array = np.asarray(leaf) if not isinstance(leaf, jax.Array) else leaf
            name = _name(path)
            names += [name + "".join(f"[{k}]" for k in index) for index in np.ndindex(array.shape)]
            values += [jnp.asarray(array[index]) for index in np.ndindex(array.shape)]
            shapes.append(array.shape)
        merged_names = [_of_all_modes(name) if _of_all_modes(name) in shared else name for name in names]
        first = {name: k for k, name in reversed(list(enumerate(merged_names)))}
        indices = sorted(first.values())
        places = tuple(indices.index(first[name]) for name in merged_names)
        return cls(
            tuple(merged_names[k] for k in indices),
            tuple(values[k] for k in indices),
            places,
            tuple(shapes),
            structure,
            static,
        )

    def tree(self, values: tuple[Array, ...]) -> dict[str, Any]:
        """The trees for other values of the numbers."""
        leaves, first = [], 0
        for shape in self.shapes:
            part = [values[k] for k in self.places[first : first + math.prod(shape)]]
            leaves.append(jnp.stack(part).reshape(shape) if shape else part[0])
            first += len(part)
        return eqx.combine(jax.tree.unflatten(self.structure, leaves), self.static)

    def replaced(self, changes: dict[str, Any]) -> tuple[Array, ...]:
        """The numbers with replacements, by name; a name such as `"system.modes[*].drag"` replaces several."""
        return tuple(
            changes.get(name, changes.get(_of_all_modes(name), value))
            for name, value in zip(self.names, self.values, strict=True)
        )

    @property
    def movable(self) -> list[str]:
        """The names of the numbers that are floats, which can be varied."""
        return [name for name, value in zip(self.names, self.values, strict=True) if eqx.is_inexact_array(value)]

    @property
    def known(self) -> list[str]:
        """The names of the numbers that can be varied, one by one or in all modes that have them."""
        merged_names = [_of_all_modes(name) for name in self.movable]
        return [*self.movable, *dict.fromkeys(name for name in merged_names if merged_names.count(name) > 1)]

    def full_name(self, argument: str, name: str) -> str:
        """The full name for a name, as in `nonholonomic.parameters.full_name`.

        **Raises:** `ValueError` for an unknown or ambiguous name, with a hint for an attribute that is no float.
        """
        try:
            return full_name(argument, name, self.known)
        except ValueError as error:
            raise ValueError(f"{error}{self._undeclared(name)}") from None

    def _undeclared(self, name: str) -> str:
        """A hint for the name of an attribute that is an integer, or that has no type in its class."""
        end = name.rsplit(".", 1)[-1]
        for module in _modules(self.tree(self.values)):
            value = getattr(module, end, None)
            if isinstance(value, int | float) and not isinstance(value, bool):
                if end in {field.name for field in dataclasses.fields(module)}:
                    return f"; {end} = {value} is an integer: write {float(value)}" if isinstance(value, int) else ""
                return f"; declare it with its type in {type(module).__name__}: {end}: float = {float(value)}"
        return ""


def _name(path: KeyPath) -> str:
    """A path in the user's notation."""
    parts = []
    for key in path:
        if isinstance(key, SequenceKey):
            parts.append(f"[{key.idx}]")
        elif isinstance(key, DictKey | GetAttrKey):
            parts.append(f".{key.key if isinstance(key, DictKey) else key.name}")
        else:
            parts.append(str(key))
    return "".join(parts).removeprefix(".")


def _of_all_modes(name: str) -> str:
    """The name of a number for all modes that have it."""
    return re.sub(r"\bmodes\[\d+\]", "modes[*]", name)


def require_apart(argument: str, names: Iterable[str]) -> None:
    """Raise `ValueError` if a number is named both alone and for all modes."""
    for name in names:
        if name != _of_all_modes(name) in names:
            raise ValueError(f"{argument}: {name!r} is named twice, alone and for all modes")


def short_names(names: list[str]) -> dict[str, str]:
    """For each full name, the part after its last dot, in the form `start_0`; if several names end alike, the whole
    name."""
    ends = [_plain(name.rsplit(".", 1)[-1]) for name in names]
    return {name: end if ends.count(end) == 1 else _plain(name) for name, end in zip(names, ends, strict=True)}


def _plain(name: str) -> str:
    return name.replace("[*]", "").replace("[", "_").replace("]", "").replace(".", "_")


def has_checks(tree: Any) -> bool:
    """Whether a user's module checks its numbers, so that every value of an axis must be checked."""
    kinds = {kind for module in _modules(tree) for kind in type(module).__mro__ if "__check_init__" in vars(kind)}
    return any(not kind.__module__.startswith("nonholonomic.") for kind in kinds)


def check_again(tree: Any) -> None:
    """Check the numbers of all modules of a tree, as when they are created."""
    for module in _modules(tree):
        for kind in type(module).__mro__:
            if "__check_init__" in vars(kind):
                vars(kind)["__check_init__"](module)


def _modules(tree: Any) -> Iterator[eqx.Module]:
    inner = jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, eqx.Module) and node is not tree)
    if isinstance(tree, eqx.Module):
        yield tree
    for node in inner:
        if isinstance(node, eqx.Module) and node is not tree:
            yield from _modules(node)
