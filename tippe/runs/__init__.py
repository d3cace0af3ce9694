"""Computations with a scene: trajectories, inversion times, tables, Lyapunov exponents, plots and pages."""
