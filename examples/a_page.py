"""See a top turn over: a page that moves, an animation for slides, and the curves (needs k3d and matplotlib).

The same launch in the cylinder and on the plane, side by side. Open `page-out/tops.html` in a browser; it needs no network.
"""

from pathlib import Path

import numpy as np

import tippe

MASS, RADIUS = 0.02, 0.02
INERTIA = MASS * RADIUS**2
TOP = tippe.Top(MASS, RADIUS, 0.3 * RADIUS, 131.0 / 350.0 * INERTIA, 0.4 * INERTIA)


def main(folder: Path = Path("page-out")) -> None:
    """Write `tops.html`, `top.gif` and `curves.png` into a folder."""
    folder.mkdir(exist_ok=True)
    launch = tippe.Launch(theta=0.3, spin=155.0)
    scenes = [tippe.Scene(TOP, arena, tippe.Viscous(0.3)) for arena in (tippe.Cylinder(0.3), tippe.Plane())]
    runs = [tippe.simulate(scene, launch, 6.0) for scene in scenes]
    print(runs[0].view(folder / "tops.html", others=runs[1:]))
    # Two seconds at a fifth of their speed; `times` are those of the pictures, 25 a second.
    runs[1].animate(folder / "top.gif", times=np.linspace(3.5, 5.5, 250))
    runs[1].plot(others=runs[:1]).savefig(folder / "curves.png", dpi=110)
    print(f"wrote tops.html, top.gif and curves.png into {folder}")


if __name__ == "__main__":
    main()
