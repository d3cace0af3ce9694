"""Plan a top: which launch makes it turn over at a given time and place? A batch, then Newton steps, then a check."""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import tippe

SCENE = tippe.Scene(tippe.presets.rutstam_top(), friction=tippe.Viscous(0.3))
ANGLE, T1, TIMES = 0.5 * np.pi, 8.0, np.linspace(0.0, 8.0, 2001)
#: When and where the axis is to be level [s, m, m], and errors there that weigh the same.
GOAL, UNITS = np.array([5.0, 0.3, 0.2]), (0.1, 0.02)


def turning(numbers: jax.Array) -> jax.Array:
    """The time [s] and the place (x, y) [m] at which the axis is first level, for an inclination, a spin and an azimuth."""
    launch = tippe.Launch(numbers[0], numbers[1], azimuth=numbers[2])
    run = tippe.simulate(SCENE, launch, T1, times=TIMES, tolerance=1e-8)
    after = jnp.argmax(run.theta > ANGLE)
    share = (ANGLE - run.theta[after - 1]) / (run.theta[after] - run.theta[after - 1])
    rows = jnp.column_stack([TIMES, run.position[:, :2]])
    return jnp.where(after > 0, rows[after - 1] + share * (rows[after] - rows[after - 1]), jnp.inf)


def planned() -> tippe.Launch:
    """The best launch of a batch, improved by Newton steps."""
    launches = np.mgrid[0.05:0.3:8j, 120.0:180.0:8j, 0.0:1.0].reshape(3, -1).T
    time, x, y = np.asarray(jax.jit(jax.vmap(turning))(launches)).T
    print(f"{np.isfinite(time).sum()} of {time.size} launches turn over")
    # On a level plane, the azimuth only turns the path.
    errors = np.hypot((time - GOAL[0]) / UNITS[0], (np.hypot(x, y) - np.hypot(*GOAL[1:])) / UNITS[1])
    best = np.nanargmin(errors)
    numbers = launches[best] + [0.0, 0.0, np.arctan2(GOAL[2], GOAL[1]) - np.arctan2(y[best], x[best])]
    both = jax.jit(lambda at: (turning(at) - GOAL, jax.jacfwd(turning)(at)))
    for _ in range(5):
        error, slopes = both(numbers)
        print(f"time off by {abs(error[0]):.0e} s, place by {np.hypot(*error[1:]):.0e} m")
        numbers = numbers - np.linalg.solve(slopes, error)
    return tippe.Launch(numbers[0], numbers[1], azimuth=numbers[2])


def draw() -> Figure:
    """The path until the planned top is level, a matplotlib figure; another event function confirms the time."""
    launch = planned()
    time = float(tippe.inversion_time(SCENE, launch, T1, angle=ANGLE, tolerance=1e-9))
    run = tippe.simulate(SCENE, launch, time, times=np.linspace(0.0, time, 1001), tolerance=1e-9)
    print(f"theta {launch.theta:.4f}, spin {launch.spin:.2f}: level at {time:.5f} s, {run.position[-1, :2].round(5)} m")
    figure = run.portrait("position.x", "position.y")
    figure.axes[0].plot(*GOAL[1:], "o", color="C3", markersize=9, fillstyle="none")
    return figure


def main() -> None:
    draw().savefig("planned_top.png", dpi=150)


if __name__ == "__main__":
    main()
