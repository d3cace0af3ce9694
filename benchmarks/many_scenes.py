"""Many different hybrid scenes in one process: time and memory, `python benchmarks/many_scenes.py [SCENES]`.

Each scene has a friction law of its own class, so that no two scenes share a program. Nothing is stored on disk.
"""

import os
import sys
import time

os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)

import tippe
from nonholonomic.compilation.cache import count_mappings, resident_memory


def main(scenes: int) -> None:
    """Time one launch in each of many scenes."""
    top = tippe.Top(0.02, 0.02, 0.006, 2.994e-6, 3.2e-6)
    peak, start_time = 0.0, time.perf_counter()
    for number in range(scenes):
        law = type(f"Law{number}", (tippe.Viscous,), {})
        scene = tippe.Scene(top, friction=law(0.3), contact="hybrid")
        tippe.inversion_time(scene, tippe.Launch(0.1, 155.0), 0.5, tolerance=1e-6)
        memory = 1e-9 * resident_memory()
        peak = max(peak, memory)
        duration = time.perf_counter() - start_time
        print(
            f"{number + 1:4d} scenes {duration:7.1f} s {memory:6.2f} GB, peak {peak:5.2f} {count_mappings():6d} mappings"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
