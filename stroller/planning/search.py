"""A path around obstacles: hybrid A* over arcs that the stroller can drive, forwards and backwards.

Method: Dolgov et al., Int. J. Robotics Research 29 (2010) 485. Nodes keep exact poses; a grid of places, headings and
directions of travel keeps the cheapest node of each cell. Nodes are expanded many at a time, in NumPy. The shortest ways
without obstacles from a node to the goal (`shortcuts`) bound its cost from below, and complete its path if they are free.
"""

import heapq
from itertools import product
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float

from .obstacles import FAR, Footprint, Obstacles

#: Headings of the grid, cells along the longer side of the region, nodes expanded at a time, and most of them in all.
HEADINGS, MOST_CELLS, BATCH, MOST_NODES = 24, 128, 48, 400_000

#: Curvatures of the arcs in units of the greatest one, and the most by which an arc turns [rad].
CURVATURES, MOST_TURN = (-1.0, -0.5, 0.0, 0.5, 1.0), 0.5

#: Points of an arc that must be free, for each step of a grid cell and a half.
SAMPLES = 3

#: Distance from the start, the goal and the obstacles [least turning radii] that a path may need to turn round: three circles
#: that touch each other reach as far.
TURNING_SPACE = 4.0

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


class Ground(NamedTuple):
    """The region of a search: lower corner and size (2,) [m], side of a cell [m], and what must not be touched."""

    low: Float[np.ndarray, " 2"]
    size: Float[np.ndarray, " 2"]
    cell: float
    obstacles: Obstacles
    footprint: Footprint

    @classmethod
    def of(
        cls, poses: Float[np.ndarray, "poses 3"], obstacles: Obstacles, footprint: Footprint, radius: float
    ) -> "Ground":
        """A region around the start, the goal and all obstacles, with space to turn with the least `radius` [m]."""
        boxes, centres = np.asarray(obstacles.boxes).reshape(-1, 2), np.asarray(obstacles.centres)
        radii = np.asarray(obstacles.radii)[:, None]
        points = np.concatenate([boxes, centres - radii, centres + radii])
        points = np.concatenate([poses[:, :2], points[np.abs(points).max(axis=1) < 0.1 * FAR]])
        # NumPy would otherwise dispatch every operation with these to JAX.
        obstacles, footprint = jax.tree.map(np.asarray, (obstacles, footprint))
        reach = max(2.5 * float(footprint.length), TURNING_SPACE * radius)
        low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
        cell = max(0.2 * float(footprint.length), float((high - low).max()) / MOST_CELLS)
        return cls(low, high - low, cell, obstacles, footprint)

    @property
    def shape(self) -> tuple[int, int]:
        """The number of cells in each direction."""
        return tuple(np.ceil(self.size / self.cell).astype(int) + 1)  # pyright: ignore[reportReturnType]

    def is_free(self, poses: Float[np.ndarray, "*n 3"], clearance: float) -> Bool[np.ndarray, "*n"]:
        """Whether the footprint is inside the region and keeps its distance from all obstacles."""
        x, y, heading = poses[..., 0], poses[..., 1], poses[..., 2]
        place = poses[..., :2] - self.low
        inside = np.all((place >= 0.0) & (place <= self.size), axis=-1, keepdims=True)[..., 0]
        length, rear = float(self.footprint.length), float(self.footprint.rear)
        ahead = length / 2.0 - rear
        centre = np.stack([x + ahead * np.cos(heading), y + ahead * np.sin(heading)], axis=-1)
        free, radius = inside.copy(), 0.5 * np.hypot(length, float(self.footprint.width)) + clearance
        if not len(self.obstacles.boxes) and not len(self.obstacles.radii):
            return free
        near = np.argwhere(self.distance(centre) < radius)
        index = tuple(near.T)
        close = poses[index]
        forward = np.stack([np.cos(close[:, 2]), np.sin(close[:, 2])], axis=-1)
        left = np.stack([-forward[:, 1], forward[:, 0]], axis=-1)
        corners = self.footprint.corners(close[:, :2], forward, left)
        free[index] &= self.obstacles.gaps(corners).min(axis=-1) > clearance
        return free

    def distance(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """A lower bound [m] of the distance of points from all obstacles, exact outside of them."""
        boxes = np.asarray(self.obstacles.boxes)
        middle, side = boxes.mean(axis=1), boxes[:, 0] - boxes[:, 3]
        length = np.linalg.norm(side, axis=-1)
        axis = side / length[:, None]
        width = np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=-1)
        away = points[..., None, :] - middle
        along = np.abs((away * axis).sum(-1)) - length / 2.0
        across = np.abs(away[..., 1] * axis[:, 0] - away[..., 0] * axis[:, 1]) - width / 2.0
        gaps = np.hypot(along.clip(0.0), across.clip(0.0))
        discs = np.linalg.norm(points[..., None, :] - np.asarray(self.obstacles.centres), axis=-1)
        discs = discs - np.asarray(self.obstacles.radii)
        return np.concatenate([gaps, discs, np.full((*gaps.shape[:-1], 1), np.inf)], axis=-1).min(axis=-1)

    def way_to(self, place: Float[np.ndarray, " 2"], clearance: float) -> Float[np.ndarray, "x y"]:
        """Length [m] of the shortest way of a disc as wide as the vehicle from every cell to a place; infinite if there is
        none."""
        nx, ny = self.shape
        x, y = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
        points = self.low + self.cell * (np.stack([x, y], axis=-1) + 0.5)
        half = 0.5 * float(self.footprint.width) + clearance
        free = self.distance(points) > half - 0.7 * self.cell
        number = np.arange(nx * ny).reshape(nx, ny)
        starts, ends, lengths = [], [], []
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            here = (slice(0, nx - dx), slice(max(0, -dy), ny - max(0, dy)))
            there = (slice(dx, nx), slice(max(0, dy), ny + min(0, dy)))
            both = free[here] & free[there]
            starts.append(number[here][both])
            ends.append(number[there][both])
            lengths.append(np.full(both.sum(), self.cell * np.hypot(dx, dy)))
        links = (np.concatenate(starts), np.concatenate(ends))
        graph = scipy.sparse.csr_array((np.concatenate(lengths), links), shape=(nx * ny, nx * ny))
        goal = np.clip(((place - self.low) / self.cell).astype(int), 0, np.array(self.shape) - 1)
        way = scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=number[tuple(goal)])
        return way.reshape(nx, ny)


class Steps(NamedTuple):
    """What the stroller may do: least and greatest curvature [1/m], and the directions of travel (1 or -1)."""

    least: float
    greatest: float
    directions: tuple[float, ...]

    @property
    def sharpest(self) -> float:
        """The greatest curvature [1/m] to either side."""
        return max(-self.least, self.greatest)


def arcs(ground: Ground, steps: Steps) -> Float[np.ndarray, "arcs 3"]:
    """The arcs of a step: direction of travel, curvature and length.

    A curve that turns by less than a heading of the grid would end in the cell of a cheaper one, and the search would not turn.
    """
    step = 1.5 * ground.cell
    bends = np.unique(np.clip(steps.sharpest * np.array(CURVATURES), steps.least, steps.greatest))
    length = np.minimum(step, MOST_TURN / np.maximum(np.abs(bends), 1e-9))
    length = np.maximum(length, MOST_TURN / steps.sharpest * (bends != 0.0))
    return np.array([[sign, k, s] for sign in steps.directions for k, s in zip(bends, length, strict=True)])


def driven(poses: Float[np.ndarray, "*n 3"], direction, curvature, length) -> Float[np.ndarray, "*n 3"]:
    """Poses at the ends of arcs."""
    turn = direction * curvature * length
    heading = poses[..., 2] + turn / 2.0
    chord = direction * length * np.sinc(turn / (2.0 * np.pi))
    return np.stack(
        [poses[..., 0] + chord * np.cos(heading), poses[..., 1] + chord * np.sin(heading), poses[..., 2] + turn],
        axis=-1,
    )


class Tree:
    """The nodes of a search, in growing arrays."""

    def __init__(self, start: Float[np.ndarray, " 3"]):
        self.pose = np.zeros((4096, 3))
        self.cost, self.parent, self.move = np.zeros(4096), np.full(4096, -1), np.zeros((4096, 3))
        self.pose[0], self.count = start, 1

    def add(self, pose, cost, parent, move) -> np.ndarray:
        """Add nodes; returns their numbers."""
        number = np.arange(self.count, self.count + len(pose))
        while number.size and number[-1] >= len(self.pose):
            self.pose, self.cost = np.concatenate([self.pose, self.pose]), np.concatenate([self.cost, self.cost])
            self.parent, self.move = np.concatenate([self.parent] * 2), np.concatenate([self.move] * 2)
        self.pose[number], self.cost[number], self.parent[number], self.move[number] = pose, cost, parent, move
        self.count += len(pose)
        return number

    def branch(self, node: int) -> list[int]:
        """The nodes from the start to a node."""
        nodes = [node]
        while self.parent[nodes[-1]] >= 0:
            nodes.append(int(self.parent[nodes[-1]]))
        return nodes[::-1]


class Children(NamedTuple):
    """The free ends of moves from some nodes: poses (children, 3), costs [m], numbers of the parents, and the moves (children,
    3), each a direction of travel, a curvature and a length."""

    pose: np.ndarray
    cost: np.ndarray
    parent: np.ndarray
    move: np.ndarray

    def only(self, which: np.ndarray) -> "Children":
        """Some of the children."""
        return Children(*(part[which] for part in self))


def shortcuts(
    poses: Float[np.ndarray, "poses 3"], goal: np.ndarray, has_heading: bool, steps: Steps
) -> Float[np.ndarray, "3 3 ways poses"]:
    """Ways without obstacles: direction, curvature and length of three pieces each; a length is NaN where there is no such way.

    A way consists of two arcs as tight as possible, with a straight piece or a third such arc between them, each forwards or in
    reverse; the shortest way forwards is among them (Dubins, Am. J. Math. 79 (1957) 497). To a goal without a heading, the last
    arc has the radius 0.
    """
    radii, either = [1.0 / bend for bend in (steps.least, steps.greatest) if bend], steps.directions
    x, y, heading = poses.T
    # The directions to try, the radii and the turns of the pieces, and the length of the middle piece where it is straight.
    ways = []
    for first, last in product(radii, radii if has_heading else [0.0]):
        # The line between the circles' centres determines the headings between the pieces.
        along = goal[0] - last * np.sin(goal[2]) - x + first * np.sin(heading)
        across = goal[1] + last * np.cos(goal[2]) - y - first * np.cos(heading)
        away, angle = np.hypot(along, across), np.arctan2(across, along)
        for sign in either if steps.least <= 0.0 <= steps.greatest else ():
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

    def piece(sign: float, radius: float, turn: Any, straight: Any) -> list[np.ndarray]:
        arc = (np.mod(sign * np.sign(radius) * turn + TIE, 2.0 * np.pi) - TIE).clip(0.0)
        return list(np.broadcast_arrays(sign, 1.0 / radius if radius else 0.0, abs(radius) * arc + straight + 0.0 * x))

    pieces = [
        list(map(piece, signs, of_pieces, turns, (0.0, straight, 0.0)))
        for options, of_pieces, turns, straight in ways
        for signs in product(*options)
    ]
    return np.array(pieces).reshape(len(pieces), 3, 3, len(poses)).transpose(1, 2, 0, 3)


@np.errstate(invalid="ignore")
def search(
    ground: Ground, start: np.ndarray, goal: np.ndarray, has_heading: bool, steps: Steps, costs: Costs
) -> tuple[Path | None, float, bool]:
    """The cheapest path that the search finds from one pose (3,) to another, or `None`; the distance [m] from the goal to the
    nearest place it came to; and whether it has looked everywhere."""
    ordinary, tree, way = arcs(ground, steps), Tree(start), ground.way_to(goal[:2], costs.clearance)
    # A path with more pieces than a shortcut begins with an arc of any length, and one with fewer with none.
    first = np.concatenate([ordinary * [1.0, 1.0, times] for times in range(FIRST_ARCS)])
    best = np.full(np.prod(ground.shape) * HEADINGS * 2, np.inf)
    frontier, nearest = [(0.0, 0)], float(np.linalg.norm(start[:2] - goal[:2]))
    path, least = None, np.inf
    while frontier and frontier[0][0] < least - TIE and tree.count < MOST_NODES:
        nodes = np.array([heapq.heappop(frontier)[1] for _ in range(min(BATCH, len(frontier)))])
        cells = _cells(ground, tree.pose[nodes], tree.move[nodes, 0])
        # A cheaper node of the same cell has replaced the others. The start has no cell.
        nodes = nodes[(nodes == 0) | (tree.cost[nodes] <= best[cells] + TIE)]
        if not nodes.size:
            continue
        children = _children(ground, tree, first if nodes[0] == 0 else ordinary, nodes, steps, costs)
        ahead = way[tuple(_places(ground, children.pose).T)]
        cells = _cells(ground, children.pose, children.move[:, 0])
        order = np.lexsort((children.cost, cells))
        kept = order[np.unique(cells[order], return_index=True)[1]]
        kept = kept[(children.cost[kept] < best[cells[kept]] - TIE) & np.isfinite(ahead[kept])]
        best[cells[kept]] = children.cost[kept]
        children, ahead = children.only(kept), ahead[kept]
        numbers = tree.add(*children)
        away = np.linalg.norm(children.pose[:, :2] - goal[:2], axis=-1)
        turn = np.abs((children.pose[:, 2] - goal[2] + np.pi) % (2.0 * np.pi) - np.pi) * has_heading
        nearest = float(away.min(initial=nearest))
        arrived = (away < ARRIVAL[0] * ground.cell) & (turn < ARRIVAL[1] * 2.0 * np.pi / HEADINGS)
        if arrived.any():
            missing = children.cost + away + turn / steps.sharpest
            return _path(tree, int(numbers[arrived][np.argmin(missing[arrived])]), np.zeros((0, 3))), 0.0, True
        ways = shortcuts(children.pose, goal, has_heading, steps)
        price, before = np.zeros(ways.shape[2:]), children.move.T[:, None]
        for move in ways:
            price += _price(ground, steps, costs, before, move)
            before = np.where(move[2] > TIE, move, before)
        price = np.nan_to_num(price, nan=np.inf)
        total = children.cost + price
        for number in np.argsort(total, axis=None)[:EXAMINED]:
            which, child = np.unravel_index(number, total.shape)
            if total[which, child] >= least:
                break
            whole = _path(tree, int(numbers[child]), ways[..., which, child])
            if ground.is_free(_along(ground, whole.poses[:-1], np.stack(whole[1:], axis=1)), costs.clearance).all():
                path, least = whole, total[which, child]
        shortest = price.min(axis=0, initial=np.inf)
        ahead = np.maximum(ahead, np.where(np.isfinite(shortest), shortest, 0.0))
        for entry in zip((children.cost + ahead).tolist(), numbers.tolist(), strict=True):
            heapq.heappush(frontier, entry)
    return path, nearest, not frontier


def _price(ground: Ground, steps: Steps, costs: Costs, before: Any, move: Any) -> Any:
    """The price [m] of a move after another one; each is a direction, 0 for none, a curvature and a length."""
    direction, bend, length = move
    change = costs.reversal * (before[0] * direction < 0.0)
    change = change + 0.5 * costs.turning * ground.cell * np.abs(before[1] - bend) / steps.sharpest
    factor = np.where(direction < 0.0, costs.backwards, 1.0) * (1.0 + costs.turning * np.abs(bend) / steps.sharpest)
    return length * factor + change * (length > TIE)


def _children(ground: Ground, tree: Tree, moves: np.ndarray, nodes: np.ndarray, steps: Steps, costs: Costs) -> Children:
    """The ends of all moves from some nodes that touch no obstacle."""
    parent, which = (part.ravel() for part in np.meshgrid(nodes, np.arange(len(moves)), indexing="ij"))
    move = moves[which]
    poses = _along(ground, tree.pose[parent], move)
    cost = tree.cost[parent] + _price(ground, steps, costs, tree.move[parent].T, move.T)
    free = ground.is_free(poses, costs.clearance).all(axis=1)
    return Children(poses[:, -1], cost, parent, move).only(np.asarray(free))


def _along(ground: Ground, pose: np.ndarray, moves: np.ndarray) -> Float[np.ndarray, "moves samples 3"]:
    """Poses along moves, each from a pose of its own."""
    count = max(SAMPLES, int(np.ceil(SAMPLES * moves[:, 2].max() / (1.5 * ground.cell))))
    direction, bend, length = moves.T[..., None]
    return driven(pose[:, None], direction, bend, length * np.arange(1, count + 1) / count)


def _places(ground: Ground, pose: np.ndarray) -> np.ndarray:
    """The cells of x and y."""
    return np.clip(((pose[:, :2] - ground.low) / ground.cell).astype(int), 0, np.array(ground.shape) - 1)


def _cells(ground: Ground, pose: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The numbers of the cells of places, headings and directions of travel."""
    place, (_, ny) = _places(ground, pose), ground.shape
    heading = np.floor(pose[:, 2] / (2.0 * np.pi) * HEADINGS + 0.5).astype(int) % HEADINGS
    return ((place[:, 0] * ny + place[:, 1]) * HEADINGS + heading) * 2 + (direction > 0.0)


def _path(tree: Tree, node: int, more: np.ndarray) -> Path:
    """The path to a node, and by more pieces from there."""
    branch = np.array(tree.branch(node))
    poses, moves = list(tree.pose[branch]), np.concatenate([tree.move[branch[1:]], more[more[:, 2] > TIE]])
    for piece in moves[len(branch) - 1 :]:
        poses.append(driven(poses[-1], *piece))
    return Path(np.array(poses), *moves.T)
