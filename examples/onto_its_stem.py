"""A top with a stem: it turns over, touches the table with its stem, and rises on it (needs the extra `view`)."""

from pathlib import Path
from typing import Any

import tippe


def draw() -> Any:
    """The page of the run."""
    stem = tippe.Stem(radius=0.005, offset=0.016)
    top = tippe.Top(mass=0.006, radius=0.015, offset=0.003, I1=8e-7, I3=7e-7, stem=stem)
    scene = tippe.Scene(top, friction=tippe.Coulomb(0.3, 0.05), contact="hybrid")
    return tippe.simulate(scene, tippe.Launch(theta=0.1, spin=180.0), t1=3.0, tolerance=1e-6).view()


if __name__ == "__main__":
    draw().save(Path("onto_its_stem.html"))
