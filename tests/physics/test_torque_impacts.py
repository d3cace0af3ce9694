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
from test_strong_friction import COUNT, Falls, random_falls, struck

import tippe
from tippe.model.state import angular_velocity
from tippe.modes.free_body import balls, energy, gap_rate


def with_torques(falls: Falls) -> Falls:
    """Discs of contact to a tenth of the radius, and rolling resistance."""
    sliding, radius, random = falls.friction, falls.body.radius, np.random.default_rng(2)
    disc, lever = 0.1 * radius * random.random((2, COUNT))
    contensou = tippe.Contensou(sliding.mu, disc, sliding.slip_speed)
    return eqx.tree_at(
        lambda falls: falls.friction, falls, tippe.Rolling(lever, random.uniform(1.0, 10.0, COUNT), contensou)
    )


@pytest.mark.slow
def test_impacts_with_torques():
    """The torque per unit normal force has the normal impulse as its clock too: against the independent program, 1000 end, and
    no energy comes from nowhere."""
    falls = with_torques(random_falls(0.0, 5.0))
    after, fails = struck(falls)
    assert not np.asarray(fails).any()
    free, ball, law = falls.free, balls(falls.body)[0], falls.friction
    before = np.asarray(energy(falls.body, 9.81, free))
    assert np.max(np.asarray(energy(falls.body, 9.81, after)) / before) < 1.0 + 1e-13
    numbers = (law.sliding.mu, law.sliding.slip_speed, law.sliding.contact_radius, law.resistance, law.turning_speed)
    velocity, turning = np.stack(after.velocity), np.stack(angular_velocity(falls.body, after.axis, after.momentum))
    falling = np.flatnonzero(-np.asarray(gap_rate(falls.body, ball, free)) > 1e-3)
    for i in falling[:20]:
        body = Body(*(float(getattr(falls.body, name)[i]) for name in Body._fields))
        motion = falls.axis[:, i], falls.velocity[:, i], falls.turning[:, i]
        expected = reference_impact(body, *motion, Law(*(float(number[i]) for number in numbers)), falls.restitution[i])
        speed = np.linalg.norm(motion[1]) + body.radius * np.linalg.norm(motion[2])
        assert_close(velocity[:, i], expected.velocity, atol=1e-9 * speed)
        assert_close(turning[:, i], expected.turning, atol=1e-9 * speed / body.radius)


@pytest.mark.slow
def test_impacts_without_disc_or_lever_are_those_of_coulomb():
    """In the limit, and close by in proportion to the lever and, but for its torque, to the square of the disc's radius."""
    falls = random_falls(0.0, 1.0)

    def changed(disc, lever):
        coulomb = falls.friction
        contensou = tippe.Contensou(coulomb.mu, disc * falls.body.radius, coulomb.slip_speed)
        law = tippe.Rolling(lever * falls.body.radius, np.ones(COUNT), contensou)
        after, _ = struck(eqx.tree_at(lambda falls: falls.friction, falls, law))
        return np.stack(after.velocity)

    expected = np.stack(struck(falls)[0].velocity)
    size = np.linalg.norm(falls.velocity, axis=0)
    assert_close(changed(0.0, 0.0) / size, expected / size, atol=1e-11)
    for near, order in ((lambda h: changed(h, 0.0), 2.0), (lambda h: changed(0.0, h), 1.0)):
        gaps = [np.max(np.abs(near(h) - expected) / size) for h in (2e-5, 1e-5)]
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
