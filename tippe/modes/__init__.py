"""What a top does between two events, as problems and modes for the integrator: slide, roll, fly, strike, lean on its stem.

Each mode has its equations of motion, a margin that is positive while the mode lasts, and a map to the mode that follows.
"""
