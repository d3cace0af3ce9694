"""The beginning of a slip from rolling, where the force turns fast beside the little slip that there is yet."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe
from tippe.model.stick_slip import slip_onset

#: A top that rolls in a sphere, its grip just gone: velocity, axis, angular momentum, the vertical in its frame.
ROLLING = np.array(
    [
        *(-0.3568385508956252, 0.052327329538077776),
        *(0.009854731488928986, -0.8111760490000502, 0.5847189950312861),
        *(-9.706914506252021e-06, -4.7816658572655934e-05, 7.522564069668788e-05),
        *(0.27478289580629695, -0.029666176759682868, 0.9610485305784775),
    ]
)


#: A fast top of great offset whose slip has come to rest where rolling would need to pull on the arena: far beyond the cone.
BEYOND = np.array(
    [
        *(-1.0751523764063413, 1.2790396691697707),
        *(-0.4362820771503579, 0.727332568489388, -0.5297596473637689),
        *(-0.0001299848587330859, 3.6481092965903644e-05, -0.0001997719177719805),
        *(-0.6756609251490091, -0.10990177782826853, 0.7289745629697728),
    ]
)


@eqx.filter_jit
def beginning(scene, start, scales, tolerance):
    """A slip's beginning from a contact at rest, and the slip's velocity at its middle and end."""
    stick_slip = scene.dynamics
    state = stick_slip.stopped(start)
    onset = slip_onset(stick_slip, stick_slip.slipping.field, state, 11, scales, jnp.asarray(0.1), tolerance)
    slips = [stick_slip.slipping.motion(point).slip for point in (onset.at(jnp.asarray(0.5)), onset.end)]
    return onset, [jnp.stack([slip.x, slip.y]) for slip in slips]


def begun(scene, launch, start):
    """The beginning at a tolerance of 1e-9, with its slips, after a comparison with that at 1e-11."""
    scales, start = scene.scales(launch), jnp.asarray(start)
    (coarse_onset, slips), (fine_onset, _) = (
        beginning(scene, start, scales, jnp.asarray(tol)) for tol in (1e-9, 1e-11)
    )
    assert bool(coarse_onset.converged)
    assert bool(fine_onset.converged)
    assert float(coarse_onset.length) > float(fine_onset.length) > 1e-4
    assert_close(coarse_onset.at(fine_onset.length / coarse_onset.length) / scales, fine_onset.end / scales, atol=1e-10)
    return coarse_onset, *slips


@pytest.mark.oldest
def test_a_slip_begins_at_every_tolerance():
    """The direction of the force turns by 0.14 rad in the first trial; the state later is that of a shorter step."""
    scene = tippe.Scene(rutstam_top(), tippe.Sphere(0.3), tippe.SetValuedCoulomb(0.2))
    _, middle, end = begun(scene, tippe.Launch(0.43, 26.0, 0.4), ROLLING)
    # The slip's speed grows as the square of the time, by half the rate at which the grip is lost over the contact's mass.
    assert_close(jnp.hypot(*end) / jnp.hypot(*middle), 4.0, rtol=0.1)


def test_a_slip_begins_far_beyond_the_cone():
    """It grows in proportion to the time, in the one direction in which friction that opposes it lets it grow."""
    scene = tippe.Scene(tippe.Top(0.02, 0.02, 0.016, 1.6e-6, 1.9e-6), tippe.Sphere(0.2), tippe.SetValuedCoulomb(0.6))
    _, middle, end = begun(scene, tippe.Launch(0.76, 600.0, 0.8), BEYOND)
    assert_close(jnp.hypot(*end) / jnp.hypot(*middle), 2.0, rtol=0.1)
    assert_close(end / jnp.hypot(*end), middle / jnp.hypot(*middle), atol=0.1)
