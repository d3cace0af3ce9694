"""Questions to a scene and their answers: trajectories, inversion times, tables, Lyapunov exponents, pictures and pages."""
