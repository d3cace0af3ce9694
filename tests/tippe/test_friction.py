"""Friction with a torque: the disc it stands for, its potential, its limits, and what the laws refuse."""

import subprocess
import sys
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import lagrange_top
import numpy as np
import pytest
import reduced_tops
from close import assert_close
from hard.friction import hertz_disc
from tops import random_states, rutstam_top

import tippe
from tippe.friction import ContactLoad, Slip

ARENAS = {"plane": tippe.Plane(), "cylinder": tippe.Cylinder(0.3), "sphere": tippe.Sphere(0.3)}
BOTH = tippe.Rolling(2e-3, 3.0, tippe.Contensou(0.4, 4e-3, 0.1))


@pytest.mark.parametrize(
    ("ratio", "exact", "ellipsoid"),
    [
        (0.3, (0.3455, 0.5378), (0.4538, 0.5249)),
        (1.0, (0.8836, 0.2209), (0.8616, 0.2990)),
        (3.0, (0.9888, 0.0672), (0.9813, 0.1135)),
    ],
)
def test_contensou_has_the_values_of_the_disc_and_of_the_ellipsoid(ratio, exact, ellipsoid):
    """Force and torque at three ratios of sliding to drilling, to four digits (`tippe.md`, section 3)."""
    radius = 1e-3
    load = tippe.Contensou(1.0, radius, 1e-12).per_normal_force(Slip(ratio * radius, 0.0, (0.0, 0.0, 1.0)))
    assert_close([-load.force[0], -load.torque[2] / radius], ellipsoid, atol=5e-5)
    assert_close(hertz_disc(ratio), exact, atol=1e-4)


def test_the_load_is_the_gradient_of_the_dissipation_potential():
    """f = -d/dv and tau = -d/dw of mu Q and of resistance sqrt(w_t^2 + turning_speed^2), at 50 random slips."""
    law, lever = BOTH.sliding, 3.0 * np.pi / 16.0 * 4e-3

    def potential(motion):
        v1, v2, w1, w2, w3 = motion
        sliding = law.mu * jnp.sqrt(v1**2 + v2**2 + (lever * w3) ** 2 + law.slip_speed**2)
        return sliding + BOTH.resistance * jnp.sqrt(w1**2 + w2**2 + BOTH.turning_speed**2)

    motions = np.random.default_rng(5).normal(size=(50, 5)) * np.array([0.3, 0.3, 30.0, 30.0, 100.0])
    expected = -jax.vmap(jax.grad(potential))(jnp.asarray(motions))
    load = BOTH.per_normal_force(Slip(motions[:, 0], motions[:, 1], tuple(motions[:, 2:].T)))
    assert_close(jnp.stack([*load.force, *load.torque], axis=1), expected, rtol=1e-12, atol=1e-16)


@pytest.mark.parametrize("arena", ARENAS)
def test_without_disc_or_lever_the_laws_are_those_of_sliding(arena):
    """contact_radius = 0 is Coulomb and resistance = 0 the sliding law, to the last bit; small ones come close."""
    coulomb = tippe.Coulomb(0.3, 0.05)
    scene = tippe.Scene(rutstam_top(), ARENAS[arena], coulomb)
    states = random_states(scene, 20)
    expected = np.asarray(scene.field(states))

    def field(law):
        return np.asarray(tippe.Scene(rutstam_top(), ARENAS[arena], law).field(states))

    np.testing.assert_array_equal(field(tippe.Contensou(0.3, 0.0, 0.05)), expected)
    np.testing.assert_array_equal(field(tippe.Rolling(0.0, 1.0, coulomb)), expected)
    # The ellipsoid departs from Coulomb with the square of the radius, but for its torque, and the lever in proportion.
    for law_at, order in (
        (lambda h: tippe.Contensou(0.3, h, 0.05), 2.0),
        (lambda h: tippe.Rolling(h, 1.0, coulomb), 1.0),
    ):
        gaps = [np.abs(field(law_at(h)) - expected).max() for h in (2e-7, 1e-7)]
        assert_close(np.log2(gaps[0] / gaps[1]), order, atol=0.02)


@pytest.mark.parametrize("arena", [None, 0.2])
def test_forces_and_torques_agree_with_lagranges_equations_in_plain_numpy(arena):
    """Accelerations of the centre and of the spin, and N, at 20 random states by `lagrange_top.py`, to 1e-11."""
    top = rutstam_top()
    scene = tippe.Scene(top, tippe.Plane() if arena is None else tippe.Cylinder(arena), BOTH)
    numbers = {name: float(getattr(top, name)) for name in ("mass", "radius", "offset", "I1", "I3")}
    law = {"mu": 0.4, "slip_speed": 0.1, "contact_radius": 4e-3, "resistance": 2e-3, "turning_speed": 3.0}
    reference = lagrange_top.Scene(**numbers, **law, theta=0.0, spin=0.0, surface_radius=arena)
    path_radius = 1.0 if arena is None else arena - 0.02

    def rates(state):
        return jnp.stack([*scene.dynamics.motion(state).velocity, scene.spin(state)])

    states = random_states(scene, 20, seed=3)
    expected = jax.jvp(rates, (states,), (scene.field(states),))[1] / np.array([[path_radius], [1.0], [1.0]])
    for k, state in enumerate(np.array(states).T):
        eta = 0.0 if arena is None else float(np.arctan2(state[8], state[9]))
        frame = np.array([[np.cos(eta), 0.0, np.sin(eta)], [0.0, 1.0, 0.0], [-np.sin(eta), 0.0, np.cos(eta)]])
        axis, turning = state[2:5] @ frame, np.cross(state[5:8], state[2:5]) / numbers["I1"] @ frame
        velocity = state[:2] + numbers["offset"] * np.cross(state[5:8], state[2:5])[:2] / numbers["I1"]
        spin = state[2:5] @ state[5:8] / numbers["I3"]
        angles, rate = lagrange_top.in_angles(axis, turning, spin)
        chart = [eta if arena else 0.0, *angles, velocity[0] / path_radius, velocity[1], *rate]
        acceleration = lagrange_top.accelerations(reference, [float(number) for number in chart], "z")
        spin_rate = acceleration[4] + acceleration[3] * np.cos(chart[1]) - chart[6] * chart[5] * np.sin(chart[1])
        assert_close(
            [*acceleration[:2], spin_rate, acceleration[5]], [*expected[:, k], scene.normal_force(state)], rtol=1e-11
        )


def test_the_reduced_forms_refuse_a_torque():
    """Jellett's quantity is no constant then, and Rutstam's equations have no place for one."""
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), BOTH)
    state = scene.state(tippe.Launch(0.3, 100.0))
    with pytest.raises(ValueError, match="must act at a point, without a torque"):
        reduced_tops.rutstam_rate(scene, reduced_tops.rutstam_state(scene, state))


def test_a_law_of_ones_own_flies_on():
    """A law says its load per unit normal force, and so what it does in an impact."""

    class OwnLaw(tippe.AbstractFriction):
        def per_normal_force(self, slip):
            return ContactLoad((-0.1 * slip.x, -0.2 * slip.y))

    scene = tippe.Scene(rutstam_top(), friction=OwnLaw(), contact="hybrid")
    state = scene.state(tippe.Launch(0.3, 100.0))
    assert_close(scene.friction_power(state) / scene.normal_force(state), -0.2 * scene.slip_velocity(state)[1] ** 2)


def test_a_law_that_prefers_a_direction():
    """Tables on the plane must not turn their frame for it: they see what a single run sees, which depends on the azimuth."""

    class Brushed(tippe.Viscous):
        def per_normal_force(self, slip):
            return ContactLoad((-0.1 * slip.x, -0.6 * slip.y))

    class New(tippe.AbstractFriction):
        def per_normal_force(self, slip):
            return ContactLoad((-0.1 * slip.x, -0.6 * slip.y))

    assert not New().isotropic
    scene, azimuths = tippe.Scene(rutstam_top(), friction=Brushed(0.3)), np.array([0.0, 1.5])
    table = tippe.inversion_table(
        scene, theta=0.5, spin=150.0, azimuth=azimuths, t1=0.5, angle=0.9, crossing="last", progress=False
    )
    ends = [
        float(tippe.simulate(scene, tippe.Launch(0.5, 150.0, azimuth=azimuth), 0.5).theta[-1]) for azimuth in azimuths
    ]
    assert_close(table.end_theta, ends, rtol=1e-7)
    assert abs(ends[0] - ends[1]) > 1e-4


@pytest.mark.parametrize(
    "law", [tippe.Viscous(0.3), tippe.Coulomb(0.3, 0.05), BOTH.sliding, BOTH], ids=lambda law: type(law).__name__
)
def test_an_isotropic_law_turns_with_the_slip(law):
    assert law.isotropic
    cosine, sine = np.cos(0.7), np.sin(0.7)

    def turned(x, y):
        return cosine * x - sine * y, sine * x + cosine * y

    load = law.per_normal_force(Slip(0.1, -0.3, (5.0, 7.0, 90.0)))
    turned_load = law.per_normal_force(Slip(*turned(0.1, -0.3), (*turned(5.0, 7.0), 90.0)))
    assert_close(turned_load.force, turned(*load.force), rtol=1e-12)
    if load.torque[0] is not None:
        assert_close(turned_load.torque, (*turned(*load.torque[:2]), load.torque[2]), rtol=1e-12)


class Belt(tippe.AbstractFriction):
    """Viscous friction on a belt that moves along t1 [m/s]."""

    belt: float = 0.2

    def per_normal_force(self, slip):
        return ContactLoad(force=(-0.3 * (slip.x - self.belt), -0.3 * slip.y))


class Sideways(tippe.AbstractFriction):
    """A brake that also pushes across the slip, which takes no power; and a torque against the drilling, of some sign."""

    torque: object = eqx.field(converter=jnp.asarray)

    def per_normal_force(self, slip):
        force = (-0.3 * slip.x - 0.2 * slip.y, -0.3 * slip.y + 0.2 * slip.x)
        return ContactLoad(force, (None, None, self.torque * jnp.tanh(slip.turning[2])))


class Pushing(tippe.Coulomb):
    """Coulomb's law with the wrong sign."""

    def per_normal_force(self, slip):
        x, y = super().per_normal_force(slip).force
        return ContactLoad(force=(-x, -y))


class Drag(tippe.AbstractFriction):
    """A law of a user's with one number, without a range of its own."""

    units = {"drag": "s m-1"}  # noqa: RUF012

    drag: object = eqx.field(converter=jnp.asarray)

    def per_normal_force(self, slip):
        return ContactLoad(force=(-self.drag * slip.x, -self.drag * slip.y))


class Pair(tippe.AbstractFriction):
    """A law that returns no load."""

    def per_normal_force(self, slip):
        return -slip.x, -slip.y


class Branching(tippe.AbstractFriction):
    """A law that asks for the value of a traced number."""

    def per_normal_force(self, slip):
        return ContactLoad(force=(-slip.x, -slip.y)) if slip.x > 0.0 else ContactLoad(force=(slip.x, -slip.y))


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (Pair, r"friction = Pair\(\): per_normal_force must return a tippe.friction.ContactLoad"),
        (Branching, r"friction = Branching\(\): per_normal_force cannot be traced by JAX: .* in place of `if`"),
    ],
)
def test_a_law_that_cannot_be_evaluated_is_refused_when_it_is_constructed(law, message):
    with pytest.raises(ValueError, match=message):
        law()


def test_a_number_with_a_unit_must_be_finite():
    assert str(Drag(0.3)) == "Drag(drag=0.3 s/m)"
    with pytest.raises(ValueError, match=r"drag = nan must be finite"):
        Drag(np.nan)


def test_a_law_that_drives_the_top_is_told_when_it_is_constructed():
    """By its worst slip: in a belt's direction, for a slow slip, 0.3 (v_belt - v) v."""
    slip = (
        r"friction = Belt\(belt=0.2\) drives the top: at a slip of \(0.001, 0\) m/s its power is 5.97e-05 W per newton"
    )
    with pytest.warns(UserWarning, match=slip):
        Belt()
    with pytest.warns(UserWarning, match=r"friction = Pushing\(mu=0.3, slip_speed=0.05 m/s\) drives the top"):
        Pushing(0.3, 0.05)
    with pytest.warns(UserWarning, match=r"and a turning of -?100 rad/s its power is .* Is a sign wrong\?"):
        Sideways(1e-2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Sideways(-1e-2)
        # A belt at rest brakes; a law whose numbers are traced is not judged.
        Belt(0.0)
        jax.jit(lambda torque: Sideways(torque).torque)(1.0)
        # Nor does a law that cannot be evaluated prevent its construction: the first run says what is wrong.
        type("Broken", (tippe.AbstractFriction,), {"per_normal_force": lambda self, slip: 1.0 / None})()


#: A law that reads a number from its module, which changes between two scenes.
CHANGED = """
import jax, tippe
from tippe.friction import ContactLoad, Slip

top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)

class Law(tippe.AbstractFriction):
    def per_normal_force(self, slip):
        return ContactLoad((-mu * slip.x, -mu * slip.y))

@jax.jit
def force(scene):
    return scene.friction.per_normal_force(Slip(1.0, 0.0)).force[0]

forces = []
for mu in (0.25, 0.5, 0.5):
    forces.append(float(force(tippe.Scene(top, friction=Law()))))
print(forces)
"""


def test_a_new_scene_uses_the_numbers_that_its_law_reads_now():
    """In a process of its own, because all programs are compiled again."""
    done = subprocess.run([sys.executable, "-c", CHANGED], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[-0.25, -0.5, -0.5]"
