"""The stability limits of standing tops on the lowest line of a cylinder, followed from the plane.

On a cylinder, Jellett's quantity is not constant and the formulas of the plane do not hold, but a top that stands on
the lowest line is still an exact equilibrium at every spin. Its marginal states, those with an eigenvalue i nu, form
curves in (curvature, spin, nu): two real equations in three unknowns, det(A(spin, curvature) - i nu) = 0. They are
followed by pseudo-arclength continuation, which passes folds, where one curvature has several critical spins.

There are no tumbling tops on a cylinder: a periodic motion has constant energy, so with friction it must not slip, but
on a cylinder, precession at a fixed inclination slips.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import Cylinder
from tippe.model.body import Top
from tippe.model.scene import Scene
from tippe.steady import inverted_critical_spin, standing_matrix, upright_critical_spin

#: Curvature ratio at the start of the curve: so close to the plane that the plane's critical spin is the first guess.
ALMOST_FLAT = 1e-9
#: Unit of R / rc in the arclength: a cylinder of ten radii is as far from the plane as a 100 % change of spin.
CURVATURE_UNIT = 0.1


class MarginalCurve(NamedTuple):
    """Points of a curve of marginal standing tops, each an array (points,).

    - `ratio`: R / rc, the curvature of the arena [1]; 0 is the plane.
    - `spin`: spin [rad/s] at which a pair of eigenvalues is imaginary.
    - `frequency`: the imaginary part nu of these eigenvalues [rad/s].
    """

    ratio: np.ndarray
    spin: np.ndarray
    frequency: np.ndarray


def marginal_curve(
    scene: Scene[Top],
    inverted: bool = False,
    start: tuple[float, float] | None = None,
    largest_ratio: float = 0.2,
    backwards: bool = False,
    step: float = 0.05,
    most_points: int = 400,
) -> MarginalCurve:
    """Follow a curve of marginal standing tops until it leaves 0 < R / rc < `largest_ratio`, or has `most_points`.

    **Arguments:**

    - `scene`: a `Scene` with friction and concrete numbers; its arena is replaced by cylinders.
    - `inverted`: whether the stem points into the arena.
    - `start`: (R / rc, spin [rad/s]) close to the first point; by default the plane and its critical spin.
    - `largest_ratio`: R / rc at which to stop, below 1.
    - `backwards`: whether to start towards smaller R / rc.
    - `step`: longest step in arclength, in units of the plane's critical spin and of R / rc = 0.1.

    **Returns:** a `MarginalCurve`.

    **Raises:** `ValueError` if the plane has no critical spin to start from; `RuntimeError` if the curve is lost.
    """
    if start is None:
        start = (ALMOST_FLAT, float((inverted_critical_spin if inverted else upright_critical_spin)(scene)))
    ratio, spin = start
    if not np.isfinite(spin):
        raise ValueError("this top has no critical spin on the plane to start from")
    rate = float(jnp.sqrt(scene.gravity / scene.body.radius))
    units = np.array([spin, rate, CURVATURE_UNIT])
    residual = functools.partial(_residual, scene, inverted, jnp.asarray(units))

    values = np.linalg.eigvals(np.asarray(standing_matrix(_on_cylinder(scene, ratio), spin, inverted)))
    swaying = values[values.imag > 1e-3 * rate]
    frequency = swaying[np.argmin(np.abs(swaying.real))].imag
    guess = np.array([1.0, frequency / rate, ratio / CURVATURE_UNIT])
    direction = np.array([0.0, 0.0, -1.0 if backwards else 1.0])
    point = _newton(residual, guess, direction)
    if point is None:
        raise RuntimeError(f"no marginal state was found near R / rc = {ratio}, spin = {spin}")

    points, length = [point], step
    while len(points) < most_points and 0.0 < points[-1][2] * CURVATURE_UNIT < largest_ratio:
        _, slope = residual(jnp.asarray(points[-1]))
        tangent = np.linalg.svd(np.asarray(slope))[2][-1]
        tangent *= np.sign(tangent @ direction)
        guess = points[-1] + length * tangent
        point = _newton(residual, guess, tangent)
        # A point far from its prediction belongs to another curve, or to another part of this one.
        if point is None or np.linalg.norm(point - guess) > 0.3 * length:
            length *= 0.5
            if length < 1e-6 * step:
                raise RuntimeError(f"the curve was lost at R / rc = {points[-1][2] * CURVATURE_UNIT}")
            continue
        points.append(point)
        direction, length = tangent, min(step, 1.5 * length)
    spin, frequency, ratio = (np.array(points) * units).T
    return MarginalCurve(ratio, spin, frequency)


def _on_cylinder(scene: Scene[Top], ratio: Float[Array, ""] | float) -> Scene:
    """The scene on a cylinder whose radius is the top's divided by `ratio`."""
    return Scene(scene.body, Cylinder(scene.body.radius / ratio), scene.friction, scene.gravity)


@eqx.filter_jit
def _residual(
    scene: Scene[Top], inverted: bool, units: Float[Array, " 3"], point: Float[Array, " 3"]
) -> tuple[Float[Array, " 2"], Float[Array, "2 3"]]:
    """Real and imaginary part of det(A - i nu) in units of sqrt(g / R), and their slope; point in the given units."""

    def determinant(point):
        spin, frequency, ratio = point * units
        matrix = standing_matrix(_on_cylinder(scene, ratio), spin, inverted)
        value = jnp.linalg.det((matrix - 1j * frequency * jnp.eye(len(matrix))) / units[1])
        return jnp.stack([value.real, value.imag])

    return determinant(point), jax.jacfwd(determinant)(point)


def _newton(residual: Callable[..., tuple[Array, Array]], guess: np.ndarray, normal: np.ndarray) -> np.ndarray | None:
    """The marginal point in the plane through the guess with the given normal, or None if Newton does not converge."""
    point = guess
    for _ in range(12):
        value, slope = residual(jnp.asarray(point))
        system = np.vstack([np.asarray(slope), normal])
        correction = np.linalg.solve(system, np.append(np.asarray(value), normal @ (point - guess)))
        point = point - correction
        if not np.all(np.isfinite(point)):
            return None
        if np.linalg.norm(correction) < 1e-12:
            return point
    return None
