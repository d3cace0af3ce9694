"""Design a top: which offset and inertia make it turn over fastest at a given spin, while the normal force keeps a
margin?

Sequential quadratic programming starts from the best tops of a grid; then the neighbours are checked, because close to
the best top another minimum of the normal force becomes the deepest, so slopes alone do not show that it is the best.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import tippe

SPIN, THETA, T1, LEAST, TIMES = 120.0, 0.1, 8.0, 0.92, 6400
MASS, RADIUS, ANGLE = 0.02, 0.02, 0.75 * np.pi
BOUNDS = [(0.1, 0.5), (0.85, 1.1)]


def time_and_force(numbers: jax.Array) -> jax.Array:
    """Inversion time [s], and the least normal force before it relative to the weight, for offset / radius and I1 /
    I3."""
    I3 = 0.4 * MASS * RADIUS**2
    top = tippe.Top(MASS, RADIUS, numbers[0] * RADIUS, numbers[1] * I3, I3)
    scene, times = tippe.Scene(top, friction=tippe.Viscous(0.3)), jnp.linspace(0.0, T1, TIMES)
    adjoint = diffrax.ForwardMode()
    run = tippe.simulate(scene, tippe.Launch(THETA, SPIN), T1, times=times, tolerance=1e-8, adjoint=adjoint)
    theta = jnp.nan_to_num(run.theta)
    after = jnp.argmax(theta > ANGLE)
    share = (ANGLE - theta[after - 1]) / (theta[after] - theta[after - 1])
    force = jnp.where((jnp.arange(TIMES) < after) & (theta > 0.0), run.normal_force / (MASS * 9.81), jnp.inf)
    # The least force lies between the times: at the vertex of the parabola through the least three.
    low, least, high = force[jnp.clip(jnp.argmin(force[:-1]) + jnp.arange(-1, 2), 0, TIMES - 1)]
    bend = low - 2.0 * least + high
    vertex = least - jnp.where(bend > 0.0, (high - low) ** 2 / (8.0 * bend), 0.0)
    return jnp.where(after > 0, jnp.stack([times[after - 1] + share * times[1], vertex]), jnp.array([2.0 * T1, 1.0]))


def main() -> None:
    single, many, slopes = map(jax.jit, (time_and_force, jax.vmap(time_and_force), jax.jacfwd(time_and_force)))
    grid = np.stack(np.meshgrid(np.linspace(0.15, 0.48, 12), np.linspace(0.87, 1.08, 8)), axis=-1).reshape(-1, 2)
    times, forces = np.asarray(many(grid)).T
    limit = {"type": "ineq", "fun": lambda at: single(at)[1] - LEAST, "jac": lambda at: slopes(at)[1]}
    fits = []
    for start in grid[np.argsort(np.where(forces > LEAST, times, 2.0 * T1))[:4]]:
        options = {"jac": lambda at: slopes(at)[0], "bounds": BOUNDS, "constraints": limit, "tol": 1e-6}
        fits.append(minimize(lambda at: single(at)[0], start, method="SLSQP", **options).x)
        print("from", start.round(3), "to", fits[-1].round(4), "time and force", np.round(single(fits[-1]), 4))
    best = min(fits, key=lambda at: single(at)[0] if single(at)[1] > LEAST - 1e-4 else np.inf)
    time, force = np.asarray(single(best))
    print(f"fastest: offset / radius {best[0]:.4f}, I1 / I3 {best[1]:.4f}: {time:.3f} s, least force {force:.4f} mg")
    turn = 2.0 * np.pi * np.arange(64) / 64.0
    times, forces = np.asarray(many(best + 0.005 * np.stack([np.cos(turn), np.sin(turn)], axis=-1))).T
    print(f"Of 64 tops around it {np.sum((times < time) & (forces >= LEAST))} are faster and keep the limit.")


if __name__ == "__main__":
    main()
