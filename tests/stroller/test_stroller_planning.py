"""Plans: closed forms of their parts, and plans that are driven again and checked by other means."""

import dataclasses
import importlib
import re
from itertools import count
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from shortest_paths import dubins, reeds_shepp

import nonholonomic
import stroller
from nonholonomic.compilation.tracing import jumps_of
from stroller import __main__ as job
from stroller.planning import planner as planner_module
from stroller.planning.plan import TIMES, planned_stage, seen_along
from stroller.planning.planner import proposed
from stroller.planning.problem import Obstacles, checked_problem, corners_of, disc_distance, separation
from stroller.planning.search import Costs, Search, guess_of, paths_of, prices
from stroller.planning.transcription import (
    LIMIT_RESERVE,
    Rates,
    Task,
    actuation,
    drive_along,
    evaluate_spline,
    interpolate,
)

BODY = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005)
SCENE = stroller.Scene(BODY, friction=stroller.Damping(2.0, 0.5, 0.1, 0.05))
FOOTPRINT = stroller.Footprint(length=0.5, width=0.25, rear=0.1)
LIMITS = stroller.Limits(steering=np.pi / 3.0, speed=(-0.5, 0.8))
OPTIONS = {"limits": LIMITS, "footprint": FOOTPRINT, "progress": False}


def room(x0, x1, y0, y1):
    """Four walls."""
    middle = ((x0 + x1) / 2.0, (y0 + y1) / 2.0)
    along, across = x1 - x0 + 0.2, y1 - y0
    lower, upper = [stroller.Box((middle[0], y), (along, 0.1)) for y in (y0 - 0.05, y1 + 0.05)]
    return [lower, upper, *(stroller.Box((x, middle[1]), (0.1, across)) for x in (x0 - 0.05, x1 + 0.05))]


#: Start, goal, obstacles and duration of problems that a straight line does not solve.
GAP = [stroller.Box((1.1, 0.3), (0.5, 0.25)), stroller.Box((2.7, 0.3), (0.5, 0.25)), *room(0.0, 3.0, 0.0, 1.2)]
CASES = {
    "parallel parking": ((0.7, 0.8, 0.0), (1.9, 0.3, 0.0), GAP, 12.0),
    "turn on the spot": ((1.1, 1.1, 0.0), (1.1, 1.1, np.pi), room(0.0, 2.2, 0.0, 2.2), 20.0),
    "kinked corridor": (
        (0.4, 0.4, 0.0),
        (3.3, 2.4, 0.0),
        [stroller.Box((1.2, 1.7), (2.4, 1.8)), stroller.Box((3.4, 0.75), (1.0, 1.5)), *room(0.0, 3.9, 0.0, 2.9)],
        20.0,
    ),
    "trap": (
        (2.0, 1.5, np.pi),
        (4.0, 1.5, 0.0),
        [stroller.Box((2.6, 1.5), (0.1, 1.6)), *(stroller.Box((2.0, y), (1.2, 0.1)) for y in (0.75, 2.25))],
        25.0,
    ),
}


def planned(name, **options):
    start, goal, obstacles, t1 = CASES[name]
    launch, target = stroller.Launch(start[:2], start[2], 0.0), stroller.Goal(goal[:2], goal[2])
    return launch, target, stroller.plan(SCENE, launch, target, t1, obstacles=obstacles, **OPTIONS, **options)


def depth_in(box, points):
    """How deep points are inside a box, negative outside: in the box's own axes, without polygons."""
    cosine, sine = np.cos(float(box.angle)), np.sin(float(box.angle))
    away = points - np.array(box.centre, dtype=float)
    own = np.stack([cosine * away[..., 0] + sine * away[..., 1], cosine * away[..., 1] - sine * away[..., 0]], axis=-1)
    return np.min(np.array(box.size, dtype=float) / 2.0 - np.abs(own), axis=-1)


def edge_of_footprint(run):
    """Points all around the footprint at the times of a run."""
    part = np.linspace(0.0, 1.0, 21)
    x, y = -0.1 + 0.5 * part, -0.125 + 0.25 * part
    around = [(x, 0 * x - 0.125), (x, 0 * x + 0.125), (0 * y - 0.1, y), (0 * y + 0.4, y)]
    own = np.concatenate([np.stack(side, axis=-1) for side in around])
    heading = np.asarray(run.heading)[:, None]
    along, across = own[:, 0], own[:, 1]
    turned = [along * np.cos(heading) - across * np.sin(heading), along * np.sin(heading) + across * np.cos(heading)]
    return np.asarray(run.place)[:, None] + np.stack(turned, axis=-1)


def times_of(plan):
    """As many times as a plan's own run has, for the programs of that run."""
    return np.linspace(0.0, plan.t1, TIMES)


def assert_solves(plan, launch, goal, obstacles):
    """Drive a plan again, and look at its end, its limits and every point of its edge."""
    assert plan.reached, str(plan)
    run = stroller.simulate(SCENE, launch, plan.t1, plan.input, times=times_of(plan), tolerance=1e-9)
    assert np.hypot(*(run.place[-1] - np.array(goal.place))) < 0.05
    assert abs(np.angle(np.exp(1j * (run.heading[-1] - goal.heading)))) < 0.05
    assert abs(run.speed[-1]) < 0.05
    assert np.max(np.abs(run.steering)) < np.pi / 3.0
    assert -0.5 < np.min(run.speed) < np.max(run.speed) < 0.8
    edge = edge_of_footprint(run)
    assert max(depth_in(box, edge).max() for box in obstacles) < 0.0
    assert plan.clearance > 0.0


@pytest.fixture(scope="module")
def parked():
    """The launch, the goal and the plan of parallel parking."""
    return planned("parallel parking")


def test_a_plan_parks_without_touching_anything(parked):
    launch, goal, plan = parked
    assert_solves(plan, launch, goal, GAP)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["turn on the spot", "kinked corridor", "trap"])
def test_a_plan_finds_the_way(name):
    launch, goal, plan = planned(name)
    assert_solves(plan, launch, goal, CASES[name][2])


@pytest.mark.usefixtures("parked")
def test_another_problem_compiles_nothing(caplog):
    with jax.log_compiles():
        launch, goal = stroller.Launch((0.6, 0.8), 0.1, 0.0), stroller.Goal((1.9, 0.3), 0.0)
        plan = stroller.plan(SCENE, launch, goal, 11.0, obstacles=GAP[:4], **OPTIONS)
    assert plan.reached
    compiled = [text for text in caplog.messages if "Finished XLA compilation" in text]
    assert compiled == []


def test_a_plan_shows_what_it_achieves(parked, tmp_path):
    _, _, plan = parked
    lines = str(plan).splitlines()
    assert lines[0] == "Plan of 12 s: reaches the goal"
    assert any(line.startswith("  speed      margin 0.") for line in lines)
    # As the run says; the centre of mass is above the rear axle.
    grip, force = np.max(plan.run.grip()[:, 0]), np.max(np.abs(plan.run.side_force[:, 1]))
    words = (
        f"needs a friction coefficient of {grip:.3g} under the rear axle; the front wheel carries no load, and a side"
    )
    assert f"  grip       {words} force of up to {force:.3g} N" in lines
    assert words in str(plan.run)
    figure = plan.plot()
    assert [panel.get_ylabel() for panel in figure.axes[1:]] == ["speed [m/s]", "steering [rad]"]
    above, speed, steering = plan.plot(unit=("deg", "km/h")).axes
    assert [speed.get_ylabel(), steering.get_ylabel()] == ["speed [km/h]", "steering [deg]"]
    assert_close(steering.lines[0].get_ydata(), np.degrees(plan.run.steering))
    names = [text.get_text() for text in above.get_legend().get_texts()]
    assert sorted(names) == ["candidates", "footprint", "goal", "obstacles", "rear axle"]
    # An arrow from the rear to the front of the goal, (1.9, 0.3) with heading 0.
    arrow = above.lines[-1].get_xydata()
    assert_close(arrow[:2, 1], [0.3, 0.3], atol=1e-9)
    assert_close(arrow[1, 0] - arrow[0, 0], float(plan.problem.footprint.length), rtol=1e-9)
    failed = dataclasses.replace(plan, hindrances=("the footprint overlaps obstacles[0] by 0.592 m",) * 5)
    (title,) = (text for text in failed.plot().texts if "overlaps" in text.get_text())
    title.figure.draw_without_rendering()
    box = title.get_window_extent()
    assert title.get_text().count("overlaps") == 5
    assert 0.0 < box.x0 < box.x1 < title.figure.bbox.x1
    page = plan.view(tmp_path / "plan.html", unit="deg")
    assert 'steering angle", "unit": "deg"' in page.html
    assert (tmp_path / "plan.html").read_text() == page.html
    # The frame and the wheels, the footprint, the candidates, the obstacles and the goal.
    assert [len(show.bodies) for show in planned_stage(plan).shows] == [4 + 4]


def test_a_plan_and_rides_on_one_page_have_colours_of_their_own(parked):
    _, _, plan = parked
    rides = {("plane", name): plan.run for name in ("without friction", "with friction")}
    colours = [show.colour for stage in job.stages(plan, rides) for show in stage.shows]
    assert len(set(colours)) == 3
    assert [show.name for show in job.stages(plan, rides)[0].shows] == ["plan of 12 s"]


def test_a_goal_without_a_heading_is_drawn_as_a_cross(parked):
    _, _, plan = parked
    problem = dataclasses.replace(plan.problem, goal=stroller.Goal((1.9, 0.3)))
    cross = dataclasses.replace(plan, problem=problem)
    (mark,) = [line for line in cross.plot().axes[0].lines if line.get_label() == "goal"]
    assert mark.get_marker() == "x"
    assert_close(np.array(mark.get_data()).ravel(), [1.9, 0.3])
    ((*_, body),) = [show.bodies for show in planned_stage(cross).shows]
    vertices = np.concatenate([mesh.vertices for mesh in body.meshes])
    # The middle is the goal, and the arms are 0.1 wheelbases from it.
    assert_close(vertices.mean(axis=0)[:2], [1.9, 0.3], atol=1e-9)
    assert_close(np.ptp(vertices[:, :2], axis=0), 0.05, atol=0.01)


@pytest.mark.parametrize("heading", [0.4, None])
def test_a_plan_on_a_curved_ground_is_drawn_in_space(parked, heading):
    """With the ground, the vehicle, and the goal, which lie on the ground."""
    scene, launch = stroller.presets.bowl(), stroller.Launch((0.0, -1.0), 0.3, 0.5)
    run, length = stroller.simulate(scene, launch, 1.0), float(scene.body.wheelbase)
    disc = stroller.Disc((-0.5, -1.0), 0.3)
    problem = checked_problem(scene, launch, stroller.Goal((0.3, -0.9), heading), 1.0, [disc])
    plan = dataclasses.replace(parked[2], run=run, problem=problem, candidates=np.asarray(run.position)[None])
    above = plan.plot().axes[0]
    assert above.name == "3d"
    lines = {line.get_label(): np.array(line.get_data_3d()).T for line in above.lines}
    assert_close(lines["rear axle"], run.position)
    # A line for each number of the ground's grid, the obstacle, the candidate, the vehicle, the path and the goal.
    assert len(above.lines) > 13 + 4 + 5
    centre, _, _, up = in_space(scene.surface, disc.centre, 0.0)
    (foot,) = [line for line in (np.array(line.get_data_3d()).T for line in above.lines) if len(line) == 49]
    assert_close(scene.surface.offset(tuple(foot.T)), np.zeros(49), atol=1e-9)
    assert_close(np.linalg.norm(np.cross(foot - centre, up), axis=1), np.full(49, 0.3), atol=2e-3)
    ((*_, body, at_the_goal),) = [show.bodies for show in planned_stage(plan).shows]
    # It rises on the stroller's side, from its own foot.
    heights = (body.meshes[0].vertices - centre) @ -up
    assert_close(heights.max(), 0.5 * length + ((foot - centre) @ -up).max(), atol=1e-9)
    goal = lines["goal"]
    assert len(goal) == (1 if heading is None else 5)
    assert_close(scene.surface.offset(tuple(goal.T)), np.zeros(len(goal)), atol=1e-2 * length)
    if heading is not None:
        assert_close(np.linalg.norm(goal[0] - goal[3]), 1.4 * length, rtol=0.02)
    vertices = np.concatenate([mesh.vertices for mesh in at_the_goal.meshes])
    assert np.linalg.norm(vertices - goal.mean(axis=0), axis=1).max() < 1.2 * length


def test_candidates_are_smooth_curves(parked):
    """Eight points for each interval of the optimiser, on its path."""
    _, _, plan = parked
    line = np.asarray(plan.candidates)[-1]
    assert len(line) == 8 * 64 + 1
    assert_close(line[[0, -1]], np.asarray(plan.run.position)[[0, -1]], atol=0.05)


def test_a_table_drives_a_plan_as_a_single_ride_does(parked):
    """The splines of a plan belong to a ride, whatever the number of cells: their coefficients are not one per cell."""
    launch, _, plan = parked
    run = stroller.simulate(SCENE, launch, plan.t1, plan.input, times=times_of(plan))
    axes = {"body.mass": [5.0, 5.1, 5.0]}
    table = stroller.sweep(SCENE, launch, plan.t1, axes=axes, input=plan.input, progress=False)
    ends = np.stack([table.x, table.y], axis=-1)
    assert_close(ends[[0, 2]], np.tile(run.place[-1], (2, 1)), atol=1e-7)
    assert np.hypot(*(ends[1] - ends[0])) > 1e-5


def test_a_parked_stroller_stays_parked_and_a_slope_is_driven_as_a_level(parked):
    """After the plan's end nothing brakes or steers; a tracker holds the weight of the scene that is driven."""
    launch, goal, plan = parked
    slope = eqx.tree_at(lambda scene: scene.surface, SCENE, stroller.Plane(tilt=0.2))
    for scene, drive in (
        (SCENE, plan.input),
        (SCENE, stroller.track(SCENE, plan)),
        (slope, stroller.track(slope, plan)),
    ):
        run = stroller.simulate(scene, launch, 4.0 * plan.t1, drive, times=[plan.t1, 1.5 * plan.t1, 4.0 * plan.t1])
        assert_close(run.place, np.tile(goal.place, (3, 1)), atol=0.02)
        assert_close(run.place[1:], np.tile(run.place[0], (2, 1)), atol=2e-3)
        assert_close(run.speed[1:], 0.0, atol=1e-3)


def freely(goal, t1, limits, steering=0.0, **options):
    """A plan from rest at the origin, with a box out of the way, for the programs of the other plans."""
    away, launch = [stroller.Box((2.0, 4.0), (0.5, 0.5))], stroller.Launch((0.0, 0.0), 0.0, 0.0, steering)
    options = {"obstacles": away, "footprint": FOOTPRINT, "progress": False, "starts": 2} | options
    return launch, stroller.plan(SCENE, launch, goal, t1, limits=limits, **options)


@pytest.mark.parametrize("t1", [40.0, pytest.param(20.0, marks=pytest.mark.slow)])
def test_limits_hold_until_the_end(t1):
    """The force rises to its limit at the end, where the speed of the goal is reached."""
    limits = stroller.Limits(steering=1.0, speed=1.0, force=3.0)
    _, plan = freely(stroller.Goal((4.0, 0.0), speed=0.5), t1, limits)
    assert plan.reached, str(plan)
    _, force, _ = seen_along(SCENE.dynamics, FOOTPRINT, plan.input, plan.run.t, plan.run.state)
    assert np.max(np.abs(force)) < 3.0


@pytest.mark.parametrize(
    ("sign", "goal"),
    [
        (1.0, stroller.Goal((3.0, 1.0))),
        pytest.param(-1.0, stroller.Goal((-3.0, 1.0)), marks=pytest.mark.slow),
        pytest.param(1.0, stroller.Goal((-2.0, 0.0), 0.0), marks=pytest.mark.slow),
    ],
)
def test_a_plan_can_go_without_reverse(sign, goal):
    """The limit is the speed of launch and goal; and the same backwards."""
    speed = tuple(sorted((0.0, sign)))
    _, plan = freely(goal, 20.0 if goal.heading is not None else 10.0, stroller.Limits(steering=1.0, speed=speed))
    assert plan.reached, str(plan)
    assert np.min(sign * np.asarray(plan.run.speed)) >= -1e-3


def test_the_wheel_can_be_limited_to_one_side():
    launch, plan = freely(stroller.Goal((2.0, 2.0)), 10.0, stroller.Limits(steering=(0.0, 1.0)))
    assert plan.reached, str(plan)
    tracker = stroller.track(SCENE, plan)
    run = stroller.simulate(SCENE, launch, plan.t1, tracker, times=times_of(plan), tolerance=1e-9)
    assert np.hypot(*(run.place[-1] - 2.0)) < 0.05


@pytest.mark.parametrize(
    ("steering", "speed", "bends", "directions"),
    [
        ((-1.0, 1.0), None, (-1.0, -0.5, 0.0, 0.5, 1.0), (-1.0, 1.0)),
        ((0.0, 1.0), (0.0, 0.8), (0.0, 0.5, 1.0), (1.0,)),
        ((-1.0, 0.0), (-0.8, 0.0), (-1.0, -0.5, 0.0), (-1.0,)),
    ],
)
def test_a_search_keeps_to_what_the_limits_allow(steering, speed, bends, directions):
    """And the optimiser may use the values of launch and goal, which are 0."""
    limits = stroller.Limits(steering=steering, speed=speed)
    problem = checked_problem(SCENE, START, GOAL, 12.0, GAP, limits, FOOTPRINT)
    task, search = Task.of(problem, 1.0, 12.0, 0.0), Search(problem, 0.85, Costs(0.0, 0.0, 1.0, 0.0))
    assert all(low <= 0.0 <= high for low, high in zip(task.low[:2], task.high[:2], strict=True))
    assert_close(np.unique(search.moves[:, 1]) / search.sharpest, bends, atol=0.02)
    assert tuple(np.unique(search.moves[:, 0])) == directions


def test_a_solution_that_a_finer_run_refutes_is_not_the_end(monkeypatch):
    """The first confirming run fails: the search goes on with another candidate."""
    module, confirmed = importlib.import_module("stroller.planning.plan"), []
    run_and_judge = module.checked_drive

    def checked_drive(problem, drive, tolerance):
        plan = run_and_judge(problem, drive, tolerance)
        if tolerance == module.TIGHT:
            confirmed.append(drive)
        return dataclasses.replace(plan, hindrances=("refuted",) if len(confirmed) == 1 else plan.hindrances)

    monkeypatch.setattr(module, "checked_drive", checked_drive)
    _, plan = freely(stroller.Goal((3.0, 1.0)), 10.0, LIMITS)
    assert plan.reached
    assert len(confirmed) == 2


def test_what_is_out_of_reach_is_said():
    """Ten metres in three seconds, at 0.8 m/s at most."""
    launch, goal = stroller.Launch((0.0, 0.0), 0.0, 0.0), stroller.Goal((10.0, 0.0), 0.0)
    plan = stroller.plan(SCENE, launch, goal, 3.0, obstacles=GAP[:1], starts=2, **OPTIONS)
    assert not plan.reached
    assert re.search(r"shortest path that was found, (9.9|10)\S* m, takes 12\.\d s at the limit", plan.hindrances[-1])
    assert "does not reach the goal" in str(plan)
    assert all(f"  hindrance  {words}" in str(plan) for words in plan.hindrances)


def test_the_search_finds_the_shortest_path_on_the_empty_plane():
    """Forwards only by Dubins' lengths, and with reverse by Reeds and Shepp's, for short and long vehicles."""
    random, prices = np.random.default_rng(0), Costs(0.0, 0.0, 1.0, 0.0)
    for number in range(24):
        (x, y), (heading, wheelbase) = (
            random.uniform(-5.0, 5.0, 2),
            (random.uniform(-np.pi, np.pi), 0.25 * 4.0 ** random.random()),
        )
        shortest, slowest = ((dubins, 0.0), (reeds_shepp, -1.0))[number % 2]
        scene = stroller.Scene(dataclasses.replace(BODY, wheelbase=wheelbase))
        # The search leaves the reserve of the limits out, and turns with a radius of 1 m at least.
        limits = stroller.Limits(steering=np.arctan(wheelbase) / (1.0 - LIMIT_RESERVE), speed=(slowest, 1.0))
        launch, goal = stroller.Launch((0.0, 0.0), 0.0, 0.0), stroller.Goal((x, y), heading)
        search = Search(checked_problem(scene, launch, goal, 99.0, limits=limits), 1.0, prices)
        assert_close(search.sharpest, 1.0, rtol=1e-12)
        path, _, _ = search.run()
        assert 1.0 - 1e-9 < path.length.sum() / shortest(*path.poses[-1]) < 1.1
        assert np.hypot(*(path.poses[-1] - [x, y, heading])[:2]) < search.cell


@pytest.mark.parametrize(("slowest", "direction"), [(-0.8, -1.0), (-0.1, 1.0)])
def test_a_search_in_haste_reverses_where_that_takes_less_time(slowest, direction):
    """To a goal behind the start: straight back, or around with two U-turns forwards."""
    launch, goal = stroller.Launch((0.0, 0.0), 0.0, 0.0), stroller.Goal((-2.0, 0.0), 0.0)
    limits = stroller.Limits(steering=1.0, speed=(slowest, 0.8))
    problem = checked_problem(SCENE, launch, goal, 12.0, (), limits, FOOTPRINT, in_haste=True)
    (path,), _ = paths_of(problem, prices(problem, 1, 0, np.random.default_rng(0)))
    assert path.length[path.direction == direction].sum() > 0.9 * path.length.sum()


def test_a_search_that_is_cut_short_says_so(monkeypatch):
    """The U-turn between two walls needs more poses than it may look at; and a goal that is walled in needs none."""
    launch, goal = stroller.Launch((0.0, 0.0), 0.0, 0.0), stroller.Goal((0.0, 0.0), np.pi)
    problem = checked_problem(SCENE, launch, goal, 12.0, room(-1.5, 1.5, -0.3, 0.3), LIMITS, FOOTPRINT)
    monkeypatch.setattr("stroller.planning.search.MOST_NODES", 50)
    _, reason = paths_of(problem, prices(problem, 1, 0, np.random.default_rng(0)))
    assert re.match(r"the search ended after \d+ poses without a path; the nearest", reason)


def in_haste(start, goal, longest, wheelbase=0.25, slowest=0.0, starts=4):
    """A plan of the least time from rest to rest with a least turning radius of 1 m, with a box out of the way."""
    body = stroller.Stroller(mass=5.0, wheelbase=wheelbase, inertia=0.1, steering_inertia=0.005)
    scene, launch = stroller.Scene(body, friction=SCENE.friction), stroller.Launch(start[:2], start[2], 0.0)
    limits = stroller.Limits(steering=np.arctan(wheelbase), speed=(slowest, 1.0))
    options = {
        "obstacles": [stroller.Box((-9.0, 0.0), (0.5, 0.5))],
        "limits": limits,
        "minimise": "time",
        "starts": starts,
    }
    return stroller.plan(scene, launch, stroller.Goal(goal[:2], goal[2]), longest, **options, progress=False)


@pytest.mark.parametrize("wheelbase", [0.25, *(pytest.param(slow, marks=pytest.mark.slow) for slow in (0.5, 1.0))])
def test_a_wide_turn_takes_hardly_more_than_the_shortest_path(wheelbase):
    """A U-turn forwards only: half a circle, and the time to turn the wheel and to brake."""
    plan = in_haste((0.0, 0.0, 0.0), (0.0, 2.0, np.pi), 20.0, wheelbase)
    assert plan.reached, str(plan)
    assert np.pi - 0.1 < plan.t1 < 1.1 * np.pi


def test_the_least_time_does_not_depend_on_the_longest():
    start, goal, shortest = (0.0, 0.0, np.pi / 2.0), (4.0, 4.0, 0.0), dubins(4.0, -4.0, -np.pi / 2.0)
    plans = [in_haste(start, goal, longest, starts=2) for longest in (5.0, 17.4)]
    assert plans[0].t1 == plans[1].t1
    assert shortest < plans[1].t1 < 1.05 * shortest
    assert plans[1].reached, str(plans[1])
    assert not plans[0].reached
    assert f"the drive takes {plans[0].t1:.4g} s, longer than t1 = 5 s" in plans[0].hindrances


@pytest.mark.slow
def test_a_turn_of_the_path_is_not_lost_to_haste():
    """A loop to a goal close by: the first candidates cut it off, and the firmer ones drive it."""
    goal = (2.85786, -0.853442, 1.4733)
    plan = in_haste((0.0, 0.0, 0.0), goal, 15.8, 0.5)
    assert plan.reached, str(plan)
    assert plan.t1 < 1.1 * dubins(*goal)


def test_with_reverse_the_least_time_is_close_to_the_shortest_path():
    goal = (-1.5, 1.0, 0.5)
    plan = in_haste((0.0, 0.0, 0.0), goal, 20.0, slowest=-1.0)
    assert plan.reached, str(plan)
    assert 1.0 < plan.t1 / reeds_shepp(*goal) < 1.2


def test_a_goal_very_far_away_gets_a_reason():
    """Ten thousand metres in 20 s; and a run that fails has no end."""
    _, plan = freely(stroller.Goal((1e4, 1e4)), 20.0, LIMITS)
    assert not plan.reached
    assert "nan" not in str(plan)
    assert "takes 1.77e+04 s at the limit of the speed" in plan.hindrances[-1]
    failed = dataclasses.replace(plan, errors=(np.nan,) * 3, effort=np.nan, hindrances=("the run ends",))
    assert "nan" not in str(failed)
    assert "hindrance  the run ends" in str(failed)


WALLED_IN = (stroller.Launch((-2.0, 0.5), 0.0, 0.0), stroller.Goal((0.5, 0.5), 0.0), room(0.0, 1.2, 0.0, 1.0))


def test_the_search_says_that_a_goal_is_walled_in():
    launch, goal, walls = WALLED_IN
    problem = checked_problem(SCENE, launch, goal, 12.0, walls, LIMITS, FOOTPRINT)
    _, reason = paths_of(problem, prices(problem, 1, 0, np.random.default_rng(0)))
    assert re.fullmatch(r"no path to the goal was found; the nearest ended \S+ m from the goal", reason)


@pytest.mark.slow
def test_a_goal_that_is_walled_in_is_not_reached():
    launch, goal, walls = WALLED_IN
    plan = stroller.plan(SCENE, launch, goal, 12.0, obstacles=walls, **OPTIONS)
    assert not plan.reached
    assert "no path to the goal was found; the nearest ended" in plan.hindrances[-1]


def test_less_time_is_less():
    launch, goal = stroller.Launch((0.0, 0.0), 0.0, 0.0), stroller.Goal((1.0, 0.0), 0.0)
    plan = stroller.plan(SCENE, launch, goal, 10.0, obstacles=GAP[:1], minimise="time", **OPTIONS)
    assert plan.reached
    # 0.95 m, which is close enough, takes more than 1.18 s at 0.8 m/s.
    assert 1.18 < plan.t1 < 1.4


@pytest.mark.slow
def test_the_shortest_time_around_boxes_does_not_depend_on_the_longest():
    limits = stroller.Limits(steering=1.0, speed=1.0, force=6.0, torque=0.5)
    boxes = [stroller.Box((1.5, 0.2), (0.4, 0.8)), stroller.Box((2.5, -0.5), (0.4, 0.8))]
    options = {"minimise": "time", "obstacles": boxes}
    goal = stroller.Goal((4.0, 0.0), speed=0.5)
    durations = [freely(goal, t1, limits, **options)[1].t1 for t1 in (10.0, 20.0, 40.0)]
    assert_close(durations, durations[0], rtol=0.05)


def test_tracking_brings_a_disturbed_ride_to_the_goal():
    """Mass and damping 5 % off, the start by 0.1 m and 0.1 rad: open loop, the error at the end is greater."""
    launch, goal = stroller.Launch((0.0, 1.0), 0.0, 0.0), stroller.Goal((3.0, 1.2), 0.0)
    plan = stroller.plan(SCENE, launch, goal, 12.0, obstacles=GAP[:2], **OPTIONS)
    body = stroller.Stroller(mass=5.25, wheelbase=0.25, inertia=0.105, steering_inertia=0.005)
    wrong = stroller.Scene(body, friction=stroller.Damping(2.1, 0.525, 0.105, 0.0525))
    elsewhere = stroller.Launch((0.07, 0.93), 0.1, 0.0)
    tracker, times = stroller.track(SCENE, plan), times_of(plan)
    runs = [
        stroller.simulate(wrong, elsewhere, plan.t1, drive, times=times, tolerance=1e-9)
        for drive in (plan.input, tracker)
    ]
    missed = [np.hypot(*(run.place[-1] - np.array(goal.place))) for run in runs]
    assert missed[1] < 0.02 < 0.1 < missed[0]
    assert max(np.max(np.abs(run.energy_residual)) for run in runs) < 1e-10
    # The shaped energy is only taken out, but for the lag of the fork.
    geometry = jax.vmap(lambda state: wrong.dynamics.geometry(state).motion)(runs[1].state)
    storage = np.asarray(jax.vmap(tracker.storage)(runs[1].t, geometry))
    assert storage.max() < 1.05 * storage[0]
    assert storage[-1] < 1e-3 * storage[0]

    def pushed(t, motion):
        force, torque = tracker(t, motion)
        return force - 3.0 * ((t > 4.0) & (t < 6.0)), torque + 0.02 * jnp.sin(3.0 * t)

    # The splines are known to be smooth; the jumps of the disturbance are found.
    jumps, unclear = jumps_of(pushed, 0.0, jax.tree.map(lambda part: part[0], geometry))
    assert unclear == ()
    # Beyond its ends, a spline is constant.
    assert {0.0, 4.0, 6.0, plan.t1} <= set(jumps.tolist())


def drawn(random):
    """A problem with a box between start and goal."""
    goal = stroller.Goal((random.uniform(1.5, 2.5), random.uniform(-0.5, 0.5)), random.uniform(-0.5, 0.5))
    box = stroller.Box((0.8, random.uniform(-0.6, 0.6)), (0.2, 0.2))
    launch = stroller.Launch((0.0, 0.0), random.uniform(-0.5, 0.5), 0.0)
    return {"launch": launch, "goal": goal, "t1": 10.0, "obstacles": [box], "limits": LIMITS, "footprint": FOOTPRINT}


def gripping(random, limits):
    return {"limits": limits} if random.random() < 0.5 else {}


@pytest.mark.parametrize("more", [{}, pytest.param({"grip": (0.0, 5.0)}, marks=pytest.mark.slow)])
def test_a_planner_learns_and_a_plan_begins_with_its_proposal(more, monkeypatch):
    """By a clock of its own, which allows eighty steps; in the slow run, every second problem limits the grip."""
    monkeypatch.setattr(planner_module, "time", SimpleNamespace(perf_counter=count().__next__))
    monkeypatch.setattr(planner_module, "BATCH", 8)
    others = dataclasses.replace(LIMITS, **more)
    planner = stroller.learn_planner(SCENE, lambda random: drawn(random) | gripping(random, others), seconds=100.0)
    untrained = stroller.learn_planner(SCENE, drawn, seconds=0)
    random = np.random.default_rng(5)
    tasks = [planner_module.drawn_task(SCENE, drawn, random, k) for k in range(6)]

    def missed(planner):
        ends = [proposed(planner, task)[-1, :4] - np.asarray(task.goal[0]) for task in tasks]
        return np.median(np.linalg.norm(ends, axis=1))

    astray = jax.tree.map(lambda part: np.nan * part if eqx.is_inexact_array(part) else part, planner)
    assert proposed(astray, tasks[0]) is None
    assert missed(planner) < 0.3 * missed(untrained)
    plan = stroller.plan(SCENE, **drawn(random), planner=planner, progress=False)
    assert plan.reached
    assert len(plan.candidates) % 2 == 1


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"problems": 3}, "problems = 3 must be a function of a numpy.random.Generator"),
        ({"problems": lambda random: {"launch": START}}, "problems: draw 0: 'goal' is missing"),
        ({"problems": lambda random: [START, GOAL, 1.0]}, "problems: draw 0: .* must be a dict with launch, goal, t1"),
        ({"problems": lambda random: drawn(random) | {"obstacle": []}}, "'obstacle' must .*; did you mean 'obstacles'"),
        ({"problems": lambda random: drawn(random) | {"goal": GOAL, "t1": 0.0}}, "problems: draw 0: t1 = 0.0 must be"),
        ({"seconds": -1.0}, "seconds = -1.0 must be at least 0"),
        ({"scene": BODY}, "scene = .* must be a Scene"),
    ],
)
def test_a_planner_cannot_learn_from_anything_else(changed, message):
    with pytest.raises(ValueError, match=message):
        stroller.learn_planner(**({"scene": SCENE, "problems": drawn, "seconds": 0} | changed))


def test_a_planner_is_for_its_kind_of_ground_and_its_wheelbase():
    planner = stroller.learn_planner(SCENE, drawn, seconds=0)
    launch, goal = stroller.Launch((0.0, -1.0), 0.0, 0.0), stroller.Goal((0.2, -1.0))
    with pytest.raises(ValueError, match="it has learned on a Plane, and the ground of this scene is a Spheroid"):
        stroller.plan(stroller.presets.bowl(), launch, goal, 9.0, planner=planner, progress=False)
    longer = stroller.Scene(stroller.Stroller(mass=5.0, wheelbase=0.3, inertia=0.1, steering_inertia=0.005))
    with pytest.raises(ValueError, match=r"learned with a wheelbase of 0\.25 m, and that of this scene is 0.3 m"):
        stroller.plan(longer, launch, goal, 9.0, planner=planner, progress=False)


@pytest.mark.parametrize(
    ("place", "met"), [(1.7, r"touches obstacles\[0\]"), (1.6, r"overlaps obstacles\[0\] by 0.1 m")]
)
def test_a_goal_that_touches_an_obstacle_is_free_after_the_stated_move(place, met):
    wall, words = (
        stroller.Box((1.1, 0.0), (1.0, 0.5)),
        rf"the footprint {met}: move the goal or the obstacle by (\S+) m",
    )
    with pytest.raises(ValueError, match=words) as refused:
        checked_problem(SCENE, START, stroller.Goal((place, 0.0), 0.0), 12.0, [wall], footprint=FOOTPRINT)
    moved = place + float(re.search(words, str(refused.value))[1])
    checked_problem(SCENE, START, stroller.Goal((moved, 0.0), 0.0), 12.0, [wall], footprint=FOOTPRINT)


def test_a_tracker_needs_a_plan_on_its_ground():
    with pytest.raises(ValueError, match=r"plan = .* must be a Plan, as stroller.plan returns it"):
        stroller.track(SCENE, SCENE)


START, GOAL = stroller.Launch((0.7, 0.8), 0.0, 0.0), stroller.Goal((1.9, 0.3), 0.0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"goal": stroller.Goal((1.1, 0.3), 0.0)}, "goal: at place .* overlaps obstacles"),
        ({"goal": stroller.Goal((1.1, 0.3))}, "goal: at place .* overlaps obstacles"),
        ({"launch": stroller.Launch((0.7, 0.3), 0.0, 0.0)}, "launch: at place .* overlaps obstacles"),
        ({"launch": stroller.Launch((0.7, 0.8), 0.0, 1.0)}, r"launch.speed = 1.0 must be at most 0.8 \(limits"),
        ({"launch": stroller.Launch((0.7, 0.8), 0.0, 0.0, -1.2)}, "launch.steering = -1.2 must be at least"),
        ({"goal": stroller.Goal((1.9, 0.3), 0.0, speed=-0.7)}, "goal.speed = -0.7 must be at least -0.5"),
        ({"goal": START}, "goal = .* must be a Goal"),
        (
            {"goal": stroller.Goal((1e9, 0.3))},
            r"goal: place = \(1000000000.0, 0.3\) .* 1e\+09 m .* more than 100000 wheelbases; plan a long way goal by goal",
        ),
        ({"t1": 0.0}, "t1 = 0.0 must be greater than 0"),
        ({"minimise": "energy"}, "minimise = 'energy' must be one of 'effort', 'time'"),
        (
            {"minimise": "time", "limits": stroller.Limits(steering=1.0)},
            "minimise = 'time' needs a limit of speed, force",
        ),
        ({"starts": 0}, "starts = 0 must be a whole number"),
        ({"obstacles": GAP[0]}, r"write obstacles=\[obstacle\]"),
        ({"obstacles": [1.0]}, r"obstacles\[0\] = 1.0 must be a Box or a Disc"),
        ({"limits": 1.0}, "limits = 1.0 must be a Limits"),
        ({"planner": 1.0}, "planner = 1.0 must be a Planner, as stroller.learn_planner returns it"),
    ],
)
def test_a_bad_problem_is_refused_before_anything_compiles(changed, message, caplog):
    arguments = {"launch": START, "goal": GOAL, "t1": 12.0, "obstacles": GAP} | OPTIONS | changed
    with jax.log_compiles(), pytest.raises(ValueError, match=message):
        stroller.plan(SCENE, **arguments)
    assert not [text for text in caplog.messages if "Finished XLA compilation" in text and "_of_lane" in text]


class Sleigh(nonholonomic.AbstractSystem):
    mass: float = 1.0
    dimension = 1

    def metric(self, q):
        return jnp.full((1, 1), self.mass)


@pytest.mark.parametrize(
    ("scene", "fix"), [(BODY, "put this body into one"), (Sleigh(), "nonholonomic.simulate runs a system of your own")]
)
def test_plans_know_one_vehicle(scene, fix):
    with pytest.raises(ValueError, match=f"must be a Scene, as plans know one vehicle, the Stroller; {fix}"):
        stroller.plan(scene, START, GOAL, 12.0)


def on(surface, side=None):
    return stroller.Scene(BODY, surface, SCENE.friction, side=side)


#: Grounds without x and y: scene, start, goal, and obstacles between them.
CURVED = {
    "cylinder": (
        on(stroller.Cylinder(1.0), "outside"),
        (-1.5, 3.0, 0.0),
        (1.5, 3.2, 0.0),
        [stroller.Disc((0.0, 3.1), 0.3), stroller.Box((0.0, 0.0), (0.4, 0.3))],
    ),
    "spheroid": (
        on(stroller.Spheroid(6.0, 3.0), "inside"),
        (0.0, -1.2, 0.3),
        (0.8, -1.1, 1.0),
        [stroller.Box((0.4, -1.2), (0.4, 0.4), 0.2)],
    ),
    "torus": (
        on(stroller.Torus(2.0, 0.8), "outside"),
        (0.0, 1.5, 0.0),
        (1.2, 1.5, 0.0),
        [stroller.Disc((0.6, 1.6), 0.25), stroller.Box((0.4, 2.2), (0.2, 0.3))],
    ),
}


def curved_problem(name, obstacles=None):
    scene, start, goal, others = CURVED[name]
    launch, target = stroller.Launch(start[:2], start[2], 0.0), stroller.Goal(goal[:2], goal[2])
    problem = {"scene": scene, "launch": launch, "goal": target, "t1": 12.0, "obstacles": obstacles or others}
    return problem | {"limits": LIMITS, "footprint": FOOTPRINT}


def in_space(surface, place, angle):
    """The point of a place, the directions at an angle from east and at a right angle to it, and the normal."""
    parts = [np.array([float(part) for part in vector]) for vector in surface.chart(tuple(map(jnp.asarray, place)))]
    position, east, north = parts
    along, across = np.cos(angle) * east + np.sin(angle) * north, np.cos(angle) * north - np.sin(angle) * east
    return position, along, across, np.cross(east, north)


def gaps_of_points(scene, obstacles, poses):
    """Distances of points all around the footprint from each obstacle, which is a cylinder or a block in space: in its plane,
    and along its normal."""
    part, gaps = np.linspace(0.0, 1.0, 41), []
    x, y = -0.1 + 0.5 * part, -0.125 + 0.25 * part
    around = [(x, 0 * x - 0.125), (x, 0 * x + 0.125), (0 * y - 0.1, y), (0 * y + 0.4, y)]
    own = np.concatenate([np.stack(side, axis=-1) for side in around])
    place, heading = poses[:, None, :3], poses[:, None, 3:]
    normal = scene.surface.normal(tuple(np.moveaxis(place, -1, 0)))
    normal = np.stack([np.zeros(place.shape[:2]) if part is None else np.asarray(part) for part in normal], axis=-1)
    points = place + own[:, :1] * heading + own[:, 1:] * np.cross(normal, heading)
    for obstacle in obstacles:
        is_disc = isinstance(obstacle, stroller.Disc)
        position, *axes = in_space(scene.surface, obstacle.centre, 0.0 if is_disc else float(obstacle.angle))
        u, v, height = np.moveaxis((points - position) @ np.array(axes).T, -1, 0)
        if is_disc:
            reach = float(obstacle.radius)
            away = np.hypot(u, v) - reach
        else:
            half = np.array(obstacle.size, dtype=float) / 2.0
            reach, away = np.hypot(*half), -np.minimum(half[0] - np.abs(u), half[1] - np.abs(v))
            outside = np.hypot((np.abs(u) - half[0]).clip(0.0), (np.abs(v) - half[1]).clip(0.0))
            away = np.where(away > 0.0, outside, away)
        gaps.append([away, np.abs(height) - reach])
    return np.moveaxis(gaps, 0, -1)


@pytest.mark.parametrize(
    "name", ["cylinder", *(pytest.param(slow, marks=pytest.mark.slow) for slow in CURVED if slow != "cylinder")]
)
def test_a_plan_goes_around_obstacles_on_any_ground(name):
    """Driven again at a tight tolerance, with every point of its edge in space beside the obstacles in space."""
    problem = curved_problem(name)
    plan, scene, goal = stroller.plan(**problem, progress=False), problem["scene"], problem["goal"]
    assert plan.reached, str(plan)
    run = stroller.simulate(scene, problem["launch"], plan.t1, plan.input, times=times_of(plan), tolerance=1e-10)
    poses = np.asarray(run.state[:, :6])
    target, along, _, _ = in_space(scene.surface, goal.place, float(goal.heading))
    assert np.linalg.norm(poses[-1, :3] - target) < 0.05
    assert np.linalg.norm(poses[-1, 3:] - along) < 0.05
    gaps = gaps_of_points(scene, problem["obstacles"], poses).max(axis=0)
    assert gaps.min() > 0.0
    assert_close(plan.clearance, gaps.min(), atol=1e-4)
    # The straight way would touch one.
    start, end = (np.asarray(pose) for pose in (plan.problem.start_pose, plan.problem.goal_pose))
    straight = start + np.linspace(0.0, 1.0, 99)[:, None] * (end - start)
    place = np.stack(scene.surface.nearest(tuple(straight[:, :3].T)), axis=-1)
    straight = np.concatenate([place, straight[:, 3:]], axis=1)
    assert gaps_of_points(scene, problem["obstacles"], straight).max(axis=0).min() < 0.0


@pytest.mark.parametrize("name", CURVED)
def test_distances_in_space_are_those_of_points(name):
    """At random poses all over the ground, also behind obstacles; and the bound of the optimiser is never greater."""
    problem, random, poses = checked_problem(**curved_problem(name)), np.random.default_rng(0), []
    scene = problem.scene
    for mu, eta, angle in random.uniform(-1.5, 1.5, (300, 3)) * [2.0, 1.0, 2.0]:
        position, along, _, _ = in_space(scene.surface, (mu, eta if name == "spheroid" else 2.0 * eta), angle)
        poses.append(np.concatenate([position, along]))
    poses = np.array(poses)
    corners = np.asarray(corners_of(scene.dynamics, FOOTPRINT, jnp.asarray(poses.T)))
    gaps, sampled = problem.gaps(corners), gaps_of_points(scene, problem.obstacles, poses)
    apart = gaps > 0.0
    assert 0.5 < apart.mean() < 1.0
    assert np.all(sampled.max(axis=0).min(axis=1)[apart] > gaps[apart] - 1e-6)
    # Half the distance between two points of the edge is 0.006 m.
    assert np.all(sampled.min(axis=2).max(axis=0)[apart] < gaps[apart] + 0.0065)
    bounds = np.asarray(Obstacles.of(problem.standing).gaps(jnp.asarray(corners)))
    bounds = bounds[:, bounds.max(axis=0) < 1e6]
    order = np.argsort([isinstance(part, stroller.Disc) for part in problem.obstacles], kind="stable")
    assert np.all(bounds <= gaps[:, order] + 1e-9)
    assert np.all((bounds > 0.0) == apart[:, order])


def test_an_upright_footprint_is_seen_as_a_line():
    """Its edges along the normal of an obstacle have no length there, and distances still have slopes."""
    obstacles = Obstacles.of(
        [(stroller.Box((0.0, 0.0), (1.0, 1.0)), np.eye(4, 3, -1)), (stroller.Disc((0.0, 0.0), 0.5), np.eye(4, 3, -1))]
    )
    corners = jnp.array([[2.0, -0.5, 0.0], [2.0, 0.5, 0.0], [2.0, 0.5, -1.0], [2.0, -0.5, -1.0]])
    gaps, slopes = obstacles.gaps(corners)[::8], jax.jacfwd(obstacles.gaps)(corners)
    assert_close(gaps, [1.5, 1.5])
    assert np.all(np.isfinite(slopes))
    assert_close(np.sum(slopes[::8], axis=1), [[1.0, 0.0, 0.0]] * 2, atol=1e-9)


@pytest.mark.parametrize("name", CURVED)
def test_a_map_shows_places_on_the_ground(name):
    """A pose on the map stands for the same pose, far from the middle too; on a cylinder, the map is its development."""
    problem = checked_problem(**curved_problem(name))
    for pose in (problem.start_pose, problem.goal_pose):
        place, heading, left = problem.seen(problem.point(pose))
        assert_close(np.concatenate([place, heading]), pose, atol=2e-3)
        normal = problem.scene.dynamics.side * np.array(stroller_normal(problem.scene, place))
        assert_close(left, np.cross(normal, heading), atol=5e-2)
    if name == "cylinder":
        points = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 3))
        places, origin = problem.seen(points)[0], problem.seen(np.zeros(3))[0]
        turned = np.arctan2(places[:, 0], -places[:, 2]) - np.arctan2(origin[0], -origin[2])
        flat = np.abs(np.angle(np.exp(1j * (turned - points[:, 1])))), np.abs(places[:, 1] - origin[1] - points[:, 0])
        mirrored = np.abs(np.angle(np.exp(1j * (turned + points[:, 1]))))
        assert min(flat[0].max(), mirrored.max()) < 1e-2
        assert flat[1].max() < 1e-2


def stroller_normal(scene, place):
    return [0.0 if part is None else float(part) for part in scene.surface.normal(tuple(map(jnp.asarray, place)))]


def test_a_search_on_a_closed_ground_keeps_clear_in_space():
    """Half round a cylinder: the paths are free of the obstacles as they stand in space, and end at the goal."""
    discs = [stroller.Disc((0.1, 2.6), 0.3), stroller.Disc((-0.3, 3.7), 0.3)]
    launch, goal = stroller.Launch((0.0, 1.7), 1.5, 0.0), stroller.Goal((0.0, 4.7), 1.5)
    problem = checked_problem(**curved_problem("cylinder", discs) | {"launch": launch, "goal": goal})
    paths, reason = paths_of(problem, prices(problem, 2, 0, np.random.default_rng(0)))
    assert reason is None
    for path in paths:
        poses = guess_of(problem, path)[0][:65, :6]
        assert_close(poses[0], problem.start_pose, atol=0.05)
        assert np.linalg.norm((poses[-1] - np.asarray(problem.goal_pose))[:3]) < 0.15
        assert gaps_of_points(problem.scene, discs, poses).max(axis=0).min() > 0.0


@pytest.mark.parametrize("name", CURVED)
def test_outlines_of_obstacles_are_what_is_checked(name):
    """They are on the ground, and the obstacle sees them at its edge."""
    problem = checked_problem(**curved_problem(name))
    for (part, frame), line in zip(problem.standing, problem.outlines, strict=True):
        assert_close(problem.scene.surface.offset(line), np.zeros(48), atol=1e-9)
        flat = (np.stack(line, axis=-1) - frame[0]) @ frame[1:3].T
        if isinstance(part, stroller.Disc):
            assert_close(np.linalg.norm(flat, axis=1), np.full(48, float(part.radius)), atol=1e-9)
        else:
            assert_close(np.abs(flat / (np.array(part.size) / 2.0)).max(axis=1), np.ones(48), atol=1e-9)


def test_a_map_contains_both_faces_of_a_flat_ground():
    ground = on(stroller.Spheroid(6.0, 1.5), "inside")
    launch, goal = stroller.Launch((0.0, -1.2), 0.0, 0.0), stroller.Goal((0.0, 1.2), 0.0)
    problem = checked_problem(ground, launch, goal, 30.0, [], limits=LIMITS, footprint=FOOTPRINT)
    for pose in (problem.start_pose, problem.goal_pose):
        assert_close(problem.seen(problem.point(pose))[0], pose[:3], atol=0.05)


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (
            stroller.Box((0.0, 0.0), (0.1, 3.0)),
            r"obstacles\[0\]: size = 0.1 x 3 m must be at most 0.0469 x 1.41 m at this place, because",
        ),
        (
            stroller.Disc((0.0, 0.0), 0.9),
            r"obstacles\[0\]: radius = 0.9 m must be at most 0.703 m .* use several smaller",
        ),
    ],
)
def test_an_obstacle_that_cannot_follow_the_ground_is_refused(obstacle, message):
    """The chord of a quarter of a circle of 1 m; along the cylinder, a wall may be as long as it likes."""
    with pytest.raises(ValueError, match=message):
        checked_problem(**curved_problem("cylinder", [obstacle]))
    checked_problem(**curved_problem("cylinder", [stroller.Box((0.0, 0.0), (3.0, 0.1))]))


def test_a_goal_on_a_cylinder_can_be_walled_in():
    walls = [stroller.Box((1.5 + y, 3.2), (0.1, 1.4)) for y in (-0.6, 0.8)]
    walls += [stroller.Box((1.6, 3.2 + angle), (1.5, 0.1)) for angle in (-0.6, 0.6)]
    problem = checked_problem(**curved_problem("cylinder", walls))
    _, reason = paths_of(problem, prices(problem, 1, 0, np.random.default_rng(0)))
    words = r"no path to the goal was found; the nearest ended \S+ m from the goal; the search is approximate on this ground"
    assert re.match(words, reason)


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (stroller.Disc((0.0, -1.2), 0.1), r"launch: at place = \(0, -1.2\) the footprint overlaps obstacles\[0\]"),
        (stroller.Box((0.0, -2.0), (0.1, 0.1)), r"obstacles\[0\]: place\[1\] = -2.0 must be"),
        (
            stroller.Disc((0.0, 0.0, 1.0), 0.1),
            r"obstacles\[0\]: place = .*: distance from the surface = -?[0-9.]+ must be",
        ),
    ],
)
def test_obstacles_are_on_the_ground(obstacle, message):
    with pytest.raises(ValueError, match=message):
        stroller.plan(**curved_problem("spheroid", [obstacle]))


def test_an_obstacle_can_be_named_by_a_point_in_space():
    position, _, _, _ = in_space(CURVED["torus"][0].surface, (0.6, 1.6), 0.0)
    discs = [stroller.Disc((0.6, 1.6), 0.25), stroller.Disc(position, 0.25)]
    frames = [
        checked_problem(CURVED["torus"][0], stroller.Launch((0.0, 1.5), 0.0, 0.0), GOAL, 1.0, [disc]).standing[0][1]
        for disc in discs
    ]
    assert_close(*frames, atol=1e-9)
    ((disc, _),) = checked_problem(SCENE, START, GOAL, 1.0, [stroller.Disc((5.0, 4.0, 0.0), 0.25)]).standing
    assert_close(disc.centre, [5.0, 4.0])


def test_a_problem_without_obstacles_has_no_gaps():
    problem = checked_problem(SCENE, START, GOAL, 1.0, footprint=FOOTPRINT)
    assert [len(gaps) for gaps in problem.gaps_at_ends.values()] == [0, 0]
    assert_close(problem.clearance, 0.04 * 0.5)


def test_a_planner_sees_obstacles_in_space():
    """An obstacle turned about the axis of the cylinder with the stroller looks the same."""
    decisions = []
    for turn, eta in ((0.0, 3.1), (0.4, 3.1), (0.0, 3.3)):
        launch, goal = stroller.Launch((-1.5, 3.0 + turn), 0.0, 0.0), stroller.Goal((1.5, 3.2 + turn), 0.0)
        problem = checked_problem(CURVED["cylinder"][0], launch, goal, 9.0, [stroller.Disc((0.0, eta + turn), 0.3)])
        task = Task.of(problem, 3.0, 9.0, 0.0)
        planner = planner_module.Planner.untrained(task, jax.random.key(0))
        # It also knows its place; here, always the same one.
        first = planner.of_step.layers[0]
        planner = eqx.tree_at(
            lambda planner: planner.of_step.layers[0].weight, planner, first.weight.at[:, 21:27].set(0.0)
        )
        decisions.append(planner.decide(task, problem.start_pose, jnp.zeros(15)))
    assert_close(decisions[0], decisions[1], atol=1e-6)
    assert np.abs(decisions[0] - decisions[2]).max() > 1e-5


def test_a_goal_is_on_the_ground():
    with pytest.raises(ValueError, match=r"goal: place = .*: distance from the surface"):
        stroller.plan(
            stroller.presets.bowl(), stroller.Launch((0.0, -1.0), 0.0, 0.0), stroller.Goal((0.0, 0.0, 1.0)), 5.0
        )


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: stroller.Box((0.0, 0.0), (1.0, 0.0)), r"size\[1\] = 0.0 must be greater than 0"),
        (lambda: stroller.Box(0.0, (1.0, 1.0)), r"centre = 0.0 must be a pair of numbers, or \(x, y, z\)"),
        (lambda: stroller.Box((0.0, [0.0, 1.0]), (1.0, 1.0)), "centre = .* must be a pair of numbers"),
        (lambda: stroller.Box((0.0, 0.0), (1.0, 1.0, 1.0)), "size = .* must be a pair of numbers$"),
        (lambda: stroller.Disc((0.0, 0.0), -1.0), "radius = -1.0 must be greater than 0"),
        (lambda: stroller.Footprint(0.5, 0.2, 0.6), "rear = 0.6 must be at most 0.5"),
        (lambda: stroller.Limits(speed=(0.5, -0.5)), r"speed\[1\] = -0.5 must be greater than 0.5"),
        (
            lambda: stroller.Limits(speed=-2.0),
            r"speed = -2.0 must be one positive number, such as 2 for \(-2, 2\), or a pair \(lowest, highest\)",
        ),
        (lambda: stroller.Limits(speed="fast"), "speed = .* must be one positive number, such as 1 for"),
        (lambda: stroller.Limits(steering=45.0), r"steering = \(-45.0, 45.0\) .* did you mean np.radians\(45\)"),
        (lambda: stroller.Goal((0.0, 0.0), -90.0), r"heading = -90.0 must be within .* did you mean np.radians\(90\)"),
        (lambda: stroller.Launch((0.0, 0.0), [0.0, 90.0], 1.0), r"heading = \[0, 90\] .* mean np.radians\(90\)"),
        (lambda: stroller.Launch((0.0, 0.0), 0.0, 1.0, 30.0), r"steering = 30.0 .* did you mean np.radians\(30\)"),
        (lambda: stroller.Goal((0.0, 0.0), within=0.0), "within = 0.0 must be greater than 0"),
        (lambda: stroller.Goal(1.0), "place = 1.0 must be a pair of numbers"),
    ],
)
def test_bad_parts_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


SQUARE, DIAMOND = (stroller.Box((0.0, 0.0), (2.0, 2.0), angle) for angle in (0.0, np.pi / 4.0))


def test_distances_of_polygons_have_closed_forms():
    """Face to face, corner to corner, corner to face, overlap; and the same for a disc."""
    shifts = np.array([[3.0, 0.5], [4.0, 5.0], [1.5, 0.2]])
    corners = SQUARE.corners
    exact = SQUARE.distance(corners + shifts[:, None])
    assert_close(exact, [1.0, np.hypot(2.0, 3.0), -0.5], atol=1e-9)
    assert_close(SQUARE.distance(DIAMOND.corners + np.array([3.0, 0.3])), 2.0 - np.sqrt(2.0), atol=1e-9)
    assert np.all(separation(corners, corners + shifts[:, None]) <= exact + 1e-12)
    centres = np.array([[3.0, 0.0], [4.0, 5.0], [0.5, 0.0]])
    assert_close(disc_distance(corners, centres, 0.25), [1.75, 4.75, -0.75], atol=1e-8)


def test_a_spline_passes_through_its_values():
    values = np.sin(np.arange(9.0))
    coefficients = jnp.asarray(interpolate(values))
    parts = np.arange(9.0) / 8.0
    assert_close(evaluate_spline(coefficients, parts), values, atol=1e-12)
    at, step = 0.37, 1e-5
    slope = (evaluate_spline(coefficients, at + step) - evaluate_spline(coefficients, at - step)) / (2.0 * step) / 8.0
    assert_close(evaluate_spline(coefficients, at, 1), slope, rtol=1e-7)


def test_inverse_dynamics_on_a_circle_is_the_balance_of_friction():
    """At constant speed and angle the drive only replaces what the wheels and the yaw lose."""
    phi, w = 0.4, 0.6
    v, yaw = w * np.cos(phi), w * np.sin(phi) / 0.25
    needed = actuation(SCENE.dynamics, jnp.array([0.3, 0.1, 1.0, 0.0]), Rates(phi, 0.0, 0.0, w, 0.0), False)
    assert_close(needed.force, (2.0 * v**2 + 0.5 * w**2 + 0.1 * yaw**2) / v, rtol=1e-12)
    assert_close(needed.torque, 0.0, atol=1e-12)


@pytest.mark.parametrize("fork", [pytest.param("relative", marks=pytest.mark.slow), "absolute"])
def test_a_drive_moves_as_planned(fork):
    """Inside a spheroid, with a heavy fork: the run has the planned angle and speed, without help from the feedback; and
    in another direction too, because the drive holds the stroller against its weight."""
    body = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.02, steering_spring=0.03)
    scene = stroller.Scene(body, stroller.Spheroid(6.0, 3.0), stroller.Damping(2.0), side="inside", fork=fork)
    launch = stroller.Launch((0.0, -1.2), 0.3, 0.0)
    position, east, north = scene.surface.chart(launch.place)
    pose = jnp.stack([*position, *(jnp.cos(0.3) * a + jnp.sin(0.3) * b for a, b in zip(east, north, strict=True))])
    knots = np.linspace(0.0, np.pi, 67)
    angle, speed = 0.5 * np.sin(knots) ** 2, 0.8 * np.sin(knots) ** 2
    angle[:3], speed[:3] = 0.0, 0.0
    drive = drive_along(scene.dynamics, pose, np.stack([angle, speed], axis=1), 6.0)
    run = stroller.simulate(scene, launch, 6.0, drive, times=np.linspace(0.0, 6.0, 13), tolerance=1e-9)
    planned_angle, _, planned_speed, _, _ = drive.reference(run.t)
    assert_close(run.steering, planned_angle, atol=2e-4)
    assert_close(run.front_speed, planned_speed, atol=2e-4)
    assert np.max(np.abs(run.energy_residual)) < 1e-6
    elsewhere = stroller.Launch((0.0, -1.2), 1.3, 0.0)
    run = stroller.simulate(scene, elsewhere, 6.0, drive, times=np.linspace(0.0, 6.0, 13), tolerance=1e-9)
    assert_close(run.front_speed, planned_speed, atol=2e-2)
