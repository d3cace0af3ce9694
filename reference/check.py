"""Check a simulator against the reference scenes: `python reference/check.py with_nonholonomic [PART OF A NAME ...]`.

The module defines `simulate(scene) -> {"events": [times], "states": {name: values}}` for a scene as in `scenes`. A
simulator may omit events or quantities, and returns `None` for a scene that it cannot run. Each report line shows the
error of every event time [s], the largest error of each quantity relative to its largest value, and the file's error
bounds in brackets.
"""

import importlib
import json
import sys
from pathlib import Path

import numpy as np

SCENES = Path(__file__).parent / "scenes"


def errors(scene: dict, answer: dict) -> dict[str, tuple[float, float]]:
    """Quantity -> error and bound, both relative except for event times [s]; a missing event has an infinite error."""
    compared = {}
    times = answer.get("events", [])
    for number, event in enumerate(scene["events"] if "events" in answer else []):
        error = abs(times[number] - event["time"]) if number < len(times) else np.inf
        compared[f"{event['kind']} {number + 1}"] = (error, event["bound"])
    for name, values in answer.get("states", {}).items():
        expected, bound = np.array(scene["states"][name]["values"]), scene["states"][name]["bound"]
        size = np.max(np.abs(expected))
        compared[name] = (float(np.max(np.abs(np.asarray(values) - expected)) / size), bound / size)
    return compared


if __name__ == "__main__":
    simulator = importlib.import_module(sys.argv[1])
    for path in sorted(SCENES.glob("*.json")):
        scene = json.loads(path.read_text())
        answer = simulator.simulate(scene) if any(part in path.stem for part in sys.argv[2:] or [""]) else None
        if answer is not None:
            report = (f"{name} {error:.0e} ({bound:.0e})" for name, (error, bound) in errors(scene, answer).items())
            print(f"{path.stem}: {', '.join(report)}", flush=True)
