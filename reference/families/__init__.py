"""The families of reference scenes, by programs in NumPy and SciPy from `tests/physics/`."""
