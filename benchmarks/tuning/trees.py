"""Rooted trees, each with its condition on a Runge-Kutta method (Hairer, Norsett and Wanner, Solving ODEs I, section II.2).

A tree is the tuple of the subtrees at its root, so a leaf is `()`. A method with stages A and weights b is of order p if
b . Phi(t) = 1/gamma(t) for every tree t of at most p vertices.
"""

import math
from collections import Counter
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

#: The subtrees at the root; a tree of trees, which has no type of its own.
Tree = tuple[Any, ...]


def trees(order: int) -> list[list[Tree]]:
    """All trees with 1, 2, ..., `order` vertices."""
    trees_by_size: list[list[Tree]] = [[()]]
    for vertices in range(2, order + 1):
        trees_by_size.append(
            sorted({tuple(sorted(forest)) for forest in _forests(trees_by_size, vertices - 1, vertices - 1)})
        )
    return trees_by_size


def _forests(trees_by_size: list[list[Tree]], vertices: int, max_size: int) -> list[list[Tree]]:
    """All lists of trees with the given total number of vertices, none with more than `largest`."""
    if vertices == 0:
        return [[]]
    return [
        [tree, *siblings]
        for size in range(min(vertices, max_size), 0, -1)
        for siblings in _forests(trees_by_size, vertices - size, size)
        for tree in trees_by_size[size - 1]
    ]


def vertices(tree: Tree) -> int:
    """Number of vertices of a tree: its order."""
    return 1 + sum(map(vertices, tree))


def density(tree: Tree) -> int:
    """gamma(t): the product of the numbers of vertices of all subtrees."""
    return vertices(tree) * math.prod(map(density, tree))


def symmetry(tree: Tree) -> int:
    """sigma(t): number of rearrangements that do not change the tree."""
    return math.prod(math.factorial(count) * symmetry(branch) ** count for branch, count in Counter(tree).items())


def error_coefficients(
    stages: Float[Any, "stages stages"], weights: Float[Any, " stages"], order: int
) -> Float[Any, " trees"]:
    """(b . Phi(t) - 1/gamma(t)) / sigma(t) of every tree of an order: all vanish if the method is of that order.

    NumPy's arrays keep their precision, which may be extended; for other arrays, JAX computes.
    """
    trees_by_order, trees_of_size = trees(order), {}
    xp = np if isinstance(weights, np.ndarray) else jnp

    def phi(tree: Tree) -> Float[Any, " stages"]:
        """The elementary weights of a tree, one per stage."""
        value = xp.ones_like(weights)
        for branch in tree:
            if branch not in trees_of_size:
                trees_of_size[branch] = stages @ phi(branch)
            value = value * trees_of_size[branch]
        return value

    return xp.stack(
        [(weights @ phi(tree) - 1.0 / density(tree)) / symmetry(tree) for tree in trees_by_order[order - 1]]
    )
