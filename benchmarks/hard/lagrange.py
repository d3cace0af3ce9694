"""An independent run of a top: Lagrange's equations in Euler angles, by SciPy."""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import tippe

sys.path.append(str(Path(__file__).parents[2] / "tests" / "witnesses"))
import euler_angles

#: Sizes of eta or x, theta, phi and the rates of eta or x, y, theta, phi, psi.
SIZES = np.array([1.0, 1.0, 1.0, 10.0, 0.1, 10.0, 10.0, 10.0])


def theta_by_lagrange(scene: tippe.Scene, launch: tippe.Launch, times: np.ndarray) -> np.ndarray:
    """theta [rad] at the given times, by DOP853 at 1e-13 on `by_lagrange` of `tests/witnesses/euler_angles.py`.

    The chart is singular where sin(theta) = 0; a run that comes close to a pole loses digits there.
    """

    def rate(_, angles):
        angles = jnp.asarray(angles)
        return np.asarray(euler_angles.state_rate(euler_angles.by_lagrange(scene, angles), angles))

    start = euler_angles.from_vector_state(scene, scene.state(launch))
    solution = solve_ivp(rate, (0.0, times[-1]), start, "DOP853", times, rtol=1e-13, atol=1e-14 * SIZES)
    assert solution.success
    # Past a pole the chart's theta goes on with the other sign.
    return np.arccos(np.cos(solution.y[1]))
