"""Several ways to one number (`roads.py`): a table, a time or a batch of times, a run or a batch of runs with their paths, and
the same scene with `contact="hybrid"`. They share the equations, and little of the code around them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from random_scenes import IN_PHASES, SMOOTH
from roads import compare_roads

#: Kinds of scenes in which the tops fly over a curved arena.
AIRBORNE = ["cylinder-viscous-hybrid", "sphere-coulomb-hybrid"]


@pytest.mark.slow
def test_all_roads_lead_to_the_same_answer():
    """The short form: 24 tops on the plane, of which two run by themselves as well."""
    findings, counts = compare_roads("plane-viscous-stop", 24, 2)
    assert counts > 20
    assert findings.lines == []
    assert findings.compared > 60


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*SMOOTH, *IN_PHASES, *AIRBORNE])
def test_all_roads_lead_to_the_same_answer_on_every_arena_and_under_every_law(kind):
    """625 scenes in all, in a process of each kind that compiles quickly, because compiling is most of the work."""
    script = Path(__file__).with_name("roads.py")
    paths = [str(script.parents[1] / "shared"), str(script.parents[2]), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    process = subprocess.run(
        [sys.executable, script, kind], env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    print(process.stdout)
    assert process.returncode == 0, process.stdout + process.stderr[-2000:]
