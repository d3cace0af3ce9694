"""Write a page with sliders that simulates a stroller on a hillside in the browser.

Open `explore-out/ride.html`; it needs no network. The map shows the distance of the ride's end; click on it.
"""

from pathlib import Path
from typing import Any

import stroller


def draw() -> Any:
    """The page of a ride across a slope of three degrees."""
    body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    friction = stroller.Damping(rolling=2.0, front=1.0, scrub=0.2, steering=0.05)
    scene = stroller.Scene(body, stroller.Plane(0.05), friction)
    launch = stroller.Launch(place=(0.0, 0.0), heading=1.2, speed=2.0, steering=0.2)
    sliders = {"speed": (0.5, 4.0), "launch.steering": (-0.6, 0.6), "heading": (-3.1, 3.1), "rolling": (0.0, 6.0)}
    # A pedestrian holds the fork and turns it slowly back to the middle.
    return stroller.explore(
        scene, launch, sliders=sliders, t1=6.0, input=lambda t, motion: (0.0, -0.2 * motion.steering)
    )


def main(folder: Path = Path("explore-out")) -> None:
    """Write `ride.html` into a folder."""
    folder.mkdir(exist_ok=True)
    page = draw()
    page.save(folder / "ride.html")
    print(page)


if __name__ == "__main__":
    main()
