"""Scenes, launches and results for tests of messages, none of which was run."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from tops import rutstam_top

import stroller
import tippe

TOP = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3))
LAUNCH = tippe.Launch(0.1, 155.0)
PRAM = stroller.Scene(stroller.Stroller(12.0, 0.7, 1.5, 0.05))
RIDE = stroller.Launch((0.0, 0.0), 0.3, 2.0)


def batch(*shape):
    """A batch of runs that was never run."""
    return eqx.tree_at(lambda run: run.t, run_of_nothing(), jnp.zeros(shape))


def rides():
    """A batch of rides of a stroller that has times alone."""
    batch = object.__new__(stroller.Trajectory)
    object.__setattr__(batch, "t", jnp.zeros((2, 51)))
    return batch


def followed():
    """A run with a dense output, which is never asked."""
    return dataclasses.replace(run_of_nothing(), dense=object())


def run_of_nothing():
    zero = jnp.zeros(3)
    states = jnp.tile(TOP.state(LAUNCH)[:, None], 3)
    return tippe.Trajectory(zero, TOP, states, jnp.zeros((5, 3)), zero, zero, 0, zero[0], {}, None)


def density_of_a_film():
    """The posterior of friction from a film of theta and azimuth whose errors are unknown."""
    random, times = np.random.default_rng(0), np.linspace(0.0, 0.5, 12)
    value = np.column_stack([0.1 + 0.0175 * random.normal(size=12), np.zeros(12)])
    film = tippe.Recording(LAUNCH, times, value, None, ("theta", "azimuth"))
    return tippe.log_density(TOP, film, {"mu": 0.3}), film


def small_table():
    return tippe.Table({"mu": np.ones(2)}, {"time": np.ones(2)}, {}, {})
