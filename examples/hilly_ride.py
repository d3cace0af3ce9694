"""A vehicle coasts over hills given by a function: one ride, its derivative with respect to the hills, a table of
speeds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import stroller


class Hills(eqx.Module):
    """Rolling ground: height [m] of its hills, distance [m] between them."""

    height: float
    distance: float

    def __call__(self, x, y):
        phase, side_phase = 2.0 * jnp.pi * x / self.distance, 2.0 * jnp.pi * y / (1.7 * self.distance)
        return self.height * jnp.cos(phase) * jnp.cos(side_phase)


LAUNCH = stroller.Launch(place=(0.0, 0.4), heading=0.1, speed=1.0)


def scene(height: float) -> stroller.Scene:
    body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05, steering_spring=2.0)
    friction = stroller.Damping(rolling=0.5, steering=0.3)
    return stroller.Scene(body, stroller.Graph(Hills(height, 8.0)), friction, fork="absolute")


def end_speed(height: float) -> jax.Array:
    return stroller.simulate(scene(height), LAUNCH, 10.0).speed[-1]


def main() -> None:
    print(stroller.simulate(scene(0.5), LAUNCH, 10.0))

    speed, slope = jax.value_and_grad(end_speed)(0.5)
    print(f"end speed {float(speed):.4f} m/s; a centimetre on the hills changes it by {0.01 * float(slope):+.4f} m/s")

    speeds, heights = np.linspace(0.5, 3.0, 6), np.array([0.25, 0.5])
    table = stroller.sweep(
        scene(0.5), LAUNCH, 10.0, axes={"launch.speed": speeds, "scene.surface.height.height": heights}
    )
    for k, height in enumerate(heights):
        print(
            f"hills of {height} m:",
            *(f"{distance:.1f}" for distance in np.asarray(table.x)[:, k]),
            "m along x, by speed",
        )
    print(f"contact lost in {int(np.isfinite(np.asarray(table.contact_time)).sum())} of {table.x.size} rides")


if __name__ == "__main__":
    main()
