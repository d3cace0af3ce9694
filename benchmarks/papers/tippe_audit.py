r"""Audit of the paper: each numbered equation as printed, the verdict, the correct form, and the tests for both.

`python benchmarks/papers/tippe_audit.py` prints it; `docs/development/papers.md` has a summary. In the formulas
eta is the angle of the position from the lowest line, r the arena's radius, rho = r - R the radius of the centre's path,
and phi the direction of the axis from that of increasing eta.
"""

import textwrap
from typing import NamedTuple


class Equation(NamedTuple):
    """The verdict on one of the paper's statements.

    - `number`: the paper's number.
    - `subject`: the subject of the statement.
    - `printed`: as printed, in TeX.
    - `verdict`: right, right on the plane, misprint, incomplete, wrong, meaningless or lost.
    - `reason`: the reason for the verdict, in a few sentences.
    - `correct`: the correct formulas, in TeX; empty where there are none.
    - `code`: the functions that compute the correct form.
    - `tests`: the tests that show verdict and correct form, as pytest names them.
    """

    number: str
    subject: str
    printed: str
    verdict: str
    reason: str
    correct: tuple[str, ...]
    code: tuple[str, ...]
    tests: tuple[str, ...]


WITNESSES, PAPER = "tests/physics/test_witnesses.py::", "tests/papers/test_tippe_paper.py::"
REDUCED, ANGLES = "tests/witnesses/reduced_tops.py::", "tests/witnesses/euler_angles.py::"
FORMULAS = "benchmarks/papers/tippe_formulas.py::"

AUDIT = (
    Equation(
        number="(1)",
        subject="Jellett's constant",
        printed=r"J = Cn\left(R\cos\theta + A\dot\eta R\sin^2\theta\right)",
        verdict="misprint",
        reason="The bracket closes in the wrong place, the offset a is missing, and the rate of precession has the symbol of "
        "the position. The first correct formula holds on the plane, the second in the cylinder.",
        correct=(
            r"J = I_3\omega_3(R\cos\theta - a) + I_1\dot\phi R\sin^2\theta",
            r"J = R\left[I_1(\dot\phi\sin^2\theta + \dot\eta\sin\theta\cos\theta\sin\phi) "
            r"+ I_3\omega_3\cos\theta\right] - aI_3\omega_3",
        ),
        code=(REDUCED + "jellett_constant", "tippe.Scene.jellett"),
        tests=(PAPER + "test_equation_1_is_jelletts_constant_only_when_corrected",),
    ),
    Equation(
        number="text",
        subject="constancy of Jellett's quantity",
        printed=r"\dot J = 0 \text{ whether or not there is slipping}",
        verdict="right on the plane",
        reason="J is constant on the plane, for every force at the contact point, but not in the cylinder, where the normal "
        "turns.",
        correct=(r"\dot J = R\,\mathbf L\cdot\dot{\mathbf n},\qquad \dot{\mathbf n} = -\dot\eta\,\mathbf t_\eta",),
        code=("tippe.Scene.jellett",),
        tests=(
            WITNESSES + "test_jelletts_quantity_in_the_cylinder_drifts_by_r_times_l_dot_n_prime",
            WITNESSES + "test_trajectories_of_all_formulations_on_the_plane_agree_for_five_seconds",
        ),
    ),
    Equation(
        number="(2)",
        subject="Poincaré's equations after Routh's reduction",
        printed=r"\frac{d}{dt}\frac{\partial R}{\partial v^\rho} "
        r"- \sum c^\lambda_{\mu\rho}v^\mu\frac{\partial R}{\partial v^\lambda} "
        r"- \sum c^\lambda_{\mu\rho}v^\mu\beta_1 - X_\rho R = 0",
        verdict="misprint",
        reason="The third term needs the structure constants of the cyclic field, with upper index 1. The right side is 0 "
        "only without friction; with friction it is the generalised force, and beta1 is not constant.",
        correct=(
            r"\frac{d}{dt}\frac{\partial R}{\partial v^\rho} "
            r"- c^\lambda_{\mu\rho}v^\mu\frac{\partial R}{\partial v^\lambda} "
            r"- c^1_{\mu\rho}v^\mu\beta_1 - X_\rho R = Q_\rho,\qquad \dot\beta_1 = Q_1,\qquad R = L - \beta_1v^1",
        ),
        code=("tests/witnesses/poincare.py::by_equation_2",),
        tests=(
            WITNESSES + "test_lagrange_poincare_and_the_corrected_paper_give_the_accelerations_of_the_vector_form",
            PAPER + "test_the_frame_of_equation_2_has_the_structure_that_the_reduction_needs",
        ),
    ),
    Equation(
        number="(3), (4), (5)",
        subject="rotation generators in cylindrical coordinates",
        printed=r"R_\theta = y\cos\eta\,\partial_r - \tfrac yr\sin\eta\,\partial_\eta - r\cos\eta\,\partial_y,\quad "
        r"R_\phi = \partial_\eta,\quad "
        r"R_\psi = -y\sin\eta\,\partial_r - \tfrac yr\cos\eta\,\partial_\eta + r\sin\eta\,\partial_y",
        verdict="right",
        reason="The formulas hold for x = r sin(eta) and z = r cos(eta), with eta = 0 at the top. The first line of (5) "
        "contains phi and theta instead of eta and y. Only the second field is tangent to the cylinder.",
        correct=(r"[R_x, R_y] = -R_z,\qquad [R_y, R_z] = -R_x,\qquad [R_z, R_x] = -R_y",),
        code=(FORMULAS + "rotation_generators",),
        tests=(
            PAPER + "test_the_printed_generators_are_the_rotations_and_close_as_so3",
            PAPER + "test_only_the_second_generator_is_tangent_to_the_cylinder",
        ),
    ),
    Equation(
        number="(6)",
        subject="Lagrangian",
        printed=r"L' = \tfrac12\left(m(\dot x^2+\dot y^2) + I\dot\theta^2 + I\sin^2\theta\,\dot\phi^2 "
        r"+ I_3(\dot\psi+\dot\phi\cos\theta)^2\right) - mg(R-a\cos\theta)",
        verdict="incomplete",
        reason="This Lagrangian is for the plane, and lacks the vertical motion of the centre of mass. The first correct "
        "formula is for the plane, the second for the cylinder, with the height z of the centre of mass.",
        correct=(
            r"L = L' + \tfrac12 ma^2\dot\theta^2\sin^2\theta",
            r"L = \tfrac12 m|\dot{\mathbf O} - a\dot{\mathbf e}|^2 + \tfrac12I_1(p^2+q^2) "
            r"+ \tfrac12I_3\omega_3^2 - mgz",
        ),
        code=(
            REDUCED + "lagrangian",
            ANGLES + "metric",
            ANGLES + "potential",
        ),
        tests=(PAPER + "test_equation_6_lacks_the_vertical_motion_of_the_centre_of_mass",),
    ),
    Equation(
        number="(7), (8), (10)",
        subject="cyclic velocity and beta1",
        printed=r"\beta_1 = \frac{J - I\dot\phi R\sin^2\theta}{R\cos\theta-a},\qquad "
        r"\dot\psi = \frac{\beta_1}{I_3} - \dot\phi\cos\theta",
        verdict="right on the plane",
        reason="The equations hold on the plane, except for an unbalanced bracket in (7). In the cylinder, the rate of eta "
        "adds a term.",
        correct=(r"\dot\psi = \frac{\beta_1}{I_3} - \dot\phi\cos\theta + \dot\eta\sin\theta\sin\phi",),
        code=(
            REDUCED + "spin_rate_from_jellett",
            REDUCED + "spin_momentum_from_jellett",
            REDUCED + "spin_rate",
        ),
        tests=(PAPER + "test_equations_7_8_and_10_hold_on_the_plane",),
    ),
    Equation(
        number="text",
        subject="constancy of beta1",
        printed=r"\beta_1 = \text{constant}",
        verdict="wrong",
        reason="Friction changes the spin about the axis.",
        correct=(r"\dot\beta_1 = -NR\,(\mathbf n\times\mathbf f)\cdot\mathbf e",),
        code=("tippe.Scene.field",),
        tests=(PAPER + "test_friction_changes_beta1",),
    ),
    Equation(
        number="(9)",
        subject="reduced kinetic energy",
        printed=r"T = \tfrac12\left(I\dot\theta^2 + I\sin^2\theta\,\dot\phi^2 + \frac{\beta_1^2}{I_3}\right)",
        verdict="wrong",
        reason="This formula gives the rotational kinetic energy, but the equations of motion follow from the Routhian, which "
        "has a gyroscopic term, the opposite sign of the last term, and the translational and potential energy.",
        correct=(
            r"R = \tfrac12\left(m(\dot x^2+\dot y^2+a^2\dot\theta^2\sin^2\theta) + I\dot\theta^2 "
            r"+ I\sin^2\theta\,\dot\phi^2\right) + \beta_1\dot\phi\cos\theta - \frac{\beta_1^2}{2I_3} "
            r"- mg(R-a\cos\theta)",
        ),
        code=(REDUCED + "routhian", REDUCED + "jellett_rate"),
        tests=(
            PAPER + "test_equation_9_is_an_energy_but_no_routhian",
            WITNESSES + "test_rutstam_and_the_jellett_reduction_give_the_accelerations_of_the_vector_form",
        ),
    ),
    Equation(
        number="(11)",
        subject="equations of motion in the cylinder",
        printed=r"(\ddot\eta,\ \ddot\phi,\ \ddot\theta,\ \ddot{\ },\ \ddot x)^T = (\ldots)",
        verdict="meaningless",
        reason="A symbol on the left is missing. The right sides mix forces times lengths with accelerations, and do not "
        "contain mu.",
        correct=(
            r"m(\ddot{\mathbf O} - a\ddot{\mathbf e}) = N(\mathbf f + \mathbf n) - mg\mathbf z",
            r"I_1\dot p + I_3\omega_3q - I_1qs = N\mathbf M\cdot\mathbf e_1,\qquad "
            r"I_1\dot q + I_1ps - I_3\omega_3p = N\mathbf M\cdot\mathbf e_2,\qquad "
            r"I_3\dot\omega_3 = N\mathbf M\cdot\mathbf e",
            r"p = -(\dot\phi\sin\theta + \dot\eta\cos\theta\sin\phi),\quad q = \dot\theta - \dot\eta\cos\phi,\quad "
            r"s = \dot\phi\cos\theta - \dot\eta\sin\theta\sin\phi,\quad \omega_3 = \dot\psi + s",
        ),
        code=(ANGLES + "equations", ANGLES + "by_equation_11"),
        tests=(
            WITNESSES + "test_lagrange_poincare_and_the_corrected_paper_give_the_accelerations_of_the_vector_form",
            WITNESSES + "test_trajectories_of_all_formulations_in_the_cylinder_agree_for_five_seconds",
        ),
    ),
    Equation(
        number="(12)",
        subject="normal force in the cylinder",
        printed=r"|F_N| = m\left[g\cos\eta + a(\ddot\theta\sin\theta + \dot\theta^2\cos\theta) + r\dot\eta^2\right]",
        verdict="incomplete",
        reason="The equation is right on the plane. In the cylinder, three terms are missing, and r must be rho = r - R, the "
        "radius of the path of the centre.",
        correct=(
            r"\frac Nm = g\cos\eta + \rho\dot\eta^2 + a(\ddot\theta\sin\theta + \dot\theta^2\cos\theta) "
            r"+ a\dot\eta^2\cos\theta - a\ddot\eta\,e_t - 2a\dot\eta\,\dot e_t,\qquad e_t = \sin\theta\cos\phi",
        ),
        code=(ANGLES + "normal_force",),
        tests=(PAPER + "test_equation_12_needs_three_more_terms_in_the_cylinder_and_none_on_the_plane",),
    ),
    Equation(
        number="Table 1",
        subject="the top",
        printed=r"I,\ I_3,\ m,\ R,\ D",
        verdict="lost",
        reason="The values are missing. The last section shows that Tables 2 and 3 do not determine them.",
        correct=(),
        code=(),
        tests=(
            PAPER + "test_one_top_gives_the_pattern_of_table_2_and_its_times_to_a_second_and_a_half",
            PAPER + "test_one_top_gives_table_3_to_half_a_second_and_table_2_nearly",
        ),
    ),
    Equation(
        number="Tables 2, 3",
        subject="times of reversal",
        printed=r"\beta_1 = 2{,}500\ \mathrm{g\,m^2\,rad/s},\qquad "
        r"\dot\theta=\dot\phi=\dot\psi=\dot\eta=\dot X=0",
        verdict="wrong",
        reason="With the printed unit, a top of ordinary size would spin at more than 1e5 rad/s. The zero rates contradict "
        "beta1: such a top never rises. We use 2500 g cm^2/s, which gives the initial spin. The paper does not state the "
        "friction law for mu = 0.3.",
        correct=(r"\omega_3(0) = \beta_1/I_3,\qquad \beta_1 = 2.5\cdot10^{-4}\ \mathrm{kg\,m^2/s}",),
        code=(FORMULAS + "launch",),
        tests=(
            PAPER + "test_the_unit_of_beta1_as_printed_is_impossible",
            PAPER + "test_a_top_launched_with_all_rates_zero_never_rises",
        ),
    ),
)

TITLE = "# The paper on the tippe top in the cylinder, equation by equation"

PREFACE = """
This audit states which equations of *Modeling of Dynamics Object with Non-Holonomic Constraints Based on Maple in
Cylinder Coordinate* hold, and corrects the others. The equations of the top (`docs/concepts/tippe.md`) define the symbols;
I is I₁ and J is Jellett's quantity λ.

* With sliding friction the top has **no nonholonomic constraint**: the contact is holonomic, and friction is a force.
* Jellett's quantity is constant on a plane, but **not in the cylinder**, where the paper uses its constancy in place of
  an equation of motion.
* This package uses none of the paper's equations. The corrected equations agree with its vector form to 10⁻¹⁰.
"""

TABLES = """
## Can Tables 2 and 3 replace the lost Table 1?

No. Each table states for nine launches whether the top reverses, and if so, when; there are six such times in all. They
depend on eight unknown parameters and an unknown friction law. Here a top counts as reversed if it reaches 0.95 pi
within 40 s.

* **Table 2** (`python benchmarks/paper_tables_scan.py`). Of 20 000 random tops under viscous friction, 294 reverse in the
  printed rows; the best of them, after optimisation, misses the times by 1.25 s.
* **Table 3** (the same program). No top reproduces it: tops that keep contact reverse after 3 to 30 s in another order.
* **Both tables** (`python benchmarks/paper_tables_joint.py --law viscous`). With an error of 1 s in each row, the smallest -2
  log likelihood is 29.6 at 11 degrees of freedom. From the wall, this top reverses at 22.6, 19.3, 19.9 and 22.4 s (printed:
  23, 19, 20, 22), and from the lowest line at 26.3, 26.3, 28.2 and 30.3 s (printed: 25, 22, not, not). Other tops fit as
  well (`examples/lost_numbers.py`).
"""


def render() -> str:
    """The audit as a page in Markdown."""
    parts = [TITLE, PREFACE.strip(), *map(_section, AUDIT), TABLES.strip()]
    return "\n\n".join(parts) + "\n"


def _section(entry: Equation) -> str:
    lines = [f"## {entry.number}: {entry.subject}", f"Printed:\n\n$$\n{entry.printed}\n$$"]
    verdict = f"**{entry.verdict[0].upper()}{entry.verdict[1:]}.** {entry.reason}"
    lines.append(textwrap.fill(verdict, 120, break_on_hyphens=False))
    if entry.correct:
        formulas = "\n\n".join(f"$$\n{formula}\n$$" for formula in entry.correct)
        lines.append(f"Correct:\n\n{formulas}")
    if entry.code:
        lines.append("Code: " + ", ".join(f"`{name}`" for name in entry.code) + ".")
    if entry.tests:
        lines.append("Tests: " + ", ".join(f"`{test}`" for test in entry.tests) + ".")
    return "\n\n".join(lines)


if __name__ == "__main__":
    print(render(), end="")
