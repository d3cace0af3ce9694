"""The paper's equations: what stands, what does not, and the audit that says so."""

import pkgutil
import re
from pathlib import Path

import euler_angles
import jax
import jax.numpy as jnp
import numpy as np
import poincare
import pytest
import reduced_tops
from other_formulations import structure_constants
from papers import tippe_audit, tippe_formulas
from scipy.integrate import solve_ivp

import tippe
from nonholonomic.systems.mechanics import lie_brackets
from tippe import paper

ROOT = Path(__file__).parents[2]
TOP = tippe.Top(0.02, 0.02, 0.006, 131 / 350 * 8e-6, 3.2e-6)
PLANE = tippe.Scene(TOP, friction=tippe.Viscous(0.3))
CYLINDER = tippe.Scene(TOP, tippe.Cylinder(0.2), tippe.Viscous(0.3))
COUNT = 200


def states(scene):
    """Random states of the vector form, away from the poles of Euler's angles."""
    rng = np.random.default_rng(11)
    theta, azimuth = rng.uniform(0.2, 2.9, COUNT), rng.uniform(0.0, 2.0 * np.pi, COUNT)
    e = np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])
    w = 40.0 * rng.normal(size=(3, COUNT))
    L = TOP.I1 * w + (TOP.I3 - TOP.I1) * np.sum(w * e, axis=0) * e
    place = np.reshape(scene.start(tippe.Launch(0.0, 0.0, eta=rng.uniform(-1.0, 1.0, COUNT)))[0], (-1, COUNT))
    return jnp.concatenate([0.3 * rng.normal(size=(2, COUNT)), e, L, place])


@pytest.fixture(scope="module")
def on_the_plane():
    vector = states(PLANE)
    chart = jax.jit(jax.vmap(lambda s: euler_angles.from_vector_state(PLANE, s), in_axes=1, out_axes=1))(vector)
    return vector, chart


@pytest.fixture(scope="module")
def in_the_cylinder():
    vector = states(CYLINDER)
    chart = jax.jit(jax.vmap(lambda s: euler_angles.from_vector_state(CYLINDER, s), in_axes=1, out_axes=1))(vector)
    return vector, chart


def test_equation_1_is_jelletts_constant_only_when_corrected(on_the_plane, in_the_cylinder):
    """L.(R n - a e) in Euler angles, on the plane and in the cylinder; the printed form is off by more than a tenth."""
    vector, (_, theta, _, _, _, _, phi_dot, _) = on_the_plane
    exact, spin = PLANE.jellett(vector), PLANE.spin(vector)
    corrected = reduced_tops.jellett_constant(PLANE, theta, phi_dot, TOP.I3 * spin)
    np.testing.assert_allclose(corrected, exact, rtol=1e-11, atol=1e-20)
    printed = tippe_formulas.printed_jellett(PLANE, theta, spin, phi_dot)
    assert jnp.median(jnp.abs(printed - exact) / jnp.abs(exact)) > 0.1

    vector, (_, theta, phi, eta_dot, _, _, phi_dot, _) = in_the_cylinder
    s, c, spin = jnp.sin(theta), jnp.cos(theta), CYLINDER.spin(vector)
    transverse = TOP.I1 * (phi_dot * s**2 + eta_dot * s * c * jnp.sin(phi))
    corrected = TOP.radius * (transverse + TOP.I3 * spin * c) - TOP.offset * TOP.I3 * spin
    np.testing.assert_allclose(corrected, CYLINDER.jellett(vector), rtol=1e-11, atol=1e-20)


def test_equation_6_lacks_the_vertical_motion_of_the_centre_of_mass(on_the_plane):
    """The Lagrangian on the plane is kinetic minus potential energy, with m a^2 theta'^2 sin(theta)^2 / 2 in it."""
    vector, chart = on_the_plane
    _, theta, _, _, _, *rates = chart
    corrected = jax.vmap(lambda angle, rate, u: reduced_tops.lagrangian(PLANE, angle, rate, u))(
        theta, jnp.stack(rates, axis=1), vector[:2].T
    )
    weight, height = TOP.mass * PLANE.gravity, TOP.radius - TOP.offset * jnp.cos(theta)
    np.testing.assert_allclose(corrected, PLANE.energy(vector) - 2.0 * weight * height, rtol=1e-12)
    vertical = 0.5 * TOP.mass * (TOP.offset * rates[0] * jnp.sin(theta)) ** 2
    assert jnp.median(vertical / (weight * TOP.offset)) > 0.1


def test_equations_7_8_and_10_hold_on_the_plane(on_the_plane):
    """beta1 and psi' from Jellett's constant and phi' alone, and psi' from beta1; 200 states."""
    vector, (_, theta, _, _, _, _, phi_dot, psi_dot) = on_the_plane
    jellett, beta1 = PLANE.jellett(vector), TOP.I3 * PLANE.spin(vector)
    # (8) divides by R cos(theta) - a.
    clear = jnp.abs(TOP.radius * jnp.cos(theta) - TOP.offset) > 0.1 * TOP.radius
    value = reduced_tops.spin_momentum_from_jellett(PLANE, theta, phi_dot, jellett)
    np.testing.assert_allclose(value[clear], beta1[clear], rtol=1e-9, atol=1e-16)
    np.testing.assert_allclose(reduced_tops.spin_rate(PLANE, theta, phi_dot, beta1), psi_dot, rtol=1e-9, atol=1e-10)
    value = reduced_tops.spin_rate_from_jellett(PLANE, theta, phi_dot, jellett)
    np.testing.assert_allclose(value[clear], psi_dot[clear], rtol=1e-9, atol=1e-9)


def test_equation_9_is_an_energy_but_no_routhian(on_the_plane):
    """Its value is the rotational energy; as a Lagrangian it misses the gyroscopic moment -beta1 phi' sin(theta)."""
    vector, (_, theta, _, _, _, theta_dot, phi_dot, _) = on_the_plane
    beta1 = TOP.I3 * PLANE.spin(vector)
    L = vector[5:8]
    rotational = (jnp.sum(L**2, axis=0) - beta1**2) / (2.0 * TOP.I1) + beta1**2 / (2.0 * TOP.I3)
    printed = tippe_formulas.printed_kinetic_energy(PLANE, theta, theta_dot, phi_dot, beta1)
    np.testing.assert_allclose(printed, rotational, rtol=1e-11)

    def moment(function):
        return jax.vmap(jax.grad(function))(theta, theta_dot, phi_dot, beta1)

    def routhian(angle, rate, precession, momentum):
        return reduced_tops.routhian(PLANE, angle, jnp.stack([rate, precession]), jnp.zeros(2), momentum)

    gravity = -TOP.mass * PLANE.gravity * TOP.offset * jnp.sin(theta)
    vertical = TOP.mass * (TOP.offset * theta_dot) ** 2 * jnp.sin(theta) * jnp.cos(theta)
    of_printed = moment(lambda *rates: tippe_formulas.printed_kinetic_energy(PLANE, *rates))
    missing = moment(routhian) - gravity - vertical - of_printed
    np.testing.assert_allclose(missing, -beta1 * phi_dot * jnp.sin(theta), rtol=1e-9, atol=1e-16)


def test_friction_changes_beta1(on_the_plane, in_the_cylinder):
    """beta1' = -N R (n x f).e at 200 states on each arena, and it is not small beside N R."""
    for scene, (vector, _) in ((PLANE, on_the_plane), (CYLINDER, in_the_cylinder)):
        beta1_dot = jax.jvp(lambda s, scene=scene: scene.body.I3 * scene.spin(s), (vector,), (scene.field(vector),))[1]
        f = -0.3 * scene.slip_velocity(vector)
        push = scene.normal_force(vector) * TOP.radius
        expected = -push * (-f[1] * vector[2] + f[0] * vector[3])
        np.testing.assert_allclose(beta1_dot, expected, rtol=1e-9, atol=1e-12)
        assert jnp.median(jnp.abs(beta1_dot / push)) > 0.05


def test_equation_12_needs_three_more_terms_in_the_cylinder_and_none_on_the_plane(on_the_plane, in_the_cylinder):
    """The corrected form is N; the printed one is N on the plane, and far from it in the cylinder."""
    for scene, (vector, chart), right in ((PLANE, on_the_plane, True), (CYLINDER, in_the_cylinder, False)):
        exact = scene.normal_force(vector)
        acceleration = jax.jit(jax.vmap(lambda s, scene=scene: euler_angles.by_lagrange(scene, s), in_axes=1))(chart)
        size = jnp.max(jnp.abs(exact))
        corrected = jax.vmap(lambda s, a, scene=scene: euler_angles.normal_force(scene, s, a), in_axes=(1, 0))
        np.testing.assert_allclose(
            corrected(chart, acceleration.second_rates), exact, rtol=0.0, atol=1e-11 * float(size)
        )
        printed = jax.vmap(lambda s, a, scene=scene: tippe_formulas.printed_normal_force(scene, s, a), in_axes=(1, 0))
        error = jnp.max(jnp.abs(printed(chart, acceleration.second_rates[:, 2]) - exact)) / (TOP.mass * scene.gravity)
        assert error < 1e-10 if right else error > 0.05


# Generators


def test_the_printed_generators_are_the_rotations_and_close_as_so3():
    """(3)-(5) carry over to y d/dz - z d/dy and so on, and [R_x, R_y] = -R_z in cyclic order."""
    place = jnp.array([0.3, 0.7, -0.4])

    def cartesian(place):
        r, eta, y = place
        return jnp.stack([r * jnp.sin(eta), y, r * jnp.cos(eta)])

    x, y, z = cartesian(place)
    rotations = jnp.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    generators = jax.jacfwd(cartesian)(place) @ tippe_formulas.rotation_generators(place)
    np.testing.assert_allclose(generators, rotations, atol=1e-15)

    brackets, fields = (
        lie_brackets(tippe_formulas.rotation_generators, place),
        tippe_formulas.rotation_generators(place),
    )
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.testing.assert_allclose(brackets[:, i, j], -fields[:, k], atol=1e-14)


def test_only_the_second_generator_is_tangent_to_the_cylinder():
    """R_x r = y cos(eta) and R_z r = -y sin(eta): they change the distance from the axis of the cylinder."""
    r, eta, y = 0.3, 0.7, -0.4
    outward = tippe_formulas.rotation_generators(jnp.array([r, eta, y]))[0]
    np.testing.assert_allclose(outward, [y * np.cos(eta), 0.0, -y * np.sin(eta)], rtol=1e-15)


def test_the_frame_of_equation_2_has_the_structure_that_the_reduction_needs():
    """All fields commute with d/dpsi, and c^1 is 1 for the two that turn the axis and 0 for all others."""
    q = jnp.array([0.4, 0.1, 0.9, -0.6, 0.3, 0.0])
    c = structure_constants(poincare.nodal_frame, q)
    np.testing.assert_allclose(c[:, poincare.PSI, :], 0.0, atol=1e-14)
    np.testing.assert_allclose(c[poincare.PSI, 2, 3], 1.0, rtol=1e-13)
    remainder = c.at[poincare.PSI, 2, 3].set(0.0).at[poincare.PSI, 3, 2].set(0.0)
    # The field in place of phi changes its own length with theta.
    np.testing.assert_allclose(remainder[3, 2, 3], -np.cos(0.9) / np.sin(0.9), rtol=1e-13)
    np.testing.assert_allclose(remainder.at[3, 2, 3].set(0.0).at[3, 3, 2].set(0.0), 0.0, atol=1e-14)


# Tables


def test_the_unit_of_beta1_as_printed_is_impossible():
    """2500 g m^2/s would spin a top of 50 g and 3 cm at more than 1e5 rad/s; 2500 g cm^2/s is ordinary."""
    limit = 0.45 * 0.05 * 0.03**2
    assert tippe_formulas.BETA1_AS_PRINTED / limit > 1e5
    launch = tippe_formulas.launch(paper.TABLE_2, paper.TABLE_2.rows[0], TOP)
    np.testing.assert_allclose(launch.spin, 78.125, rtol=1e-12)


@pytest.mark.parametrize("scene", [PLANE, CYLINDER], ids=["plane", "cylinder"])
def test_a_top_launched_with_all_rates_zero_never_rises(scene):
    """The initial conditions as printed, theta = 0.5 for five seconds: theta never exceeds where it started."""
    rate = jax.jit(lambda _, y: scene.field(y))
    start = np.asarray(scene.state(tippe.Launch(0.5, 0.0)))
    run = solve_ivp(lambda t, y: np.asarray(rate(t, y)), (0.0, 5.0), start, rtol=1e-9, atol=1e-12, max_step=0.02)
    assert run.success
    theta = scene.theta(jnp.asarray(run.y))
    assert jnp.min(theta) < 0.1
    assert jnp.max(theta) < 0.5 + 1e-9


def test_the_tables_are_those_of_the_paper():
    """Nine inclinations each; two and four of them reversed."""
    for table, times in ((paper.TABLE_2, [25, 22]), (paper.TABLE_3, [23, 19, 20, 22])):
        assert [row.theta for row in table.rows] == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, np.pi / 2]
        assert [row.time for row in table.rows if row.time is not None] == times


def test_one_top_gives_the_pattern_of_table_2_and_its_times_to_a_second_and_a_half():
    """A viscous top in a cylinder of 7.741 R: 23.74 and 23.18 s for the paper's 25 and 22, and no more by 40 s."""
    mass, radius = 0.0498, 0.015
    I3 = 0.3716 * mass * radius**2
    top = tippe.Top(mass, radius, 0.1692 * radius, 0.9162 * I3, I3)
    scene = tippe.Scene(top, tippe.Cylinder(7.741 * radius), tippe.Viscous(paper.TABLE_2.mu))
    theta = [row.theta for row in paper.TABLE_2.rows]
    spin = float(tippe_formulas.launch(paper.TABLE_2, paper.TABLE_2.rows[0], top).spin)
    result = tippe.inversion_table(scene, theta=theta, spin=spin, azimuth=1.836, t1=40.0, tolerance=1e-9)
    np.testing.assert_allclose(result.time[:2], [23.7405, 23.1838], rtol=1e-5)
    assert list(result.status[2:]) == ["not_inverted"] * 7


def test_one_top_gives_table_3_to_half_a_second_and_table_2_nearly():
    """The best of `benchmarks/paper_tables_joint.py`: its pattern is that of both tables but for 0.3 rad in Table 2."""
    mass, radius = 0.011573, 0.027474
    I3 = 0.4075 * mass * radius**2
    top = tippe.Top(mass, radius, 0.086495 * radius, 1.0533 * I3, I3)
    scene = tippe.Scene(top, tippe.Cylinder(84.428 * radius), tippe.Viscous(0.32573))
    tables = []
    for table in (paper.TABLE_2, paper.TABLE_3):
        theta = [row.theta for row in table.rows]
        start = {"spin": float(paper.BETA1 / I3), "eta": min(table.eta, np.pi / 2.0 - 1e-6), "azimuth": 1.7971}
        tables.append(tippe.inversion_table(scene, theta=theta, **start, t1=30.0, tolerance=1e-9))
    np.testing.assert_allclose(tables[0].time[:3], [26.3, 26.3, 28.2], atol=0.05)
    assert list(tables[0].status[3:]) == ["not_inverted"] * 6
    printed = [row.time for row in paper.TABLE_3.rows[:4]]
    np.testing.assert_allclose(tables[1].time[:4], printed, atol=0.5)
    assert list(tables[1].status[4:]) == ["contact_lost"] * 5


# The page


def test_the_page_has_the_verdicts_of_the_audit():
    """docs/development/papers.md has a row for each entry, and the command prints each printed and correct form."""
    page, printed = (ROOT / "docs" / "development" / "papers.md").read_text(), tippe_audit.render()
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| ")]
    assert rows[1:] == [[entry.number, entry.subject, entry.verdict] for entry in tippe_audit.AUDIT]
    assert all(formula in printed for entry in tippe_audit.AUDIT for formula in (entry.printed, *entry.correct))


def test_every_test_and_function_that_the_audit_names_exists():
    """A verdict without a test is an opinion."""
    for entry in tippe_audit.AUDIT:
        assert entry.tests
        for name in (*entry.tests, *entry.code):
            file, _, function = name.rpartition("::")
            if file:
                assert re.search(rf"^def {function}\(", (ROOT / file).read_text(), re.MULTILINE), name
            else:
                pkgutil.resolve_name(name)
