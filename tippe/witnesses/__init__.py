"""Independent descriptions of the same top: Euler angles, reductions, Poincare's equations, quadratures.

Tests compare them with the vector form; no result for users depends on them.
"""
