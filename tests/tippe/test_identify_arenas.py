"""Numbers of a top and of its arena, on arenas of the general form, from what an independent program saw there."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from arena_reference import SAMPLES, Case, cases, recorded
from close import assert_close
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
    found = zip(cases(), recorded(), strict=True)
    case, row = next((case, row) for case, row in found if case.arena == arena and case.slip_speed == 0.0)
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


def test_the_height_of_waves():
    """From waves a tenth too high, by differences, which need no derivative of the run; of exact data nothing is left."""
    case, recording = film("graph")
    scene = tippe.Scene(rutstam_top(), tippe.Graph(Waves(1.1 * case.p1, case.p2)), tippe.Viscous(case.mu))
    found = tippe.identify(scene, recording, {"tall": 1.1 * case.p1}, slopes="differences", progress=False)
    assert found.status == "converged"
    assert_close(list(found.estimates.values()), case.p1, rtol=1e-6)
    assert max(abs(row.residual) for row in found.residuals) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("arena", ["graph", "paraboloid"])
def test_friction_and_shape(arena):
    """Of waves and of a bowl, by exact slopes, from a third too much friction and a tenth too much height."""
    case, recording = film(arena)
    surface = tippe.Paraboloid(1.1 * case.p1) if arena == "paraboloid" else tippe.Graph(Waves(1.1 * case.p1, case.p2))
    name = "surface.p" if arena == "paraboloid" else "tall"
    free = {"mu": 1.3 * case.mu, name: 1.1 * case.p1}
    found = tippe.identify(tippe.Scene(rutstam_top(), surface, tippe.Viscous(0.2)), recording, free, progress=False)
    assert found.status == "converged"
    assert_close(list(found.estimates.values()), [case.mu, case.p1], rtol=1e-5)
    assert 0.0 < found.standard_errors["scene.friction.mu"] < 0.1 * case.mu
