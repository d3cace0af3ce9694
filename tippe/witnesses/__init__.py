"""Independent descriptions of the same top: Euler angles, reductions, Poincare's equations, quadratures.

They would disagree if the vector form were wrong; no result for users depends on them.
"""
