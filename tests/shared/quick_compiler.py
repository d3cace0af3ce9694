"""Flags of a compiler that is quick, for tests whose work is compiling."""

import jax


def quick_to_compile() -> list[str]:
    """XLA's flags of a quick compiler. One that a version does not know ends the process: jax 0.11 lost the older emitters."""
    emitters = ["--xla_cpu_use_fusion_emitters=false"] if jax.__version_info__[:2] == (0, 10) else []
    return ["--xla_backend_optimization_level=0", *emitters]
