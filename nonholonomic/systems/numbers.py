"""The numbers of a user's system by name: `"system.modes[0].drag"`, `"start[1]"`, `"start.q[0]"`, `"event.level"`."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import DictKey, GetAttrKey, KeyPath, SequenceKey
from jaxtyping import Array

from .form import is_number


class Named(NamedTuple):
    """The numbers of a tree, one by one, and the tree as a function of these numbers.

    `names` and `values`: names and values of the numbers, in the same order; `shapes`: the shapes of the arrays that
    contain the numbers.
    """

    names: tuple[str, ...]
    values: tuple[Array, ...]
    shapes: tuple[tuple[int, ...], ...]
    structure: Any
    rest: Any

    @classmethod
    def of(cls, tree: dict[str, Any]) -> "Named":
        """The numbers of several named trees."""
        numbers, rest = eqx.partition(tree, is_number)
        leaves, structure = jax.tree_util.tree_flatten_with_path(numbers)
        names, values, shapes = [], [], []
        for path, leaf in leaves:
            array = np.asarray(leaf) if not isinstance(leaf, jax.Array) else leaf
            name = _name(path)
            names += [name + "".join(f"[{k}]" for k in index) for index in np.ndindex(array.shape)]
            values += [jnp.asarray(array[index]) for index in np.ndindex(array.shape)]
            shapes.append(array.shape)
        return cls(tuple(names), tuple(values), tuple(shapes), structure, rest)

    def tree(self, values: tuple[Array, ...]) -> dict[str, Any]:
        """The trees for other values of the numbers."""
        leaves, begin = [], 0
        for shape in self.shapes:
            end = begin + math.prod(shape)
            leaves.append(jnp.stack(values[begin:end]).reshape(shape) if shape else values[begin])
            begin = end
        return eqx.combine(jax.tree.unflatten(self.structure, leaves), self.rest)

    def replaced(self, changes: dict[str, Any]) -> tuple[Array, ...]:
        """The numbers with replacements, by name."""
        return tuple(changes.get(name, value) for name, value in zip(self.names, self.values, strict=True))

    @property
    def movable(self) -> list[str]:
        """The names of the numbers that are floats, which can be varied."""
        return [name for name, value in zip(self.names, self.values, strict=True) if eqx.is_inexact_array(value)]


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


def short_names(names: list[str]) -> dict[str, str]:
    """For each full name, the part after its last dot, in the form `start_0`; if several names end alike, the whole
    name."""
    ends = [_plain(name.rsplit(".", 1)[-1]) for name in names]
    return {name: end if ends.count(end) == 1 else _plain(name) for name, end in zip(names, ends, strict=True)}


def _plain(name: str) -> str:
    return name.replace("[", "_").replace("]", "").replace(".", "_")


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
