"""The group of a top, and the thresholds of its standing motions on the plane, in closed form."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.validation import shown

from ..model.scene import Scene
from ..model.top import Top
from .checks import require_one_top, require_scene_of_a_top, require_top


def proportions(body: Top) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """The two numbers that classify a top: alpha = a / R and gamma = I1 / I3.

    **Raises:** `ValueError` for a body other than a `Top`, for which these formulas do not hold.

    **Example:** with the scene of the module.

    >>> alpha, gamma = steady.proportions(top)
    >>> print(f"{alpha:.2f} {gamma:.3f}")
    0.30 0.936
    """
    require_top(body)
    return body.offset / body.radius, body.I1 / body.I3


def group(body: Top) -> str:
    """The group of a top (Rutstam 2012; Ciocci et al. 2012).

    **Returns:** "I" if gamma < 1 - alpha: the top stands upright at every spin; "III" if gamma > 1 + alpha: the top
    never stands inverted, and ends tumbling; "II" otherwise: the top inverts if Jellett's constant is large enough.

    **Example:** with the scene of the module.

    >>> steady.group(top)
    'II'
    """
    require_one_top(body, "steady.group")
    alpha, gamma = (float(number) for number in proportions(body))
    return "I" if gamma <= 1.0 - alpha else "III" if gamma >= 1.0 + alpha else "II"


def folds(body: Top) -> bool:
    """Whether Jellett's constant has an extremum over the tumbling angles of a top of group II, which causes
    hysteresis.

    There is none if gamma > 1 - delta, delta = (1 + 6 alpha + alpha^2 - (1 - alpha) sqrt(1 + 14 alpha + alpha^2)) / 8.

    **Example:** with the scene of the module.

    >>> steady.folds(top), steady.folds(tippe.Top(0.02, 0.02, 0.006, I1=2.5e-6, I3=3.2e-6))
    (False, True)
    """
    require_one_top(body, "steady.folds")
    alpha, gamma = proportions(body)
    delta = (1.0 + 6.0 * alpha + alpha**2 - (1.0 - alpha) * jnp.sqrt(1.0 + 14.0 * alpha + alpha**2)) / 8.0
    return bool(gamma < 1.0 - delta)


def upright_critical_spin(scene: Scene[Top]) -> Float[Array, "..."]:
    """Spin [rad/s] above which the upright top on the plane is unstable; infinite if there is none. omega^2 = m g a (1
    - alpha)^2 / (I3 (gamma - 1 + alpha)).

    **Example:** with the scene of the module.

    >>> print(f"{steady.upright_critical_spin(scene):.1f} rad/s")
    27.7 rad/s
    """
    require_scene_of_a_top(scene)
    alpha, gamma = proportions(scene.body)
    weight = scene.body.mass * scene.gravity * scene.body.offset
    return _root_of_ratio(weight * (1.0 - alpha) ** 2 / scene.body.I3, gamma - 1.0 + alpha)


def inverted_critical_spin(scene: Scene[Top]) -> Float[Array, "..."]:
    """Spin [rad/s] above which the inverted top on the plane (on its stem, if any) is stable; infinite if there is
    none. omega^2 = m g a (1 + alpha)^2 / (I3 (1 + alpha - gamma)), for a stem with its offset and radius (`tippe.md`,
    sections 4, 6).

    **Example:** with the scene of the module.

    >>> print(f"{steady.inverted_critical_spin(scene):.1f} rad/s")
    41.3 rad/s
    """
    require_scene_of_a_top(scene)
    (_, gamma), body = proportions(scene.body), scene.body
    sphere = body if body.stem is None else body.stem
    alpha, weight = sphere.offset / sphere.radius, body.mass * scene.gravity * sphere.offset
    return _root_of_ratio(weight * (1.0 + alpha) ** 2 / body.I3, 1.0 + alpha - gamma)


def jellett_thresholds(scene: Scene[Top]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Jellett's constant [kg m^3/s] of the standing tops at their critical spins, upright and inverted.

    Below the first constant, the upright top is stable; above the second, the inverted top is stable (Rutstam's
    lambda_thres).

    **Raises:** `ValueError` for a top with a stem: Jellett's constants of its sphere and of its stem differ.

    **Example:** with the scene of the module.

    >>> print(" ".join(f"{jellett:.2e}" for jellett in steady.jellett_thresholds(scene)))
    1.24e-06 3.44e-06
    """
    require_scene_of_a_top(scene)
    (alpha, _), body = proportions(scene.body), scene.body
    if body.stem is not None:
        raise ValueError(
            f"stem = {shown(body.stem)} must be None: a top with a stem does not keep Jellett's constant as it inverts; "
            "upright_critical_spin and inverted_critical_spin say from which spin it leaves the upright position and stays "
            "on its stem"
        )
    upright = (1.0 - alpha) * body.radius * body.I3 * upright_critical_spin(scene)
    inverted = (1.0 + alpha) * body.radius * body.I3 * inverted_critical_spin(scene)
    return upright, inverted


def _root_of_ratio(value: Float[Array, "..."], excess: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root of value / excess, or infinity if the excess is not positive."""
    return jnp.where(excess > 0.0, jnp.sqrt(value / jnp.where(excess > 0.0, excess, 1.0)), jnp.inf)
