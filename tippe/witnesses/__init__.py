"""Independent descriptions of the same top: Euler angles, reductions, Poincare's equations, quadratures.

They are there to disagree if the vector form is wrong, and nothing that is computed for a user comes from them.
"""
