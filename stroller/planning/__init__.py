"""Motion planning: drives to a goal, around obstacles and within limits, on any ground.

Begin with `plan.py`, which calls the others in turn. The user states a problem by the classes of `problem.py` and
`obstacles.py`; `problem.py` also checks it, and has a flat map of the ground. `search.py` finds paths on this map, and
`candidates.py` turns them into first guesses. `transcription.py` writes the problem as residuals, with the distances of
`obstacles.py`, reduces these, and makes the input of the drive. `problem.py` drives it, `result.py` shows it, and `plan.py`
adds feedback that corrects the place. `planner.py` trains a network that proposes drives.
"""
