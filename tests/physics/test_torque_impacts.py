"""Friction with a torque, in impacts and in motions through flights, against Euler's equations in NumPy and SciPy."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest
from close import assert_close
from hop_reference import Case, row
from impact_reference import Body, Law
from impact_reference import resolve_impact as reference_impact
from test_hops import scene_of
from test_strong_friction import COUNT, Falls, impact_of, random_falls

import tippe
from tippe.model.dynamics import angular_velocity
from tippe.modes.impact import balls


def with_torques(impacts: Falls) -> Falls:
    """Discs of contact to a tenth of the radius, and rolling resistance."""
    sliding, radius, random = impacts.friction, impacts.body.radius, np.random.default_rng(2)
    disc, lever = 0.1 * radius * random.random((2, COUNT))
    contensou = tippe.Contensou(sliding.mu, disc, sliding.slip_speed)
    return eqx.tree_at(
        lambda impacts: impacts.friction, impacts, tippe.Rolling(lever, random.uniform(1.0, 10.0, COUNT), contensou)
    )


@pytest.mark.slow
def test_impacts_with_torques():
    """The torque per unit normal force has the normal impulse as its clock too: against the independent program, 1000 end, and
    no energy comes from nowhere."""
    impacts = with_torques(random_falls(0.0, 5.0))
    free_after, has_failed = impact_of(impacts)
    assert not np.asarray(has_failed).any()
    free, ball, law = impacts.free, balls(impacts.body)[0], impacts.friction
    energy_before = np.asarray(free.energy(impacts.body, 9.81))
    assert np.max(np.asarray(free_after.energy(impacts.body, 9.81)) / energy_before) < 1.0 + 1e-13
    numbers = (law.sliding.mu, law.sliding.slip_speed, law.sliding.contact_radius, law.resistance, law.turning_speed)
    velocity, turning = (
        np.stack(free_after.velocity),
        np.stack(angular_velocity(impacts.body, free_after.axis, free_after.momentum)),
    )
    indices = np.flatnonzero(-np.asarray(free.gap_rate(impacts.body, ball)) > 1e-3)
    for i in indices[:20]:
        body = Body(*(float(getattr(impacts.body, name)[i]) for name in Body._fields))
        motion = impacts.axis[:, i], impacts.velocity[:, i], impacts.turning[:, i]
        expected = reference_impact(
            body, *motion, Law(*(float(number[i]) for number in numbers)), impacts.restitution[i]
        )
        speed = np.linalg.norm(motion[1]) + body.radius * np.linalg.norm(motion[2])
        assert_close(velocity[:, i], expected.velocity, atol=1e-9 * speed)
        assert_close(turning[:, i], expected.turning, atol=1e-9 * speed / body.radius)


@pytest.mark.slow
def test_impacts_without_disc_or_lever_are_those_of_coulomb():
    """In the limit, and close by in proportion to the lever and, but for its torque, to the square of the disc's radius."""
    impacts = random_falls(0.0, 1.0)

    def changed(disc, lever):
        coulomb = impacts.friction
        contensou = tippe.Contensou(coulomb.mu, disc * impacts.body.radius, coulomb.slip_speed)
        law = tippe.Rolling(lever * impacts.body.radius, np.ones(COUNT), contensou)
        free_after, _ = impact_of(eqx.tree_at(lambda impacts: impacts.friction, impacts, law))
        return np.stack(free_after.velocity)

    expected = np.stack(impact_of(impacts)[0].velocity)
    size = np.linalg.norm(impacts.velocity, axis=0)
    assert_close(changed(0.0, 0.0) / size, expected / size, atol=1e-11)
    for law_at, order in ((lambda h: changed(h, 0.0), 2.0), (lambda h: changed(0.0, h), 1.0)):
        gaps = [np.max(np.abs(law_at(h) - expected) / size) for h in (2e-5, 1e-5)]
        assert_close(np.log2(gaps[0] / gaps[1]), order, atol=0.05)


HOPS = Case(0.02, 0.02, 0.016, 1.6e-6, 1.9e-6, 0.5, 1.5, 300.0, slip_speed=0.1, t1=0.4)
TORQUES = {"contact_radius": 1e-3, "resistance": 1e-4, "turning_speed": 5.0}


@pytest.mark.slow
@pytest.mark.parametrize("surface", [tippe.Plane(), tippe.Graph(lambda x, y: 0.0 * x)], ids=["plane", "graph"])
def test_inversion_times_through_flights_with_torques(surface):
    """A disc of contact and rolling resistance, after 3 flights and 2 impacts; a graph has the modes of every arena."""
    cases = [dataclasses.replace(HOPS, spin=spin, **TORQUES) for spin in (300.0, 350.0)]
    scene = dataclasses.replace(scene_of(cases[0]), surface=surface)
    table = tippe.inversion_table(scene, theta=1.5, spin=[300.0, 350.0], t1=0.4, tolerance=1e-11)
    for case, time, hops in zip(cases, table.time, table.hops, strict=True):
        expected = row(case)
        # The differences seen are below 1e-12.
        assert_close(time, expected["time"], rtol=1e-10)
        assert hops == expected["flights"] == 3
