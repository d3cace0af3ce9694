"""The production equations against four formulations of the stroller in coordinates, from one set of data."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from other_formulations import ConstrainedConnection, Multipliers, ReducedBracket
from stroller_chart import Chart, coordinates, coordinates_and_rates

import stroller
from nonholonomic.systems.mechanics import Hamel
from stroller import Damping, Frictionless, Launch, Plane, RollingResistance, Scene, Spheroid, Stroller

FORMULATIONS = (Multipliers, Hamel, ConstrainedConnection, ReducedBracket)
BODY = Stroller(mass=1.7, wheelbase=0.7, inertia=0.4, steering_inertia=0.05, steering_spring=0.3)
GROUNDS = {
    "plane": dict(surface=Plane(tilt=0.3)),
    "intrinsic outside": dict(surface=Spheroid(2.0, 1.1)),
    "intrinsic inside": dict(surface=Spheroid(2.0, 1.1), side="inside"),
    "projected": dict(surface=Spheroid(2.0, 1.1), heading="projected", side="inside"),
}
#: The other pairs are slow.
QUICK = [("plane", "absolute")]
CASES = [
    pytest.param(ground, fork, marks=[] if (ground, fork) in QUICK else [pytest.mark.slow])
    for ground in ("plane", "intrinsic inside", "projected")
    for fork in ("relative", "absolute")
]


class Push(eqx.Module):
    """A drive and a steering torque that depend on time, place and motion; both scale with `gain`."""

    gain: jax.Array

    def __call__(self, t, motion):
        drive = jnp.cos(t) - 0.4 * motion.speed * motion.position[0]
        return self.gain * drive, self.gain * (jnp.sin(2.0 * t) - motion.steering + 0.3 * motion.heading[1])


def random_launches(scene, count):
    """Launches all over the ground, away from the poles and the equator where the coordinates fail."""
    random = np.random.default_rng(2026)

    def spread(low, high):
        return random.uniform(low, high, count)

    place = (spread(-2, 2), spread(-2, 2))
    if not isinstance(scene.surface, Plane):
        place = (spread(-3, 3), spread(0.15, 1.4) * random.choice([-1.0, 1.0], count))
    # The front wheel points forward or backward.
    steering = np.angle(np.exp(1j * (spread(-1.45, 1.45) + np.pi * random.choice([0.0, 1.0], count))))
    return Launch(place, spread(-3, 3), spread(-2, 2), steering, spread(-2, 2))


def relative(value, expected):
    return jnp.max(jnp.abs(value - expected)) / (1.0 + jnp.max(jnp.abs(expected)))


@eqx.filter_jit
def disagreements(scene, push, states):
    """Per state: of the four accelerations with the P-form's, of the side and normal forces, energies, constraints."""
    chart = Chart(scene, push)

    def errors_at(state):
        t = jnp.asarray(0.3)
        (q, rate), (_, expected) = jax.jvp(
            lambda state: coordinates_and_rates(scene, t, state, push),
            (state,),
            (scene.dynamics.field(t, state, push),),
        )
        errors = [relative(kind(chart).acceleration(t, q, rate), expected) for kind in FORMULATIONS]
        forces = Multipliers(chart).multipliers(t, q, rate)
        side = relative(jnp.concatenate(scene.dynamics.side_force(t[None], state[:, None], push)), forces)
        normal = relative(scene.contact(state), chart.normal_force(q, rate))
        energy = relative(scene.energy(state), chart.energy(q, rate))
        slip = jnp.max(jnp.abs(chart.constraints(q) @ rate))
        return jnp.stack([*errors, side, normal, energy, slip])

    return jax.vmap(errors_at, in_axes=1)(states)


@pytest.mark.parametrize(("ground", "fork"), CASES)
def test_accelerations_and_forces_agree_at_a_thousand_states(ground, fork):
    """Section 6, F1 to F4 against the P-form: every ground, both forks, free and with everything on."""
    for friction, gain in ((Damping(0.0), 0.0), (Damping(0.3, 0.2, 0.1, 0.15), 0.7)):
        body = BODY if gain else eqx.tree_at(lambda body: body.steering_spring, BODY, jnp.zeros(()))
        scene = Scene(body, friction=friction, fork=fork, **GROUNDS[ground])
        errors = disagreements(scene, Push(jnp.asarray(gain)), scene.state(random_launches(scene, 1000), driven=True))
        np.testing.assert_allclose(errors, 0.0, atol=1e-11)


@pytest.mark.slow
def test_accelerations_agree_with_rolling_resistance():
    """The loads on which rolling resistance depends agree too, on both axles where the centre of mass is ahead."""
    body = Stroller(1.7, 0.7, 0.9, 0.05, centre=0.3)
    scene = Scene(body, Plane(0.3), RollingResistance(0.1, 0.2), fork="absolute")
    states = scene.state(random_launches(scene, 1000), driven=True)
    np.testing.assert_allclose(disagreements(scene, Push(jnp.asarray(0.7)), states), 0.0, atol=1e-11)


#: Where the accelerations agree, so must the trajectories: one of them is followed in the ordinary run.
TRAJECTORIES = [
    ("intrinsic inside", "relative", Damping(0.3, 0.2, 0.1, 0.15), Launch((0.3, -0.9), 0.5, 1.2, 0.3, 0.2)),
    *(
        pytest.param(*case, marks=pytest.mark.slow)
        for case in (
            ("plane", "absolute", Damping(0.3, 0.2, 0.1, 0.15), Launch((0.2, -0.3), 0.4, 1.2, 0.3, 0.5)),
            ("intrinsic outside", "absolute", Frictionless(), Launch((0.3, 0.5), 0.1, 1.2, 0.3, 0.2)),
            ("projected", "relative", Damping(0.3, 0.2, 0.1, 0.15), Launch((0.3, -1.0), 0.5, 0.6, 0.4, 0.0)),
        )
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("ground", "fork", "friction", "launch"), TRAJECTORIES)
def test_trajectories_agree_over_ten_seconds(ground, fork, friction, launch):
    """The four formulations, integrated side by side, and the P-form end at the same coordinates."""
    scene = Scene(BODY, friction=friction, fork=fork, gravity=1.5, **GROUNDS[ground])
    push = Push(jnp.asarray(0.2))
    run = stroller.simulate(scene, launch, 10.0, push, times=[0.0, 5.0, 10.0], tolerance=1e-12)
    chart = Chart(scene, push)
    q, rate = jax.jit(lambda state: coordinates_and_rates(scene, 0.0, state, push))(run.state[0])
    formulations = [kind(chart) for kind in FORMULATIONS]

    def field(t, states, args):
        return [formulation.field(t, state) for formulation, state in zip(formulations, states, strict=True)]

    sol = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Dopri8(),
        0.0,
        10.0,
        None,
        [formulation.state(q, rate) for formulation in formulations],
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
    )
    expected = coordinates(scene, run.state[-1])
    for state in sol.ys:
        difference = state[0, :4] - expected
        # The angles are known up to whole turns.
        whole_turns = jnp.round(difference / (2.0 * jnp.pi)) * jnp.array([ground != "plane", ground != "plane", 1, 0])
        np.testing.assert_allclose(difference - 2.0 * jnp.pi * whole_turns, 0.0, atol=1e-9)


class UnitSpeed(Chart):
    """The chart with the rear axle's unit speed as its first field, X1 = long + tan(phi) / l yaw."""

    def frame(self, q):
        fields = super().frame(q)
        return fields.at[:, 0].divide(jnp.cos(q[3]))


@pytest.mark.parametrize(
    ("ground", "fork"),
    [
        ("plane", "relative"),
        ("intrinsic outside", "absolute"),
        pytest.param("plane", "absolute", marks=pytest.mark.slow),
        pytest.param("intrinsic outside", "relative", marks=pytest.mark.slow),
    ],
)
def test_coefficients_of_the_constrained_connection(ground, fork):
    """Section 6, F3: Gamma^1_21 = M' / (2M), alone with a relative fork; Gamma^2_21 besides with an absolute one."""
    chart = UnitSpeed(Scene(BODY, fork=fork, **GROUNDS[ground]))
    phi, mass, length, inertia = 0.6, 1.7, 0.7, 0.4
    gamma = jax.jit(lambda q: ConstrainedConnection(chart).coefficients(q))(jnp.array([0.5, 0.2, 0.9, phi]))
    secant2, tangent = 1.0 / np.cos(phi) ** 2, np.tan(phi)
    growth = inertia * tangent * secant2 / length**2 / (mass + inertia * tangent**2 / length**2)
    expected = np.zeros((2, 2, 2))
    expected[0, 1, 0] = growth
    if fork == "absolute":
        expected[1, 1, 0] = secant2 / length - tangent / length * growth
    np.testing.assert_allclose(gamma, expected, atol=1e-13)


def test_reduced_bracket_of_the_plane():
    """Section 6, F4: the bracket's entry is M' v / 2, p~1 = M v, p~2 = J_f s, so p~1' = M' s v / 2 without forces."""
    chart = UnitSpeed(Scene(Stroller(1.7, 0.7, 0.4, 0.05)))
    v, s, phi = 1.3, 0.8, 0.6
    q, rate = jnp.array([0.0, 0.0, 0.0, phi]), jnp.array([v, 0.0, v * jnp.tan(phi) / 0.7, s])
    formulation = ReducedBracket(chart)
    state = jax.jit(lambda q, rate: formulation.state(q, rate))(q, rate)
    inertia = 1.7 + 0.4 * np.tan(phi) ** 2 / 0.49
    slope = 2.0 * 0.4 * np.tan(phi) / np.cos(phi) ** 2 / 0.49
    np.testing.assert_allclose(state[4:], [inertia * v, 0.05 * s], rtol=1e-14)
    field = jax.jit(lambda state: formulation.field(0.0, state))(state)
    np.testing.assert_allclose(field[4:], [slope * s * v / 2.0, 0.0], atol=1e-14)


def test_momentum_projection_keeps_the_constraints_through_a_coarse_integration():
    """Section 9: RK4 with a step of 0.02 s drifts by about 1e-6 in 20 s; projected it does not."""
    chart = Chart(Scene(BODY, surface=Plane(0.3)))
    q, rate = jnp.array([0.0, 0.0, 0.4, 0.3]), jnp.array([0.0, 0.0, 0.0, 0.5])

    def drift(formulation):
        def step(state, _):
            h, f = 0.02, lambda y: formulation.field(0.0, y)
            k1 = f(state)
            k2 = f(state + h / 2 * k1)
            k3 = f(state + h / 2 * k2)
            k4 = f(state + h * k3)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            q, rate = formulation.split(state)
            return state, jnp.max(jnp.abs(chart.constraints(q) @ rate))

        return jnp.max(jax.lax.scan(step, formulation.state(q, rate), length=1000)[1])

    bare, projected = jax.jit(drift)(Multipliers(chart)), jax.jit(drift)(Multipliers(chart, project=True))
    assert 1e-9 < float(bare) < 1e-3
    assert float(projected) < 1e-13
