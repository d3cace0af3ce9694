"""Park a stroller between two others: a plan with the full dynamics, as a page or as a picture."""

from typing import Any

import stroller


def planned() -> stroller.Plan:
    """The plan: into a gap of 0.8 m, with a vehicle of 0.5 m."""
    body = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005)
    scene = stroller.Scene(body, friction=stroller.Damping(2.0, 0.5, 0.1, 0.05))
    parked = [stroller.Box(centre=(x, 0.3), size=(0.5, 0.25)) for x in (0.3, 1.1, 2.4)]
    kerb = stroller.Box(centre=(1.5, 0.05), size=(3.4, 0.1))
    return stroller.plan(
        scene,
        stroller.Launch(place=(0.7, 0.8), heading=0.0, speed=0.0),
        stroller.Goal(place=(1.6, 0.3), heading=0.0),
        t1=15.0,
        obstacles=[*parked, kerb],
        limits=stroller.Limits(steering=1.0, speed=(-0.5, 0.8)),
        footprint=stroller.Footprint(length=0.5, width=0.25, rear=0.1),
    )


def draw() -> Any:
    """The page with the drive."""
    return planned().view()


def main() -> None:
    """Print the plan, and write the page and the picture."""
    plan = planned()
    print(plan)
    plan.plot().savefig("parking.png", dpi=150)
    plan.view("parking.html")


if __name__ == "__main__":
    main()
