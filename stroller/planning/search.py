"""Paths around obstacles, and the candidates of a plan: paths that are driven within the given time.

The paths come from hybrid A* over arcs that the stroller can drive, forwards and backwards (Dolgov et al., Int. J. Robotics
Research 29 (2010) 485). Nodes keep exact poses; a grid of places, headings and directions of travel keeps the cheapest node
of each cell. Nodes are expanded many at a time, in NumPy. The shortest ways without obstacles from a node to the goal
(`shortcuts`) bound its cost from below, and complete its path if they are free.
"""

import heapq
from itertools import product
from typing import NamedTuple

import jax
import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int

from nonholonomic.geometry import Plane

from .problem import MAPPED, SEARCH_CURVATURES, Numbers, Obstacles, Problem, outline_of, poses_at
from .transcription import ORDER

# The region of a search, and what the stroller may do there.

#: Headings of the grid, cells along the longer side of the region, nodes expanded at a time, and most of them in all.
HEADINGS, MOST_CELLS, BATCH, MOST_NODES = 24, 128, 48, 400_000

#: Curvatures of the arcs in units of the greatest one, and the most by which an arc turns [rad].
CURVATURES, MOST_TURN = (-1.0, -0.5, 0.0, 0.5, 1.0), 0.5

#: Points of an arc that must be free, for each step of a grid cell and a half.
SAMPLES = 3

#: First arcs from the start, in units of an ordinary step, and shortcuts of a batch that are examined.
FIRST_ARCS, EXAMINED = 12, 8

#: Difference of costs [m] that is round-off.
TIE = 1e-9

#: How close a path must come to the goal: in units of a cell, and in units of a heading of the grid.
ARRIVAL = (1.0, 0.8)


class Path(NamedTuple):
    """A path: places and headings (points, 3) [m, rad], and for each piece between them its direction of travel (1 or
    -1), curvature [1/m] and length [m]."""

    poses: Float[np.ndarray, "points 3"]
    direction: Float[np.ndarray, " pieces"]
    curvature: Float[np.ndarray, " pieces"]
    length: Float[np.ndarray, " pieces"]


class Costs(NamedTuple):
    """What a search minimises beside the length.

    - `reversal`: price [m] of a change of direction.
    - `turning`: factor without dimension: the tightest arc costs so much more in units of its length, and a turn of the wheel
      from straight ahead to its limit costs half as many cells.
    - `backwards`: how many times the length in reverse counts.
    - `clearance`: distance [m] to keep from obstacles.
    """

    reversal: float
    turning: float
    backwards: float
    clearance: float


def driven(
    poses: Float[np.ndarray, "*n 3"], direction: Numbers, curvature: Numbers, length: Numbers
) -> Float[np.ndarray, "*n 3"]:
    """Poses at the ends of arcs."""
    turn = direction * curvature * length
    heading = poses[..., 2] + turn / 2.0
    chord = direction * length * np.sinc(turn / (2.0 * np.pi))
    changes = chord * np.cos(heading), chord * np.sin(heading), turn
    return poses + np.stack(np.broadcast_arrays(*changes), axis=-1)


#: A node of a search: its pose (3,), its cost [m], the number of its parent, and the move (3,) that led from there: a direction
#: of travel, a curvature and a length.
NODE = np.dtype([("pose", float, 3), ("cost", float), ("parent", int), ("move", float, 3)])


class Search:
    """A search for the cheapest path from the start to the goal on the map of a problem.

    - `low`, `size`: lower corner and size (2,) [m] of the region; `cell`: side of a cell [m]; `shape`: cells in each direction;
    - `obstacles`, `footprint`: what must not be touched, and by what; `costs`: what is minimised;
    - `least`, `greatest`, `sharpest`: least and greatest curvature, and the greatest to either side [1/m]; `directions` of
      travel (1 or -1);
    - `moves`: the arcs of a step (arcs, 3): direction of travel, curvature and length; `first_moves`: those from the start;
    - `way`: the length [m] of the shortest way to the goal from every cell (see `way_to`);
    - `tree`: all nodes, of which the first is the start, and their number `count`; `best`: the least cost in each cell;
    - `path`, `price_of_path`: the cheapest path that a shortcut has completed, and its cost [m];
    - `nearest`: distance [m] from the goal to the nearest place of a node.
    """

    def __init__(self, problem: Problem, share: float, costs: Costs):
        """**Arguments:** `share`: share of the curvatures, which the limits of the steering angle allow, that is used."""
        self.problem, self.costs, self.has_heading = problem, costs, problem.goal.heading is not None
        start, self.goal = problem.point(problem.start_pose), problem.point(problem.goal_pose)
        # NumPy would otherwise dispatch every operation with these to JAX.
        self.obstacles, self.footprint = Obstacles.of(problem.standing, 1), jax.tree.map(np.asarray, problem.footprint)
        low, high, space = problem.turns
        self.least, self.greatest = max(low, share * low), min(high, share * high)
        self.sharpest = max(-self.least, self.greatest)
        slowest, fastest = problem.limits.ranges().get("speed", (-np.inf, np.inf))
        self.directions = tuple(sign for sign, speed in ((1.0, fastest), (-1.0, -slowest)) if speed > 0.0)
        # The whole map, or a region around the start, the goal and all obstacles, with space to turn.
        if problem.map is None:
            outlines = (outline_of(part) for part, _ in problem.standing)
            points = np.concatenate([[start[:2], self.goal[:2]], *outlines])
            self.low, high = points.min(axis=0) - space, points.max(axis=0) + space
            self.size = high - self.low
        else:
            self.low = np.full(2, -MAPPED * problem.map[0])
            self.size = -2.0 * self.low
        self.cell = max(0.2 * float(self.footprint.length), float(self.size.max()) / MOST_CELLS)
        nx, ny = np.ceil(self.size / self.cell).astype(int) + 1
        self.shape = (int(nx), int(ny))
        # A curve that turns by less than a heading of the grid would end in the cell of a cheaper one, and the search would
        # not turn.
        bends = np.unique(np.clip(self.sharpest * np.array(CURVATURES), self.least, self.greatest))
        length = np.minimum(1.5 * self.cell, MOST_TURN / np.maximum(np.abs(bends), 1e-9))
        length = np.maximum(length, MOST_TURN / self.sharpest * (bends != 0.0))
        self.moves = np.array([[sign, k, s] for sign in self.directions for k, s in zip(bends, length, strict=True)])
        # A path with more pieces than a shortcut begins with an arc of any length, and one with fewer with none.
        self.first_moves = np.concatenate([self.moves * [1.0, 1.0, times] for times in range(FIRST_ARCS)])
        self.way = self.way_to(self.goal[:2])
        most = MOST_NODES + max(BATCH * len(self.moves), len(self.first_moves))
        self.tree, self.count = np.zeros(most, NODE), 1
        self.tree["pose"][0] = start
        self.best = np.full(np.prod(self.shape) * HEADINGS * 2, np.inf)
        self.path, self.price_of_path = None, np.inf
        self.nearest = float(np.linalg.norm(start[:2] - self.goal[:2]))

    @np.errstate(invalid="ignore")
    def run(self) -> tuple[Path | None, float, bool]:
        """The cheapest path that the search finds, or `None`; the distance [m] from the goal to the nearest place it came
        to; and whether it has looked everywhere."""
        frontier, tree = [(0.0, 0)], self.tree
        while frontier and frontier[0][0] < self.price_of_path - TIE and self.count < MOST_NODES:
            nodes = np.array([heapq.heappop(frontier)[1] for _ in range(min(BATCH, len(frontier)))])
            cells = self.cells(tree["pose"][nodes], tree["move"][nodes, 0])
            # A cheaper node of the same cell has replaced the others. The start has no cell.
            nodes = nodes[(nodes == 0) | (tree["cost"][nodes] <= self.best[cells] + TIE)]
            if not nodes.size:
                continue
            children, numbers = self.expanded(nodes)
            poses, cost = children["pose"], children["cost"]
            away = np.linalg.norm(poses[:, :2] - self.goal[:2], axis=-1)
            turn = np.abs((poses[:, 2] - self.goal[2] + np.pi) % (2.0 * np.pi) - np.pi) * self.has_heading
            self.nearest = float(away.min(initial=self.nearest))
            arrived = (away < ARRIVAL[0] * self.cell) & (turn < ARRIVAL[1] * 2.0 * np.pi / HEADINGS)
            if arrived.any():
                missing = cost + away + turn / self.sharpest
                return self.path_by(int(numbers[arrived][np.argmin(missing[arrived])]), np.zeros((0, 3))), 0.0, True
            ahead = np.maximum(self.way[self.places(poses[:, :2])], self.cut_short(children, numbers))
            for entry in zip((cost + ahead).tolist(), numbers.tolist(), strict=True):
                heapq.heappush(frontier, entry)
        return self.path, self.nearest, not frontier

    def expanded(self, nodes: Int[np.ndarray, " nodes"]) -> tuple[np.ndarray, Int[np.ndarray, " children"]]:
        """The new nodes at the ends of all moves from some nodes: those that touch no obstacle, have a way to the goal, and
        are the cheapest in their cells; and their numbers in the tree."""
        tree, moves = self.tree, self.first_moves if nodes[0] == 0 else self.moves
        parent, move = np.repeat(nodes, len(moves)), np.tile(moves, (len(nodes), 1))
        poses = self.along(tree["pose"][parent], move)
        children = np.zeros(len(parent), NODE)
        children["pose"], children["parent"], children["move"] = poses[:, -1], parent, move
        children["cost"] = tree["cost"][parent] + self.price(tree["move"][parent].T, move.T)
        children = children[np.asarray(self.is_free(poses).all(axis=1))]
        cells = self.cells(children["pose"], children["move"][:, 0])
        order = np.lexsort((children["cost"], cells))
        kept = order[np.unique(cells[order], return_index=True)[1]]
        has_way = np.isfinite(self.way[self.places(children["pose"][kept, :2])])
        kept = kept[(children["cost"][kept] < self.best[cells[kept]] - TIE) & has_way]
        children, numbers = children[kept], np.arange(self.count, self.count + len(kept))
        self.best[cells[kept]], tree[numbers] = children["cost"], children
        self.count += len(kept)
        return children, numbers

    def shortcuts(self, poses: Float[np.ndarray, "poses 3"]) -> Float[np.ndarray, "3 3 ways poses"]:
        """Ways to the goal without obstacles: direction, curvature and length of three pieces each; a length is NaN where there
        is no such way.

        A way consists of two arcs as tight as possible, with a straight piece or a third such arc between them, each forwards
        or in reverse; the shortest way forwards is among them (Dubins, Am. J. Math. 79 (1957) 497). To a goal without a
        heading, the last arc has the radius 0.
        """
        goal, either = self.goal, self.directions
        radii = [1.0 / bend for bend in (self.least, self.greatest) if bend]
        x, y, heading = poses.T
        # The directions to try, the radii and the turns of the pieces, and the length of the middle piece where it is straight.
        ways = []
        for first, last in product(radii, radii if self.has_heading else [0.0]):
            # The line between the circles' centres determines the headings between the pieces.
            along = goal[0] - last * np.sin(goal[2]) - x + first * np.sin(heading)
            across = goal[1] + last * np.cos(goal[2]) - y - first * np.cos(heading)
            away, angle = np.hypot(along, across), np.arctan2(across, along)
            for sign in either if self.least <= 0.0 <= self.greatest else ():
                straight = np.sqrt(away**2 - (last - first) ** 2)
                turned = angle - np.arctan2(last - first, sign * straight)
                turns = (turned - heading, 0.0, goal[2] - turned)
                ways.append(((either, (sign,), either), (first, 0.0, last), turns, straight))
            for middle, side in product(radii, (1.0, -1.0)):
                if middle * first < 0.0 and last in (first, 0.0):
                    a, b = middle - first, last - middle
                    bend = side * np.arccos((away**2 - a**2 - b**2) / (2.0 * a * b))
                    turned = angle - np.arctan2(a * np.cos(bend) + b, -a * np.sin(bend))
                    turns = (turned + bend - heading, -bend, goal[2] - turned)
                    ways.append(((either,) * 3, (first, middle, last), turns, 0.0))

        def piece(sign: float, radius: float, turn: Numbers | float, straight: Numbers | float) -> list[np.ndarray]:
            arc = (np.mod(sign * np.sign(radius) * turn + TIE, 2.0 * np.pi) - TIE).clip(0.0)
            return list(
                np.broadcast_arrays(sign, 1.0 / radius if radius else 0.0, abs(radius) * arc + straight + 0.0 * x)
            )

        pieces = [
            list(map(piece, signs, of_pieces, turns, (0.0, straight, 0.0)))
            for options, of_pieces, turns, straight in ways
            for signs in product(*options)
        ]
        return np.array(pieces).reshape(len(pieces), 3, 3, len(poses)).transpose(1, 2, 0, 3)

    def cut_short(self, children: np.ndarray, numbers: Int[np.ndarray, " children"]) -> Float[np.ndarray, " children"]:
        """Look for a cheaper path to the goal by shortcuts from new nodes, and return the least price [m] of a shortcut from
        each, 0 where there is none."""
        ways = self.shortcuts(children["pose"])
        price, before = np.zeros(ways.shape[2:]), children["move"].T[:, None]
        for move in ways:
            price += self.price(before, move)
            before = np.where(move[2] > TIE, move, before)
        price = np.nan_to_num(price, nan=np.inf)
        total = children["cost"] + price
        for number in np.argsort(total, axis=None)[:EXAMINED]:
            which, child = np.unravel_index(number, total.shape)
            if total[which, child] >= self.price_of_path:
                break
            whole = self.path_by(int(numbers[child]), ways[..., which, child])
            poses = self.along(whole.poses[:-1], np.stack(whole[1:], axis=1))
            if self.is_free(poses).all():
                self.path, self.price_of_path = whole, total[which, child]
        shortest = price.min(axis=0, initial=np.inf)
        return np.where(np.isfinite(shortest), shortest, 0.0)

    def price(self, before: np.ndarray, move: np.ndarray) -> np.ndarray:
        """The price [m] of a move after another one; each is a direction, 0 for none, a curvature and a length."""
        (direction, bend, length), costs, sharpest = move, self.costs, self.sharpest
        change = costs.reversal * (before[0] * direction < 0.0)
        change = change + 0.5 * costs.turning * self.cell * np.abs(before[1] - bend) / sharpest
        factor = np.where(direction < 0.0, costs.backwards, 1.0) * (1.0 + costs.turning * np.abs(bend) / sharpest)
        return length * factor + change * (length > TIE)

    def along(self, pose: np.ndarray, moves: np.ndarray) -> Float[np.ndarray, "moves samples 3"]:
        """Poses along moves, each from a pose of its own."""
        count = max(SAMPLES, int(np.ceil(SAMPLES * moves[:, 2].max() / (1.5 * self.cell))))
        direction, bend, length = moves.T[..., None]
        return driven(pose[:, None], direction, bend, length * np.arange(1, count + 1) / count)

    def path_by(self, node: int, more: np.ndarray) -> Path:
        """The path to a node, and by more pieces from there."""
        branch = [node]
        while branch[-1]:
            branch.append(int(self.tree["parent"][branch[-1]]))
        branch = branch[::-1]
        poses = list(self.tree["pose"][branch])
        moves = np.concatenate([self.tree["move"][branch[1:]], more[more[:, 2] > TIE]])
        for piece in moves[len(branch) - 1 :]:
            poses.append(driven(poses[-1], *piece))
        return Path(np.array(poses), *moves.T)

    def places(self, points: Float[np.ndarray, "*n 2"]) -> tuple[Int[np.ndarray, "*n"], Int[np.ndarray, "*n"]]:
        """The cells of points, in x and y."""
        x, y = np.moveaxis(((points - self.low) / self.cell).astype(int), -1, 0)
        return x.clip(0, self.shape[0] - 1), y.clip(0, self.shape[1] - 1)

    def cells(self, poses: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """The numbers of the cells of places, headings and directions of travel."""
        x, y = self.places(poses[:, :2])
        heading = np.floor(poses[:, 2] / (2.0 * np.pi) * HEADINGS + 0.5).astype(int) % HEADINGS
        return ((x * self.shape[1] + y) * HEADINGS + heading) * 2 + (direction > 0.0)

    def is_free(self, poses: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Whether the footprint is inside the region and keeps its distance from all obstacles."""
        place = poses[..., :2] - self.low
        free = np.all((place >= 0.0) & (place <= self.size), axis=-1)
        place, forward, left = self.problem.seen(poses)
        length = float(self.footprint.length)
        centre = place + (length / 2.0 - float(self.footprint.rear)) * forward
        # Only where the circle about the footprint may touch an obstacle, its corners are looked at.
        close = self.distance(centre) < 0.5 * np.hypot(length, float(self.footprint.width)) + self.costs.clearance
        corners = self.footprint.corners(place[close], forward[close], left[close])
        free[close] &= self.obstacles.gaps(corners).min(axis=-1, initial=np.inf) > self.costs.clearance
        return free

    def distance(self, points: Float[np.ndarray, "*n axes"]) -> Float[np.ndarray, "*n"]:
        """A lower bound [m] of the distance of points from all obstacles: seen from above, exact outside of them, and in space,
        0 inside."""
        if self.problem.map is not None:
            gaps = np.asarray(self.obstacles.gaps(np.repeat(points[..., None, :], 4, axis=-2)))
            return gaps.min(axis=-1, initial=np.inf)
        boxes = self.obstacles.boxes
        side = boxes[:, 0] - boxes[:, 3]
        length, width = np.linalg.norm(side, axis=-1), np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=-1)
        axis, away = side / length[:, None], points[..., None, :] - boxes.mean(axis=1)
        along = np.abs((away * axis).sum(-1)) - length / 2.0
        across = np.abs(away[..., 1] * axis[:, 0] - away[..., 0] * axis[:, 1]) - width / 2.0
        gaps = np.hypot(along.clip(0.0), across.clip(0.0))
        discs = np.linalg.norm(points[..., None, :] - self.obstacles.centres, axis=-1) - self.obstacles.radii
        return np.concatenate([gaps, discs], axis=-1).min(axis=-1, initial=np.inf)

    def way_to(self, place: Float[np.ndarray, " 2"]) -> Float[np.ndarray, "x y"]:
        """Length [m] of the shortest way of a disc as wide as the vehicle from every cell to a place; infinite if there is
        none."""
        nx, ny = self.shape
        points = self.low + self.cell * (np.moveaxis(np.indices((nx, ny)), 0, -1) + 0.5)
        half = 0.5 * float(self.footprint.width) + self.costs.clearance
        # In space, an obstacle may see the disc as a line.
        least = half - 0.7 * self.cell if self.problem.map is None else 0.0
        free = self.distance(self.problem.seen(np.pad(points, ((0, 0), (0, 0), (0, 1))))[0]) > least
        number = np.arange(nx * ny).reshape(nx, ny)
        links = []
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            cells = (slice(0, nx - dx), slice(max(0, -dy), ny - max(0, dy)))
            neighbours = (slice(dx, nx), slice(max(0, dy), ny + min(0, dy)))
            both = free[cells] & free[neighbours]
            links.append(
                [number[cells][both], number[neighbours][both], np.full(both.sum(), self.cell * np.hypot(dx, dy))]
            )
        starts, ends, lengths = map(np.concatenate, zip(*links, strict=True))
        graph = scipy.sparse.csr_array((lengths, (starts, ends)), shape=(nx * ny, nx * ny))
        return scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=number[self.places(place)]).reshape(nx, ny)


# The candidates of a plan: paths from searches at different prices, driven within the given time, as first guesses.

#: Number of intervals of a plan.
INTERVALS = 64

#: Length of the shortest drive that is expected, in units of the path of a search, which consists of arcs.
OPTIMISTIC = 0.8

#: Neighbouring knots over which the steering angle and the speed of a path are averaged.
SMOOTHING = (2, 1)

#: Share of a section's time in which the stroller speeds up, and again slows down.
RAMP = 0.2

#: Time that a change of direction takes, in units of the time for one wheelbase.
CHANGE = 1.5


def prices(problem: Problem, count: int, batch: int, rng: np.random.Generator) -> list[Costs]:
    """What the searches of a batch minimise: ordinary prices first, or mostly the time at the limits of the speed in haste,
    then random ones."""
    length, keep = float(problem.footprint.length), problem.clearance
    low, high = problem.limits.ranges().get("speed", (-1.0, 1.0))
    backwards = high / -low if low < 0.0 < high else 1.0
    if batch == 0:
        usual = [Costs(1.5 * length, 0.1, 1.0, 0.9 * keep), Costs(0.5 * length, 0.3, 1.5, 1.8 * keep)]
        if problem.in_haste:
            usual = [Costs(0.1 * length, 0.0, backwards, 0.9 * keep), Costs(0.5 * length, 0.1, backwards, 1.8 * keep)]
        return [usual[k % 2] for k in range(count)]
    spread = np.exp(rng.normal(size=(count, 4)) * np.array([1.0, 0.7, 0.5, 0.5]))
    middle = np.array([length, 0.2, 1.2 * backwards if problem.in_haste else 1.2, 0.7 * keep])
    return [Costs(*map(float, row)) for row in middle * spread]


def paths_of(problem: Problem, costs: list[Costs]) -> tuple[list[Path], str | None]:
    """A path for each of several prices, straight to the goal where the search finds none; and a reason, in words, why
    none can be driven in time, if there is one."""
    start, goal = problem.point(problem.start_pose), problem.point(problem.goal_pose)
    approximate = "; the search is approximate on this ground: it may be wrong"
    if isinstance(problem.scene.surface, Plane):
        approximate = ""
    results = [Search(problem, SEARCH_CURVATURES[lane % 2], cost).run() for lane, cost in enumerate(costs)]
    paths = [path for path, _, _ in results if path is not None]
    if not paths:
        nearest, was_all = min(result[1] for result in results), all(result[2] for result in results)
        cut_short = f"the search ended after {MOST_NODES} poses without a path"
        what = "no path to the goal was found" if was_all else cut_short
        away = goal[:2] - start[:2]
        poses = np.stack([start, goal])
        poses[:, 2] = np.arctan2(away[1], away[0])
        straight = Path(poses, np.ones(1), np.zeros(1), np.array([max(float(np.hypot(*away)), 1e-3)]))
        return [straight] * len(costs), f"{what}; the nearest ended {nearest:.2g} m from the goal{approximate}"
    low, high = problem.limits.ranges().get("speed", (-np.inf, np.inf))
    way, fastest, reason = min(float(path.length.sum()) for path in paths), max(-low, high), None
    if OPTIMISTIC * way > fastest * problem.t1:
        reason = f"the shortest path that was found, {way:.3g} m, takes {way / fastest:.3g} s at the limit of the speed"
        reason += approximate
    return [path or paths[0] for path, _, _ in results], reason


def guess_of(problem: Problem, path: Path) -> tuple[Float[np.ndarray, "rows unknowns"], float]:
    """A path as unknowns of the optimiser (see `transcription.py`), and the duration [s] of its drive: the given one, or, in
    haste, the time that the path takes at least, by the limits of speed, force, grip and torque."""
    scene, body, t1 = problem.scene, problem.scene.body, problem.t1
    wheelbase = float(body.wheelbase)
    if problem.in_haste:
        way = max(float(path.length.sum()), wheelbase)
        most = {name: max(-low, high) for name, (low, high) in problem.limits.ranges().items()}
        # The way from rest to rest with the greatest acceleration, and a turn of the wheel by 1 rad in the same manner.
        accelerations = [most.get("force", np.inf) / body.mass, most.get("grip", np.inf) * scene.gravity]
        slowest = [way / accelerations[0], way / accelerations[1], body.steering_inertia / most.get("torque", np.inf)]
        t1 = max(way / most.get("speed", np.inf), 2.0 * float(np.sqrt(max(slowest))))
    points, splines = timed(path, t1, wheelbase)
    lifted = poses_at(scene.surface, points) if problem.map is None else np.hstack(problem.seen(points)[:2])
    poses = np.asarray(lifted)[[*range(len(lifted)), -1, -1]]
    return np.concatenate([poses, np.pad(splines, ((1, ORDER - 3), (0, 0)), mode="edge")], axis=1), t1


def timed(path: Path, t1: float, wheelbase: float) -> tuple[Float[np.ndarray, "knots 3"], Float[np.ndarray, "knots 2"]]:
    """Poses, and running means of the steering angle [rad] and the speed of the front wheel [m/s], at the knots of a plan,
    from 0 to `t1`."""
    # The sections between changes of direction.
    cuts = [0, *(np.flatnonzero(np.diff(path.direction)) + 1), len(path.direction)]
    lengths = np.array([path.length[a:b].sum() for a, b in zip(cuts, cuts[1:], strict=False)])
    shares = (lengths + CHANGE * wheelbase) / (lengths + CHANGE * wheelbase).sum()
    ends = np.concatenate([[0.0], np.cumsum(shares)])
    time = np.linspace(0.0, 1.0, INTERVALS + 1)
    section = np.clip(np.searchsorted(ends, time, side="right") - 1, 0, len(lengths) - 1)
    # The share of a section's length, and its rate: smooth ramps, and constant speed between.
    part, top = (time - ends[section]) / shares[section], 1.0 / (1.0 - RAMP)
    up, down = np.clip(part / RAMP, 0.0, 1.0), np.clip((1.0 - part) / RAMP, 0.0, 1.0)
    ramps = RAMP * (up**3 - 0.5 * up**4) + RAMP * (0.5 - (down**3 - 0.5 * down**4))
    way = top * (ramps + np.clip(part, RAMP, 1.0 - RAMP) - RAMP)
    rate = top * np.minimum(3.0 * up**2 - 2.0 * up**3, 3.0 * down**2 - 2.0 * down**3)
    start = np.array([path.length[:cut].sum() for cut in cuts])
    along = start[section] + way * lengths[section]
    piece_ends = np.cumsum(path.length)
    piece = np.clip(np.searchsorted(piece_ends, along), 0, len(piece_ends) - 1)
    into = along - (piece_ends - path.length)[piece]
    poses = driven(path.poses[piece], path.direction[piece], path.curvature[piece], into)
    speed = rate * lengths[section] / (shares[section] * t1) * path.direction[piece]
    steering, speed = (
        np.convolve(np.pad(values, width, mode="edge"), np.full(2 * width + 1, 1.0 / (2 * width + 1)), mode="valid")
        for values, width in zip((np.arctan(wheelbase * path.curvature[piece]), speed), SMOOTHING, strict=True)
    )
    return poses, np.stack([steering, speed / np.cos(steering)], axis=1)
