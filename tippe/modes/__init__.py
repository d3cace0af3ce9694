"""The modes of a top between events, as problems for the integrator: sliding, rolling, flight, impact, leaning on its
stem.

Each mode has its equations of motion, a domain margin that is positive while the mode lasts, and a reset map to the
next mode.
"""
