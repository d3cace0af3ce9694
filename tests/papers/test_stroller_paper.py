"""The paper's equations, as corrected and as printed, against what follows from the position on the spheroid."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from other_formulations import Multipliers
from papers import stroller_paper as paper
from stroller_chart import Chart

from stroller import Plane, Scene, Spheroid, Stroller

P = paper.Parameters(*map(jnp.asarray, (1.7, 0.7, 0.4, 0.05, 2.0, 0.8, 9.81)))
Q = jnp.array([0.6, 0.3, 1.4, 0.5])
ETA, MU, THETA, PHI = Q
BODY = Stroller(1.7, 0.7, 0.4, 0.05)
SPHEROID = Chart(Scene(BODY, Spheroid.from_oblate(2.0, 0.8), heading="projected"))
PLANE = Chart(Scene(BODY, Plane()))
A, C = P.a * jnp.cosh(P.xi), P.a * jnp.sinh(P.xi)
D = jnp.sinh(P.xi) ** 2 + jnp.sin(ETA) ** 2


def allowed(fields, q, rates=(1.2, -1.3)):
    """A velocity that is a combination of the fields."""
    return fields(P, q) @ jnp.array(rates)


def test_constraints_on_the_plane():
    """(1) to (3): they vanish where neither wheel slips; the printed first line does not."""
    v, turn = 0.9, 0.9 * jnp.tan(PHI) / P.l
    rate = jnp.array([v * jnp.cos(THETA), v * jnp.sin(THETA), turn, 0.3])
    np.testing.assert_allclose(paper.constraints_plane(P, Q) @ rate, 0.0, atol=1e-15)
    front = rate[:2] + P.l * turn * jnp.array([-jnp.sin(THETA), jnp.cos(THETA)])
    np.testing.assert_allclose(-jnp.sin(THETA + PHI) * front[0] + jnp.cos(THETA + PHI) * front[1], 0.0, atol=1e-15)
    printed = -jnp.sin(THETA) * rate[0] + jnp.cos(THETA + PHI) * rate[1]
    assert abs(float(printed)) > 0.1
    np.testing.assert_allclose(PLANE.constraints(Q), paper.constraints_plane(P, Q), atol=1e-15)


def test_position_is_on_the_spheroid():
    """(4), (11): (x^2 + y^2) / A^2 + z^2 / c^2 = 1; with the printed z it is not."""
    x, y, z = paper.position(P, ETA, MU)
    np.testing.assert_allclose((x**2 + y**2) / A**2 + z**2 / C**2, 1.0, rtol=1e-15)
    printed = P.a * jnp.sinh(P.xi) * jnp.sin(MU)
    assert abs(float((x**2 + y**2) / A**2 + printed**2 / C**2 - 1.0)) > 0.1


def test_differentials_are_those_of_the_position():
    """(5), (6)."""
    slope = jnp.stack(jax.jacfwd(paper.position, argnums=(1, 2))(P, ETA, MU), axis=1)
    np.testing.assert_allclose(paper.differentials(P, ETA, MU), slope[:2], atol=1e-15)


def test_constraints_on_the_spheroid():
    """(7), (8): the pull-back of (2) and (3) by (4); the printed (7) lacks d mu."""
    pulled_form = (
        paper.constraints_plane(P, Q)
        .at[:, :2]
        .set(paper.constraints_plane(P, Q)[:, :2] @ paper.differentials(P, ETA, MU))
    )
    np.testing.assert_allclose(paper.constraints_spheroid(P, Q), pulled_form, atol=1e-15)
    np.testing.assert_allclose(SPHEROID.constraints(Q), pulled_form, atol=1e-14)
    assert abs(float(pulled_form[0, 1])) > 0.1


def test_hamiltonian_is_the_energy():
    """(9): kinetic energy of the position's velocity and of the rotations, plus weight times height."""
    rate = jnp.array([0.4, -0.7, 0.8, 1.1])
    momentum = paper.masses_spheroid(P, ETA) * rate
    _, velocity = jax.jvp(lambda q: paper.position(P, q[0], q[1]), (Q,), (rate,))
    energy = 0.5 * P.m * velocity @ velocity + 0.5 * P.J * rate[2] ** 2 + 0.5 * P.J_f * rate[3] ** 2
    energy = energy + P.m * P.g * (paper.position(P, ETA, MU)[2] + C)
    np.testing.assert_allclose(paper.hamiltonian(P, Q, momentum), energy, rtol=1e-14)
    np.testing.assert_allclose(SPHEROID.energy(Q, rate), energy, rtol=1e-14)
    printed = momentum[0] ** 2 / (2 * P.m * P.a * jnp.sqrt(D)) + P.m * P.g * C * (1 + jnp.sin(ETA))
    printed = printed + momentum[1] ** 2 / (2 * P.m * A * jnp.cosh(ETA))
    assert abs(float(printed - energy)) > 0.1


def test_constraints_in_the_momenta():
    """(10): W G^-1 p; zero for an allowed velocity."""
    momentum = jnp.array([0.4, -0.7, 0.8, 1.1])
    expected = paper.constraints_spheroid(P, Q) @ (momentum / paper.masses_spheroid(P, ETA))
    np.testing.assert_allclose(paper.constraint_momenta(P, Q, momentum), expected, rtol=1e-14)
    legal = paper.masses_spheroid(P, ETA) * allowed(paper.fields_spheroid, Q)
    np.testing.assert_allclose(paper.constraint_momenta(P, Q, legal), 0.0, atol=1e-15)


def test_scale_factors_are_those_of_the_position():
    """(12): the lengths of the position's derivatives, by xi too."""

    def place(xi, eta, mu):
        return paper.position(paper.Parameters(P.m, P.l, P.J, P.J_f, P.a, xi, P.g), eta, mu)

    lengths = [jnp.linalg.norm(column) for column in jax.jacfwd(place, argnums=(0, 1, 2))(P.xi, ETA, MU)]
    h_eta, h_mu = paper.scale_factors(P, ETA)
    np.testing.assert_allclose(lengths, [h_eta, h_eta, h_mu], rtol=1e-14)


def test_fields_on_the_plane():
    """(13): allowed and orthogonal in diag(m, m, J, J_f); the printed X1 is neither."""
    X = paper.fields_plane(P, Q)
    np.testing.assert_allclose(paper.constraints_plane(P, Q) @ X, 0.0, atol=1e-15)
    G = PLANE.metric(Q)
    np.testing.assert_allclose(X[:, 0] @ G @ X[:, 1], 0.0, atol=1e-16)
    printed = jnp.stack([P.l * jnp.cos(THETA), P.l * jnp.sin(THETA), 0.0, jnp.tan(PHI)])
    np.testing.assert_allclose(printed @ G @ X[:, 1], P.J_f * jnp.tan(PHI), rtol=1e-14)
    assert float(jnp.max(jnp.abs(paper.constraints_plane(P, Q) @ printed))) > 0.1


def test_fields_on_the_spheroid():
    """(14): allowed and orthogonal in the corrected metric, which is the chart's; the printed X1 breaks w2."""
    X = paper.fields_spheroid(P, Q)
    np.testing.assert_allclose(paper.constraints_spheroid(P, Q) @ X, 0.0, atol=1e-14)
    np.testing.assert_allclose(SPHEROID.metric(Q), jnp.diag(paper.masses_spheroid(P, ETA)), rtol=1e-14)
    np.testing.assert_allclose(X[:, 0] @ SPHEROID.metric(Q) @ X[:, 1], 0.0, atol=1e-16)
    residual = (paper.constraints_spheroid(P, Q) @ X[:, 0].at[2].set(0.0))[1]
    np.testing.assert_allclose(residual, A * P.l / 2.0 * jnp.sin(2.0 * ETA) * jnp.sin(PHI), rtol=1e-13)


def canonical(chart, rate):
    """q', p' and multipliers of the generic canonical equations."""
    formulation = Multipliers(chart)
    field = formulation.field(0.0, formulation.state(Q, rate))
    return field[:4], field[4:], formulation.multipliers(0.0, Q, rate)


def test_canonical_equations_on_the_plane():
    """(15): the generic equations; with the printed sign of p_y' the constraint force does work."""
    rate = allowed(paper.fields_plane, Q)
    velocity, push, force = canonical(PLANE, rate)
    momentum = PLANE.metric(Q) @ rate
    rates = paper.pchs_plane(P, Q, momentum, force)
    np.testing.assert_allclose(rates[0], velocity, rtol=1e-14)
    np.testing.assert_allclose(rates[1], push, atol=1e-14)
    np.testing.assert_allclose(rates[1] @ rate, 0.0, atol=1e-14)
    printed = rates[1].at[1].multiply(-1.0)
    assert abs(float(printed @ rate)) > 0.1


def test_output_on_the_plane():
    """(16): the output of a port is the speed whose product with the force is the power."""
    rate = allowed(paper.fields_plane, Q)
    speed, steering = paper.output_plane(P, Q, PLANE.metric(Q) @ rate)
    np.testing.assert_allclose([speed, steering], [1.2 * P.l, -1.3], rtol=1e-14)
    printed = rate[0] + rate[1]
    assert abs(float(printed - speed)) > 0.1


def test_canonical_equations_on_the_spheroid():
    """Before (17): the generic equations with the projected heading."""
    rate = allowed(paper.fields_spheroid, Q)
    velocity, push, force = canonical(SPHEROID, rate)
    momentum = paper.masses_spheroid(P, ETA) * rate
    rates = paper.pchs_spheroid(P, Q, momentum, force)
    np.testing.assert_allclose(rates[0], velocity, rtol=1e-13)
    np.testing.assert_allclose(rates[1], push, atol=1e-12)
    bracket = momentum[0] ** 2 * jnp.cos(ETA) / D**1.5 - P.m * P.g * C * jnp.cos(ETA)
    printed = jnp.sin(ETA) / (2 * P.m * P.a) * bracket
    assert abs(float(printed - push[0])) > 0.1
    assert abs(float(momentum[3] / P.J_f - velocity[2])) > 0.1
    assert abs(float(momentum[0] / (P.m * P.a * jnp.sqrt(D)) - velocity[0])) > 0.1


def test_output_on_the_spheroid():
    """(17): the horizontal speed, by the position's velocity; the printed one has a stray cos(eta)."""
    rate = allowed(paper.fields_spheroid, Q)
    momentum = paper.masses_spheroid(P, ETA) * rate
    _, velocity = jax.jvp(lambda q: paper.position(P, q[0], q[1]), (Q,), (rate,))
    speed = velocity[0] * jnp.cos(THETA) + velocity[1] * jnp.sin(THETA)
    np.testing.assert_allclose(paper.output_spheroid(P, Q, momentum), speed, rtol=1e-14)
    np.testing.assert_allclose(jnp.abs(speed), jnp.hypot(velocity[0], velocity[1]), rtol=1e-14)
    printed = (momentum[0] * jnp.cos(ETA) / jnp.sqrt(D) + momentum[1] / (jnp.cosh(P.xi) * jnp.cos(ETA))) / (P.m * P.a)
    assert abs(float(printed - speed)) > 0.1


def test_headings_of_the_two_readings_correspond():
    """Section 3: theta = mu + pi/2 + atan2(S sin(psi), cos(psi)), from the direction itself."""
    from stroller import Launch

    intrinsic = Scene(BODY, Spheroid.from_oblate(2.0, 0.8))
    state = intrinsic.state(Launch((0.3, 0.6), 0.9, 1.0))
    direction = intrinsic.dynamics.geometry(state).direction
    S = jnp.cosh(P.xi) * jnp.sin(ETA) / jnp.sqrt(D)
    theta = 0.3 + jnp.pi / 2 + jnp.arctan2(S * jnp.sin(0.9), jnp.cos(0.9))
    np.testing.assert_allclose(jnp.arctan2(direction[1], direction[0]), theta, rtol=1e-14)


@pytest.mark.parametrize("equation", paper.EQUATIONS, ids=lambda equation: equation.number)
def test_every_equation_names_a_test_that_exists(equation):
    assert callable(getattr(sys.modules[__name__], equation.test))


def test_the_page_lists_the_equations_that_are_right():
    """docs/development/papers.md has those with that verdict; the command prints every equation and its correct form."""
    page = Path(__file__).parents[2] / "docs" / "development" / "papers.md"
    right = [equation.number for equation in paper.EQUATIONS if equation.verdict.startswith("right")]
    assert f"These are right: {'; '.join(right)}." in " ".join(page.read_text(encoding="utf-8").split())
    assert all(f"| {equation.printed} |" in paper.render() for equation in paper.EQUATIONS)
