"""Trajectories of users' own systems against closed forms, with their derivatives through resets."""

import copy
import json
import math
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from other_formulations import Routhian
from own_modes import GRAVITY, Ball, Sleigh, Slip, Stick, bounce, final_turn
from scipy.integrate import quad

import nonholonomic
from nonholonomic import AbstractMode, AbstractSystem, Hybrid, event_time, simulate, sweep
from nonholonomic.sweeps import Table
from nonholonomic.systems.form import check_start
from nonholonomic.systems.mechanics import Hamel, Lagrange, formulation_of

START = [1.0, 0.0, 0.0]
TIMES = jnp.array([0.3, 0.7, 1.1, 1.5])


def exact(height, restitution, time):
    """Height and velocity of a ball before its third bounce."""
    bounces = [bounce(height, restitution, GRAVITY, number) for number in (1, 2)]
    speed = jnp.sqrt(2.0 * GRAVITY * height)
    count = int(time > bounces[0]) + int(time > bounces[1])
    elapsed = time - (bounces[count - 1] if count else 0.0)
    start = restitution**count * speed if count else 0.0
    place = 0.0 if count else height
    return jnp.stack([place + start * elapsed - 0.5 * GRAVITY * elapsed**2, start - GRAVITY * elapsed])


def states(height, restitution):
    start = jnp.stack([height, 0.0 * height, 0.0 * height])
    return simulate(Hybrid([Ball(restitution)]), start, 1.5, times=TIMES).state


def test_a_ball_and_its_derivatives_through_two_bounces():
    """The saltation matrix is exact for an impact, in both directions of differentiation."""
    point = (jnp.asarray(1.0), jnp.asarray(0.8))
    expected = jnp.stack([exact(*point, float(time)) for time in TIMES])
    slopes = jnp.stack([jnp.stack(jax.jacfwd(exact, (0, 1))(*point, float(time)), axis=-1) for time in TIMES])
    assert_close(states(*point)[:, :2], expected, atol=1e-13)
    assert_close(jnp.stack(jax.jit(jax.jacrev(states, (0, 1)))(*point), axis=-1)[:, :2], slopes, atol=1e-11)


def test_stick_and_slip_where_the_end_of_sticking_is_tangential():
    """With equal friction at rest and in motion the block slips without a kink: x = 1 + v sin(t - 1 / v) from x = 1 on."""
    run = simulate(Hybrid([Stick(), Slip()]), jnp.array([0.0, 0.5]), 5.0, times=jnp.array([1.0, 3.0, 5.0]))
    assert run.status == "completed"
    assert run.mode.tolist() == [0, 1, 1]
    assert_close(run.state[0], [0.5, 0.5], atol=1e-12)
    elapsed = np.array([1.0, 3.0])
    assert_close(run.state[1:, 0], 1.0 + 0.5 * np.sin(elapsed), atol=1e-9)
    assert_close(run.state[1:, 1], 0.5 * np.cos(elapsed), atol=1e-9)
    assert (run.resets["mode_before"].tolist(), run.resets["mode_after"].tolist()) == ([0], [1])
    assert_close(run.resets["y0_after"], [1.0], atol=1e-9)


class Melting(AbstractMode):
    """A mode that ends, without a reset, when its state has fallen to zero."""

    def field(self, t, y):
        return -jnp.ones(1)

    def margin(self, t, y):
        return y[0]


def test_a_mode_without_a_reset_stops_the_run():
    run = simulate(Hybrid([Melting()]), jnp.array([1.0]), 2.0, times=jnp.array([0.5, 1.5]))
    assert run.status == "stopped"
    assert_close(run.end_time, 1.0, rtol=1e-12)
    assert_close(run.state[0], 0.5, rtol=1e-12)
    assert np.isnan(run.state[1]).all()
    assert run.mode.tolist() == [0, -1]
    assert len(simulate(Hybrid([Melting()]), jnp.array([1.0]), 0.5, times=jnp.array([0.25, 0.5])).resets["time"]) == 0


def test_resets_without_end_are_unresolved():
    """A ball that loses a fifth of its speed at each bounce comes to rest after a finite time and infinitely many of them."""
    run = simulate(Hybrid([Ball(0.2)]), jnp.array([1.0, 0.0, 0.0]), 5.0, times=jnp.array([0.2, 4.0]))
    assert run.status in ("unresolved", "failed")
    assert np.isnan(run.state[1]).all()


def test_a_printed_run_states_why_it_ended():
    run = simulate(Hybrid([Ball(0.2)]), jnp.array([1.0, 0.0, 0.0]), 5.0, times=jnp.array([0.2, 4.0]))
    lines = str(run).splitlines()
    assert lines[0].startswith("Trajectory of 2 times, unresolved at 0.67")
    assert [line.split(":")[0].strip() for line in lines[1:6]] == ["y0", "y1", "y2", "resets", "steps"]
    assert lines[6].strip().startswith("resets followed one another without end; add a mode for rest")
    assert "without end" not in str(simulate(Hybrid([Ball()]), [1.0, 0.0, 0.0], 1.0, times=[0.0, 1.0]))


def test_a_printed_batch_states_how_its_runs_ended():
    starts = jnp.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    runs = jax.vmap(lambda start: simulate(Hybrid([Ball()]), start, 1.0, times=[0.0, 1.0]))(starts)
    assert str(runs) == "3 runs of 2 times: 2 completed, 1 illegal"
    texts = []
    jax.jit(lambda start: texts.append(str(simulate(Hybrid([Ball()]), start, 1.0, times=[0.0, 1.0]))))(starts[0])
    assert texts == ["Trajectory of 2 times, inside a transformation"]


def test_components_are_drawn_over_time():
    run = simulate(Hybrid([Ball()]), [1.0, 0.0, 0.0], 1.0, times=[0.0, 1.0])
    panels = run.plot().axes
    assert [panel.get_ylabel() for panel in panels] == ["y0", "y1", "y2"]
    assert run.plot("y0", ax=panels[0]) is panels[0]
    heights, speeds = run.plot("y0", "y1", others=[run], unit="ms").axes
    assert (heights.get_ylabel(), speeds.get_xlabel()) == ("y0", "time [ms]")
    assert [text.get_text() for text in heights.get_legend().get_texts()] == ["run 1", "run 2"]
    higher = simulate(Hybrid([Ball()]), [2.0, 0.0, 0.0], 1.0, times=[0.0, 1.0])
    labels = [text.get_text() for text in run.plot("y0", others=[higher]).axes[0].get_legend().get_texts()]
    assert labels == ["start[0] 1", "start[0] 2"]
    assert run.at(1.0).state.shape == (1, 3)
    assert list(run) == ["y0", "y1", "y2"]
    assert "y3" not in run
    assert_close(speeds.get_lines()[0].get_ydata()[[0, -1]], run.state[:, 1])
    assert list(run.to_dataframe().columns) == ["time", "y0", "y1", "y2", "mode"]


def labels(*runs):
    return runs[0].labels_of(list(runs), None)


def test_labels_name_each_number_once_and_briefly():
    """A number of all modes is one number, and a name is as short as it is clear."""

    def run(*balls, start=START):
        return simulate(Hybrid([Ball(*numbers) for numbers in balls]), start, 0.1, times=[0.1])

    both = run((0.8, 9.0), (0.8, 9.0))
    assert labels(both, run((0.8, 3.0), (0.8, 3.0))) == ["gravity 9", "gravity 3"]
    assert labels(both, run((0.8, 3.0), (0.8, 9.0))) == ["system.modes[0].gravity 9", "system.modes[0].gravity 3"]
    different = labels(both, run((0.8, 3.0), (0.8, 2.0), start=[2.0, 0.0, 0.0]))
    assert different[1] == "start[0] 2, …"
    assert labels(run((0.8, 9.0)), run((0.8, 3.0))) == ["gravity 9", "gravity 3"]


def test_resets_are_listed_and_drawn():
    """A ball strikes the ground at its closed-form times; its lines reach the ground and jump there."""
    run = simulate(Hybrid([Ball()]), [1.0, 0.0, 0.0], 1.5, times=[0.0, 1.0, 1.5])
    times = [bounce(1.0, 0.8, GRAVITY, number) for number in (1, 2)]
    speeds = math.sqrt(2.0 * GRAVITY) * 0.8 ** np.arange(3)
    resets = run.resets
    assert_close(resets["time"], times, rtol=1e-9)
    assert resets["mode_before"].tolist() == resets["mode_after"].tolist() == [0, 0]
    assert_close(resets["y0_before"], np.zeros(2), atol=1e-9)
    assert_close(resets["y1_before"], -speeds[:2], rtol=1e-9)
    assert_close(resets["y1_after"], speeds[1:], rtol=1e-9)
    (velocity,) = run.plot("y1").axes[0].get_lines()
    assert_close(velocity.get_xdata(), np.repeat([0.0, times[0], 1.0, times[1], 1.5], [1, 2, 1, 2, 1]), rtol=1e-9)
    assert_close(velocity.get_ydata()[[1, 2, 4, 5]], [-speeds[0], speeds[1], -speeds[1], speeds[2]], rtol=1e-9)
    heights = [run.plot().axes[0].get_lines()[0].get_ydata(), run.portrait().axes[0].get_lines()[0].get_xdata()]
    heights.append(run.stages()[0].shows[0].curves[0].values)
    for drawn in heights:
        assert len(drawn) == 7
        assert_close(np.sort(drawn)[:4], np.zeros(4), atol=1e-9)
    assert len(run.to_table()["y0"]) == 3


def test_resets_need_one_run():
    with pytest.raises(ValueError, match="resets takes one run outside jit"):
        jax.eval_shape(jax.vmap(lambda height: states_of(height).resets), jnp.ones(2))


def states_of(height):
    """A ball's run from a height."""
    return simulate(Hybrid([Ball()]), jnp.stack([height, 0.0 * height, 0.0 * height]), 1.5, times=TIMES)


class Capped(AbstractMode):
    """A decay, at first at a constant rate if there is a cap."""

    restart: float = jnp.inf

    def field(self, t, y):
        return -jnp.minimum(y, self.restart)


def test_a_number_of_the_system_may_be_infinite_whatever_its_name():
    """Only the numbers of the start must be finite."""
    state = jax.jit(lambda y: simulate(Hybrid([Capped()]), [y], 1.0, times=[1.0]).state)(1.0)
    assert_close(state, np.exp([[-1.0]]), rtol=1e-8)


def test_a_number_given_as_text_is_named():
    with pytest.raises(ValueError, match=r"restart = '0.8' is a text"):
        check_start(Hybrid([Capped("0.8")]), np.ones(1))


def test_a_misspelt_method_is_reported():
    """Only where the class does not define the method itself, and no other method calls this one."""
    force = broken(Sleigh, forces=lambda self, t, q, rate: -rate)
    with pytest.warns(UserWarning, match=r"^Broken\.forces is never called; did you mean force\?$"):
        check_start(force, (np.zeros(3), np.zeros(3)))
    with pytest.warns(UserWarning, match=r"Broken\.margins is never called; did you mean margin\?"):
        check_start(Hybrid([Melting(), broken(Decay, margins=lambda self, t, y: y[0])]), np.ones(1))
    helpers = {
        "forces": lambda self, q: -q,
        "force": lambda self, t, q, rate: self.forces(q),
        "speed": lambda self: 1.0,
    }
    called = {"resets": lambda self, y: y, "field": lambda self, t, y: -self.resets(y)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_start(broken(Sleigh, **helpers), (np.zeros(3), np.zeros(3)))
        check_start(Hybrid([broken(Decay, **called), Ball()]), np.ones(1))


class Decay(AbstractMode):
    """A mode that never ends."""

    def field(self, t, y):
        return -y


def broken(kind, **functions):
    """A mode or a system of which some functions are replaced."""
    return type("Broken", (kind,), functions)()


WRONG = {
    "a branch in a field": (
        lambda: Hybrid([broken(Ball, field=lambda self, t, y: y if y[0] > 0.0 else -y)]),
        r"modes\[0\]\.field\(t, y\) cannot be traced by JAX: write it with jax.numpy",
    ),
    "numpy in a reset": (
        lambda: Hybrid([broken(Ball, reset=lambda self, t, y: (np.sin(y), 0))]),
        r"modes\[0\]\.reset\(t, y\) cannot be traced by JAX",
    ),
    "a metric of another size": (
        lambda: broken(Sleigh, metric=lambda self, q: jnp.eye(2)),
        r"metric\(q\) must be of shape \(3, 3\), not \(2, 2\)",
    ),
    "a potential that is a vector": (
        lambda: broken(Sleigh, potential=lambda self, q: q**2),
        r"potential\(q\) must be one number, not \(3,\)",
    ),
    "a force in a list": (
        lambda: broken(Sleigh, force=lambda self, t, q, rate: [q[0]]),
        r"force\(t, q, rate\) must be of shape \(3,\), not \[",
    ),
    "one constraint without a row": (
        lambda: broken(Sleigh, constraints=lambda self, q: q),
        r"constraints\(q\) must be of shape \(k, 3\), a row for each constraint, such as .* for one, not \(3,\)",
    ),
    "math in a constraint": (
        lambda: broken(Sleigh, constraints=lambda self, q: jnp.array([[math.sin(q[2]), 0.0, 0.0]])),
        r"constraints\(q\) cannot be traced by JAX",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_function_is_named(name):
    build, message = WRONG[name]
    system = build()
    start = np.array([1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=message):
        simulate(system, start if isinstance(system, Hybrid) else (start, start), 1.0)


@pytest.mark.parametrize(("system", "start"), [(Hybrid([Ball()]), START), (Sleigh(), ([0.0] * 3, [0.0] * 3))])
def test_an_input_of_a_system_without_ports_is_refused(system, start):
    message = (
        r"input = 2\.0 must be None for a Hybrid or a system without ports: write input\(self, q\) of an AbstractSystem"
    )
    for call in (simulate, event_time):
        with pytest.raises(ValueError, match=message):
            call(system, start, 1.0, input=2.0)


def test_the_sleigh_turns_to_its_final_heading():
    """From a turn on the spot the heading turns by pi / (2 a) sqrt(I / m + a^2) in the end; energy and constraint hold."""
    sleigh = Sleigh()
    run = simulate(sleigh, (jnp.zeros(3), jnp.array([0.0, 0.0, 2.0])), 40.0, times=jnp.array([1.0, 40.0]))
    assert run.status == "completed"
    assert_close(run.state[-1, 2], final_turn(sleigh, 2.0), rtol=1e-8)
    energies = [sleigh.energy(state[:3], state[3:]) for state in run.state]
    assert_close(energies, 0.5 * (0.4 + 1.7 * 0.09) * 4.0, rtol=1e-9)
    assert_close([sleigh.constraints(state[:3]) @ state[3:] for state in run.state], 0.0, atol=1e-9)


def test_a_trajectory_is_a_table():
    run = simulate(Hybrid([Melting()]), jnp.array([1.0]), 0.5, times=jnp.array([0.25, 0.5]))
    table = run.to_table()
    assert_close(table.y0, [0.75, 0.5], rtol=1e-12)
    assert json.loads(table.attributes["request"])["status"] == "completed"
    assert run.to_xarray()["y0"].dims == ("time",)
    request = json.loads(table.attributes["request"])
    assert (request["system"], request["start[0]"], request["end_time"]) == ("Hybrid", 1.0, 0.5)


def test_the_file_of_a_run_is_not_overwritten_by_a_table(tmp_path):
    run = simulate(Hybrid([Melting()]), jnp.array([1.0]), 0.5, times=jnp.array([0.25, 0.5]))
    run.save(tmp_path / "run.h5")
    assert_close(Table.load(tmp_path / "run.h5").y0, run["y0"])
    with pytest.raises(
        ValueError, match=r"run.h5 holds the result of another run: it is a single run, not a table of many"
    ):
        sweep(Hybrid([Melting()]), [1.0], 0.5, axes={"start[0]": [1.0, 2.0]}, path=tmp_path / "run.h5", progress=False)


def test_a_lagrangian_of_one_s_own_is_run_by_poincare_s_equations():
    """Metric and potential alone would miss its terms that are linear in the velocities."""
    system = Sleigh()
    assert isinstance(formulation_of(system), Lagrange)
    assert isinstance(formulation_of(Routhian(system, cyclic=0, momentum=0.3)), Hamel)


class Fading(AbstractMode):
    rate: float

    def field(self, t, y):
        return -self.rate * t * y


def test_derivatives_by_the_times_of_samples_and_the_horizon():
    """y = exp(-rate t^2 / 2): all second derivatives; the horizon moves the end alone."""

    def last(point, t1=3.0):
        run = simulate(Hybrid([Fading(point[0])]), [1.0], t1, times=point[1:])
        return jnp.sin(run.state[0, 0]), run.end_time

    def exact(point):
        return jnp.sin(jnp.exp(-0.5 * point[0] * point[1] ** 2))

    point = jnp.array([0.7, 1.3])
    hessian, of_end = jax.jit(jax.hessian(last))(point)
    assert_close(hessian, jax.hessian(exact)(point), rtol=1e-7)
    assert_close(of_end, 0.0)
    assert_close(jnp.stack(jax.jacrev(last, 1)(point, 3.0)), [0.0, 1.0])


def test_derivatives_that_do_not_exist_through_resets_are_refused_in_words():
    """Derivatives with respect to the horizon, and second derivatives: messages do not mention another model."""
    ball, start = Hybrid([Ball()]), jnp.array([1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="runs with resets; differentiate with respect to the start or the parameters"):
        jax.grad(lambda t1: simulate(ball, start, t1, times=t1 * TIMES / 1.5).state[0, 0])(1.5)
    with pytest.raises(
        ValueError, match="second derivatives do not exist through changes of mode; take differences of a gradient"
    ):
        jax.grad(jax.grad(lambda height: states(height, 0.8)[-1, 0]))(1.0)


class NamedBall(Ball):
    names = ("height", "velocity", "bounces")


class NamedSleigh(Sleigh):
    names = ("x", "y", "heading")


def test_a_component_is_an_attribute():
    run = simulate(Hybrid([NamedBall()]), [1.0, 0.0, 0.0], 2.0, times=TIMES)
    np.testing.assert_array_equal(run.velocity, run["velocity"])
    np.testing.assert_array_equal(copy.deepcopy(run).velocity, run["velocity"])
    with pytest.raises(AttributeError, match=r"the run has no 'heigth'; did you mean 'height'\?"):
        _ = run.heigth


def test_a_run_knows_its_event_only_for_its_page():
    ball = Hybrid([NamedBall()], event=lambda t, y: y[1])
    run = simulate(ball, [1.0, 0.0, 0.0], 1.4, times=[0.5, 1.4])
    assert run.status == "completed"
    assert len(run.resets["time"]) == 2
    assert_close(run.at(1.4).state, run.state[-1:], rtol=1e-12)
    sliders = {"restitution": (0.7, 0.9)}
    page = run.explore(sliders=sliders)
    assert page.html == nonholonomic.explore(ball, [1.0, 0.0, 0.0], sliders=sliders, t1=1.4).html
    assert "time of the event" in page.html


def test_components_have_the_names_of_the_system():
    run = simulate(Hybrid([NamedBall()]), [1.0, 0.0, 0.0], 2.0, times=TIMES)
    assert list(run.to_table().variables) == ["height", "velocity", "bounces", "mode"]
    assert_close(run["height"], run.state[:, 0])
    table = sweep(Hybrid([NamedBall()]), [1.0, 0.0, 0.0], 0.3, axes={"start[0]": [1.0, 2.0]}, progress=False)
    assert_close(table.height, np.array([1.0, 2.0]) - 0.5 * GRAVITY * 0.09, rtol=1e-12)
    turning = simulate(NamedSleigh(), ([0.0, 0.0, 0.0], [1.0, 0.0, 1.3]), 0.5, times=[0.5])
    assert list(turning) == list(turning.names) == ["x", "y", "heading", "x_rate", "y_rate", "heading_rate"]


@pytest.mark.parametrize("words", [("height",), ("height", "height", "bounces"), ("height", "time", "bounces"), "abc"])
def test_wrong_names_are_refused(words):
    wrong = type("Wrong", (Ball,), {"names": words})
    with pytest.raises(ValueError, match=r"Wrong\.names = .* must be 3 different words, one for each component"):
        simulate(Hybrid([wrong()]), [1.0, 0.0, 0.0], 2.0)


def test_rates_must_not_be_named_like_coordinates():
    wrong = type("Wrong", (Sleigh,), {"names": ("x", "x_rate", "heading")})
    with pytest.raises(ValueError, match="must be 3 different words, one for each coordinate"):
        simulate(wrong(), ([0.0, 0.0, 0.0], [1.0, 0.0, 1.3]), 0.5)


@pytest.mark.parametrize(
    "start", [["1", "0", "0"], [["1"], ["0"]], np.array(["1", "0", "0"])], ids=["list", "nested", "array"]
)
def test_texts_are_not_numbers(start):
    with pytest.raises(ValueError, match=r"start = .* is not a list of numbers"):
        simulate(Hybrid([Ball()]), start, 1.0)


def test_a_number_of_times_is_not_their_list():
    with pytest.raises(ValueError, match=r"times = 11 must be a list of at least one number; np\.linspace"):
        simulate(Hybrid([Ball()]), [1.0, 0.0, 0.0], 1.0, times=11)


class AboveTable(AbstractMode):
    """A ball above a table at A sin(50 t), by its height above the table."""

    amplitude: float = 0.3

    def field(self, t, y):
        return jnp.array([y[1], -1.0 + 2500.0 * self.amplitude * jnp.sin(50.0 * t)])

    def margin(self, t, y):
        return y[0]


class WithPhase(AbstractMode):
    """The same ball by its height, with the sine and cosine of the table's phase."""

    amplitude: float = 0.3

    def field(self, t, y):
        return jnp.array([y[1], -1.0, 50.0 * y[3], -50.0 * y[2]])

    def margin(self, t, y):
        return y[0] - self.amplitude * y[2]


@pytest.mark.parametrize(
    ("mode", "start", "atol"), [(AboveTable(), [1.0, -15.0], 1e-8), (WithPhase(), [1.0, 0.0, 0.0, 1.0], 1e-10)]
)
def test_the_first_contact_with_a_vibrating_table(mode, start, atol):
    """The manual says how to write such a system; the time is the first zero of 1 - t^2 / 2 - 0.3 sin(50 t)."""
    run = simulate(Hybrid([mode]), start, 3.0, times=[3.0])
    assert run.status == "stopped"
    assert_close(run.end_time, 1.2705959283857677, atol=atol, rtol=0.0)


def test_the_reason_of_an_unresolved_run_names_the_limit_of_resets():
    run = simulate(Hybrid([Ball(0.2)]), [1.0, 0.0, 0.0], 5.0, times=[0.2, 4.0])
    assert "it may have at most 2000 resets" in str(run)


class Doses(AbstractMode):
    """A level that decays, at the sum of some rates, and a clock that adds a dose after each second."""

    decay: tuple = (0.7,)

    def field(self, t, y):
        return jnp.stack([-sum(self.decay) * y[0], jnp.ones_like(t)])

    def margin(self, t, y):
        return 1.0 - y[1]

    def reset(self, t, y):
        return jnp.stack([y[0] + 1.0, 0.0 * y[1]]), 0


def level(times, decay, after=False):
    """The sum of the doses that have been given, each decayed; one at the time of a sample counts if `after`."""
    doses = np.arange(1.0, 21.0)[:, None]
    has_acted = (times >= doses) if after else (times > doses)
    return np.exp(-decay * times) + np.sum(np.where(has_acted, np.exp(-decay * (times - doses)), 0.0), axis=0)


DOSE_TIMES = np.linspace(0.0, 20.0, 201).round(12)


def levels(decay):
    return simulate(Hybrid([Doses(tuple(decay))]), [1.0, 0.0], 20.0, times=DOSE_TIMES).state[:, 0]


def test_a_sample_at_a_reset_is_the_state_before_it():
    """Also where the times of the resets are rounded: in runs, tables and derivatives, forwards and backwards."""
    expected = level(DOSE_TIMES, 0.7)
    slope = (level(DOSE_TIMES, 0.7001) - level(DOSE_TIMES, 0.6999)) / 2e-4
    run = simulate(Hybrid([Doses()]), [1.0, 0.0], 20.0)
    assert_close(run.state[:, 0], expected, rtol=1e-9)
    assert_close(jax.jit(jax.jacfwd(levels))(jnp.array([0.7]))[:, 0], slope, atol=1e-6)
    decays = jnp.tile(jnp.array([[0.1], [0.15]]), 7)
    gradient = jax.jit(jax.grad(lambda decays: jnp.sum(jax.vmap(levels)(decays) * DOSE_TIMES)))(decays)
    assert_close(gradient[0], np.full(7, slope @ DOSE_TIMES), rtol=1e-6)
    axes = {"modes[0].decay[0]": [0.7, 0.8]}
    table = sweep(Hybrid([Doses()]), [1.0, 0.0], 20.0, axes=axes, times=DOSE_TIMES, quantities=["y0"], progress=False)
    assert_close(table["y0"][0], expected, rtol=1e-9)


def test_samples_at_the_times_of_all_resets():
    """A dropped ball hits the ground with the speed v, e v, e^2 v, ..."""
    ball = Hybrid([Ball(0.8)])
    for tolerance in (1e-6, 1e-9):
        impacts = simulate(ball, START, 3.0, tolerance=tolerance).resets["time"]
        run = simulate(ball, START, 3.0, times=impacts, tolerance=tolerance)
        speeds = np.sqrt(2.0 * GRAVITY) * 0.8 ** np.arange(len(impacts))
        assert_close(run.state[:, :2], np.stack([0.0 * speeds, -speeds], axis=-1), atol=1e-5)
        assert np.all(np.asarray(run.mode) == 0)


@pytest.mark.parametrize("side", ["before", "after"])
def test_a_recording_says_on_which_side_of_a_reset_its_samples_are(side):
    """The levels of 1 s, 2 s, ... just before or just after the doses, fitted from another start."""
    times = np.arange(1.0, 8.0)
    values = level(times, 0.7, side == "after")
    recording = nonholonomic.Recording([1.0, 0.0], times, values, 0.001, "y0", side=side)
    fit = nonholonomic.identify(Hybrid([Doses()]), recording, {"decay[0]": 0.6}, progress=False)
    assert_close(fit.estimates["system.modes[0].decay[0]"], 0.7, atol=1e-5)
    with pytest.raises(ValueError, match=r"side = 'below' must be \"before\" or \"after\""):
        nonholonomic.Recording([1.0, 0.0], times, values, 0.001, "y0", side="below")


class EulerTop(AbstractSystem):
    """A symmetric top with a fixed point, in Euler angles (theta, phi, psi), with moments of inertia 1 and 1/2."""

    dimension = 3

    def metric(self, q):
        sin, cos = jnp.sin(q[0]), jnp.cos(q[0])
        return jnp.array([[1.0, 0.0, 0.0], [0.0, sin**2 + 0.5 * cos**2, 0.5 * cos], [0.0, 0.5 * cos, 0.5]])

    def potential(self, q):
        return jnp.cos(q[0])


def test_steps_that_shorten_near_a_pole_of_the_coordinates_are_named():
    """A top that swings almost through the vertical reaches it as the plane pendulum does; its errors exceed the tolerance."""
    expected, _ = quad(lambda theta: 1.0 / np.sqrt(1.0 + 2.0 * (np.cos(0.5) - np.cos(theta))), 0.0, 0.5)
    with pytest.warns(UserWarning, match="coordinates singular there") as caught:
        run = simulate(EulerTop(), ([0.5, 0.0, 0.0], [-1.0, 1e-6, 0.0]), 1.0, times=[1.0], tolerance=1e-8)
    assert run.status == "completed"
    assert_close(float(re.search(r"near t = ([\d.]+) s", str(caught[0].message)).group(1)), expected, atol=1e-4)
    with pytest.warns(UserWarning, match="1 of 4 cells need more than 30 times as many steps"):
        sweep(
            EulerTop(),
            ([0.5, 0.0, 0.0], [-1.0, 0.1, 0.0]),
            1.0,
            axes={"rate[1]": [1e-6, 0.1, 0.2, 0.3]},
            tolerance=1e-8,
        )
    # Nor does a run that keeps away from the pole warn, nor one with a kink, at which steps shorten for a moment.
    simulate(EulerTop(), ([0.5, 0.0, 0.0], [-1.0, 0.1, 0.0]), 1.0, times=[1.0])
    kink = simulate(Hybrid([Kink()]), [1.0, 0.0], 10.0)
    assert int(kink.rejected) > 50


class Kink(AbstractMode):
    """An oscillator on a spring that is stiffer on one side."""

    def field(self, t, y):
        return jnp.stack([y[1], -y[0] - 3.0 * jnp.maximum(y[0], 0.0)])
