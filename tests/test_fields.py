"""No field that is integrated calls a function that XLA has no fast double-precision version of."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr
from tops import rutstam_top

import stroller
import tippe
from stroller.table import RideProblem
from tippe.trajectory import TrajectoryProblem

#: 16 to 44 ns for each number on a CPU, where a product takes one.
SLOW = {"sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp", "exp2", "expm1"}
SLOW |= {"log", "log1p", "logistic", "pow", "cbrt", "erf", "erf_inv"}


def is_program(parameter):
    """Whether a primitive's parameter is a program, open or closed."""
    return isinstance(parameter, Jaxpr | ClosedJaxpr)


def primitives(jaxpr):
    """The names of all primitives of a program, those of the functions that it calls included."""
    found = set()
    for equation in jaxpr.eqns:
        found.add(equation.primitive.name)
        for inner in jax.tree.leaves(equation.params, is_leaf=is_program):
            if is_program(inner):
                found |= primitives(getattr(inner, "jaxpr", inner))
    return found


def slow_in(function, *arguments):
    """Which slow functions a function calls."""
    return primitives(jax.make_jaxpr(function)(*arguments).jaxpr) & SLOW


def test_the_search_finds_what_is_hidden():
    inside = jax.jit(lambda x: jax.lax.cond(x > 0.0, jnp.sin, lambda x: x**0.3, x))
    assert slow_in(lambda x: jax.lax.fori_loop(0, 3, lambda i, x: inside(x), x), 1.0) == {"sin", "pow"}


ARENAS = (tippe.Plane(), tippe.Cylinder(0.3), tippe.Sphere(0.3))
LAWS = (
    tippe.Frictionless(),
    tippe.Viscous(0.3),
    tippe.Coulomb(0.3, 0.1),
    tippe.Contensou(0.3, 5e-4, 0.1),
    tippe.Rolling(1e-4, 1.0, tippe.Coulomb(0.3, 0.1)),
    tippe.SetValuedCoulomb(0.3),
)


@pytest.mark.parametrize(("arena", "law"), list(itertools.product(ARENAS, LAWS)), ids=lambda part: type(part).__name__)
def test_fields_of_the_top(arena, law):
    """The lean one, and that of a trajectory with its path and its spin angle."""
    scene, launch = tippe.Scene(rutstam_top(), arena, law), tippe.Launch(0.3, 100.0, eta=0.0)
    run, dynamics = TrajectoryProblem.of(scene, launch), scene.dynamics
    assert slow_in(dynamics.field, scene.state(launch)) == set()
    assert slow_in(run.field, jnp.zeros(()), run.start()[0]) == set()
    assert slow_in(dynamics.contact_margin, scene.state(launch)) == set()


def test_the_field_of_an_egg():
    body = tippe.SpheroidBody(mass=0.05, equatorial=0.02, polar=0.028, I1=1.184e-5, I3=8e-6, offset=0.003)
    scene, launch = tippe.Scene(body, tippe.Plane(0.1), LAWS[4]), tippe.Launch(1.3, 100.0)
    run = TrajectoryProblem.of(scene, launch)
    assert slow_in(run.field, jnp.zeros(()), run.start()[0]) == set()


GROUNDS = (stroller.Plane(), stroller.Plane(0.3), stroller.Sphere(2.0), stroller.Spheroid(2.0, 1.1))
FRICTIONS = (stroller.Frictionless(), stroller.Damping(0.3, 0.2, 0.1, 0.1), stroller.RollingResistance(0.1, 0.1))
PARTS = list(itertools.product(GROUNDS, FRICTIONS, (0.0, 20.0), ("intrinsic", "projected")))


@pytest.mark.parametrize(("ground", "friction", "spring", "heading"), PARTS, ids=lambda part: type(part).__name__)
def test_fields_of_the_stroller(ground, friction, spring, heading):
    """With a spring and without, as a ride and a table have it; tanh is what rolling resistance is, and it alone."""
    body = stroller.Stroller(1.7, 0.7, 0.4, 0.05, steering_spring=spring)
    scene = stroller.Scene(body, ground, friction, heading=heading)
    launch = stroller.Launch((0.3, 0.5), 0.5, 1.5, 0.2, 0.1)
    allowed = {"tanh"} if isinstance(friction, stroller.RollingResistance) else set()
    dynamics, pushed = scene.dynamics, stroller.Steady(1.0, 0.1)
    for controls in (None, pushed):
        state = scene.state(launch, controls is not None)
        assert slow_in(lambda t, state, controls=controls: dynamics.field(t, state, controls), 0.0, state) == allowed
    problem = RideProblem.of(scene, launch, None, 1, watched=True)
    states = problem.start()[0]
    assert slow_in(problem.field, jnp.zeros(1), states) == allowed
    rates = problem.field(jnp.zeros(1), states)
    along = functools.partial(problem.crossing_along, rate=rates)
    for watch in (lambda state: problem.guard(jnp.zeros(1), state), problem.crossing, along):
        assert watch(states) is None or slow_in(watch, states) == set()
    if problem.watched:
        np.testing.assert_allclose(along(states), problem.crossing(states), rtol=1e-14)
