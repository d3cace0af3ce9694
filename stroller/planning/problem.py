"""A planning problem as the user states it, checked before anything compiles, and the distances of its obstacles."""

import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic import validation
from nonholonomic.geometry import AbstractSurface, Plane, Vector, cross, difference, dot, scale, sum_vectors
from nonholonomic.integration.problem import require_run
from nonholonomic.text import shown
from nonholonomic.validation import Bound, Bounded, Usual, as_number, require, require_kind

from ..model.scene import HEADING, STEERING, Dynamics, Launch, Scene, as_numbers, as_place, padded

#: Numbers, points (..., points, 2), and points or a point of the ground, seen from above or in space, in NumPy or in JAX.
Numbers: TypeAlias = Float[Array | np.ndarray, "..."]
Points: TypeAlias = Float[Array | np.ndarray, "... points 2"]
Corners: TypeAlias = Float[Array | np.ndarray, "... points axes"]
Point: TypeAlias = Float[Array | np.ndarray, "... axes"]

#: The frame of an obstacle, in the ground's axes: its origin, the directions of its axes, and upwards.
Frame: TypeAlias = Float[Array | np.ndarray, "... 4 3"]

# Obstacles, and the footprint of the stroller: in the coordinates x and y, or in space.
#
# Where the ground's coordinates are x and y, everything is seen from above. On any other ground, each obstacle sees the
# corners of the footprint along the normal of its tangent plane, in coordinates of its own.

#: The numbers of boxes and of discs are padded to a multiple of this, so that other problems use the same programs.
PADDING = 8

#: The corners of a square about the origin, counterclockwise.
SQUARE = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])

#: Distance [m] of the obstacles that pad a list.
FAR = 1e9

#: The coordinates of a ground on which all is seen from above, and the frame of its obstacles.
FROM_ABOVE, ABOVE = (("x", "m"), ("y", "m")), np.eye(4, 3, -1)

#: Length, width and rear overhang of the drawn vehicle, in units of the wheelbase.
DRAWN = (1.4, 0.87, 0.2)

#: Square of a length [m^2] that keeps the slope of a distance finite where the distance vanishes.
SMALLEST_SQUARE = 1e-18


#: Square of a length [m^2] that is lost in that of any other edge.
NO_EDGE = 1e-30


as_centre = functools.partial(as_place, name="centre", single=True)
as_size = functools.partial(as_place, name="size", counts=(2,), single=True)


class Box(Bounded):
    """A rectangular obstacle, seen from above where the ground's coordinates are x and y. On any other ground, it stands on the
    tangent plane at its centre, and reaches as far above and below this plane as its corners are from the centre; distances are
    measured in this plane or along its normal, whichever is greater.

    **Arguments:**

    - `centre`: its middle, in the ground's coordinates, as the place of a `Launch`.
    - `size`: its lengths [m] along its own two axes, positive.
    - `angle`: angle [rad] of its first axis, seen from above from x towards y, otherwise as the heading of a `Launch`.

    **Raises:** `ValueError` for numbers out of range.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Box(centre=(1.0, 0.3), size=(0.5, 0.25))
    Box(centre=(1, 0.3) m or rad, size=(0.5, 0.25) m, angle=0 rad)

    ```
    """

    units: ClassVar[dict[str, str]] = {"centre": "m or rad", "size": "m", "angle": "rad"}

    centre: tuple[Float[Array, ""], ...] = eqx.field(converter=as_centre)
    size: tuple[Float[Array, ""], ...] = eqx.field(converter=as_size, metadata=Bound.POSITIVE)
    angle: Float[Array, ""] = eqx.field(converter=as_number, default=0.0, metadata=HEADING)

    @property
    def corners(self) -> Float[np.ndarray, "4 2"]:
        """The corners [m], counterclockwise."""
        cosine, sine = np.cos(float(self.angle)), np.sin(float(self.angle))
        own = SQUARE * np.array(self.size, dtype=float) / 2.0
        return np.array(self.centre, dtype=float) + own @ np.array([[cosine, sine], [-sine, cosine]])

    def distance(self, polygon: Float[np.ndarray, "*n 4 2"]) -> Float[np.ndarray, "*n"]:
        """The exact distance [m] of polygons from the box, minus the depth of penetration where they overlap."""
        corners = self.corners
        gap = separation(polygon, corners)
        apart = np.minimum(_edge_distance(polygon, corners).min(-1), _edge_distance(corners, polygon).min(-1))
        return np.where(gap > 0.0, apart, gap)


class Disc(Bounded):
    """A round obstacle, seen from above where the ground's coordinates are x and y. On any other ground, it stands on the
    tangent plane at its centre, and reaches a radius above and below this plane; distances are those of a `Box`.

    **Arguments:**

    - `centre`: its middle, in the ground's coordinates, as the place of a `Launch`.
    - `radius`: its radius [m], positive.

    **Raises:** `ValueError` for numbers out of range.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Disc(centre=(1.0, 0.3), radius=0.2)
    Disc(centre=(1, 0.3) m or rad, radius=0.2 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"centre": "m or rad", "radius": "m"}

    #: The direction of its frame.
    angle: ClassVar[float] = 0.0

    centre: tuple[Float[Array, ""], ...] = eqx.field(converter=as_centre)
    radius: Float[Array, ""] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)

    def distance(self, polygon: Points) -> Numbers:
        """The exact distance [m] of polygons from the disc, negative where they overlap."""
        return disc_distance(polygon, np.array(self.centre, dtype=float), float(self.radius))


class Footprint(Bounded):
    """The rectangle that must not touch an obstacle, as seen from above.

    **Arguments:**

    - `length`, `width`: its size [m] along and across the heading, positive.
    - `rear`: distance [m] from its rear end to the rear axle, in [0, `length`].

    **Raises:** `ValueError` for numbers out of range.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Footprint(length=0.5, width=0.25, rear=0.1)
    Footprint(length=0.5 m, width=0.25 m, rear=0.1 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"length": "m", "width": "m", "rear": "m"}

    length: Float[Array, ""] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    width: Float[Array, ""] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    rear: Float[Array, ""] = eqx.field(converter=as_number, metadata=Bound.NOT_NEGATIVE)

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        yield Bound(self.rear, "rear", at_most=self.length, why="the length")

    def corners(self, place: Point, heading: Point, left: Point) -> Corners:
        """The corners [m], counterclockwise. **Arguments:** `place`: the rear axle [m]; `heading`, `left`: unit vectors
        of the stroller, seen from above or in space."""
        front, half = self.length - self.rear, self.width / 2.0
        along = np.array([1.0, 1.0, 0.0, 0.0])[:, None] * front - np.array([0.0, 0.0, 1.0, 1.0])[:, None] * self.rear
        across = np.array([-1.0, 1.0, 1.0, -1.0])[:, None] * half
        return place[..., None, :] + along * heading[..., None, :] + across * left[..., None, :]


class Obstacles(eqx.Module):
    """The obstacles as arrays, padded: corners of the boxes (boxes, 4, 2), centres (discs, 2) and radii of the discs, and the
    frames of both."""

    boxes: Float[Array | np.ndarray, "boxes 4 2"]
    centres: Float[Array | np.ndarray, "discs 2"]
    radii: Float[Array | np.ndarray, " discs"]
    box_frames: Frame
    disc_frames: Frame

    @classmethod
    def of(cls, obstacles: Sequence[tuple[Box | Disc, Frame]], padding: int = PADDING) -> "Obstacles":
        """Boxes and discs in their frames as arrays, padded to multiples of a number."""
        boxes = [(part, frame) for part, frame in obstacles if isinstance(part, Box)]
        discs = [(part, frame) for part, frame in obstacles if isinstance(part, Disc)]
        circles = np.array([[*disc.centre, disc.radius] for disc, _ in discs], dtype=float).reshape(-1, 3)
        frames = (np.array([frame for _, frame in pairs]).reshape(-1, 4, 3) for pairs in (boxes, discs))
        arrays = np.array([box.corners for box, _ in boxes]).reshape(-1, 4, 2), circles[:, :2], circles[:, 2], *frames
        return cls(*arrays).padded(*(-(-len(pairs) // padding) * padding for pairs in (boxes, discs)))

    def padded(self, boxes: int, discs: int) -> "Obstacles":
        """The obstacles with others far away, so that there are so many boxes and discs; in NumPy, because JAX would
        compile a program for every number of obstacles."""
        others = Box((FAR, FAR), (1.0, 1.0)).corners, np.full(2, FAR), np.ones(()), ABOVE, ABOVE
        counts, parts = (boxes, discs, discs, boxes, discs), jax.tree.leaves(self)
        more = [np.broadcast_to(far, (n - len(a), *far.shape)) for a, far, n in zip(parts, others, counts, strict=True)]
        return Obstacles(*(np.concatenate(pair) for pair in zip(parts, more, strict=True)))

    def gaps(self, corners: Corners) -> Numbers:
        """A lower bound [m] of the distance of footprints from every obstacle, with a slope everywhere."""
        xp = np if isinstance(corners, np.ndarray) else jnp
        boxes, above_boxes = seen_from(self.box_frames, corners)
        discs, above_discs = seen_from(self.disc_frames, corners)
        gaps = separation(boxes, self.boxes), disc_distance(discs, self.centres, self.radii)
        above = above_boxes - (self.boxes[:, 0] ** 2).sum(-1) ** 0.5, above_discs - self.radii
        return xp.concatenate([xp.maximum(*pair) for pair in zip(gaps, above, strict=True)], axis=-1)


def seen_from(frames: Frame, corners: Corners) -> tuple[Points, Numbers | float]:
    """The corners of footprints as each obstacle sees them, (..., obstacles, 4, 2), counterclockwise, and how far [m] the whole
    footprint is above or below the obstacle's plane: negative if it is on both sides, and if all is seen from above."""
    if corners.shape[-1] == 2:
        return corners[..., None, :, :], -np.inf
    xp: Any = np if isinstance(corners, np.ndarray) else jnp
    away = corners[..., None, :, :] - frames[:, :1]
    own = (away[..., None, :] * frames[:, None, 1:]).sum(-1)
    flat, height = own[..., :2], own[..., 2]
    along, across = flat[..., 1, :] - flat[..., 0, :], flat[..., 2, :] - flat[..., 1, :]
    is_mirrored = along[..., 0] * across[..., 1] < along[..., 1] * across[..., 0]
    flat = xp.where(is_mirrored[..., None, None], flat[..., ::-1, :], flat)
    return flat, xp.maximum(_least(height, -1), _least(-height, -1))


def outline_of(part: Box | Disc) -> Float[np.ndarray, "sides 2"]:
    """Points around an obstacle [m], counterclockwise, among them its corners."""
    share = np.arange(SIDES) / SIDES
    if isinstance(part, Disc):
        angle = 2.0 * np.pi * share
        return np.array(part.centre) + float(part.radius) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.stack([np.interp(4.0 * share, range(5), np.append(x, x[0])) for x in part.corners.T], axis=-1)


def require_obstacles(obstacles: Iterable[Box | Disc]) -> tuple[Box | Disc, ...]:
    """A list of obstacles as a tuple; raise `ValueError` for anything else."""
    if isinstance(obstacles, Box | Disc):
        raise ValueError("obstacles = one obstacle must be a list: write obstacles=[obstacle]")
    try:
        parts = tuple(obstacles)
    except TypeError:
        raise ValueError(f"obstacles = {shown(obstacles)} must be a list of Box and Disc") from None
    for k, part in enumerate(parts):
        if not isinstance(part, Disc):
            require_kind(part, f"obstacles[{k}]", Box, " or a Disc")
    return parts


# Distances between rectangles and discs. Arrays have the shape (..., corners, 2), counterclockwise. The functions use only
# operators and methods that NumPy and JAX share, so that the optimiser and the check share them.

#: The next corner of each.
NEXT = [1, 2, 3, 0]


def _least(values: Numbers, axis: int) -> Numbers:
    """The least of some values along an axis, with the derivative of that value.

    JAX divides the derivative of `min` by the number of values that equal the result: if XLA computes a value again and
    rounds it differently, that number is zero.
    """
    xp: Any = np if isinstance(values, np.ndarray) else jnp
    return xp.take_along_axis(values, xp.expand_dims(values.argmin(axis), axis), axis).squeeze(axis)


def _face_gaps(polygon: Points, points: Points) -> Numbers:
    """How far points (..., points, 2) are outside each face of a polygon: (..., faces, points)."""
    edge = polygon[..., NEXT, :] - polygon
    length = ((edge * edge).sum(-1) + NO_EDGE) ** 0.5
    normal_x, normal_y = edge[..., 1] / length, -edge[..., 0] / length
    offset = normal_x * polygon[..., 0] + normal_y * polygon[..., 1]
    x, y = points[..., None, :, 0], points[..., None, :, 1]
    return normal_x[..., None] * x + normal_y[..., None] * y - offset[..., None]


def separation(first: Points, second: Points) -> Numbers:
    """Greatest gap [m] between two polygons across a face of either.

    This is the exact depth of penetration (negative) of polygons that overlap (the separating-axis theorem; Ericson,
    Real-Time Collision Detection (2005), section 5.2), and a lower bound of the distance of others.
    """
    gap, gap_back = (-_least(-_least(_face_gaps(*pair), -1), -1) for pair in ((first, second), (second, first)))
    return gap + (gap_back - gap).clip(0.0)


def _edge_distance(polygon: Points, points: Points) -> Numbers:
    """Distance [m] of points (..., points, 2) from the boundary of a polygon."""
    edge = (polygon[..., NEXT, :] - polygon)[..., :, None, :]
    along = points[..., None, :, :] - polygon[..., :, None, :]
    part = ((along * edge).sum(-1) / ((edge * edge).sum(-1) + NO_EDGE)).clip(0.0, 1.0)
    away = along - part[..., None] * edge
    return (_least((away * away).sum(-1), -2) + SMALLEST_SQUARE) ** 0.5


def disc_distance(polygon: Points, centre: Points, radius: Numbers | float) -> Numbers:
    """Distance [m] between a polygon and a disc, or minus the depth of penetration if they overlap."""
    point = centre[..., None, :]
    inside = _face_gaps(polygon, point).max(-2)[..., 0] < 0.0
    return _edge_distance(polygon, point)[..., 0] * (1.0 - 2.0 * inside) - radius


# What a plan must achieve, and what it must not exceed.

#: A bound [any unit] that nothing reaches.
UNLIMITED = 1e9

#: The greatest steering angle [rad] of plans without a limit of their own.
MOST_STEERING = 1.2


class Goal(Bounded):
    """Where a plan ends, and how fast.

    **Arguments:**

    - `place`: position of the rear axle, in the surface's coordinates, as in `Launch`.
    - `heading`: angle [rad] of the heading, as in `Launch`; `None` for any heading.
    - `speed`: speed [m/s] of the rear axle, negative in reverse.
    - `within`: greatest error at the end: of the place [m], of the heading [rad] and of the speed [m/s]; positive.

    **Raises:** `ValueError` for numbers out of range.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Goal(place=(1.9, 0.3), heading=0.0)
    Goal(place=(1.9, 0.3) m or rad, heading=0 rad, speed=0 m/s, within=0.05)

    ```
    """

    units: ClassVar[dict[str, str]] = {"place": "m or rad", "heading": "rad", "speed": "m s-1", "within": "1"}

    place: tuple[Float[Array, ""], ...] = eqx.field(converter=as_place)
    heading: Float[Array, ""] | None = eqx.field(converter=as_number, default=None, metadata=HEADING)
    speed: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    within: Float[Array, ""] = eqx.field(converter=as_number, default=0.05, metadata=Bound.POSITIVE)


def as_range(value: Any) -> Any:
    """A positive bound as the pair (-bound, bound); a pair, `None` and anything else stay as they are."""
    numbers = as_numbers(value)
    if isinstance(numbers, tuple) or value is None:
        return numbers
    bound = as_number(value)
    return (-bound, bound) if isinstance(bound, Array) and (validation.is_traced(bound) or bound > 0.0) else value


#: A grip above 5 suggests per cent.
GRIP = {"usual": Usual(5.0, {"%": 0.01})}


class Limits(Bounded):
    """The ranges that a plan must not leave, each a pair (low, high) or one number b for (-b, b); `None` for no limit.
    A plan may exceed a limit by 0.001 of its range, so that a limit can be the very value at the start or at the goal, as
    in `speed=(0.0, 0.8)` for a plan that never reverses.

    **Arguments:**

    - `steering`: steering angle [rad]; by default, plans steer by at most 1.2 rad.
    - `speed`: speed [m/s] of the rear axle.
    - `force`: drive force [N].
    - `torque`: steering torque [N m].
    - `grip`: coefficient of friction that the tyres need.

    **Raises:** `ValueError` if a range is empty or not made of numbers.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Limits(steering=1.0, speed=(-0.5, 0.8))
    Limits(steering=(-1, 1) rad, speed=(-0.5, 0.8) m/s)

    ```
    """

    units: ClassVar[dict[str, str]] = {"steering": "rad", "speed": "m s-1", "force": "N", "torque": "N m", "grip": "1"}

    steering: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None, metadata=STEERING)
    speed: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    force: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    torque: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    grip: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None, metadata=GRIP)

    def bounds(self) -> Iterator[Bound]:
        pairs = {name: getattr(self, name) for name in self.units if getattr(self, name) is not None}
        for name, value in pairs.items():
            if not (isinstance(value, tuple) and len(value) == 2):
                bound = f"{(validation.largest(as_number(value)) if np.ndim(value) == 0 else 0.0) or 1.0:g}"
                words = f"one positive number, such as {bound} for (-{bound}, {bound}), or a pair (lowest, highest)"
                raise ValueError(f"{name} = {shown(value)} must be {words}")
        yield from super().bounds()
        for name, (low, high) in pairs.items():
            yield Bound(high, f"{name}[1]", above=low, why="the lower bound")

    def ranges(self) -> dict[str, tuple[float, float]]:
        """The limits by name; those that are `None` are left out."""
        pairs = {name: getattr(self, name) for name in self.units}
        return {name: (float(pair[0]), float(pair[1])) for name, pair in pairs.items() if pair is not None}

    def arrays(self, reserve: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of all quantities, narrowed by a share of each range.

        **Arguments:** `reserve`: the share.
        """
        free = {"steering": (-MOST_STEERING, MOST_STEERING)}
        ranges = {name: (-UNLIMITED, UNLIMITED) for name in self.units} | free | self.ranges()
        low, high = np.array([ranges[name] for name in self.units]).T
        narrowed = reserve * (high - low) / 2.0
        return low + narrowed, high - narrowed


# A planning problem, checked before anything compiles.

#: Distance to keep from obstacles while planning, in units of the footprint's length: the check examines the ride between the
#: points at which the optimiser looks.
RESERVE = 0.04

#: The greatest distance of a goal [wheelbases]: the splines of a plan cannot end a longer drive exactly.
FARTHEST = 1e5

#: A footprint nearer to an obstacle than this touches it, in units of its length.
TOUCHING = 1e-9

#: A mean speed [m/s] above which the place of a goal is suspected to be in another unit.
FASTEST = 50.0

#: Headings at which a goal without a heading is examined.
HEADINGS = 72

#: Share of every limit's range to keep in reserve at first: the check examines the ride between the points at which the
#: optimiser looks.
LIMIT_RESERVE = 0.003

#: Curvature of the arcs of the searches for neighbouring lanes, in units of the greatest one: less, because the fork takes time
#: to turn, and nearly all, because a somewhat wider turn may need a detour.
SEARCH_CURVATURES = (0.98, 0.85)

#: Distance from the start, the goal and the obstacles [least turning radii] that a path may need to turn round: three circles
#: that touch each other reach as far.
TURNING_SPACE = 4.0

#: Steps of a straight way from the middle of a map, points of its table from the middle to each side, and the most tables, each
#: larger than the one before, until one contains the start and the goal.
STEPS, MAPPED, MOST_MAPS = 48, 64, 4

#: Points around an obstacle, steps of Newton's method to their feet on the ground, and the least cosine of the angle by which
#: the ground may turn beneath an obstacle, of 45 degrees: a steeper wall would be longer than its size by more than 11 %.
SIDES, LOWERED, STEEPEST = 48, 10, 0.7

#: Shares of the size of an obstacle at which the ground beneath it is examined.
SHARES = np.arange(1, 65) / 64

#: A place of the rear axle and a heading, in the ground's axes, as one array.
Pose: TypeAlias = Float[Array, " components"]


def frame_of(dynamics: Dynamics, pose: Float[Array, "components *n"]) -> tuple[Vector, Vector, Vector]:
    """The place, the heading and the direction to the left of a pose, or of many, in the ground's axes."""
    axes = dynamics.surface.axes
    place, heading = padded(pose[:axes]), padded(pose[axes:])
    return place, heading, scale(dynamics.side, cross(dynamics.surface.normal(place), heading))


def corners_of(dynamics: Dynamics, footprint: Footprint, pose: Float[Array, "components *n"]) -> Corners:
    """The corners [m] of the footprint at a pose, or at many, as seen from above or in space."""
    axes = 2 if tuple(dynamics.surface.coordinates) == FROM_ABOVE else 3
    return footprint.corners(*(jnp.stack(part[:axes], axis=-1) for part in frame_of(dynamics, pose)))


@eqx.filter_jit
def pose_of(scene: Scene, place: tuple[ArrayLike, ...], heading: Float[Array, ""]) -> Pose:
    """A position and a heading [rad], in the ground's axes, as one array."""
    axes = scene.surface.axes
    return jnp.stack([component for vector in scene.dynamics.pose(place, heading) for component in vector[:axes]])


@eqx.filter_jit
def poses_at(surface: AbstractSurface, points: Float[Array | np.ndarray, "n 3"]) -> Float[Array, "n components"]:
    """The poses of points and headings (x, y, angle), where the ground names its places x and y."""
    along = jnp.stack([jnp.cos(points[:, 2]), jnp.sin(points[:, 2])], axis=1)
    place, along = jax.jvp(
        lambda at: jnp.stack(surface.charted(tuple(at.T))[0][: surface.axes], axis=1),
        (jnp.asarray(points[:, :2]),),
        (along,),
    )
    return jnp.concatenate([place, along / jnp.sqrt(jnp.sum(along**2, axis=1, keepdims=True))], axis=1)


@eqx.filter_jit
def walked(surface: AbstractSurface, frame: Frame, ways: Float[Array | np.ndarray, "n 2"]) -> Float[Array, "n 3"]:
    """The places [m] to which straight ways on the ground lead. **Arguments:** `frame`: that of their common start;
    `ways`: their lengths [m] along its first two axes."""
    step = jnp.asarray(ways / STEPS @ frame[1:3]).T

    def walk(_: int, way: tuple[Numbers, Numbers]) -> tuple[Numbers, Numbers]:
        # The step turns with the normal.
        place, step = surface.onto(tuple(way[0] + way[1])), tuple(way[1])
        before, after = surface.normal(tuple(way[0])), surface.normal(place)
        turn = scale(dot(step, after) / (1.0 + dot(before, after)), sum_vectors(before, after))
        return jnp.stack(place), jnp.stack(difference(step, turn))

    start = jnp.broadcast_to(frame[0][:, None], step.shape)
    return jax.lax.fori_loop(0, STEPS, walk, (start, step))[0].T


@eqx.filter_jit
def feet(
    surface: AbstractSurface, frame: Frame, points: Float[Array | np.ndarray, "n 2"]
) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    """The points [m] of the ground above or below those of an obstacle's plane, and the cosines of the angles by which the
    ground is turned there; NaN where there is none."""
    up, cosine = frame[3], jnp.ones(len(points))
    side, foot = dot(surface.normal(tuple(frame[0])), tuple(up)), (frame[0] + points @ frame[1:3]).T
    for _ in range(LOWERED):
        foot = foot - up[:, None] * (side * surface.offset(tuple(foot)) / jnp.maximum(cosine, 0.5 * STEEPEST))
        cosine = side * dot(surface.normal(tuple(foot)), tuple(up))
    return foot.T, jnp.where(jnp.abs(surface.offset(tuple(foot))) < 1e-6 * jnp.abs(points).max(), cosine, jnp.nan)


class Problem(eqx.Module):
    """A planning problem, as the user states it. `t1` is the duration [s] of the drive, or, `in_haste`, where the time is
    minimised, the longest one.

    Paths are searched on a flat map of the ground: x and y where the ground names its places so, and otherwise
    straight ways from a middle: each point stands for the place to which the way in this direction, of this length, leads.
    """

    scene: Scene
    launch: Launch
    goal: Goal
    t1: float
    obstacles: tuple[Box | Disc, ...]
    limits: Limits
    footprint: Footprint
    in_haste: bool = False

    @functools.cached_property
    def start_pose(self) -> Pose:
        """The pose of the launch."""
        return pose_of(self.scene, self.launch.place, self.launch.heading)

    @functools.cached_property
    def goal_pose(self) -> Pose:
        """The pose of the goal; its heading is 0 if the goal has none."""
        heading = jnp.zeros(()) if self.goal.heading is None else self.goal.heading
        return pose_of(self.scene, self.goal.place, heading)

    @property
    def distance(self) -> float:
        """The straight distance [m] from the start to the goal."""
        return float(np.linalg.norm(np.asarray(self.goal_pose - self.start_pose)[: self.scene.surface.axes]))

    def frame(self, place: tuple[ArrayLike, ...], angle: ArrayLike) -> Float[np.ndarray, "4 3"]:
        """The frame at a place, whose first axis has the direction of a heading [rad]."""
        place, heading, left = frame_of(self.scene.dynamics, pose_of(self.scene, place, jnp.asarray(angle, float)))
        return np.array([place, heading, left, cross(heading, left)], dtype=float)

    @property
    def turns(self) -> tuple[float, float, float]:
        """The least and the greatest curvature [1/m] of a path, by the limits of the steering angle, and the distance [m]
        from the start, the goal and the obstacles that it may need to turn round."""
        low, high = (float(np.tan(angle[0])) for angle in self.limits.arrays(LIMIT_RESERVE))
        low, high = low / float(self.scene.body.wheelbase), high / float(self.scene.body.wheelbase)
        radius = 1.0 / (min(SEARCH_CURVATURES) * max(-low, high))
        return low, high, max(2.5 * float(self.footprint.length), TURNING_SPACE * radius)

    @functools.cached_property
    def map(self) -> tuple[float, Float[np.ndarray, "points points 3 3"]] | None:
        """A table of the map: the distance [m] of its points, and for each of them its place [m] and the derivatives of the
        place by x and y; `None` if the ground names its places x and y."""
        surface = self.scene.surface
        if tuple(surface.coordinates) == FROM_ABOVE:
            return None
        ends = np.array([self.start_pose, self.goal_pose])[:, :3]
        middle = self.frame(surface.place_at(surface.nearest(tuple(ends.mean(axis=0)))), 0.0)
        middle = middle if np.all(np.isfinite(middle)) else self.frame(self.launch.place, 0.0)
        places = np.concatenate([ends, *(frame[0] + outline_of(part) @ frame[1:3] for part, frame in self.standing)])
        # Along a sphere, no place is further than half a circle about the straight line to it.
        reach = np.pi / 2.0 * np.linalg.norm(places - middle[0], axis=1).max() + self.turns[2]
        number = np.arange(-MAPPED, MAPPED + 1)
        for _ in range(MOST_MAPS):
            spacing = float(reach) / MAPPED
            ways = spacing * np.stack(np.meshgrid(number, number, indexing="ij"), axis=-1)
            table = np.asarray(walked(surface, middle, ways.reshape(-1, 2))).reshape(*ways.shape[:2], 3)
            if all(np.linalg.norm(table - end, axis=-1).min() <= spacing for end in ends):
                break
            # Elsewhere, ways round may be longer.
            reach *= 1.5
        return (spacing, np.stack([table, *np.gradient(table, spacing, axis=(0, 1))], axis=-2))

    def point(self, pose: Float[Array | np.ndarray, " components"]) -> Float[np.ndarray, " 3"]:
        """The point and the heading (x, y, angle) of a pose on the map, the nearest to its middle if there are several."""
        (place, heading), corner = np.asarray(pose).reshape(2, -1), np.zeros(2)
        if self.map is not None:
            spacing, frames = self.map
            away = np.nan_to_num(np.linalg.norm(frames[:, :, 0] - place, axis=-1), nan=np.inf)
            numbers = np.argwhere(away <= max(2.0 * away.min(), 0.5 * spacing))
            number = numbers[np.argmin(np.linalg.norm(numbers - MAPPED, axis=-1))]
            origin, *slopes = frames[tuple(number)]
            corner, inverse = spacing * (number - MAPPED), np.linalg.pinv(slopes)
            place, heading = (place - origin) @ inverse, heading @ inverse
        return np.array([*(place[:2] + corner), np.arctan2(heading[1], heading[0])])

    def seen(self, points: Float[np.ndarray, "*n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The places, the headings and the directions to the left of points and headings on the map, seen from above or in
        space, as obstacles are."""
        points, cosine, sine = points[..., :2], np.cos(points[..., 2:]), np.sin(points[..., 2:])
        if self.map is None:
            return points, np.concatenate([cosine, sine], axis=-1), np.concatenate([-sine, cosine], axis=-1)
        spacing, frames = self.map
        number = np.rint(points / spacing).astype(int).clip(-MAPPED, MAPPED)
        origin, by_x, by_y = np.moveaxis(frames[tuple(np.moveaxis(number + MAPPED, -1, 0))], -2, 0)
        x, y = np.moveaxis(points - spacing * number, -1, 0)[..., None]
        heading = cosine * by_x + sine * by_y
        left = np.cross(np.cross(by_x, by_y), heading)
        units = (part / np.linalg.norm(part, axis=-1, keepdims=True) for part in (heading, left))
        return origin + x * by_x + y * by_y, *units

    @functools.cached_property
    def standing(self) -> list[tuple[Box | Disc, Float[np.ndarray, "4 3"]]]:
        """Each obstacle in the coordinates of its frame, and this frame."""
        standing, is_above = [], tuple(self.scene.surface.coordinates) == FROM_ABOVE
        for part in self.obstacles:
            place, angle, frame = np.zeros(2), 0.0, ABOVE
            if is_above:
                place, angle = np.asarray(pose_of(self.scene, part.centre, jnp.zeros(())))[:2], part.angle
            else:
                frame = self.frame(part.centre, part.angle)
            standing.append(
                (Box(place, part.size, angle) if isinstance(part, Box) else Disc(place, part.radius), frame)
            )
        return standing

    @property
    def outlines(self) -> Iterator[Vector]:
        """The outline of each obstacle on the ground [m], in the ground's axes."""
        for part, frame in self.standing:
            line, surface = outline_of(part), self.scene.surface
            yield surface.charted(tuple(line.T))[0] if frame is ABOVE else tuple(feet(surface, frame, line)[0].T)

    def gaps(self, corners: Float[np.ndarray, "footprints 4 axes"]) -> Float[np.ndarray, "footprints obstacles"]:
        """The exact distance [m] of footprints from every obstacle, in its tangent plane or along its normal; negative for an
        overlap."""
        gaps = np.empty((len(corners), len(self.standing)))
        for number, (part, frame) in enumerate(self.standing):
            polygon, above = seen_from(frame[None], corners)
            reach = float(part.radius) if isinstance(part, Disc) else np.linalg.norm(part.corners[0])
            gaps[:, number] = np.maximum(part.distance(np.asarray(polygon[:, 0])), np.ravel(above) - reach)
        return gaps

    @functools.cached_property
    def gaps_at_ends(self) -> dict[str, Float[np.ndarray, " obstacles"]]:
        """The distance [m] of the footprint from every obstacle at the launch and at the goal, negative for an overlap; at the
        best of all headings if the goal has none."""
        goal, whole_turn = self.goal, jnp.linspace(-np.pi, np.pi, HEADINGS, endpoint=False)
        headings = whole_turn if goal.heading is None else [goal.heading]
        poses = [self.start_pose, *(pose_of(self.scene, goal.place, heading) for heading in headings)]
        corners = np.asarray(corners_of(self.scene.dynamics, self.footprint, jnp.stack(poses, axis=1)))
        launch, *goals = self.gaps(corners)
        return {"launch": launch, "goal": max(goals, key=lambda goal: goal.min(initial=np.inf))}

    @property
    def clearance(self) -> float:
        """The clearance [m] to keep at first, which the start and the goal leave."""
        gaps = (0.5 * float(gap.min(initial=np.inf)) for gap in self.gaps_at_ends.values())
        return min(RESERVE * float(self.footprint.length), *gaps)


def checked_problem(
    scene: Scene,
    launch: Launch,
    goal: Goal,
    t1: ArrayLike,
    obstacles: Iterable[Box | Disc] = (),
    limits: Limits | None = None,
    footprint: Footprint | None = None,
    *,
    tolerance: float = 1e-6,
    in_haste: bool = False,
) -> Problem:
    """A planning problem; raises `ValueError` unless its parts are legal and its start and goal are free."""
    require_kind(scene, "scene", Scene, ", as plans know one vehicle, the Stroller")
    require_run(scene, launch, t1, tolerance, (Scene, Launch), "plan each problem by a call of its own")
    scene.check(launch)
    if scene.heading == "projected" and not isinstance(scene.surface, Plane):
        raise ValueError("heading = 'projected' must be 'intrinsic' for a plan on a curved ground")
    require_kind(goal, "goal", Goal)
    validation.require_scalars(
        {f"goal.{name}": getattr(goal, name) for name in ("heading", "speed", "within")}, "plan one goal at a time"
    )
    limits = Limits() if limits is None else limits
    require_kind(limits, "limits", Limits)
    footprint = Footprint(*(part * scene.body.wheelbase for part in DRAWN)) if footprint is None else footprint
    require_kind(footprint, "footprint", Footprint)
    duration = float(np.asarray(t1))
    problem = Problem(scene, launch, goal, duration, require_obstacles(obstacles), limits, footprint, in_haste)
    centres = {f"obstacles[{number}]": part.centre for number, part in enumerate(problem.obstacles)}
    for name, place in {"goal": goal.place, **centres}.items():
        try:
            validation.require_all(scene.surface.place_bounds(place, scene.body.wheelbase))
        except ValueError as error:
            remark = "; a heading is an argument of its own, heading=" if name == "goal" and len(place) == 3 else ""
            raise ValueError(f"{name}: {error}{remark}") from None
    if not np.all(np.isfinite(problem.goal_pose)):
        raise ValueError(f"goal: place = {goal.place} must be on the ground, where it has no finite position")
    if problem.distance > FARTHEST * float(scene.body.wheelbase):
        away = f"it is {problem.distance:.4g} m from the launch, more than {FARTHEST:.0f} wheelbases"
        raise ValueError(f"goal: place = {shown(goal.place)} is too far: {away}; plan a long way goal by goal")
    # A limit of the speed is checked by the plan.
    is_free = not in_haste and limits.speed is None
    if is_free and (speed := problem.distance / duration) > FASTEST:
        validation.warn(
            f"goal: place = {shown(goal.place)} is {problem.distance:.0f} m from the launch, a mean speed of {speed:.3g} m/s: "
            "was it in cm or mm? Or take a longer t1"
        )
    for number, (part, frame) in enumerate(problem.standing):
        if frame is ABOVE:
            continue
        parts = np.multiply.outer(SHARES, outline_of(part))
        cosines = np.asarray(feet(scene.surface, frame, parts.reshape(-1, 2))[1]).reshape(len(SHARES), -1)
        steep = ~np.all(cosines >= STEEPEST, axis=1)
        if steep.any():
            name, sizes = ("radius", [part.radius]) if isinstance(part, Disc) else ("size", part.size)
            # The least share may be too large, too.
            shares = [1.0, SHARES[np.argmax(steep) - 1] if np.argmax(steep) else 0.0]
            own, most = (" x ".join(f"{share * float(size):.3g}" for size in sizes) for share in shares)
            raise ValueError(
                f"obstacles[{number}]: {name} = {own} m must be at most {most} m at this place, because obstacles are flat, "
                "and the ground turns by more than 45 degrees beneath it: use several smaller ones"
            )
    why = "limits; no plan can keep a limit that is broken at its ends"
    for owner, part, name in (("launch", launch, "steering"), ("launch", launch, "speed"), ("goal", goal, "speed")):
        low, high = limits.ranges().get(name, (None, None))
        require(getattr(part, name), f"{owner}.{name}", at_least=low, at_most=high, why=why)
    length = float(footprint.length)
    for name, gaps in problem.gaps_at_ends.items():
        if (gap := gaps.min(initial=np.inf)) <= TOUCHING * length:
            obstacle = f"obstacles[{np.argmin(gaps)}]"
            met = f"touches {obstacle}" if gap > -TOUCHING * length else f"overlaps {obstacle} by {-gap:.3g} m"
            place = ", ".join(f"{float(number):g}" for number in getattr(problem, name).place)
            raise ValueError(
                f"{name}: at place = ({place}) the footprint {met}: move the {name} or the obstacle by "
                f"{RESERVE * length - gap:.2g} m, or pass a smaller footprint"
            )
    return problem
