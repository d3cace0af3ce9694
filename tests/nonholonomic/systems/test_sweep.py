"""Tables of users' own systems against closed forms, with their derivatives, files and other processes."""

import functools
import json
import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from own_modes import GRAVITY, Ball, Bounces, Sleigh, Slip, Stick, bounce

import nonholonomic
import stroller
import tippe
from nonholonomic import AbstractMode, Hybrid, sweep
from nonholonomic.integration import Settings
from nonholonomic.runs.model import model_of
from nonholonomic.runs.table import TableForm, TableJob, checksum_of, has_users_code

HEIGHTS, RESTITUTIONS = np.array([0.5, 1.0, 2.0]), np.array([0.7, 0.8])
BALL = Hybrid([Ball()], event=Bounces(3.0))


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Third bounces of balls, in a table with a file."""
    path = tmp_path_factory.mktemp("balls") / "balls.h5"
    axes = {"start[0]": HEIGHTS, "restitution": RESTITUTIONS}
    arguments = {"axes": axes, "sensitivities": ["restitution", "modes[0].gravity"], "path": path, "progress": False}
    first = sweep(BALL, [1.0, 0.0, 0.0], 1.4, **arguments)
    second_table = sweep(BALL, [1.0, 0.0, 0.0], 1.4, **arguments)
    assert_close(second_table.time, first.time)
    return second_table


def test_a_table_of_bounces_and_its_derivatives(table):
    """Times, and derivatives by the restitution and gravity, through two impacts and a third that ends the run."""

    def time(height, restitution, gravity):
        return bounce(height, restitution, gravity, 3)

    heights, restitutions = np.meshgrid(HEIGHTS, RESTITUTIONS, indexing="ij")
    expected = np.vectorize(time)(heights, restitutions, GRAVITY)
    has_event = expected < 1.4
    assert 0 < has_event.sum() < has_event.size
    assert (table.status == np.where(has_event, "event", "completed")).all()
    assert_close(table.time, np.where(has_event, expected, np.inf), rtol=1e-13)
    slopes = jax.vmap(jax.grad(time, (1, 2)), (0, 0, None))(heights.ravel(), restitutions.ravel(), GRAVITY)
    for name, slope in zip(("restitution", "gravity"), slopes, strict=True):
        assert_close(table[f"time_by_{name}"].ravel(), np.where(has_event.ravel(), slope, 0.0), rtol=1e-11)
    assert (table.switches[has_event] == 3).all()
    assert (table.grazes == 0).all()
    assert_close(table.y2[has_event], 3.0)
    assert_close(table.coords["start_0"], HEIGHTS)


def test_a_job_may_be_sent_to_another_process():
    model = model_of(BALL, jnp.array([1.0, 0.0, 0.0]))
    job = TableJob(model, TableForm(), 1.4, "first", Settings(1e-9))
    copy = pickle.loads(pickle.dumps(job)).model.parameters
    assert copy.names == model.parameters.names
    assert_close(copy.values, model.parameters.values)


class Middle(eqx.Module):
    """An event: the block passes the middle of its oscillation."""

    friction: float = 0.6

    def __call__(self, t, y):
        return y[0] - self.friction


class Carried(Stick):
    """The block, which starts to slip at the speed of the belt."""

    def reset(self, t, y):
        return jnp.array([y[0], self.belt]), 1


def test_one_number_of_all_modes():
    """The speed of the belt is a number of both modes. The block sticks for 1 / v, then moves on a circle."""

    def expected(belt):
        return 1.0 / belt + jnp.pi - jnp.arctan2(0.4, belt)

    block, belts = Hybrid([Carried(), Slip(friction=0.6)], event=Middle()), np.array([0.4, 0.5])
    axes = {"modes[*].belt": belts}
    table = sweep(block, [0.0, 0.5], 20.0, axes=axes, sensitivities=["modes[*].belt"], progress=False)
    assert_close(table.time, expected(belts), rtol=1e-9)
    assert_close(table.time_by_belt, jax.vmap(jax.grad(expected))(belts), rtol=1e-7)
    assert table.dims("time") == ("belt",)


def test_one_number_of_all_modes_is_named_once():
    block = Hybrid([Stick(), Slip()], event=Middle())
    with pytest.raises(ValueError, match=r"could be .*modes\[0\].belt or .*modes\[1\].belt or .*modes\[\*\].belt"):
        sweep(block, [0.0, 0.5], 1.0, axes={"belt": [0.5]})
    with pytest.raises(ValueError, match=r"'system.modes\[1\].belt' is named twice, alone and for all modes"):
        sweep(block, [0.0, 0.5], 1.0, axes={"modes[*].belt": [0.5], "modes[1].belt": [0.5]})
    apart = Hybrid([Stick(belt=0.5), Slip(belt=0.6)], event=Middle())
    with pytest.raises(ValueError, match=r"'system.modes\[\*\].belt' stands for several numbers, which differ"):
        sweep(apart, [0.0, 0.5], 1.0, axes={"start[0]": [0.0]}, sensitivities=["modes[*].belt"])


def test_a_mechanical_system_has_a_table_over_its_start_and_numbers():
    """The sleigh keeps its energy (m v^2 + J w^2) / 2 in every cell, whatever it is."""
    axes = {"rate[2]": [0.5, 1.0], "ahead": [0.2, 0.3]}
    table = sweep(Sleigh(), (np.zeros(3), np.array([1.0, 0.0, 0.0])), 2.0, axes=axes, progress=False)
    assert (table.status == "completed").all()
    turning = 0.4 + 1.7 * np.array([0.2, 0.3]) ** 2
    squared_speed = 1.7 + turning * np.array([[0.5], [1.0]]) ** 2
    forward_speed = table.rate0 * np.cos(table.q2) + table.rate1 * np.sin(table.q2)
    assert_close(1.7 * forward_speed**2 + turning * table.rate2**2, squared_speed, rtol=1e-9)
    assert table.dims("q2") == ("rate_2", "ahead")


class Checked(AbstractMode):
    """A mode that checks its number, with a constant that is not declared."""

    offset = 0.5
    rate: float

    def __check_init__(self):
        if np.any(np.asarray(self.rate) < 0.0):
            raise ValueError(f"rate = {self.rate} must not be negative")

    def field(self, t, y):
        return -self.rate * y


def test_what_is_wrong_with_a_table_is_said_before_anything_compiles():
    system = Hybrid([Checked(1.0)])
    with pytest.raises(ValueError, match=r"rate = -1.0 must not be negative"):
        sweep(system, [1.0], 1.0, axes={"rate": [1.0, -1.0]})
    with pytest.raises(ValueError, match=r"axes: 'drag' must be one of start\[0\], system.modes\[0\].rate"):
        sweep(system, [1.0], 1.0, axes={"drag": [1.0]})
    with pytest.raises(ValueError, match="did you mean 'rate'"):
        sweep(system, [1.0], 1.0, axes={"rte": [1.0]})
    with pytest.raises(ValueError, match=r"rate = 1 is an integer: write 1\.0"):
        sweep(Hybrid([Checked(1)]), [1.0], 1.0, axes={"rate": [1.0]})
    with pytest.raises(ValueError, match=r"declare it with its type in Checked: offset: float = 0\.5"):
        sweep(system, [1.0], 1.0, axes={"offset": [1.0]})
    with pytest.raises(ValueError, match="sensitivities are those of the event's time"):
        sweep(system, [1.0], 1.0, axes={}, sensitivities=["rate"])


def test_long_steps_leave_no_error_in_the_times_of_bounces():
    """The ball's field is integrated exactly, so steps grow without limit; an end is located to a fraction of a step."""
    heights = np.linspace(0.5, 2.0, 512)
    table = sweep(BALL, [1.0, 0.0, 0.0], 20.0, axes={"start[0]": heights}, progress=False)
    assert_close(table.time, bounce(heights, 0.8, GRAVITY, 3), rtol=1e-13)


def test_what_a_user_of_own_systems_needs_has_public_names(table):
    """The table in the file, and the unknowns of a fit, without imports from the rooms or the vehicles."""
    assert nonholonomic.Table is type(table)
    assert nonholonomic.Free(0.8, lower=0.0).lower == 0.0
    assert issubclass(nonholonomic.FitWarning, UserWarning)


def fall(rate, level):
    """A decay, and its event, of code with these constants."""

    class Decay(AbstractMode):
        scale: float = 1.0

        def field(self, t, y):
            return -rate * self.scale * y

    return Hybrid([Decay()], event=lambda t, y: y[0] - level)


def test_a_table_of_changed_code_does_not_resume(tmp_path):
    def run(rate, level):
        axes = {"scale": [1.0, 2.0]}
        return sweep(fall(rate, level), [1.0], 3.0, axes=axes, path=tmp_path / "falls.h5", progress=False).time

    time = run(2.0, 0.5)
    assert_close(time, np.log(2.0) / np.array([2.0, 4.0]), rtol=1e-6)
    # The same code, defined again.
    assert np.array_equal(run(2.0, 0.5), time)
    for changed in ((2.5, 0.5), (2.0, 0.6)):
        with pytest.raises(ValueError, match=r"falls\.h5 holds .*: the code of the system, its event or its input has"):
            run(*changed)


@pytest.mark.parametrize("option", [{"errors": True}, {"sensitivities": ["restitution"]}], ids=["errors", "slopes"])
def test_options_of_an_event_s_time_are_not_dropped_when_runs_are_sampled(option):
    (name,) = option
    with pytest.raises(ValueError, match=f"{name} = .* of the time of an event, and without event= the runs are only"):
        sweep(
            BALL,
            [1.0, 0.0, 0.0],
            1.0,
            axes={"restitution": [0.7]},
            times=[0.5],
            quantities=["y0"],
            **option,
            progress=False,
        )


def test_constant_arrays_are_part_of_the_code():
    def checksum(rates):
        class Decay(AbstractMode):
            def field(self, t, y):
                return -rates * y

        return checksum_of(model_of(Hybrid([Decay()]), [1.0, 1.0]))

    assert checksum(np.array([1.0, 2.0])) == checksum(np.array([1.0, 2.0]))
    assert checksum(np.array([1.0, 2.0])) != checksum(np.array([1.0, 3.0]))


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ((tippe.Viscous(0.3), stroller.Plane(), [None]), False),
        ((tippe.Viscous(0.3), {"event": lambda t, motion: motion.theta}), True),
        (stroller.Graph(lambda x, y: 0.1 * x * y), True),
        (jax.jit(lambda t, motion: (jnp.cos(t), 0.0)), True),
        (functools.partial(pow, 2.0), True),
        (jax.tree_util.Partial(jnp.interp, xp=jnp.arange(3.0), fp=jnp.ones(3)), True),
        (jnp.sin, False),
    ],
    ids=["packages", "event", "ground", "compiled", "partial", "partial of JAX", "function of JAX"],
)
def test_code_of_users_is_told_from_that_of_the_packages(parts, expected):
    assert has_users_code(parts) is expected


def waves(x, y, heights):
    """A ground with waves of the given heights."""
    modes = jnp.sin(jnp.asarray(x)[..., None] * jnp.arange(1.0, len(heights) + 1.0))
    return jnp.sum(jnp.asarray(heights) * modes, axis=-1) + 0.0 * y


class Waves:
    """The same as an object that can be called."""

    def __init__(self, heights):
        self.heights = heights

    def __call__(self, x, y):
        return waves(x, y, self.heights)


GROUNDS = {
    "closure": lambda heights: lambda x, y: waves(x, y, heights),
    "compiled": lambda heights: jax.jit(lambda x, y: waves(x, y, heights)),
    "compiled within": lambda heights: lambda x, y: 2.0 * jax.jit(lambda x, y: waves(x, y, heights))(x, y),
    "compiled by equinox": lambda heights: eqx.filter_jit(lambda x, y: waves(x, y, heights)),
    "partial": lambda heights: functools.partial(waves, heights=heights),
    "partial of JAX": lambda heights: jax.tree_util.Partial(waves, heights=heights),
    "object": Waves,
    "method": lambda heights: Waves(heights).__call__,
}


@pytest.mark.parametrize("kind", GROUNDS)
def test_a_request_is_that_of_the_code_and_its_data(kind):
    """It has no address, which is another in every process, and the data of the code are part of its checksum."""

    def request(heights):
        scene = stroller.Scene(
            stroller.presets.light(), stroller.Graph(GROUNDS[kind](heights)), stroller.Damping(2.0, 1.0, 0.2, 0.05)
        )
        model = model_of(scene, stroller.Launch((0.0, -0.8), 0.3, 2.0))
        assert has_users_code(model.__reduce__()[1])
        description = json.dumps(model.description())
        assert " at 0x" not in description
        return description, checksum_of(model)

    first, again, changed = (request(scale * np.arange(20.0)) for scale in (1e-3, 1e-3, 1.0001e-3))
    assert first == again
    assert first[1] != changed[1]


@pytest.mark.parametrize("compiled", [jax.jit, eqx.filter_jit, lambda function: jax.tree_util.Partial(function)])
def test_a_table_of_compiled_code_with_other_data_does_not_resume(compiled, tmp_path):
    def run(rates):
        decay = compiled(lambda y: -jnp.asarray(rates) * y)

        class Decay(AbstractMode):
            scale: float = 1.0

            def field(self, t, y):
                return self.scale * decay(y)

        falls = Hybrid([Decay()], event=lambda t, y: y[0] - 0.5)
        axes, path = {"scale": [1.0, 2.0]}, tmp_path / "falls.h5"
        return sweep(falls, [1.0, 1.0], 3.0, axes=axes, path=path, progress=False).time

    time = run(np.array([2.0, 1.0]))
    assert_close(time, np.log(2.0) / np.array([2.0, 4.0]), rtol=1e-6)
    assert np.array_equal(run(np.array([2.0, 1.0])), time)
    with pytest.raises(ValueError, match="the code of the system, its event or its input has changed"):
        run(np.array([2.5, 1.0]))
