"""Computations with a scene: rides, tables, crossings, plots and pages."""
