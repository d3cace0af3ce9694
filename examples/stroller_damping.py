"""Damping and wheelbase of a stroller from a recorded path."""

import numpy as np

import stroller


def scene(rolling: float, wheelbase: float) -> stroller.Scene:
    body = stroller.Stroller(mass=12.0, wheelbase=wheelbase, inertia=1.5, steering_inertia=0.05)
    return stroller.Scene(body, friction=stroller.Damping(rolling, steering=0.1))


def main() -> None:
    launch = stroller.Launch(place=(0.0, 0.0), heading=0.0, speed=1.5, steering=0.3, steering_rate=-0.4)
    times, error = np.linspace(0.0, 6.0, 31)[1:], 0.01
    truth = {"scene.friction.rolling": 2.0, "scene.body.wheelbase": 0.7}
    path = stroller.simulate(scene(*truth.values()), launch, 6.0, times=times).position
    recorded = path + error * np.random.default_rng(1).normal(size=path.shape)
    data = stroller.Recording(launch, times, recorded, error)
    fit = stroller.identify(scene(1.0, 1.4), data, {"friction.rolling": 1.0, "wheelbase": 1.4}, starts=4)
    print(fit, fit.details, sep="\n")
    for name, value in truth.items():
        low, high = fit.interval(name)
        print(f"truth {name} = {value}: {'inside' if low < value < high else 'outside'} its 95 % interval")
    print(
        "Mass, inertias and dampings could not all be free: scaled alike they leave the path on level ground as it is."
    )


if __name__ == "__main__":
    main()
