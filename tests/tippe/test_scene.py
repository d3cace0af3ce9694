"""Scenes, tops, laws and launches: what is refused, and what an evaluation costs."""

import math
from collections import Counter

import jax
import jax.numpy as jnp
import pytest
from close import assert_close
from jax.interpreters.partial_eval import dce_jaxpr
from tops import random_states, rutstam_top

import tippe
from nonholonomic.validation import all_bounds, legal

pytestmark = pytest.mark.oldest

GOOD = {"mass": 0.02, "radius": 0.02, "offset": 0.006, "I1": 3e-6, "I3": 3.2e-6}
EGG = {"mass": 0.05, "equatorial": 0.02, "polar": 0.028, "I1": 1.184e-5, "I3": 8e-6}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": -1.0}, "mass = -1.0 must be greater than 0.0"),
        ({"mass": 0.0}, "mass = 0.0 must be greater than 0.0"),
        ({"mass": math.nan}, "mass = nan must be finite"),
        ({"mass": "heavy"}, "mass = 'heavy' is not a number"),
        ({"mass": "1"}, "mass = '1' is not a number"),
        ({"radius": math.inf}, "radius = inf must be finite"),
        ({"offset": 0.02}, "offset = 0.02 must be less than 0.02"),
        ({"offset": -0.001}, "offset = -0.001 must be at least 0.0"),
        ({"I1": 0.0}, "I1 = 0.0 must be greater than 0.0"),
        ({"I3": 6.1e-6}, "I3 = 6.1e-06 must be at most 6e-06"),
    ],
)
def test_impossible_tops_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        tippe.Top(**(GOOD | change))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: tippe.Viscous(-0.1), "mu = -0.1 must be at least 0.0"),
        (lambda: tippe.Coulomb(0.3, 0.0), "slip_speed = 0.0 must be greater than 0.0"),
        (lambda: tippe.Coulomb(math.nan, 0.1), "mu = nan must be finite"),
        (lambda: tippe.Contensou(-0.1, 1e-3, 0.1), "mu = -0.1 must be at least 0.0"),
        (lambda: tippe.Contensou(0.3, -1e-3, 0.1), "contact_radius = -0.001 must be at least 0.0"),
        (lambda: tippe.Contensou(0.3, 1e-3, 0.0), "slip_speed = 0.0 must be greater than 0.0"),
        (lambda: tippe.Rolling(-1e-4, 1.0, tippe.Viscous(0.3)), "resistance = -0.0001 must be at least 0.0"),
        (lambda: tippe.Rolling(1e-4, 0.0, tippe.Viscous(0.3)), "turning_speed = 0.0 must be greater than 0.0"),
        (lambda: tippe.Rolling(1e-4, 1.0, 0.3), "sliding = 0.3 must be a Friction"),
        (
            lambda: tippe.Rolling(0.0, 1.0, tippe.Rolling(0.0, 1.0, tippe.Viscous(0.3))),
            "must be a sliding law with a force",
        ),
        (lambda: tippe.Cylinder(0.0), "surface radius = 0.0 must be greater than 0.0"),
        (lambda: tippe.Scene(rutstam_top(), tippe.Cylinder(0.02)), "surface radius = 0.02 must be greater than 0.02"),
        (lambda: tippe.Scene(rutstam_top(), tippe.Sphere(0.01)), "surface radius = 0.01 must be greater than 0.02"),
        (lambda: tippe.Scene(rutstam_top(), gravity=-9.81), "gravity = -9.81 must be greater than 0.0"),
        (lambda: tippe.Scene(rutstam_top(), surface="plane"), "surface = 'plane' must be a Surface"),
        (lambda: tippe.Scene(rutstam_top(), friction=0.3), "friction = 0.3 must be a Friction"),
        (lambda: tippe.Scene("top"), "body = 'top' must be a Top"),
        (lambda: tippe.SpheroidBody(**(EGG | {"polar": 0.0})), "polar = 0.0 must be greater than 0.0"),
        (lambda: tippe.SpheroidBody(**(EGG | {"offset": 0.03})), "offset = 0.03 must be less than 0.028"),
        (lambda: tippe.ConvexBody(0.05, 0.02, 1e-5, 8e-6), r"support = 0.02 must be a function of \(c\)"),
        (
            lambda: tippe.ConvexBody(0.05, lambda c: 0.02 - 0.03 * c, 1e-5, 8e-6),
            r"least support = -0.0\d* must be greater than 0.0 \(the centre of mass",
        ),
        (
            lambda: tippe.ConvexBody(0.05, lambda c: 0.02 - 0.01 * c * c, 1e-5, 8e-6),
            "least radius of curvature by supp",
        ),
        (lambda: tippe.Scene(tippe.SpheroidBody(**EGG), tippe.Sphere(1.0)), "must be a Plane for a SpheroidBody"),
        (lambda: tippe.Scene(tippe.SpheroidBody(**EGG), contact="hybrid"), "must be 'stop' for a SpheroidBody"),
        (
            lambda: tippe.Scene(tippe.SpheroidBody(**EGG), friction=tippe.SetValuedCoulomb(0.3)),
            r"friction = SetValuedCoulomb\(mu=0.3\) must be a law with a single mode for a SpheroidBody",
        ),
        (lambda: tippe.steady.jellett_thresholds(tippe.Scene(tippe.SpheroidBody(**EGG))), "must be a Top"),
        (lambda: tippe.Launch(-0.1, 100.0), "theta = -0.1 must be at least 0.0"),
        (lambda: tippe.Launch(3.2, 100.0), "theta = 3.2 must be at most pi rad"),
        (lambda: tippe.Launch(0.1, math.nan), "spin = nan must be finite"),
        (lambda: tippe.Launch(0.1, 100.0, eta=4.0), "eta = 4.0 must be at most pi rad"),
    ],
)
def test_bad_scenes_and_launches_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_traced_numbers_pass_the_checks():
    """A scene can be built inside a transformation, whatever the numbers."""
    energy = jax.jit(lambda mass: tippe.Scene(tippe.Top(mass, 0.02, 0.006, 3e-6, 3.2e-6)).body.mass * 2.0)
    assert energy(-1.0) == -2.0


@pytest.mark.parametrize(
    ("make", "good", "bad"),
    [
        (lambda x: tippe.Top(**(GOOD | {"mass": x})), 0.02, 0.0),
        (lambda x: tippe.Top(**(GOOD | {"offset": x})), 0.0, 0.02),
        (lambda x: tippe.Top(**(GOOD | {"I1": x})), 3e-6, 1.5e-6),
        (lambda x: tippe.Stem(0.005, x), 0.018, 0.0),
        (lambda x: tippe.SpheroidBody(**(EGG | {"equatorial": x})), 0.03, -0.03),
        (lambda x: tippe.ConvexBody(0.05, lambda c: 0.02 - x * c, 1e-5, 8e-6), 0.019, 0.021),
        (lambda x: tippe.Launch(x, 100.0), math.pi, 3.2),
        (lambda x: tippe.Launch(0.1, x), -100.0, math.nan),
        (lambda x: tippe.Launch(0.1, 100.0, eta=x), -3.0, -4.0),
        (lambda x: tippe.Scene(rutstam_top(), gravity=x), 1.6, 0.0),
        (lambda x: tippe.Scene(rutstam_top(), tippe.Cylinder(x)), 0.021, 0.02),
        (lambda x: tippe.Scene(rutstam_top(), tippe.Sphere(x)), 0.021, 0.01),
        (lambda x: tippe.Scene(rutstam_top(), contact="hybrid", restitution=x), 1.0, 1.1),
        (lambda x: tippe.Scene(rutstam_top(), friction=tippe.Viscous(x)), 0.0, -0.1),
        (lambda x: tippe.Coulomb(0.3, x), 0.1, 0.0),
        (lambda x: tippe.Contensou(0.3, x, 0.1), 0.0, math.inf),
        (lambda x: tippe.Rolling(1e-4, x, tippe.Viscous(0.3)), 1.0, 0.0),
        (lambda x: tippe.Rolling(1e-4, 1.0, tippe.Viscous(x)), 0.3, -0.3),
        (lambda x: tippe.SetValuedCoulomb(x), 0.0, -0.1),
    ],
)
def test_what_constructors_refuse_a_trace_knows_to_be_illegal(make, good, bad):
    """One statement of every range serves both."""
    legality = jax.vmap(lambda number: legal(all_bounds(make(number))))(jnp.array([good, bad]))
    assert legality.tolist() == [True, False]
    make(good)
    with pytest.raises(ValueError, match="must be"):
        make(bad)


#: The lean field's cost in tippe.md, section 2 (i)-(iii), counted by operator overloading.
YARDSTICK = {
    ("plane", "frictionless"): 53,
    ("plane", "viscous"): 63,
    ("plane", "coulomb"): 69,
    ("plane", "contensou"): 77,
    ("cylinder", "viscous"): 83,
    ("cylinder", "coulomb"): 89,
    ("sphere", "viscous"): 101,
    ("sphere", "coulomb"): 107,
}


@pytest.mark.parametrize(("arena", "law"), YARDSTICK)
def test_the_field_costs_what_the_lean_one_does(arena, law):
    """A scene evaluates only the terms it has: within 2 operations of the yardstick, no trigonometry, no power."""
    surface = {"plane": tippe.Plane(), "cylinder": tippe.Cylinder(0.3), "sphere": tippe.Sphere(0.3)}[arena]
    friction = {"frictionless": tippe.Frictionless(), "viscous": tippe.Viscous(0.3), "coulomb": tippe.Coulomb(0.3, 0.1)}
    friction["contensou"] = tippe.Contensou(0.3, 5e-4, 0.1)
    scene = tippe.Scene(rutstam_top(), surface, friction[law])
    dynamics, states = scene.dynamics, random_states(scene, 7)
    program = jax.make_jaxpr(lambda state: dynamics.motion(state).rate)(states).jaxpr
    # Without what nothing depends on, which the compiler leaves out.
    equations = dce_jaxpr(program, [True] * len(program.outvars))[0].eqns
    # Values that are stored together with their tangents pass through unchanged.
    stored = [equation for equation in equations if equation.primitive.name == "custom_jvp_call"]
    assert not any(equation.params["call_jaxpr"].jaxpr.eqns for equation in stored)
    equations = [equation for equation in equations if equation not in stored]
    primitives = {"squeeze", "slice", "broadcast_in_dim", "neg", "unstack"}
    arithmetic = {"add", "sub", "mul", "div", "sqrt"}
    results = [
        (equation.primitive.name, result.aval.shape) for equation in equations for result in equation.outvars[:1]
    ]
    on_lanes = Counter(name for name, shape in results if shape == (7,))
    assert set(on_lanes) <= arithmetic | primitives
    assert sum(count for name, count in on_lanes.items() if name in arithmetic) <= YARDSTICK[arena, law] + 2


def test_one_function_serves_one_state_and_a_block():
    """A field on (components,) and on (components, lanes), and with one scene a lane, gives the same numbers."""
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), tippe.Coulomb(0.3, 0.1))
    states = random_states(scene, 5)
    block = scene.field(states)
    for lane in range(5):
        assert_close(scene.field(states[:, lane]), block[:, lane], rtol=1e-12, atol=1e-12)
    scenes = tippe.Scene(rutstam_top(), tippe.Cylinder(jnp.full(5, 0.3)), tippe.Coulomb(jnp.full(5, 0.3), 0.1))
    assert_close(scenes.field(states), block, rtol=1e-12, atol=1e-12)


def test_the_margin_of_a_contact_has_its_slope_however_it_is_compiled(rutstam_scene):
    """A compiler may compute a margin again, with another rounding: a slope that asks which one is the least is lost then."""
    states, ways = (random_states(rutstam_scene, 100, seed) for seed in (1, 2))
    margin = rutstam_scene.dynamics.contact_margin

    @jax.jit
    def slopes(state, way):
        slope = jax.grad(margin)(state) @ way
        return slope, (margin(state + 1e-6 * way) - margin(state - 1e-6 * way)) / 2e-6

    derivatives, expected = jax.vmap(slopes, in_axes=-1)(states, ways)
    assert_close(derivatives, expected, rtol=1e-5, atol=1e-5)
