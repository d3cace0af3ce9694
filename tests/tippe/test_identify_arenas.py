"""Numbers of a top and of its arena, on arenas of the general form, from what an independent program saw there."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from arena_reference import SAMPLES, Case, Top, cases, recorded
from close import assert_close
from scipy.integrate import solve_ivp
from tops import rutstam_top

import tippe


class Waves(eqx.Module):
    """z = tall sin(k x) cos(k y), as in the independent program."""

    tall: float
    k: float

    def __call__(self, x, y):
        return self.tall * jnp.sin(self.k * x) * jnp.cos(self.k * y)


def film(arena: str) -> tuple[Case, tippe.Recording]:
    """A row of `arena_reference.csv` with viscous friction: centre and axis at six times, as a recording."""
    films = zip(cases(), recorded(), strict=True)
    case, row = next((case, row) for case, row in films if case.arena == arena and case.slip_speed == 0.0)
    launch = tippe.Launch(
        case.theta,
        case.spin,
        azimuth=case.azimuth,
        place=(row["q1"], row["q2"]),
        velocity=(case.v1, case.v2),
        angular_velocity=(case.w1, case.w2, case.w3),
    )
    times = case.t1 * np.arange(1, SAMPLES + 1) / SAMPLES
    value = [[row[f"{name}{i}_{k}"] for name in "Oe" for i in range(3)] for k in range(1, SAMPLES + 1)]
    return case, tippe.Recording(launch, times, value, [1e-3] * 3 + [1e-2] * 3, ("position", "axis"))


@pytest.mark.slow
def test_the_height_of_waves():
    """From waves a tenth too high, by differences, which need no derivative of the run; of exact data nothing is left."""
    case, recording = film("graph")
    scene = tippe.Scene(rutstam_top(), tippe.Graph(Waves(1.1 * case.p1, case.p2)), tippe.Viscous(case.mu))
    fit = tippe.identify(scene, recording, {"tall": 1.1 * case.p1}, slopes="differences", progress=False)
    assert fit.status == "converged"
    assert_close(list(fit.estimates.values()), case.p1, rtol=1e-6)
    assert max(abs(row.residual) for row in fit.residuals) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("arena", ["graph", "paraboloid"])
def test_friction_and_shape(arena):
    """Of waves and of a bowl, by exact slopes, from a third too much friction and a tenth too much height."""
    case, recording = film(arena)
    surface = tippe.Paraboloid(1.1 * case.p1) if arena == "paraboloid" else tippe.Graph(Waves(1.1 * case.p1, case.p2))
    name = "surface.p" if arena == "paraboloid" else "tall"
    free = {"mu": 1.3 * case.mu, name: 1.1 * case.p1}
    fit = tippe.identify(tippe.Scene(rutstam_top(), surface, tippe.Viscous(0.2)), recording, free, progress=False)
    assert fit.status == "converged"
    assert_close(list(fit.estimates.values()), [case.mu, case.p1], rtol=1e-5)
    assert 0.0 < fit.standard_errors["scene.friction.mu"] < 0.1 * case.mu


#: Launches at a place of the bowl z = (x^2 + y^2) / (2 p), p = 0.25 m, and when theta is 0.6 pi there (`independent_time`).
BOWL, ANGLE, PLACE = 0.25, 0.6 * math.pi, (0.05, 0.02)
THETA, SPIN = [0.1, 0.3, 0.3, 0.6], [150.0, 150.0, 170.0, 160.0]
TIMES = [3.51969430631434, 2.9824320158330484, 2.8399916101924654, 2.415615397994213]


def independent_time(theta, spin):
    """When the axis of a top in the bowl is at the angle from the normal at its foot [s], by Newton-Euler in SciPy."""
    place = (*PLACE, (PLACE[0] ** 2 + PLACE[1] ** 2) / (2.0 * BOWL))
    case = Case("paraboloid", BOWL, 0.0, 0.3, 0.0, theta, 0.0, spin, *place, *5 * (0.0,), 6.0)
    top = Top(case)

    def reached(_, y):
        centre, u, e, w = y.reshape(4, 3)
        normal, _ = top.contact(centre, u + case.offset * np.cross(w, e))
        return normal @ e - math.cos(ANGLE)

    reached.terminal = True
    start = top.start()
    run = solve_ivp(lambda _, y: top.motion(y)[0], (0.0, 6.0), start, "DOP853", rtol=1e-10, atol=1e-11, events=reached)
    return float(run.t_events[0][0])


@pytest.mark.slow
def test_the_times_in_a_bowl_are_those_of_the_independent_program():
    assert_close([independent_time(theta, spin) for theta, spin in zip(THETA, SPIN, strict=True)], TIMES, rtol=1e-8)


@pytest.mark.slow
def test_the_shape_of_a_bowl_from_inversion_times():
    """From a bowl a tenth too wide, in which every top inverts 0.2 to 0.4 s later; of exact times nothing is left."""
    launch = tippe.Launch(theta=THETA, spin=SPIN, place=PLACE)
    data = tippe.InversionTimes(launch, TIMES, error=0.01, t1=6.0, angle=ANGLE)
    scene = tippe.Scene(rutstam_top(), tippe.Paraboloid(1.1 * BOWL), tippe.Viscous(0.3))
    fit = tippe.identify(scene, data, {"surface.p": 1.1 * BOWL}, progress=False)
    assert fit.status == "converged"
    # Half a standard error from there the estimate is a likely point near the mean.
    assert_close(fit.most_likely["scene.surface.p"], BOWL, rtol=1e-6)
    assert abs(fit.estimates["scene.surface.p"] - BOWL) < fit.standard_errors["scene.surface.p"]
    assert max(abs(row.residual) for row in fit.residuals) < 1e-3
    assert 0.0 < fit.standard_errors["scene.surface.p"] < 0.01 * BOWL
