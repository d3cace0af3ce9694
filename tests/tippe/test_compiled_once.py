"""A program is compiled once for each kind of scene: a second call with other numbers compiles nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from tops import rutstam_top

import tippe

T1, TOLERANCE = 0.2, 1e-4


def stemmed_top() -> tippe.Top:
    """A classroom top that stands on its stem in the end."""
    return tippe.Top(0.006, 0.0133, 0.00217, 3.95e-07, 3.77e-07, stem=tippe.Stem(0.00557, 0.0155))


def egg() -> tippe.SpheroidBody:
    return tippe.SpheroidBody(0.05, 0.02, 0.028, 1.184e-5, 8e-6)


#: Every kind of scene, as a function of the coefficient of friction.
SCENES = {
    "smooth": lambda mu: tippe.Scene(rutstam_top(), friction=tippe.Viscous(mu)),
    "hybrid": lambda mu: tippe.Scene(rutstam_top(), friction=tippe.Viscous(mu), contact="hybrid"),
    "set-valued": lambda mu: tippe.Scene(rutstam_top(), friction=tippe.SetValuedCoulomb(mu)),
    "stem": lambda mu: tippe.Scene(stemmed_top(), friction=tippe.Coulomb(mu, 0.05), contact="hybrid", restitution=0.2),
    "arena": lambda mu: tippe.Scene(rutstam_top(), tippe.Sphere(0.3), tippe.Viscous(mu)),
    "hybrid arena": lambda mu: tippe.Scene(rutstam_top(), tippe.Sphere(0.3), tippe.Viscous(mu), contact="hybrid"),
    "egg": lambda mu: tippe.Scene(egg(), friction=tippe.Coulomb(mu, 0.05)),
}

#: Those whose runs are one smooth motion.
SMOOTH = ("smooth", "arena", "egg")


def launch(theta=0.1):
    return tippe.Launch(theta, 155.0)


def time(scene, mu, theta=0.1):
    return tippe.inversion_time(scene(mu), launch(theta), T1, 0.15, tolerance=TOLERANCE)


def last_time(scene, mu):
    return tippe.inversion_time(scene(mu), launch(), T1, 0.15, tolerance=TOLERANCE, crossing="last")


def extended(scene, mu):
    return tippe.extended_inversion_time(scene(mu), launch(), T1, 0.15, tolerance=TOLERANCE)


def end(scene, mu):
    times = jnp.array([0.5 * T1, T1])
    return tippe.simulate(scene(mu), launch(), T1, times, tolerance=TOLERANCE).theta[-1]


def pair(function):
    return lambda scene, mu: jax.vmap(lambda number: function(scene, number))(jnp.array([mu, mu + 0.01]))


def slope(function):
    return lambda scene, mu: jax.grad(lambda number: function(scene, number))(mu)


def slopes(scene, mu):
    return jax.grad(lambda point: time(scene, *point))(jnp.array([mu, 0.1]))


def table(scene, mu, **options):
    return tippe.inversion_table(
        scene(mu), theta=[0.1, 0.2], spin=155.0, t1=T1, angle=0.15, tolerance=TOLERANCE, **options
    )


#: The public functions that compute, in every way in which they can be called.
CALLS = {
    "time": time,
    "time, grad": slope(time),
    "time, grad by two": slopes,
    "time, vmap": pair(time),
    "time, vmap of grad": lambda scene, mu: jax.vmap(jax.grad(lambda number: time(scene, number)))(
        jnp.array([mu, mu + 0.01])
    ),
    "time, hessian": lambda scene, mu: jax.hessian(lambda number: time(scene, number))(mu),
    "last time": last_time,
    "last time, grad": slope(last_time),
    "extended": extended,
    "extended, grad": slope(extended),
    "extended, vmap": pair(extended),
    "path": lambda scene, mu: tippe.simulate(scene(mu), launch(), T1, tolerance=TOLERANCE).at([0.1]).theta,
    "path, grad": slope(end),
    "path, vmap": pair(end),
    "table": table,
    "table with errors": lambda scene, mu: table(scene, mu, errors=True),
    "table with slopes": lambda scene, mu: table(scene, mu, sensitivities=["mu"]),
    "table of paths": lambda scene, mu: tippe.trajectory_table(
        scene(mu), theta=[0.1, 0.2], spin=155.0, times=np.linspace(0.0, T1, 5), tolerance=TOLERANCE
    ),
    "exponent": lambda scene, mu: tippe.lyapunov_exponent(scene(mu), launch(), T1, tolerance=TOLERANCE),
    "fit": lambda scene, mu: tippe.identify(
        scene(0.3), tippe.InversionTimes(launch([0.1, 0.2]), [0.1, 0.5 * mu], error=0.1, t1=T1, angle=0.25), {"mu": mu}
    ),
}

#: What has no meaning through modes, and is refused there.
SMOOTH_ONLY = ("time, hessian", "extended", "table of paths", "exponent")


def is_refused(kind, call):
    if kind not in SMOOTH and call.startswith(SMOOTH_ONLY):
        return True
    # The last time at which a stem takes over has no derivatives.
    if kind == "stem" and call == "last time, grad":
        return True
    # A fit of an egg or a stem takes long, and compiles nothing that the other calls do not.
    return kind == "set-valued" and call.startswith("path,")


def compiles_once(kind, call):
    scene, function = SCENES[kind], CALLS[call]
    first = compilations(function, scene, 0.3)
    assert compilations(function, scene, 0.31) == 0
    return first


CHEAP = [("smooth", "time, grad"), ("arena", "path")]


@pytest.mark.oldest
@pytest.mark.parametrize(("kind", "call"), CHEAP)
def test_a_second_call_with_other_numbers_compiles_nothing(kind, call):
    compiles_once(kind, call)


@pytest.mark.slow
# Two times of such short runs do not determine the friction.
@pytest.mark.filterwarnings("ignore::tippe.FitWarning")
@pytest.mark.parametrize(
    ("kind", "call"), [(kind, call) for kind in SCENES for call in CALLS if not is_refused(kind, call)]
)
def test_every_function_compiles_once_for_every_kind_of_scene(kind, call):
    compiles_once(kind, call)
