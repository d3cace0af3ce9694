"""Write the scenes of `reference/scenes`: `python reference/generate.py [FAMILY ...]`, half an hour on one core for all.

The numbers come from the programs in `tests/physics/`, written in NumPy and SciPy; nothing here imports the simulator.
Every scene is computed twice, by two formulations or at two tolerances. The values are those of the finer run. An error
bound is the largest difference between the two runs, and at least `ROUND_OFF` times the size of the quantity.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "tests" / "physics")]

from families.hybrid_tops import hops, stick_slip  # noqa: E402
from families.rides import strollers  # noqa: E402
from families.smooth_tops import arenas, eggs, plane_and_cylinder, spheres  # noqa: E402

FAMILIES = {
    "plane_and_cylinder": plane_and_cylinder,
    "spheres": spheres,
    "arenas": arenas,
    "hops": hops,
    "stick_slip": stick_slip,
    "eggs": eggs,
    "strollers": strollers,
}


def main(names: Sequence[str]) -> None:
    """Write the scenes of some families, or of all."""
    folder = HERE / "scenes"
    folder.mkdir(exist_ok=True)
    for family in names or FAMILIES:
        for scene in FAMILIES[family]():
            (folder / f"{scene['name']}.json").write_text(json.dumps(scene, indent=1) + "\n")
            print(
                scene["name"],
                scene["outcome"],
                {k: v["bound"] for k, v in scene["states"].items() if k != "times"},
                flush=True,
            )
            print("   ", [(event["kind"], event["time"], event["bound"]) for event in scene["events"]], flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
