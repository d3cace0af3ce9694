"""The numbers of a user's system by name: `"system.modes[0].drag"`, `"start[1]"`, `"start.q[0]"`, `"event.level"`.

`"system.modes[*].drag"` is one number for all modes that have it.
"""

import dataclasses
import math
import re
from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import DictKey, GetAttrKey, KeyPath, SequenceKey
from jaxtyping import Array, Float

from ..parameters import full_name
from ..per_run import gathered, spread


def is_number(leaf: Any) -> bool:
    """Whether a leaf of a tree is a number or an array of numbers, which may differ from cell to cell."""
    return eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.inexact | float)


@dataclasses.dataclass(frozen=True)
class TreeForm:
    """A tree without its numbers, which are listed one by one, in order within each array.

    - `structure`: structure of the tree of numbers; `kinds`: shape and type of each leaf.
    - `static_leaves`, `static_structure`: the leaves that are not numbers.
    """

    structure: Any
    kinds: tuple[tuple[tuple[int, ...], Any], ...]
    static_leaves: tuple[Hashable, ...]
    static_structure: Any

    @classmethod
    def of(cls, tree: Any) -> tuple["TreeForm", tuple[Array, ...]]:
        """The form of a tree, and its numbers."""
        numbers, static = eqx.partition(tree, is_number)
        leaves, structure = jax.tree.flatten(numbers)
        arrays = [jnp.asarray(leaf) for leaf in leaves]
        static_leaves, static_structure = jax.tree.flatten(static)
        kinds = tuple((array.shape, array.dtype) for array in arrays)
        return cls(structure, kinds, tuple(static_leaves), static_structure), spread(arrays)

    def tree(self, numbers: Sequence[Array]) -> Any:
        """The tree with the given numbers, each a scalar."""
        leaves = gathered(numbers, [shape for shape, _ in self.kinds])
        static = jax.tree.unflatten(self.static_structure, self.static_leaves)
        return eqx.combine(jax.tree.unflatten(self.structure, leaves), static)

    @property
    def types(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        """The types of the numbers."""
        return tuple(jax.ShapeDtypeStruct((), kind) for shape, kind in self.kinds for _ in range(math.prod(shape)))


class Parameters(eqx.Module):
    """The numbers of a tree of a user's modules, one by one, by name.

    - `values`: the numbers, scalars or arrays with one number per cell; `names`: their names, in the same order.
    - `form`: the rest of the tree.
    """

    values: tuple[Float[Array, "..."], ...]
    names: tuple[str, ...] = eqx.field(static=True)
    form: TreeForm = eqx.field(static=True)

    @classmethod
    def of(cls, tree: dict[str, Any]) -> "Parameters":
        """The numbers of several named trees."""
        form, values = TreeForm.of(tree)
        leaves, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, is_number))
        names = [
            _name(path) + "".join(f"[{k}]" for k in index)
            for path, leaf in leaves
            for index in np.ndindex(np.shape(leaf))
        ]
        return cls(values, tuple(names), form)

    @property
    def tree(self) -> dict[str, Any]:
        """The trees, for values that are scalars."""
        return self.form.tree(self.values)

    def replaced(self, changes: dict[str, Any]) -> "Parameters":
        """The parameters with replacements, by name; a name such as `"system.modes[*].drag"` replaces several."""
        values = tuple(
            changes.get(name, changes.get(_of_all_modes(name), value))
            for name, value in zip(self.names, self.values, strict=True)
        )
        return dataclasses.replace(self, values=values)

    def value(self, name: str) -> Array:
        """The value of a parameter; of the first of several."""
        return next(
            value for own, value in zip(self.names, self.values, strict=True) if name in (own, _of_all_modes(own))
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
        for module in _modules(self.tree):
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
