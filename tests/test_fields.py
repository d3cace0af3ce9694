"""No field that is integrated calls a function that XLA has no fast double-precision version of."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.interpreters.partial_eval import dce_jaxpr
from tops import rutstam_top

import stroller
import tippe
from stroller.runs.model import RideModel
from tippe.modes.impact import FreeBody, Impact, Skid, approach, balls
from tippe.modes.problems import InversionProblem, trajectory_problem
from tippe.runs.model import TopModel, modes_of

#: 16 to 44 ns for each number on a CPU, where a product takes one.
SLOW = {"sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp", "exp2", "expm1"}
SLOW |= {"log", "log1p", "logistic", "pow", "cbrt", "erf", "erf_inv"}


def is_program(parameter):
    """Whether a primitive's parameter is a program, open or closed."""
    return isinstance(parameter, Jaxpr | ClosedJaxpr)


def primitives(jaxpr):
    """The names of all primitives of a program, those of the functions that it calls included."""
    kinds = set()
    for equation in jaxpr.eqns:
        kinds.add(equation.primitive.name)
        for inner in jax.tree.leaves(equation.params, is_leaf=is_program):
            if is_program(inner):
                kinds |= primitives(getattr(inner, "jaxpr", inner))
    return kinds


def slow_in(function, *arguments):
    """Which slow functions a function calls for what it returns; the numbers of its arguments may be shapes alone."""
    program = eqx.filter_make_jaxpr(function)(*arguments)[0].jaxpr
    return primitives(dce_jaxpr(program, [True] * len(program.outvars))[0]) & SLOW


def test_the_search_finds_what_is_hidden():
    jaxpr = jax.jit(lambda x: jax.lax.cond(x > 0.0, jnp.sin, lambda x: x**0.3, x))
    assert slow_in(lambda x: jax.lax.fori_loop(0, 3, lambda i, x: jaxpr(x), x), 1.0) == {"sin", "pow"}


def slow_in_problem(problem):
    """Which slow functions are called in the steps of a problem: by its field, and by what is watched."""
    start = eqx.filter_eval_shape(lambda problem: problem.start()[0], problem)
    time = jnp.zeros(start.shape[1:])
    parts = (
        lambda problem, state: problem.field(time, state),
        lambda problem, state: problem.domain_margin(time, state),
        lambda problem, state: problem.event_function(state),
    )
    return set().union(*(slow_in(part, problem, start) for part in parts))


def table_problems(scene, launch):
    """The problems that a table of the scene integrates: one, or that of every mode."""
    problem = InversionProblem.of(scene, launch, 3.0, 1)
    if TopModel(scene=scene, launch=launch).smooth:
        return (problem,)
    modes, _ = modes_of(scene, problem, 1e-9, True)
    return tuple(mode.problem(problem.states) for mode in modes)


def trajectory_problems(scene, launch):
    """The problems that `simulate` integrates, with all that rides along: one, or that of every mode."""
    model = TopModel(scene=scene, launch=launch)
    if model.smooth:
        return (trajectory_problem((scene, launch)),)
    modes, _, state = model.modes(1, 1e-9, None, False)
    return tuple(mode.problem(state) for mode in modes)


def slow_in_scene(scene, launch):
    """Which slow functions are called in the steps of a table of the scene, and of `simulate`; nothing compiles."""
    pair = (eqx.filter_eval_shape(problems, scene, launch) for problems in (table_problems, trajectory_problems))
    return set().union(*map(slow_in_problem, itertools.chain(*pair)))


#: Functions of the user's are what they are; these have no slow function, and the package adds none.
ARENAS = (
    tippe.Plane(),
    tippe.Plane(0.1),
    tippe.Cylinder(0.3),
    tippe.Sphere(0.3),
    tippe.Spheroid(0.3, 0.2),
    tippe.Torus(0.5, 0.2),
    tippe.Paraboloid(0.3),
    tippe.Graph(lambda x, y: x * x + 0.9 * y * y),
    tippe.Implicit(lambda x, y, z: 0.09 - x * x - y * y - 0.5 * z * z),
)
LAWS = (
    tippe.Frictionless(),
    tippe.Viscous(0.3),
    tippe.Coulomb(0.3, 0.1),
    tippe.Contensou(0.3, 5e-4, 0.1),
    tippe.Rolling(1e-4, 1.0, tippe.Coulomb(0.3, 0.1)),
    tippe.SetValuedCoulomb(0.3),
)
EGG = tippe.SpheroidBody(mass=0.05, equatorial=0.02, polar=0.028, I1=1.184e-5, I3=8e-6, offset=0.003)
BLUNT = tippe.ConvexBody(mass=0.05, support=lambda c: 0.02 - 1e-3 * c * (1.0 + c * c), I1=1.2e-5, I3=8e-6)
ON_A_STEM = tippe.Top(6e-3, 0.015, 3e-3, 8e-7, 7e-7, stem=tippe.Stem(radius=5e-3, offset=0.016))


def launched_in(arena):
    """A launch at the arena's lowest point, where it has one."""
    place = (0.0, 0.0, -np.sqrt(0.18)) if isinstance(arena, tippe.Implicit) else None
    return tippe.Launch(0.3, 100.0, place=place)


def name_of(part):
    return type(part).__name__


#: Every arena under the longest law; every law on a frame of its own and on a carried one; rolling on every frame.
SCENES = [*itertools.product(ARENAS, LAWS[4:5]), *itertools.product((ARENAS[0], ARENAS[4]), (*LAWS[:4], LAWS[5]))]
SCENES += [(arena, LAWS[5]) for arena in ARENAS[1:4]]


@pytest.mark.parametrize(("arena", "law"), SCENES, ids=name_of)
def test_fields_of_the_top(arena, law):
    """In contact, while it slips and while it rolls."""
    scene = tippe.Scene(rutstam_top(), arena, law)
    assert slow_in_scene(scene, launched_in(arena)) == set()


#: Every arena is flown over, and both laws with and without two kinds of motion are landed under.
FLIGHTS = [*itertools.product(ARENAS, LAWS[4:5]), *itertools.product((ARENAS[0], ARENAS[4]), LAWS[5:])]


@pytest.mark.parametrize(("arena", "law"), FLIGHTS, ids=name_of)
def test_fields_of_a_top_that_flies(arena, law):
    """In contact as it is seen from there, and in flight."""
    scene = tippe.Scene(rutstam_top(), arena, law, contact="hybrid")
    assert slow_in_scene(scene, launched_in(arena)) == set()


@pytest.mark.parametrize("arena", ARENAS[:4], ids=name_of)
def test_fields_of_a_top_with_a_stem(arena):
    """On either sphere, on both, and in flight."""
    scene = tippe.Scene(ON_A_STEM, arena, LAWS[4], contact="hybrid")
    assert slow_in_scene(scene, launched_in(arena)) == set()


@pytest.mark.parametrize("law", LAWS, ids=name_of)
def test_fields_of_impacts(law):
    def impact(body):
        one = jnp.ones(1)
        (ball,), free = balls(body), FreeBody((one, one, -one), one, (one, one, one), (one, one, one))
        outcome = Impact(body, law, approach(body, ball, free), ball.radius, one)
        return Skid(outcome, law.mu, one) if law.set_valued else outcome

    assert slow_in_problem(eqx.filter_eval_shape(impact, rutstam_top())) == set()


@pytest.mark.parametrize("body", [EGG, BLUNT], ids=name_of)
def test_fields_of_an_egg(body):
    for arena in ARENAS[:2]:
        assert slow_in_scene(tippe.Scene(body, arena, LAWS[4]), tippe.Launch(1.3, 100.0)) == set()


GROUNDS = (stroller.Plane(), stroller.Plane(0.3), stroller.Sphere(2.0), stroller.Spheroid(2.0, 1.1))
FRICTIONS = (stroller.Frictionless(), stroller.Damping(0.3, 0.2, 0.1, 0.1), stroller.RollingResistance(0.1, 0.1))
OTHERS = (
    stroller.Cylinder(2.0),
    stroller.Torus(3.0, 1.0),
    stroller.Paraboloid(0.5),
    stroller.Graph(lambda x, y: 0.1 * x * x - 0.2 * y * y),
    stroller.Implicit(lambda x, y, z: x * x + y * y + z * z - 4.0),
)
#: Every ground with every heading, and every friction; all pairs of both are slow.
PARTS = list(itertools.product(GROUNDS, FRICTIONS[1:2], (20.0,), ("intrinsic", "projected")))
PARTS += itertools.product(GROUNDS[1:2], FRICTIONS[::2], (20.0,), ("intrinsic",))
#: A fork without a spring needs no other ground.
PARTS += itertools.product(GROUNDS[1:2], FRICTIONS[:2], (0.0,), ("intrinsic",))
PARTS += itertools.product(OTHERS, FRICTIONS[1:2], (20.0,), ("intrinsic",))
PAIRS = itertools.product(GROUNDS, FRICTIONS[::2], (20.0,), ("intrinsic", "projected"))
PARTS += [pytest.param(*parts, marks=pytest.mark.slow) for parts in PAIRS if parts not in PARTS]


@pytest.mark.parametrize(("ground", "friction", "spring", "heading"), PARTS, ids=name_of)
def test_fields_of_the_stroller(ground, friction, spring, heading):
    """With a spring and without, as a ride and a table have it; tanh is what rolling resistance is, and it alone."""
    body = stroller.Stroller(1.7, 0.7, 0.4, 0.05, steering_spring=spring)
    scene = stroller.Scene(body, ground, friction, heading=heading)
    place = (0.0, 1.2, 1.6) if isinstance(ground, stroller.Implicit) else (0.3, 0.5)
    launch = stroller.Launch(place, 0.5, 1.5, 0.2, 0.1)
    allowed = {"tanh"} if isinstance(friction, stroller.RollingResistance) else set()
    dynamics, push = scene.dynamics, stroller.Steady(1.0, 0.1)
    for controls in (None, push):
        state = scene.state(launch, controls is not None)
        assert slow_in(lambda t, state, controls=controls: dynamics.field(t, state, controls), 0.0, state) == allowed
    problem = RideModel.of(scene, launch, None).problem(1, ())
    states = problem.start()[0]
    assert slow_in(problem.field, jnp.zeros(1), states) == allowed
    rates = problem.field(jnp.zeros(1), states)
    crossing = functools.partial(problem.crossing_along, rate=rates)
    for watch in (lambda state: problem.domain_margin(jnp.zeros(1), state), problem.event_function, crossing):
        assert watch(states) is None or slow_in(watch, states) == set()
    if problem.watched:
        np.testing.assert_allclose(crossing(states), problem.event_function(states), rtol=1e-14)
