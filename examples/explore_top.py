"""Write a page with sliders that simulates a tippe top in the browser.

Open `explore-out/top.html`; it needs no network. The map shows where the top turns over, and how soon; click on it.
"""

from pathlib import Path
from typing import Any

import tippe


def draw() -> Any:
    """The page of Rutstam's top on a plane."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    sliders = {"theta": (0.02, 0.6), "spin": (60.0, 200.0), "mu": (0.05, 1.0), "offset": (0.004, 0.008)}
    return tippe.explore(scene, tippe.Launch(theta=0.1, spin=155.0), sliders=sliders)


def main(folder: Path = Path("explore-out")) -> None:
    """Write `top.html` into a folder."""
    folder.mkdir(exist_ok=True)
    page = draw()
    page.save(folder / "top.html")
    print(page)


if __name__ == "__main__":
    main()
