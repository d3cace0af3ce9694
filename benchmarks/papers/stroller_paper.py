"""The paper's equations in its own coordinates, corrected, and a table of the printed and the correct forms.

The paper: "Vector Fields of the Dynamics of Non-Holonomic Constraint System With Elliptical Configuration Space". Its
coordinates are q = (x, y, theta, phi) on the plane and (eta, mu, theta, phi) on the spheroid of constant xi, with theta
the direction of the horizontal projection of the heading and phi the steering angle; p are the canonical momenta. The
fork's inertia is relative. Each function is the corrected form of the equation that its first line names.
`python benchmarks/papers/stroller_paper.py` prints the table; `docs/development/papers.md` has a summary.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

Four = Float[Array, " 4"]


class Parameters(eqx.Module):
    """The paper's constants: m [kg], l [m], J and J_f [kg m^2], a [m], xi [1], g [m/s^2]."""

    m: Float[Array, ""]
    l: Float[Array, ""]  # noqa: E741
    J: Float[Array, ""]
    J_f: Float[Array, ""]
    a: Float[Array, ""]
    xi: Float[Array, ""]
    g: Float[Array, ""]


def constraints_plane(p: Parameters, q: Four) -> Float[Array, "2 4"]:
    """(1) to (3): the one-forms w1 and w2 that vanish on the velocities of a stroller on the plane."""
    _, _, theta, phi = q
    zero = jnp.zeros(())
    rear = [-jnp.sin(theta), jnp.cos(theta), zero, zero]
    front = [-jnp.sin(theta + phi), jnp.cos(theta + phi), p.l * jnp.cos(phi), zero]
    return jnp.array([rear, front])


def position(p: Parameters, eta: Float[Array, ""], mu: Float[Array, ""]) -> Float[Array, " 3"]:
    """(4) and (11): x, y and z [m] of a point of the spheroid."""
    transverse = p.a * jnp.cosh(p.xi) * jnp.cos(eta)
    return jnp.array([transverse * jnp.cos(mu), transverse * jnp.sin(mu), p.a * jnp.sinh(p.xi) * jnp.sin(eta)])


def differentials(p: Parameters, eta: Float[Array, ""], mu: Float[Array, ""]) -> Float[Array, "2 2"]:
    """(5) and (6): dx and dy at constant xi, one per row, in terms of (d eta, d mu)."""
    A = p.a * jnp.cosh(p.xi)
    dx = [-A * jnp.sin(eta) * jnp.cos(mu), -A * jnp.cos(eta) * jnp.sin(mu)]
    dy = [-A * jnp.sin(eta) * jnp.sin(mu), A * jnp.cos(eta) * jnp.cos(mu)]
    return jnp.array([dx, dy])


def constraints_spheroid(p: Parameters, q: Four) -> Float[Array, "2 4"]:
    """(7) and (8): the one-forms w1 and w2 of the projected heading on the spheroid."""
    eta, mu, theta, phi = q
    A, zero = p.a * jnp.cosh(p.xi), jnp.zeros(())

    def lateral(angle, turning):
        along_eta = A * jnp.sin(eta) * jnp.sin(angle - mu)
        return [along_eta, A * jnp.cos(eta) * jnp.cos(angle - mu), turning, zero]

    return jnp.array([lateral(theta, zero), lateral(theta + phi, p.l * jnp.cos(phi))])


def masses_spheroid(p: Parameters, eta: Float[Array, ""]) -> Four:
    """(14), the metric: diag(m a^2 D, m a^2 cosh^2(xi) cos^2(eta), J, J_f), D = sinh^2(xi) + sin^2(eta)."""
    h_eta, h_mu = scale_factors(p, eta)
    return jnp.array([p.m * h_eta**2, p.m * h_mu**2, p.J, p.J_f])


def scale_factors(p: Parameters, eta: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(12): h_eta = h_xi and h_mu [m]."""
    return p.a * jnp.sqrt(jnp.sinh(p.xi) ** 2 + jnp.sin(eta) ** 2), p.a * jnp.cosh(p.xi) * jnp.cos(eta)


def hamiltonian(p: Parameters, q: Four, momentum: Four) -> Float[Array, ""]:
    """(9): kinetic energy in the momenta, rotations included, plus m g a sinh(xi) (1 + sin(eta)) [J]."""
    height = p.a * jnp.sinh(p.xi) * (1.0 + jnp.sin(q[0]))
    return 0.5 * jnp.sum(momentum**2 / masses_spheroid(p, q[0])) + p.m * p.g * height


def constraint_momenta(p: Parameters, q: Four, momentum: Four) -> Float[Array, " 2"]:
    """(10): the constraints (7) and (8) in the momenta; both vanish."""
    eta, mu, theta, phi = q
    D = jnp.sinh(p.xi) ** 2 + jnp.sin(eta) ** 2

    def lateral(angle):
        by_eta = jnp.cosh(p.xi) * jnp.sin(eta) * jnp.sin(angle - mu) * momentum[0] / (p.m * p.a * D)
        return by_eta + jnp.cos(angle - mu) * momentum[1] / (p.m * p.a * jnp.cosh(p.xi) * jnp.cos(eta))

    return jnp.array([lateral(theta), lateral(theta + phi) + p.l * jnp.cos(phi) * momentum[2] / p.J])


def fields_plane(p: Parameters, q: Four) -> Float[Array, "4 2"]:
    """(13): the fields X1 = l cos(theta) d_x + l sin(theta) d_y + tan(phi) d_theta and X2 = d_phi, one per column."""
    _, _, theta, phi = q
    zero = jnp.zeros(())
    rolling = jnp.stack([p.l * jnp.cos(theta), p.l * jnp.sin(theta), jnp.tan(phi), zero])
    return jnp.stack([rolling, jnp.array([0.0, 0.0, 0.0, 1.0])], axis=1)


def fields_spheroid(p: Parameters, q: Four) -> Float[Array, "4 2"]:
    """(14): X1 = l cos(eta) cos(theta - mu) d_eta - l sin(eta) sin(theta - mu) d_mu
    - a cosh(xi) sin(eta) cos(eta) tan(phi) d_theta and X2 = d_phi, one per column."""
    eta, mu, theta, phi = q
    turning = -p.a * jnp.cosh(p.xi) * jnp.sin(eta) * jnp.cos(eta) * jnp.tan(phi)
    along_mu = -p.l * jnp.sin(eta) * jnp.sin(theta - mu)
    rolling = jnp.stack([p.l * jnp.cos(eta) * jnp.cos(theta - mu), along_mu, turning, jnp.zeros(())])
    return jnp.stack([rolling, jnp.array([0.0, 0.0, 0.0, 1.0])], axis=1)


def pchs_plane(p: Parameters, q: Four, momentum: Four, force: Float[Array, " 2"]) -> tuple[Four, Four]:
    """(15): q' and p' on the plane, given the multipliers lambda_1 and lambda_2 [N]."""
    _, _, theta, phi = q
    l1, l2 = force
    rate = momentum / jnp.stack([p.m, p.m, p.J, p.J_f])
    push_x = -l1 * jnp.sin(theta) - l2 * jnp.sin(theta + phi)
    push_y = l1 * jnp.cos(theta) + l2 * jnp.cos(theta + phi)
    return rate, jnp.stack([push_x, push_y, l2 * p.l * jnp.cos(phi), jnp.zeros(())])


def output_plane(p: Parameters, q: Four, momentum: Four) -> Float[Array, " 2"]:
    """(16): the outputs of a vehicle, speed along the heading and steering rate."""
    return jnp.stack([(momentum[0] * jnp.cos(q[2]) + momentum[1] * jnp.sin(q[2])) / p.m, momentum[3] / p.J_f])


def pchs_spheroid(p: Parameters, q: Four, momentum: Four, force: Float[Array, " 2"]) -> tuple[Four, Four]:
    """The equations before (17): q' and p' on the spheroid, given the multipliers lambda_1 and lambda_2 [N]."""
    eta, mu, theta, phi = q
    (l1, l2), A = force, p.a * jnp.cosh(p.xi)
    D = jnp.sinh(p.xi) ** 2 + jnp.sin(eta) ** 2
    inertial = momentum[0] ** 2 * jnp.sin(eta) * jnp.cos(eta) / (p.m * p.a**2 * D**2)
    inertial = inertial - momentum[1] ** 2 * jnp.sin(eta) / (p.m * A**2 * jnp.cos(eta) ** 3)
    weight = -p.m * p.g * p.a * jnp.sinh(p.xi) * jnp.cos(eta)
    push_eta = A * jnp.sin(eta) * (l1 * jnp.sin(theta - mu) + l2 * jnp.sin(theta + phi - mu))
    push_mu = A * jnp.cos(eta) * (l1 * jnp.cos(theta - mu) + l2 * jnp.cos(theta + phi - mu))
    rate = momentum / masses_spheroid(p, eta)
    return rate, jnp.stack([inertial + weight + push_eta, push_mu, l2 * p.l * jnp.cos(phi), jnp.zeros(())])


def drive_spheroid(p: Parameters, q: Four) -> Four:
    """(17), the port: the drive along the horizontal heading acts through this one-form."""
    eta, mu, theta, _ = q
    A, zero = p.a * jnp.cosh(p.xi), jnp.zeros(())
    return jnp.stack([-A * jnp.sin(eta) * jnp.cos(theta - mu), A * jnp.cos(eta) * jnp.sin(theta - mu), zero, zero])


def output_spheroid(p: Parameters, q: Four, momentum: Four) -> Float[Array, ""]:
    """(17): the output of that port, the horizontal speed."""
    return drive_spheroid(p, q) @ (momentum / masses_spheroid(p, q[0]))


class Equation(NamedTuple):
    """A numbered equation: as printed, the verdict, the correct form, and the test that shows it."""

    number: str
    printed: str
    verdict: str
    correct: str
    test: str


EQUATIONS = (
    Equation(
        "(1), first line",
        "-sin θ x'_back + cos(θ+φ) y'_back = 0",
        "wrong: cos(θ+φ) for cos θ",
        "-sin θ x'_back + cos θ y'_back = 0",
        "test_constraints_on_the_plane",
    ),
    Equation(
        "(1), second line",
        "-sin(θ+φ) x'_front + cos(θ+φ) y'_front = 0",
        "right",
        "as printed",
        "test_constraints_on_the_plane",
    ),
    Equation(
        "(2)",
        "tan θ = y'/x'; ω¹ = -sin θ dx + cos θ dy",
        "right; the tangent form fails at cos θ = 0",
        "the one-form as printed",
        "test_constraints_on_the_plane",
    ),
    Equation(
        "(3), its number lost",
        "ω² = -sin(θ+φ) dx + cos(θ+φ) dy + l cos φ dθ",
        "right",
        "as printed",
        "test_constraints_on_the_plane",
    ),
    Equation(
        "(4)",
        "z = a sinh ξ sin μ",
        "wrong: not a point of the spheroid",
        "z = a sinh ξ sin η",
        "test_position_is_on_the_spheroid",
    ),
    Equation(
        "(5), (6)",
        "dx, dy without a dξ term",
        "right where dξ = 0, as on the spheroid",
        "as printed",
        "test_differentials_are_those_of_the_position",
    ),
    Equation(
        "(7)",
        "ω¹ = a cosh ξ sin η sin(θ-μ) dη",
        "wrong: the dμ term is missing",
        "ω¹ = a cosh ξ [sin η sin(θ-μ) dη + cos η cos(θ-μ) dμ]",
        "test_constraints_on_the_spheroid",
    ),
    Equation(
        "(8)",
        "ω² = a cosh ξ [sin η sin(θ+φ-μ) dη + cos η cos(θ+φ-μ) dμ] + l cos φ dθ",
        "right, as the pull-back of (3)",
        "as printed",
        "test_constraints_on_the_spheroid",
    ),
    Equation(
        "(9)",
        "H = p_η²/(2 m a √D) + p_μ²/(2 m a cosh ξ cosh η) + m g a sinh ξ (1 + sin η)",
        "wrong: scale factors for their squares, cosh η for cos η, no rotational energy; the potential is right",
        "H = p_η²/(2 m a² D) + p_μ²/(2 m a² cosh²ξ cos²η) + p_θ²/(2J) + p_φ²/(2J_f) + m g a sinh ξ (1 + sin η)",
        "test_hamiltonian_is_the_energy",
    ),
    Equation(
        "(10)",
        "two rows, neither a constraint",
        "wrong: both",
        "0 = cosh ξ sin η sin(θ-μ) p_η/(m a D) + cos(θ-μ) p_μ/(m a cosh ξ cos η); "
        "0 = the same with θ+φ for θ, plus l cos φ p_θ/J",
        "test_constraints_in_the_momenta",
    ),
    Equation(
        "(11)",
        "z = a sinh ξ sin μ; coordinates (ξ, η, φ); 0 ≤ η ≤ π",
        "wrong: z, the third coordinate and the range",
        "z = a sinh ξ sin η; (ξ, η, μ); -π/2 ≤ η ≤ π/2",
        "test_position_is_on_the_spheroid",
    ),
    Equation(
        "(12)",
        "h_ξ = h_η = a √(sinh²ξ + sin²η), h_μ = a cosh ξ cos η",
        "right",
        "as printed",
        "test_scale_factors_are_those_of_the_position",
    ),
    Equation(
        "(13)",
        "X₁ = l cos θ ∂x + l sin θ ∂y + tan φ ∂φ, X₂ = ∂φ, orthogonal",
        "wrong: tan φ ∂φ; the printed X₁ breaks the constraints and is not orthogonal to X₂",
        "X₁ = l cos θ ∂x + l sin θ ∂y + tan φ ∂θ",
        "test_fields_on_the_plane",
    ),
    Equation(
        "(14)",
        "X₁ = l cos η cos(θ-μ) ∂η - l sin η sin(θ-μ) ∂μ, X₂ = ∂φ; metric m a √D, cosh ξ + cos η",
        "wrong: the ∂θ component is missing; the metric",
        "X₁ with - a cosh ξ sin η cos η tan φ ∂θ; metric diag(m a² D, m a² cosh²ξ cos²η, J, J_f)",
        "test_fields_on_the_spheroid",
    ),
    Equation(
        "(15)",
        "p_y' = -λ₁ cos θ - λ₂ cos(θ+φ), φ' = p_φ/J",
        "wrong: the sign of p_y', J for J_f; the rest is right",
        "p_y' = λ₁ cos θ + λ₂ cos(θ+φ), φ' = p_φ/J_f",
        "test_canonical_equations_on_the_plane",
    ),
    Equation(
        "(16)",
        "y¹ = (p_x + p_y)/m",
        "no port of a vehicle: it depends on how the axes are drawn",
        "y = ((p_x cos θ + p_y sin θ)/m, p_φ/J_f), speed and steering rate",
        "test_output_on_the_plane",
    ),
    Equation(
        "before (17): η', μ'",
        "η' = p_η/(m a √D), μ' = p_μ/(m a cosh ξ cos η)",
        "wrong: scale factors for their squares",
        "η' = p_η/(m a² D), μ' = p_μ/(m a² cosh²ξ cos²η)",
        "test_canonical_equations_on_the_spheroid",
    ),
    Equation(
        "before (17): θ', φ'",
        "θ' = p_φ/J_f, no φ'",
        "wrong",
        "θ' = p_θ/J, φ' = p_φ/J_f",
        "test_canonical_equations_on_the_spheroid",
    ),
    Equation(
        "before (17): p_η'",
        "(sin η/(2 m a)) (p_η² cos η/D^(3/2) - m g a sinh ξ cos η)",
        "wrong: exponent, the p_μ² term, the multipliers, gravity inside the bracket",
        "p_η² sin η cos η/(m a² D²) - p_μ² sin η/(m a² cosh²ξ cos³η) - m g a sinh ξ cos η "
        "+ a cosh ξ sin η [λ₁ sin(θ-μ) + λ₂ sin(θ+φ-μ)]",
        "test_canonical_equations_on_the_spheroid",
    ),
    Equation(
        "before (17): p_μ', p_θ', p_φ'",
        "a cosh ξ cos η [λ₁ cos(θ-μ) + λ₂ cos(θ+φ-μ)], λ₂ l cos φ, 0",
        "right",
        "as printed",
        "test_canonical_equations_on_the_spheroid",
    ),
    Equation(
        "(17)",
        "y¹ = (1/(m a)) (p_η cos η/√D + p_μ/(cosh ξ cos η))",
        "wrong: a stray cos η, and no port of a vehicle",
        "y¹ = -a cosh ξ sin η cos(θ-μ) η' + a cosh ξ cos η sin(θ-μ) μ', the horizontal speed",
        "test_output_on_the_spheroid",
    ),
)


def render() -> str:
    """The audit as a page in Markdown."""
    lines = [
        "# The stroller's paper, equation by equation",
        "",
        "This audit states which equations of *Vector Fields of the Dynamics of Non-Holonomic Constraint System With",
        "Elliptical Configuration Space* hold, and corrects the others. D stands for sinh²ξ + sin²η. The tests, listed in",
        "`benchmarks/papers/stroller_paper.py`, derive each corrected form from the position on the spheroid.",
        "",
        'The paper constrains the horizontal projections of the wheels\' velocities: `heading="projected"`. On a slope, such a',
        'vehicle does not have a rigid frame, so `heading="intrinsic"` is the default.',
        "",
        "| equation | as printed | verdict | correct form |",
        "|---|---|---|---|",
    ]
    lines += [f"| {' | '.join(equation[:4])} |" for equation in EQUATIONS]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(render(), end="")
