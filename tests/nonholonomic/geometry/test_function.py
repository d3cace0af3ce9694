"""Functions of a ground that hold arrays: their numbers are parameters of the ground, not one for each lane."""

import json
import pickle
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from jax.scipy.interpolate import RegularGridInterpolator

import tippe
from nonholonomic import Graph
from nonholonomic.parameters import description, numbers


class Bowl(eqx.Module):
    """A ground with an array of two axes, of which the sum counts, and a number."""

    bends: jax.Array
    height: float

    def __call__(self, x, y):
        return self.height * sum(self.bends[k, 0] * x * x + self.bends[k, 1] * y * y for k in range(2))


BENDS = np.array([[0.1, 0.6], [0.3, 0.4]])


def heights(x, y):
    return 0.4 * x * x + 1.0 * y * y


def test_arrays_of_a_function_are_not_taken_for_numbers_of_lanes():
    """A cell of a batch has the complete function; in a batch, each lane has its own height."""
    ground = Graph(Bowl(BENDS, 1.0))
    assert all(leaf.ndim == 0 for leaf in jax.tree.leaves(ground))
    x, y = jnp.array([0.1, 0.2, 0.3]), jnp.array([0.3, -0.2, 0.1])
    assert_close(ground.ground(x, y), heights(x, y), rtol=1e-14)
    assert_close(ground.height.bends, BENDS, rtol=0.0)
    (name,) = (name for name in numbers("ground", ground) if name.endswith(".height"))
    assert float(numbers("ground", ground)[name]) == 1.0
    swept = eqx.tree_at(lambda node: node.height.function.height, ground, jnp.array([1.0, 2.0, 3.0]))
    assert_close(swept.ground(x, y), np.array([1.0, 2.0, 3.0]) * heights(x, y), rtol=1e-14)


def test_a_ground_with_arrays_is_described_printed_and_sent_as_others_are():
    """As the request of a table, which is JSON; as text; and to another process."""
    ground = Graph(Bowl(BENDS, 1.0))
    text = json.loads(json.dumps(description("ground", ground)))
    assert text["ground.height"] == "Bowl"
    assert text["ground.height.bends"] == BENDS.tolist()
    assert repr(ground.height).startswith("Bowl(")
    assert_close(pickle.loads(pickle.dumps(ground)).ground(0.1, 0.3), heights(0.1, 0.3), rtol=1e-14)


@pytest.mark.parametrize("held", [True, False], ids=["module", "closure"])
def test_the_numbers_in_an_array_have_their_derivatives(held):
    x, y = jnp.array([0.1, 0.2, 0.3]), jnp.array([0.3, -0.2, 0.1])

    def total(bends):
        bowl = Bowl(bends, 1.0)
        return jnp.sum(Graph(bowl if held else lambda x, y: bowl(x, y)).ground(x, y))

    squares = np.array([np.sum(x * x), np.sum(y * y)])
    assert_close(jax.jit(jax.grad(total))(jnp.asarray(BENDS)), np.array([squares, squares]), rtol=1e-14)


class Ridge(eqx.Module):
    """A ground whose function branches, with a number."""

    height: float

    def __call__(self, x, y):
        return jax.lax.cond(x > 0.15, lambda: self.height * x * y, lambda: self.height * x)


PLACES = np.linspace(-1.0, 1.0, 5)
TERRAIN = RegularGridInterpolator((PLACES, PLACES), 0.2 * PLACES[:, None] + 0.1 * PLACES)

#: Grounds that join, sort, look up or compare their numbers, and the same in NumPy for numbers.
OF_NUMBERS = {
    "interp": (lambda x, y: jnp.interp(x, PLACES, PLACES**2) + 0.0 * y, lambda x, y: np.interp(x, PLACES, PLACES**2)),
    "searchsorted": (lambda x, y: x * jnp.searchsorted(PLACES, y), lambda x, y: x * np.searchsorted(PLACES, y)),
    "grid": (lambda x, y: TERRAIN(jnp.array([x, y]))[0], lambda x, y: 0.2 * x + 0.1 * y),
    "sort": (lambda x, y: jnp.sort(jnp.stack([x, y]))[0], min),
    "einsum": (lambda x, y: jnp.einsum("i,i->", jnp.array([x, y]), jnp.array([x, x])), lambda x, y: x * x + x * y),
    "norm": (lambda x, y: jnp.linalg.norm(jnp.stack([x, y])), np.hypot),
    "cond": (lambda x, y: jax.lax.cond(x > y, jnp.sin, jnp.cos, x), lambda x, y: np.sin(x) if x > y else np.cos(x)),
    "constant": (lambda x, y: 0.3, lambda x, y: 0.3),
    "module": (Ridge(2.0), lambda x, y: 2.0 * x * (y if x > 0.15 else 1.0)),
}


@pytest.mark.parametrize("name", OF_NUMBERS)
def test_a_height_is_a_function_of_numbers_in_every_lane(name):
    """In lanes and for a single place; derivatives are those of differences."""
    height, expected = OF_NUMBERS[name]
    ground, x, y = Graph(height), jnp.array([0.1, 0.2, 0.3]), jnp.array([0.35, -0.2, 0.1])
    heights = np.array([expected(*place) for place in zip(x.tolist(), y.tolist(), strict=True)])
    assert_close(ground.ground(x, y), heights, rtol=1e-14)
    assert_close(ground.ground(x[0], y[0]), heights[0], rtol=1e-14)
    slope = ground.gradient((x, y, 0.0 * x))[0]
    nearby = [expected(*place) for place in zip((x + 1e-7).tolist(), y.tolist(), strict=True)]
    assert_close(-slope, (np.array(nearby) - heights) / 1e-7, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("contact", ["stop", "hybrid"])
def test_runs_over_a_ground_with_arrays_are_those_over_the_same_ground_without(contact):
    """A table of a single cell took the first number of an array for all of them, and "hybrid" raised an error of JAX's."""
    top = tippe.Top(0.02, 0.02, 0.006, 2.994e-6, 3.2e-6)
    launch = tippe.Launch(0.1, 155.0, place=(0.02, 0.03))
    place = {"axes": {"launch.place[0]": 0.02, "launch.place[1]": 0.03}, "tolerance": 1e-7}
    ends = []
    for ground in (heights, Bowl(BENDS, 1.0)):
        scene = tippe.Scene(top, Graph(ground), tippe.Viscous(0.3), contact=contact)
        ends.append([float(tippe.simulate(scene, launch, 0.3, tolerance=1e-7).theta[-1])])
        ends[-1].append(float(tippe.inversion_table(scene, theta=0.1, spin=155.0, t1=0.3, **place).end_theta))
        if contact == "stop":
            table = tippe.trajectory_table(scene, theta=0.1, spin=155.0, times=[0.3], **place)
            ends[-1].append(float(table.theta[0]))
    assert_close(ends[0], np.full(len(ends[0]), 0.0857507), atol=1e-6)
    assert_close(ends[1], ends[0], rtol=1e-12)


STEEPNESS = 0.5


def hills(x, y):
    return STEEPNESS * x * x + jnp.where(y > 0.0, 0.1, 0.2)


def test_a_ground_keeps_the_numbers_that_its_function_read_when_it_was_made(monkeypatch):
    """A new ground has the new numbers, also in a program that was compiled for the old ones; the old ground keeps its own."""
    evaluated = jax.jit(lambda ground, x, y: ground.ground(x, y))
    old = Graph(hills)
    assert evaluated(old, 1.0, 1.0) == 0.6
    monkeypatch.setattr(sys.modules[__name__], "STEEPNESS", 2.0)
    new = Graph(hills)
    assert evaluated(new, 1.0, 1.0) == 2.1
    assert evaluated(old, 1.0, 1.0) == 0.6
    assert old.ground(1.0, 1.0) == 0.6
    assert pickle.loads(pickle.dumps(new)).ground(1.0, 1.0) == 2.1
    assert repr(new) == "Graph(height=Plain(function=<function hills>))"
