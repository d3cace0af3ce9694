"""Two launches of one top, overlaid: above Jellett's threshold it turns over, below it does not (needs the extra `view`)."""

from pathlib import Path
from typing import Any

import tippe


def draw() -> Any:
    """The page with both runs."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    fast_run, slow_run = (tippe.simulate(scene, tippe.Launch(theta=0.3, spin=spin), 8.0) for spin in (110.0, 60.0))
    return fast_run.view(others=[slow_run], overlaid=True)


if __name__ == "__main__":
    draw().save(Path("fork_in_the_road.html"))
