"""What the tests share: the declared tops, and how close is close."""

import gc
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nonholonomic
import tippe


def pytest_configure(config: pytest.Config) -> None:
    """What one test compiles serves all others, in every worker and child process, and in the next run of the tests.

    `pytest --cache-clear` forgets it; a folder that `JAX_COMPILATION_CACHE_DIR` names is used instead.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and hasattr(config, "cache"):
        folder = nonholonomic.enable_compilation_cache(config.cache.mkdir("compiled"))
        if folder is not None:
            os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
            os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
            os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"


#: Memory mappings that a process may collect before it forgets its compiled programs; Linux allows 65 530, and a compiler that
#: gets no more of them crashes.
MOST_MAPPINGS = 45_000


@pytest.fixture(autouse=True)
def forget_compiled_programs():
    """Let go of compiled programs before they exhaust the memory mappings that a process may have."""
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > MOST_MAPPINGS:
        jax.clear_caches()
        gc.collect()


def rutstam_top(I1_factor: float = 131.0 / 350.0) -> tippe.Top:
    """Rutstam's top (SIGMA 8 (2012) 019); his later papers have I1 = 131/350 m R^2, this one 235/625."""
    mass, radius = 0.02, 0.02
    inertia = mass * radius**2
    return tippe.Top(mass, radius, 0.3 * radius, I1_factor * inertia, 0.4 * inertia)


def homogeneous_ball(mass: float = 0.1, radius: float = 0.02) -> tippe.Top:
    """A homogeneous ball: no offset, I = 2/5 m R^2."""
    inertia = 0.4 * mass * radius**2
    return tippe.Top(mass, radius, 0.0, inertia, inertia)


def assert_close(value, expected, rtol=0.0, atol=0.0):
    """Compare arrays, the tolerances stated in full."""
    np.testing.assert_allclose(np.asarray(value), np.asarray(expected), rtol=rtol, atol=atol)


@pytest.fixture(scope="session")
def rutstam_scene() -> tippe.Scene:
    """Rutstam's top on the plane with viscous friction, mu = 0.3 s/m."""
    return tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))


def random_states(scene: tippe.Scene, count: int, seed: int = 0):
    """Legal states with nothing special about them: any axis, spins to 200 rad/s, slips to 1 m/s."""
    random = np.random.default_rng(seed)
    axis = random.normal(size=(3, count))
    axis /= np.linalg.norm(axis, axis=0)
    momentum = float(scene.body.I3) * 100.0 * random.normal(size=(3, count))
    place, _ = scene.frame.at_angle(jnp.asarray(random.uniform(-1.2, 1.2, count)))
    place = np.array(jnp.stack(place)) if place else np.zeros((0, count))
    return jnp.asarray(np.concatenate([random.normal(scale=0.3, size=(2, count)), axis, momentum, place]))
