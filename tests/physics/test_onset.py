"""The beginning of a slip from rolling, where the force turns fast beside the little slip that there is yet."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe
from tippe.phases.onset import begin

#: A top that rolls in a sphere, its grip just gone: velocity, axis, angular momentum, the vertical in its frame.
ROLLING = np.array(
    [
        *(-0.3568385508956252, 0.052327329538077776),
        *(0.009854731488928986, -0.8111760490000502, 0.5847189950312861),
        *(-9.706914506252021e-06, -4.7816658572655934e-05, 7.522564069668788e-05),
        *(0.27478289580629695, -0.029666176759682868, 0.9610485305784775),
    ]
)


@pytest.mark.newest
def test_a_slip_begins_at_every_tolerance():
    """The direction of the force turns by 0.14 rad in the first trial; the state later is that of a shorter step."""
    scene = tippe.Scene(rutstam_top(), tippe.Sphere(0.3), tippe.SetValuedCoulomb(0.2))
    both, scales = scene.dynamics, scene.scales(tippe.Launch(0.43, 26.0, 0.4))
    state = both.stopped(jnp.asarray(ROLLING))

    @jax.jit
    def beginning(tolerance):
        onset = begin(
            both.slipping, both.rolling, both.mu, both.slipping.field, state, 11, scales, jnp.asarray(0.1), tolerance
        )
        speed = both.slip_speed(onset.end)
        return onset, speed

    (long, speed), (short, _) = beginning(1e-9), beginning(1e-11)
    assert bool(long.found)
    assert bool(short.found)
    assert float(long.length) > float(short.length) > 1e-3
    assert_close(long.at(short.length / long.length) / scales, short.end / scales, atol=1e-10)
    # The slip's speed grows as the square of the time, by half the rate at which the grip is lost over the contact's mass.
    middle = both.slip_speed(long.at(jnp.asarray(0.5)))
    assert_close(speed / middle, 4.0, rtol=0.1)
