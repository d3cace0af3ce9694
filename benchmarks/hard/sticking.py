"""Stick and slip: Cohen's top under a regularised Coulomb law of ever smaller slip speed, and under the law itself.

theta after 0.5 s, against the event-driven reference in SciPy (`tests/physics/coulomb_top.py`) for the law itself, and against
another method at a sharp tolerance for the regularised one. The explicit method's steps grow as 1 / slip speed, those of the
implicit one do not: it pays from 1e-4 m/s down. Kvaerno's method with Diffrax's own root finder, a chord iteration that
fails often here, rejects every second step; Newton's takes a fifth of the steps.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import diffrax
import numpy as np
import optimistix
from measure import timed

import tippe
from hard.row import Row, of_runs

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "physics"))

import coulomb_top

#: Where the runs are compared [s].
END = 0.5


def cohen_top() -> tippe.Top:
    """Cohen's top, Am. J. Phys. 45 (1977) 12."""
    inertia = 0.4 * 0.015 * 0.025**2
    return tippe.Top(0.015, 0.025, 0.005, inertia, inertia)


def implicit() -> diffrax.Kvaerno5:
    """Kvaerno's method of fifth order with Newton's iteration."""
    return diffrax.Kvaerno5(root_finder=diffrax.with_stepsize_controller_tols(optimistix.Newton)())


def final_theta(friction: tippe.AbstractFriction, solver: diffrax.AbstractSolver, tolerance: float) -> tippe.Trajectory:
    """The run to the end, mu = 0.3, theta = 0.1, 100 rad/s."""
    scene = tippe.Scene(cohen_top(), friction=friction)
    return tippe.simulate(scene, tippe.Launch(0.1, 100.0), END, tolerance=tolerance, solver=solver)


def regularised(slip_speed: float, solver: diffrax.AbstractSolver, tolerance: float, bound: float) -> Row:
    """The regularised law at one slip speed with one method, against the other method at a sharp tolerance."""
    friction = tippe.Coulomb(0.3, slip_speed)
    explicit = isinstance(solver, diffrax.Dopri8)
    reference = final_theta(friction, implicit() if explicit else diffrax.Dopri8(), 1e-9)
    run = timed(lambda: final_theta(friction, solver, tolerance), 1)
    theta = float(run.result.theta[-1])
    return of_runs(
        f"Cohen's top, Coulomb regularised by {slip_speed:g} m/s, {'explicit' if explicit else 'implicit'}",
        f"theta(0.5 s) = {theta:.6f} rad",
        abs(theta - float(reference.theta[-1])),
        bound,
        f"{'Kvaerno5' if explicit else 'Dopri8'} at 1e-9 [rad]",
        run,
    )


def explicit_at_a_tenth() -> Row:
    """Slip speed 0.1 m/s, Dopri8."""
    return regularised(1e-1, diffrax.Dopri8(), 1e-7, 1e-6)


def explicit_at_a_hundredth() -> Row:
    """Slip speed 0.01 m/s, Dopri8."""
    return regularised(1e-2, diffrax.Dopri8(), 1e-7, 3e-7)


def explicit_at_a_thousandth() -> Row:
    """Slip speed 1e-3 m/s, Dopri8."""
    return regularised(1e-3, diffrax.Dopri8(), 1e-7, 1e-7)


def explicit_at_a_ten_thousandth() -> Row:
    """Slip speed 1e-4 m/s, Dopri8."""
    return regularised(1e-4, diffrax.Dopri8(), 1e-7, 1e-7)


def implicit_at_a_tenth() -> Row:
    """Slip speed 0.1 m/s, Kvaerno5."""
    return regularised(1e-1, implicit(), 1e-7, 5e-5)


def implicit_at_a_ten_thousandth() -> Row:
    """Slip speed 1e-4 m/s, Kvaerno5."""
    return regularised(1e-4, implicit(), 1e-7, 1e-5)


def implicit_at_the_limit() -> Row:
    """Slip speed 1e-5 m/s, Kvaerno5, against the law itself: the regularisation is the error."""
    run = timed(lambda: final_theta(tippe.Coulomb(0.3, 1e-5), implicit(), 1e-7), 1)
    theta = float(run.result.theta[-1])
    return of_runs(
        "Cohen's top, Coulomb regularised by 1e-05 m/s, implicit",
        f"theta(0.5 s) = {theta:.6f} rad",
        abs(theta - by_events()),
        4e-4,
        "SciPy by events, without a slip speed [rad]",
        run,
    )


def by_events() -> float:
    """theta at the end under the law itself, in NumPy and SciPy."""
    top = cohen_top()
    body = coulomb_top.Body(*(float(x) for x in (top.mass, top.radius, top.offset, top.I1, top.I3)), 0.3)
    last = coulomb_top.follow(body, coulomb_top.start(body, 0.1, 100.0), END)[-1]
    return float(coulomb_top.theta(last.states[:, -1]))


def the_law_itself() -> Row:
    """SetValuedCoulomb: the slip ends and the top rolls."""
    run = timed(lambda: final_theta(tippe.SetValuedCoulomb(0.3), diffrax.Dopri8(), 1e-9), 1)
    theta = float(run.result.theta[-1])
    slip = run.result.dense.mode_segments[0]
    return of_runs(
        "Cohen's top under Coulomb's law itself",
        f"slips to {slip.end:.5f} s, then rolls; theta(0.5 s) = {theta:.6f} rad",
        abs(theta - by_events()),
        1e-8,
        "SciPy by events [rad]",
        run,
    )


def stick_and_slip_again() -> Row:
    """Rutstam's top at mu = 0.2, theta = 1.5, 30 rad/s: slips three times and rolls twice within 0.9 s."""
    inertia = 0.02 * 0.02**2
    numbers = (0.02, 0.02, 0.006, 131.0 / 350.0 * inertia, 0.4 * inertia)
    scene = tippe.Scene(tippe.Top(*numbers), friction=tippe.SetValuedCoulomb(0.2))
    run = timed(lambda: tippe.simulate(scene, tippe.Launch(1.5, 30.0), 0.9, tolerance=1e-9), 1)
    body = coulomb_top.Body(*numbers, 0.2)
    last = coulomb_top.follow(body, coulomb_top.start(body, 1.5, 30.0), 0.9)[-1]
    return of_runs(
        "Rutstam's top under Coulomb's law itself, mu = 0.2",
        f"sticks {run.result.stats['sticks']} times and slips again",
        float(np.max(np.abs(np.asarray(run.result.axis[-1]) - last.states[:3, -1]))),
        1e-7,
        "SciPy by events, axis [1]",
        run,
    )


def rows() -> list[Callable[[], Row]]:
    """The rows of this file."""
    return [
        explicit_at_a_tenth,
        explicit_at_a_hundredth,
        explicit_at_a_thousandth,
        explicit_at_a_ten_thousandth,
        implicit_at_a_tenth,
        implicit_at_a_ten_thousandth,
        implicit_at_the_limit,
        the_law_itself,
        stick_and_slip_again,
    ]
