"""Measure how many operations a machine computes per second."""

from typing import Any

import jax
import jax.numpy as jnp
from measure import timed

#: Independent chains of multiply-adds, and links of each, in the measurement of the peak.
CHAINS, LINKS = 8, 64


def peak() -> float:
    """Operations per second [1/s] that multiply-adds on registers reach: on one core of a CPU, or on all of an accelerator."""
    on_cpu = jax.default_backend() == "cpu"
    elements, rounds = (1 << 11, 2000) if on_cpu else (1 << 24, 20)

    def links(values: Any) -> Any:
        chains = [values + 0.1 * k for k in range(CHAINS)]
        for _ in range(LINKS):
            chains = [chain * values + 0.5 for chain in chains]
        return 1e-3 * sum(chains)

    run = jax.jit(lambda values: jax.lax.fori_loop(0, rounds, lambda _, now: links(now), values))
    values = jnp.linspace(0.0, 0.5, elements)
    measurement = timed(lambda: run(values), 3)
    return 2.0 * CHAINS * LINKS * elements * rounds / (measurement.cpu if on_cpu else measurement.wall)
