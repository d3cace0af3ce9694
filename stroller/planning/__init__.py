"""Motion planning: drives to a goal, around obstacles and within limits, on any ground.

`plan.py` is the way through the room. `problem.py` checks what the user states; `search.py` finds paths, which
`candidates.py` and `guess.py` turn into first guesses; `transcription.py` writes the problem as residuals, which
`optimise.py` reduces; `drive.py` makes the input, by `inverse.py`; `check.py` drives it, and `result.py` and `drawing.py`
show it. `planner.py` is a network that proposes drives, which `learn.py` trains.
"""
