"""Modes with several margins: which of them fell, against reflections and the conservation laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import needs_browser, open_browser
from close import assert_close

from nonholonomic import AbstractMode, AbstractSystem, Hybrid, event_time, simulate, sweep
from nonholonomic.runs.model import model_of
from nonholonomic.runs.trajectory import page_of
from nonholonomic.views.pages import programs


class Room(AbstractMode):
    """A ball in a square room, from -1 to 1."""

    names = ("x", "y", "vx", "vy")

    def field(self, t, s):
        return jnp.array([s[2], s[3], 0.0, 0.0])

    def margin(self, t, s):
        return jnp.array([1.0 + s[0], 1.0 + s[1], 1.0 - s[0], 1.0 - s[1]])

    def reset(self, t, s, exit):
        return jnp.where(jnp.arange(4) == 2 + exit % 2, -s, s), 0


def fold(place):
    return 1.0 - np.abs((place + 1.0) % 4.0 - 2.0)


ROOM = Hybrid([Room()], event=lambda t, s: 4.0 - t)
#: The last one strikes two walls at once, in a corner.
STARTS = np.array([[0.3, -0.2, 0.8, 0.6], [-0.9, 0.1, -0.6, 0.9], [0.5, 0.5, 0.1, -1.0], [0.5, 0.5, 1.0, 1.0]])


def unfolded(start, time):
    return fold(start[..., :2] + time * start[..., 2:])


def test_a_ball_in_a_room_with_four_walls():
    def end(start):
        run = simulate(Hybrid([Room()]), start, 7.0, times=[7.0])
        return run.state[0, :2], (run.state[0, :2], run.switches)

    slopes, (ends, switches) = jax.jit(jax.vmap(jax.jacfwd(end, has_aux=True)))(STARTS)
    assert_close(ends, unfolded(STARTS, 7.0), atol=1e-9)
    walls = np.abs((STARTS[:, :2] + 7.0 * STARTS[:, 2:] + 1.0) // 2.0).sum(1)
    assert switches.tolist() == walls.tolist()
    sign = np.sign(unfolded(STARTS[0] + [1e-3, 1e-3, 0.0, 0.0], 7.0) - unfolded(STARTS[0], 7.0))
    assert_close(slopes[0], np.hstack([np.diag(sign), 7.0 * np.diag(sign)]), atol=1e-9)
    table = sweep(ROOM, STARTS[0], 7.0, scattered=True, axes={f"start[{k}]": STARTS[:3, k] for k in range(4)})
    assert_close(np.asarray(table["time"]), 4.0, atol=1e-9)
    assert_close(np.stack([table["x"], table["y"]], axis=1), unfolded(STARTS[:3], 4.0), atol=1e-9)


class Beads(AbstractMode):
    """Two beads of masses 1 and 3 on a rail between two walls."""

    def field(self, t, s):
        return jnp.array([s[2], s[3], 0.0, 0.0])

    def margin(self, t, s):
        return {"wall": s[0], "beads": s[1] - s[0], "end": 1.0 - s[1]}

    def reset(self, t, s, exit):
        left, right = s[2], s[3]
        struck = jnp.array([-0.5 * left + 1.5 * right, 0.5 * left + 0.5 * right])
        walls = jnp.array([jnp.where(exit["wall"], -left, left), jnp.where(exit["end"], -right, right)])
        return jnp.concatenate([s[:2], jnp.where(exit["beads"], struck, walls)]), 0


def test_two_beads_strike_one_another_and_the_walls():
    """The reference takes the impacts one by one."""
    place, speed, left, struck = np.array([0.2, 0.7]), np.array([0.9, -0.4]), 10.0, []
    while True:
        gaps = np.array([place[0], place[1] - place[0], 1.0 - place[1]])
        rates = np.array([speed[0], speed[1] - speed[0], -speed[1]])
        waits = np.where(rates < 0.0, gaps / np.where(rates < 0.0, -rates, 1.0), np.inf)
        exit = int(np.argmin(waits))
        if waits[exit] > left:
            break
        place, left = place + waits[exit] * speed, left - waits[exit]
        struck.append(("wall", "beads", "end")[exit])
        speed = [speed * [-1, 1], np.array([[-0.5, 1.5], [0.5, 0.5]]) @ speed, speed * [1, -1]][exit]
    run = simulate(Hybrid([Beads()]), [0.2, 0.7, 0.9, -0.4], 10.0, times=[10.0])
    assert_close(run.state[0], np.concatenate([place + left * speed, speed]), atol=1e-9)
    assert np.all(np.diff(run.resets["time"]) >= 0.0)
    assert run.resets["margin"].tolist() == struck


class Block(AbstractSystem):
    """A falling block that strikes the floor with either of its lower edges."""

    dimension = 3

    def metric(self, q):
        return jnp.diag(jnp.array([1.0, 1.0, 0.2]))

    def potential(self, q):
        return 9.81 * q[1]

    def margin(self, t, q, rate):
        lower, width = q[1] - jnp.cos(q[2]), 0.5 * jnp.sin(q[2])
        return {"left": lower - width, "right": lower + width}

    def reset(self, t, q, rate, exit):
        return q, self.impact(t, q, rate, 1.0, exit)


def test_a_block_rocks_on_two_edges_and_keeps_its_energy():
    run = simulate(Block(), ([0.0, 1.1, 0.1], [0.0, 0.0, 0.0]), 1.5)
    q, rate = np.split(np.asarray(run.state), 2, axis=1)
    assert run.status == "completed"
    assert int(run.switches) >= 3
    edges = q[:, 1] - np.cos(q[:, 2]) - 0.5 * np.abs(np.sin(q[:, 2]))
    assert edges.min() > -1e-9
    assert_close(0.5 * (rate[:, :2] ** 2).sum(1) + 0.1 * rate[:, 2] ** 2 + 9.81 * q[:, 1], 9.81 * 1.1, atol=1e-7)


@pytest.mark.parametrize(
    ("margin", "message"),
    [
        (lambda self, t, s: jnp.ones((2, 2)), r"modes\[0\]\.margin\(t, y\) must return one number, an array of shape"),
        (lambda self, t, s: {"a": jnp.ones(2)}, "a dict of numbers by name"),
        (lambda self, t, s: {"a": 1}, "a dict of numbers by name|must return floats"),
    ],
)
def test_wrong_margins_are_described(margin, message):
    with pytest.raises(ValueError, match=message):
        event_time(Hybrid([type("Wrong", (Room,), {"margin": margin})()], lambda t, y: y[0]), STARTS[0], 1.0)


@pytest.mark.parametrize("written", [0, "left"])
def test_a_dict_of_exits_is_not_compared_with_a_number_or_a_name(written):
    """`exit == "left"` would be false, and the reset another one than it says."""

    def reset(self, t, q, rate, exit):
        return jnp.where(exit == written, q, -q), rate

    with pytest.raises(ValueError, match=r"exit == (0|left): .*write exit\['left'\]"):
        simulate(type("Wrong", (Block,), {"reset": reset})(), ([0.0, 1.1, 0.1], [0.0, 0.0, 0.0]), 1.5)


@pytest.mark.slow
@needs_browser
def test_the_browser_knows_the_wall():
    live = page_of(model_of(Hybrid([Room()]), list(STARTS[0])), {"start[0]": (-0.5, 0.5)}, 7.0)[0]
    with open_browser() as driver:
        ends = driver.execute_script(
            f"""{programs(live)}
            const asks = integrator(live.answer);
            return [-0.4, 0.3].map((x) => {{
              asks.run([x]);
              return asks.read("outcome", [x])[1];
            }})"""
        )
    assert_close(np.array(ends, float), fold(np.array([-0.4, 0.3]) + 5.6), atol=1e-9)
