"""Inputs that jump: a stroller that drives straight on, without friction, whose motion follows from its force and mass."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

import nonholonomic
import stroller

SCENE = stroller.Scene(stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05))
LAUNCH = stroller.Launch((0.0, 0.0), 0.0, 1.0)


class Push(eqx.Module):
    """A push of a number of newton seconds."""

    start: float
    width: float
    impulse: float = 6.0

    def __call__(self, t, motion):
        is_on = (t >= self.start) & (t < self.start + self.width)
        return jnp.where(is_on, self.impulse / self.width, 0.0), 0.0


def place(start, width, impulse=6.0, time=2.0):
    return time + impulse / 12.0 * (time - start - 0.5 * width)


def test_the_functions_of_many_rides_may_hold_other_numbers():
    """Under `jax.vmap`, arrays and numbers of an input may differ from ride to ride, or be one for all."""
    shared = jnp.array([0.5, 0.2])

    def time(gain, own):
        def push(t, motion):
            return 12.0 * gain * (own[0] * shared[0] + own[1] * shared[1] * t), 0.0

        return nonholonomic.event_time(SCENE, LAUNCH, 2.0, lambda t, motion: 1.2 - motion.speed, input=push)

    gains, ones = jnp.array([1.0, 2.0, 4.0]), jnp.ones((3, 2))
    times = jax.vmap(time)(gains, gains[:, None] * ones)
    # gain^2 (t / 2 + t^2 / 10) = 0.2
    assert_close(times, (jnp.sqrt(0.25 + 0.08 / gains**2) - 0.5) / 0.2, atol=1e-9)


@pytest.mark.parametrize("tolerance", [1e-6, 1e-9])
@pytest.mark.parametrize("width", [1e-2, 1e-3])
def test_no_push_is_missed(width, tolerance):
    """In single runs, at times that may be those of the jumps, and in tables over the time of the push."""
    times = [0.5, 0.5 + 0.5 * width, 2.0]
    run = stroller.simulate(SCENE, LAUNCH, 2.0, Push(0.5, width), times=times, tolerance=tolerance)
    assert_close(run.speed, [1.0, 1.25, 1.5], atol=1e-11)
    assert_close(run.position[-1, 0], place(0.5, width), atol=1e-11)
    starts = np.array([0.0, 0.4, 1.2])
    options = {"axes": {"input.start": starts}, "input": Push(0.5, width), "tolerance": tolerance, "progress": False}
    table = stroller.sweep(SCENE, LAUNCH, 2.0, **options)
    assert_close(table["x"], place(starts, width), atol=1e-11)


def test_derivatives_by_the_time_of_a_push():
    def end(start, width, impulse):
        run = stroller.simulate(SCENE, LAUNCH, 2.0, Push(start, width, impulse), times=[2.0])
        return run.position[0, 0]

    point = (0.5, 0.1, 6.0)
    slopes, expected = (jnp.stack(jax.jit(jax.grad(function, (0, 1, 2)))(*point)) for function in (end, place))
    assert_close(slopes, expected, atol=1e-9)


def test_jumps_can_be_given():
    """Times that no comparison shows, which may be traced; and the time of an event after them."""

    def end(start):
        def push(t, motion):
            return 30.0 * (jnp.tanh(1e9 * (t - start)) + 1.0), 0.0

        return stroller.simulate(SCENE, LAUNCH, 2.0, push, times=[2.0], jumps=[start]).position[0, 0]

    assert_close(end(1.5), 2.0 + 0.5 * 5.0 * 0.25, atol=1e-8)

    def fast(t, motion):
        return 1.2 - motion.speed

    options = {"event": fast, "input": Push(0.5, 0.1)}
    assert_close(nonholonomic.event_time(SCENE, LAUNCH, 2.0, **options), 0.54, atol=1e-10)
    with pytest.raises(ValueError, match=r"jumps = 3.0 must be a list of times"):
        stroller.simulate(SCENE, LAUNCH, 2.0, Push(0.5, 0.1), jumps=3.0)
    with pytest.raises(ValueError, match="must be None without an input"):
        stroller.simulate(SCENE, LAUNCH, 2.0, jumps=[1.0])


def test_samples_of_a_force_bring_their_kinks():
    """A measured force, linear between its samples: the work is that of a triangle."""
    times, forces = jnp.array([0.5, 0.505, 0.51]), jnp.array([0.0, 1200.0, 0.0])
    run = stroller.simulate(SCENE, LAUNCH, 1.0, lambda t, motion: (jnp.interp(t, times, forces), 0.0), times=[1.0])
    assert_close(run.speed, [1.0 + 6.0 / 12.0], atol=1e-11)


def test_an_unknown_comparison_warns_once():
    def waves(t, motion):
        return jnp.where(jnp.sin(5.0 * t) > 0.0, 1.0, 0.0), 0.0

    with pytest.warns(UserWarning, match=r"input\(t, motion\) compares \(gt\)") as record:
        stroller.simulate(SCENE, LAUNCH, 0.5, waves, times=[0.5])
    assert len(record) == 1
