"""Motion planning: drives to a goal, around obstacles and within limits, on any ground.

Begin with `plan.py`, which calls the others in turn. The user states a problem by `goal.py` and `obstacles.py`, and
`problem.py` checks it. `search.py` finds paths on the flat map of `chart.py`, and `candidates.py` and `guess.py` turn them
into first guesses. `transcription.py` writes the problem as residuals, with the distances of `obstacles.py` and the splines
of `spline.py`, and `optimise.py` reduces them. `drive.py` makes the input, by `inverse.py`; `check.py` drives it, and
`result.py` and `drawing.py` show it. `track.py` adds feedback that corrects the place. `planner.py` is a network that
proposes drives, which `learn.py` trains.
"""
