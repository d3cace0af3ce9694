"""The hard cases of `hard_cases.py`, a file for each subject."""
