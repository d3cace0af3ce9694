"""Show a top that turns over: an animated page, a film for slides, and the curves (needs the extras `view` and `plot`, and
Chromium, Chrome or Edge for the film).

The same launch in the cylinder and on the plane, side by side. Open `page-out/tops.html` in a browser; it needs no
network.
"""

from pathlib import Path
from typing import Any

import numpy as np

import tippe


def runs() -> list[Any]:
    """One launch in the cylinder and on the plane."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scenes = [tippe.Scene(top, arena, tippe.Viscous(0.3)) for arena in (tippe.Cylinder(0.3), tippe.Plane())]
    return [tippe.simulate(scene, tippe.Launch(theta=0.3, spin=155.0), 6.0) for scene in scenes]


def draw() -> Any:
    """The page with both runs."""
    cylinder, plane = runs()
    return cylinder.view(others=[plane])


def main(folder: Path = Path("page-out")) -> None:
    """Write `tops.html`, `top.webm` and `curves.png` into a folder."""
    folder.mkdir(exist_ok=True)
    cylinder, plane = runs()
    print(cylinder.view(folder / "tops.html", others=[plane]))
    # Two seconds at a fifth of real time; `times` are those of the frames, 25 per second.
    plane.animate(folder / "top.webm", times=np.linspace(3.5, 5.5, 250))
    plane.plot(others=[cylinder]).savefig(folder / "curves.png", dpi=110)
    print(f"wrote tops.html, top.webm and curves.png into {folder}")


if __name__ == "__main__":
    main()
