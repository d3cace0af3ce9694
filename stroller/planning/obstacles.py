"""Obstacles and the footprint of the stroller, in the horizontal plane."""

from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.text import shown
from nonholonomic.validation import Bound, Bounded, as_number, require_kind

from ..model.vehicle import Stroller

#: The numbers of boxes and of discs are padded to a multiple of this, so that other problems use the same programs.
PADDING = 8

#: Distance [m] of the obstacles that pad a list.
FAR = 1e9

#: Length, width and rear overhang of the drawn vehicle, in units of the wheelbase.
DRAWN = (1.4, 0.87, 0.2)

#: Square of a length [m^2] that keeps the slope of a distance finite where the distance vanishes.
SMALLEST_SQUARE = 1e-18


def as_pair(value: Any) -> Any:
    """Two numbers as a tuple of arrays; anything else stays unchanged, for later checks."""
    try:
        return tuple(as_number(number) for number in tuple(value))
    except TypeError:
        return value


def require_pair(value: Any, name: str, example: str) -> None:
    """Raise `ValueError` unless the value is a pair of single numbers."""
    if not (isinstance(value, tuple) and len(value) == 2 and all(np.shape(number) == () for number in value)):
        raise ValueError(f"{name} = {shown(value)} must be a pair of numbers, such as {example}")


class Box(Bounded):
    """A rectangular obstacle in the coordinates x and y.

    **Arguments:**

    - `centre`: its middle (x, y) [m].
    - `size`: its lengths [m] along its own two axes, positive.
    - `angle`: angle [rad] from x to its first axis.

    **Raises:** `ValueError` for numbers out of range.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Box(centre=(1.0, 0.3), size=(0.5, 0.25))
    Box(centre=(1, 0.3) m, size=(0.5, 0.25) m, angle=0 rad)

    ```
    """

    units: ClassVar[dict[str, str]] = {"centre": "m", "size": "m", "angle": "rad"}

    centre: tuple[Float[Array, ""], ...] = eqx.field(converter=as_pair)
    size: tuple[Float[Array, ""], ...] = eqx.field(converter=as_pair)
    angle: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)

    def __check_init__(self):
        require_pair(self.centre, "centre", "(1.0, 0.5)")
        require_pair(self.size, "size", "(0.5, 0.25)")

    def bounds(self) -> Iterator[Bound]:
        for name in ("centre", "size"):
            numbers = getattr(self, name)
            for k, number in enumerate(numbers if isinstance(numbers, tuple) else ()):
                yield Bound(number, f"{name}[{k}]", above=0.0 if name == "size" else None)
        yield Bound(self.angle, "angle")

    @property
    def corners(self) -> Float[np.ndarray, "4 2"]:
        """The corners [m], counterclockwise."""
        cosine, sine = np.cos(float(self.angle)), np.sin(float(self.angle))
        own = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]]) * np.array(self.size, dtype=float) / 2.0
        return np.array(self.centre, dtype=float) + own @ np.array([[cosine, sine], [-sine, cosine]])

    def distance(self, polygon: Float[np.ndarray, "*n 4 2"]) -> Float[np.ndarray, "*n"]:
        """The exact distance [m] of polygons from the box, negative where they overlap."""
        return signed_distance(polygon, self.corners)


class Disc(Bounded):
    """A round obstacle in the coordinates x and y.

    **Arguments:**

    - `centre`: its middle (x, y) [m].
    - `radius`: its radius [m], positive.

    **Raises:** `ValueError` for numbers out of range.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Disc(centre=(1.0, 0.3), radius=0.2)
    Disc(centre=(1, 0.3) m, radius=0.2 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"centre": "m", "radius": "m"}

    centre: tuple[Float[Array, ""], ...] = eqx.field(converter=as_pair)
    radius: Float[Array, ""] = eqx.field(converter=as_number)

    def __check_init__(self):
        require_pair(self.centre, "centre", "(1.0, 0.5)")

    def bounds(self) -> Iterator[Bound]:
        for k, number in enumerate(self.centre if isinstance(self.centre, tuple) else ()):
            yield Bound(number, f"centre[{k}]")
        yield Bound(self.radius, "radius", above=0.0)

    def distance(self, polygon: Float[np.ndarray, "*n 4 2"]) -> Float[np.ndarray, "*n"]:
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

    length: Float[Array, ""] = eqx.field(converter=as_number)
    width: Float[Array, ""] = eqx.field(converter=as_number)
    rear: Float[Array, ""] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.length, "length", above=0.0)
        yield Bound(self.width, "width", above=0.0)
        yield Bound(self.rear, "rear", at_least=0.0)
        yield Bound(self.rear, "rear", at_most=self.length, why="the length")

    @classmethod
    def of(cls, body: Stroller) -> "Footprint":
        """The footprint of the vehicle that the pages draw."""
        return cls(*(part * body.wheelbase for part in DRAWN))

    def corners(self, place: Any, heading: Any, left: Any) -> Any:
        """The corners [m], (..., 4, 2), counterclockwise.

        **Arguments:** `place`: the rear axle (..., 2) [m]; `heading`, `left`: unit vectors of the stroller, seen from
        above, (..., 2).
        """
        front, half = self.length - self.rear, self.width / 2.0
        along = np.array([1.0, 1.0, 0.0, 0.0])[:, None] * front - np.array([0.0, 0.0, 1.0, 1.0])[:, None] * self.rear
        across = np.array([-1.0, 1.0, 1.0, -1.0])[:, None] * half
        return place[..., None, :] + along * heading[..., None, :] + across * left[..., None, :]


class Obstacles(eqx.Module):
    """The obstacles as arrays, padded: corners of the boxes (boxes, 4, 2), centres (discs, 2) and radii of the discs."""

    boxes: Float[Array, "boxes 4 2"]
    centres: Float[Array, "discs 2"]
    radii: Float[Array, " discs"]

    @classmethod
    def of(cls, obstacles: Sequence[Box | Disc]) -> "Obstacles":
        """Boxes and discs as arrays, padded."""
        boxes = np.array([box.corners for box in obstacles if isinstance(box, Box)]).reshape(-1, 4, 2)
        discs = [[*disc.centre, disc.radius] for disc in obstacles if isinstance(disc, Disc)]
        circles = np.array(discs, dtype=float).reshape(-1, 3)
        counts = (-(-len(parts) // PADDING) * PADDING for parts in (boxes, circles))
        return with_others_far_away(boxes, circles[:, :2], circles[:, 2], *counts)

    def padded(self, boxes: int, discs: int) -> "Obstacles":
        """The obstacles with others far away, so that there are so many boxes and discs."""
        arrays = np.asarray(self.boxes), np.asarray(self.centres), np.asarray(self.radii)
        return with_others_far_away(*arrays, boxes, discs)

    def gaps(self, corners: Any) -> Any:
        """A lower bound [m] of the distance of footprints (..., 4, 2) from every obstacle, with a slope everywhere."""
        xp = np if isinstance(corners, np.ndarray) else jnp
        boxes = separation(corners[..., None, :, :], self.boxes)
        discs = disc_distance(corners[..., None, :, :], self.centres, self.radii)
        return xp.concatenate([boxes, discs], axis=-1)


def with_others_far_away(
    boxes: np.ndarray, centres: np.ndarray, radii: np.ndarray, most_boxes: int, most_discs: int
) -> Obstacles:
    """Obstacles with others far away; in NumPy, because JAX would compile a program for every number of obstacles."""
    far = Box((FAR, FAR), (1.0, 1.0)).corners
    more_boxes, more_discs = most_boxes - len(boxes), most_discs - len(radii)
    parts = (
        (boxes, np.broadcast_to(far, (more_boxes, 4, 2))),
        (centres, np.full((more_discs, 2), FAR)),
        (radii, np.ones(more_discs)),
    )
    return Obstacles(*(jnp.asarray(np.concatenate(part)) for part in parts))


def require_obstacles(obstacles: Any) -> tuple[Box | Disc, ...]:
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


# Distances between a convex polygon that moves and obstacles: convex polygons and discs. Arrays have the shape
# (..., vertices, 2), counterclockwise. The functions use only operators and methods that NumPy and JAX share, so that the
# optimiser and the check share them.


def _least(values: Any, axis: int) -> Any:
    """The least of some values along an axis, with the derivative of that value.

    JAX divides the derivative of `min` by the number of values that equal the result: if XLA computes a value again and
    rounds it differently, that number is zero.
    """
    xp: Any = np if isinstance(values, np.ndarray) else jnp
    return xp.take_along_axis(values, xp.expand_dims(values.argmin(axis), axis), axis).squeeze(axis)


def _next(polygon: Any) -> Any:
    return polygon[..., np.roll(np.arange(polygon.shape[-2]), -1), :]


def _face_gaps(polygon: Any, points: Any) -> Any:
    """How far points (..., points, 2) are outside each face of a polygon: (..., faces, points)."""
    edge = _next(polygon) - polygon
    length = (edge * edge).sum(-1) ** 0.5
    normal_x, normal_y = edge[..., 1] / length, -edge[..., 0] / length
    offset = normal_x * polygon[..., 0] + normal_y * polygon[..., 1]
    x, y = points[..., None, :, 0], points[..., None, :, 1]
    return normal_x[..., None] * x + normal_y[..., None] * y - offset[..., None]


def separation(first: Any, second: Any) -> Any:
    """Greatest gap [m] between two polygons across a face of either.

    This is the exact depth of penetration (negative) of polygons that overlap (the separating-axis theorem; Ericson,
    Real-Time Collision Detection (2005), section 5.2), and a lower bound of the distance of others.
    """
    gap, gap_back = (-_least(-_least(_face_gaps(*pair), -1), -1) for pair in ((first, second), (second, first)))
    return gap + (gap_back - gap).clip(0.0)


def _edge_distance(polygon: Any, points: Any) -> Any:
    """Distance [m] of points (..., points, 2) from the boundary of a polygon."""
    edge = (_next(polygon) - polygon)[..., :, None, :]
    along = points[..., None, :, :] - polygon[..., :, None, :]
    part = ((along * edge).sum(-1) / (edge * edge).sum(-1)).clip(0.0, 1.0)
    away = along - part[..., None] * edge
    return (_least((away * away).sum(-1), -2) + SMALLEST_SQUARE) ** 0.5


def signed_distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Distance [m] between two polygons, or minus the depth of penetration if they overlap."""
    gap = separation(first, second)
    corners = np.minimum(_edge_distance(first, second).min(-1), _edge_distance(second, first).min(-1))
    return np.where(gap > 0.0, corners, gap)


def disc_distance(polygon: Any, centre: Any, radius: Any) -> Any:
    """Distance [m] between a polygon and a disc, or minus the depth of penetration if they overlap."""
    point = centre[..., None, :]
    inside = _face_gaps(polygon, point).max(-2)[..., 0] < 0.0
    return _edge_distance(polygon, point)[..., 0] * (1.0 - 2.0 * inside) - radius
