"""How many programs a call compiles."""

import collections

import jax

COMPILED = "/jax/core/compile/backend_compile_duration"


def compilations(function, *arguments):
    """How many programs a call compiles, those that are found on the disk included."""
    counts = collections.Counter()

    def heard(event, duration_secs, **_):
        counts[event] += 1

    jax.monitoring.register_event_duration_secs_listener(heard)
    try:
        jax.block_until_ready(jax.tree.leaves(function(*arguments)))
    finally:
        jax.monitoring.unregister_event_duration_listener(heard)
    return counts[COMPILED]
