"""Motion planning: drives to a goal, around obstacles and within limits, on any ground.

Begin with `plan.py`, which calls the others in turn, drives what they find, says what this run achieves, shows it, and adds
feedback that corrects the place. The user states a problem by the classes of `problem.py`, which also checks it, has the
distances of its obstacles and a flat map of its ground. `search.py` finds paths on this map and turns them into first guesses.
`transcription.py` writes the problem as residuals, reduces these, and makes the input of the drive. `planner.py` trains a
network that proposes drives.
"""
