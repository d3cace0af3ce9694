"""Users' objects, which are written for a single run, with their arrays as separate numbers."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

#: The packages whose own methods are written for lanes.
OWN = ("nonholonomic", "tippe", "stroller")


class Numbers(eqx.Module):
    """An array as separate numbers, each a leaf with one value for all lanes or one per lane; and its shape."""

    numbers: tuple[Any, ...]
    shape: tuple[int, ...] = eqx.field(static=True)

    @property
    def array(self) -> Array:
        """The array."""
        return gathered(self.numbers, [self.shape])[0]

    def __jax_array__(self) -> Array:
        return self.array

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self.array, dtype)


def spread(arrays: Sequence[Array]) -> tuple[Array, ...]:
    """The numbers of arrays, one by one."""
    return tuple(number for array in arrays for number in (jnp.unstack(array.ravel()) if array.ndim else (array,)))


def gathered(numbers: Sequence[Array], shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """The arrays with the given shapes, from their `spread` numbers."""
    arrays, first = [], 0
    for shape in shapes:
        end = first + math.prod(shape)
        arrays.append(jnp.stack(numbers[first:end]).reshape(shape) if shape else numbers[first])
        first = end
    return arrays


def parted(tree: Any) -> Any:
    """A tree with `Numbers` in place of its arrays, which hold the numbers of a single run."""

    def part(leaf: Any) -> Any:
        return Numbers(spread([jnp.asarray(leaf)]), leaf.shape) if is_array(leaf) and leaf.ndim else leaf

    return jax.tree.map(part, tree)


def joined(tree: Any) -> Any:
    """A tree with arrays in place of its `Numbers`."""

    def join(leaf: Any) -> Any:
        return leaf.array if is_numbers(leaf) else leaf

    return jax.tree.map(join, tree, is_leaf=is_numbers)


def is_numbers(leaf: Any) -> bool:
    """Whether a node of a tree is an array as separate numbers."""
    return isinstance(leaf, Numbers)


def is_array(leaf: Any) -> bool:
    """Whether a leaf is an array of JAX or NumPy."""
    return isinstance(leaf, jax.Array | np.ndarray)


def is_users(kind: type) -> bool:
    """Whether a class is a user's, not one of these packages."""
    return kind.__module__.partition(".")[0] not in OWN


class AbstractHeld(eqx.Module):
    """A user's module that is a function, with `Numbers` in place of its arrays. This object has its attributes, too."""

    function: eqx.AbstractVar[Any]

    @property
    def whole(self) -> Any:
        """The module with its arrays."""
        return joined(self.function)

    def __repr__(self) -> str:
        return repr(self.whole)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "function":
            raise AttributeError(name)
        return getattr(self.whole, name)
