"""The contents of pages and films: arenas, and bodies, traces, arrows and curves on stages.

This module does not depend on tops or strollers. Lengths are in metres in the fixed frame (x, y, z), z up; times in
seconds.
"""

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from ..geometry import AbstractSurface
from ..text import Unit, in_unit, require_unit_of

#: Points [m], such as one for each time.
Points = Float[np.ndarray, "points 3"]

#: JAX's arrays for a page, or NumPy's for a picture.
Kind = TypeVar("Kind", Array, np.ndarray)

#: Times [s] that curves mark, and what they are, such as (1.2, "turned over at 1.2 s").
Marks = tuple[tuple[float, str], ...]

#: The parts of a drawing, and a function of your own system, the time and the state that returns them, or `None` for a default.
Parts = Sequence["AbstractPart | Line"]
Drawing = Callable[..., Parts]
Draw = Drawing | None


class Mesh(NamedTuple):
    """Triangles of one colour, 0xrrggbb, in the axes of their body."""

    vertices: Float[np.ndarray, "vertices 3"]
    triangles: Int[np.ndarray, "triangles 3"]
    colour: int


class Body(NamedTuple):
    """A rigid body: position of its origin, rotation as a quaternion (x, y, z, w) for each time, and meshes."""

    position: Points
    orientation: Float[np.ndarray, "times 4"]
    meshes: tuple[Mesh, ...]


class Trace(NamedTuple):
    """A line that grows over time, relative to the moving point `about` if there is one.

    `shown`: whether a page shows it at first.
    """

    name: str
    points: Points
    colour: int
    width: float
    about: Points | None = None
    shown: bool = True


class Arrow(NamedTuple):
    """A vector that changes over time: its start, and its components in `unit`; without a unit, a line without a tip.

    It is drawn `scale` metres long per SI unit, and no longer than `limit` [m]. With `through`, it is visible through the
    body and has a ball at its start. `shown`: whether a page shows it at first. `factor` converts its size, in SI units, to
    `unit`.
    """

    name: str
    start: Points
    vector: Points
    unit: str
    scale: float
    colour: int
    width: float
    limit: float | None = None
    through: bool = False
    shown: bool = True
    factor: float = 1.0


class Curve(NamedTuple):
    """A number over time, and its unit, which is empty for a number without one.

    `factor` converts the values, in SI units, to `unit`.
    """

    name: str
    unit: str
    values: Float[np.ndarray, " times"]
    factor: float = 1.0


class Show(NamedTuple):
    """The drawing of one run: `size` is a length [m] of the body, and `colour` the colour of its curves.

    `normal` is the arena's unit normal at the body, towards the body; `note` states what the model omits; `marks` are marked
    in the curves.
    """

    name: str
    colour: int
    times: Float[np.ndarray, " times"]
    normal: Points
    size: float
    bodies: tuple[Body, ...]
    traces: tuple[Trace, ...]
    arrows: tuple[Arrow, ...]
    curves: tuple[Curve, ...]
    note: str = ""
    marks: Marks = ()


class Arena(NamedTuple):
    """A part of a surface: its mesh, the lines on it and their spacing as text, and a normal towards the body.

    `axes`: for a level rectangle without lines, the name of each axis, and the centre and the scale at which its values are
    drawn; the page draws lines at round values.
    """

    mesh: Mesh
    lines: tuple[Points, ...]
    spacing: str
    normal: Float[np.ndarray, " 3"]
    axes: tuple[tuple[str, float, float], ...] = ()


class Stage(NamedTuple):
    """An arena and the runs on it, seen by one camera, which follows runs that go far, or all runs if `follows` is
    true; `rise` is its height above the ground in units of its distance along the ground."""

    title: str
    arena: Arena
    shows: tuple[Show, ...]
    follows: bool = False
    rise: float = 0.3


def curves_in(stages: list[Stage], unit: Unit) -> list[Stage]:
    """The stages with their curves, and the sizes of their arrows, in other units, as for `in_unit`.

    **Raises:** `ValueError` if no curve can be drawn in the unit.
    """
    if unit is None:
        return stages
    curves = [curve for stage in stages for show in stage.shows for curve in show.curves]
    require_unit_of(unit, {curve.name: curve.unit or "1" for curve in curves})

    def shown_in(show: Show) -> Show:
        curves, arrows = (
            tuple(part._replace(**converted(part.unit, unit)) for part in parts) for parts in (show.curves, show.arrows)
        )
        return show._replace(curves=curves, arrows=arrows)

    return [stage._replace(shows=tuple(map(shown_in, stage.shows))) for stage in stages]


def converted(si: str, unit: Unit) -> dict[str, str | float]:
    """The fields `unit` and `factor` of what is shown in another unit, as for `in_unit`."""
    return dict(zip(("unit", "factor"), in_unit(si, unit), strict=True))


#: Colours of a page's runs, for the curves, their numbers and one half of the body, with a contrast of 4.5 to 1 on white and to
#: white on them; arrows have other colours.
COLOURS = (0xC8412B, 0x2A6FB0, 0x28794C, 0x8C5A3C, 0xB8437F, 0x2A7A87)

#: Colour of the other half of the body.
PALE = 0xF4E9D2
DARK = 0x3A3A3E


def finite(points: Points) -> Points:
    """Points, with NaN replaced by the last finite point before."""
    is_finite = np.all(np.isfinite(points), axis=-1)
    last = np.maximum.accumulate(np.where(is_finite, np.arange(len(points)), 0))
    return np.nan_to_num(points[last])


def css(colour: int) -> str:
    """A colour in the notation of CSS and matplotlib."""
    return f"#{colour:06x}"


def quaternion(rotation: Float[Kind, "*times 3 3"]) -> Float[Kind, "*times 4"]:
    """The quaternions (x, y, z, w) of rotation matrices, from their largest components (Shepperd 1978)."""
    xp, m = rotation.__array_namespace__(), [[rotation[..., i, j] for j in range(3)] for i in range(3)]
    trace = m[0][0] + m[1][1] + m[2][2]
    # Four times the products of the quaternion's components, one row each.
    skew = (m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1])
    symmetric = (m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1])
    squares = [1.0 - trace + 2.0 * m[k][k] for k in range(3)]
    rows = [
        xp.stack([squares[0], symmetric[0], symmetric[1], skew[0]], axis=-1),
        xp.stack([symmetric[0], squares[1], symmetric[2], skew[1]], axis=-1),
        xp.stack([symmetric[1], symmetric[2], squares[2], skew[2]], axis=-1),
        xp.stack([*skew, 1.0 + trace], axis=-1),
    ]
    row, largest = rows[0], rows[0][..., 0]
    for k in range(1, 4):
        square = rows[k][..., k]
        row, largest = xp.where((square > largest)[..., None], rows[k], row), xp.maximum(square, largest)
    return row / xp.sqrt(xp.sum(row * row, axis=-1, keepdims=True))


# Meshes of simple solids, in a body's own axes.

#: Number of corners of a circle, and of sectors with alternating colours.
SEGMENTS, SECTORS = 48, 6


def revolved(profile: list[tuple[float, float]] | Float[np.ndarray, "points 2"], colour: int) -> Mesh:
    """The solid of revolution of a profile about the z axis: points (distance from the axis, z) [m], from the top
    downwards."""
    profile = np.asarray(profile, dtype=float)
    angle = np.linspace(0.0, 2.0 * np.pi, SEGMENTS + 1)
    radius, height = profile.T
    corners = radius * np.cos(angle)[:, None], radius * np.sin(angle)[:, None], height
    vertices = np.stack(np.broadcast_arrays(*corners), axis=-1)
    return Mesh(vertices.reshape(-1, 3), of_grid(len(angle), len(profile)), colour)


def of_grid(rows: int, columns: int) -> np.ndarray:
    """Triangles of a grid of vertices, given row by row."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return np.concatenate([np.stack([a, d, b], axis=-1), np.stack([b, d, c], axis=-1)])


def ball(radius: float, colours: tuple[int, int]) -> tuple[Mesh, Mesh]:
    """A ball about the origin, in sectors about the z axis with two alternating colours."""
    polar = np.linspace(0.0, np.pi, 25)
    return striped(radius * np.stack([np.sin(polar), np.cos(polar)], axis=-1), colours)


def striped(profile: Float[np.ndarray, "points 2"], colours: tuple[int, int]) -> tuple[Mesh, Mesh]:
    """The solid of revolution of a profile, in sectors about the z axis with two alternating colours."""
    mesh = revolved(profile, colours[0])
    middles = mesh.vertices[mesh.triangles].mean(axis=1)
    first = np.floor(np.arctan2(middles[:, 1], middles[:, 0]) / np.pi * SECTORS / 2.0).astype(int) % 2 == 0
    return mesh._replace(triangles=mesh.triangles[first]), Mesh(mesh.vertices, mesh.triangles[~first], colours[1])


def rod(radius: float, begin: float, end: float, knob: float, colour: int) -> Mesh:
    """A round rod along the z axis, with a knob of another radius about its upper end [m]."""
    polar = np.linspace(0.0, np.pi - np.arcsin(min(1.0, radius / knob)), 13)
    cap = [(knob * np.sin(a), end + knob * np.cos(a)) for a in polar]
    return revolved([*cap, (radius, begin)], colour)


def box(lengths: ArrayLike | tuple[float, float, float], centre: tuple[float, float, float], colour: int) -> Mesh:
    """A box with edges along the axes [m]."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    vertices = np.concatenate([corners[list(side)] for side in sides]) * np.asarray(lengths) + np.asarray(centre)
    triangles = np.concatenate([[[4 * k, 4 * k + 1, 4 * k + 2], [4 * k, 4 * k + 2, 4 * k + 3]] for k in range(6)])
    return Mesh(vertices, triangles, colour)


def bar(begin: tuple[float, float, float], end: tuple[float, float, float], radius: float, colour: int) -> Mesh:
    """A round bar between two points [m]."""
    foot, direction = np.asarray(begin), np.subtract(end, begin)
    tube = revolved([(0.0, 1.0), (radius, 1.0), (radius, 0.0), (0.0, 0.0)], colour)
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(z, x), direction])
    return tube._replace(vertices=tube.vertices @ axes + foot)


def wheel(radius: float, width: float, colours: tuple[int, int]) -> tuple[Mesh, ...]:
    """A wheel about the y axis: a tyre, and spokes of another colour that show that it rolls."""
    half, inner = width / 2.0, 0.78 * radius
    edge = [(inner, half), (radius, half), (radius, -half), (inner, -half), (inner, half)]
    tyre = revolved(edge, colours[0])
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    ends = [(inner * np.cos(a), 0.0, inner * np.sin(a)) for a in np.pi * np.arange(6) / 3.0]
    colours_of_spokes = (colours[1], colours[0], colours[0])
    spokes = [bar(ends[k + 3], ends[k], 0.35 * half, colour) for k, colour in enumerate(colours_of_spokes)]
    return tyre._replace(vertices=tyre.vertices @ rotation), *spokes


# The parts that draw your own system, for one state or for the states at many times.


class AbstractPart(eqx.Module):
    """A rigid part of a drawing, with its middle at `place` [m]: first it spins about the y axis, then it leans about the x
    axis, then it turns to its heading about the z axis [rad]; `colour`: 0xrrggbb, by default that of the run, but dark for a
    `Wheel`."""

    place: Float[Array, "*times 3"] = eqx.field(converter=jnp.asarray)
    heading: Float[ArrayLike, "*times"] = eqx.field(default=0.0, kw_only=True)
    lean: Float[ArrayLike, "*times"] = eqx.field(default=0.0, kw_only=True)
    spin: Float[ArrayLike, "*times"] = eqx.field(default=0.0, kw_only=True)
    colour: int | None = eqx.field(default=None, kw_only=True, static=True)


class Box(AbstractPart):
    """A box with edges of these `lengths` along its own axes [m]; `place`, `heading`, `lean`, `spin`, `colour`: as for all
    parts.

    **Example:**

    >>> from nonholonomic.views import Box
    >>> Box((1.0, 2.0, 0.1), (0.8, 0.4, 0.2), heading=0.5).place.tolist()
    [1.0, 2.0, 0.1]
    """

    lengths: Float[Array, "*times 3"] = eqx.field(converter=jnp.asarray)


class Wheel(AbstractPart):
    """A wheel of a `radius` [m] about its own y axis, with spokes that show its `spin`, dark by default; the rest as for
    `Box`."""

    radius: Float[ArrayLike, "*times"]


class Disc(Wheel):
    """A thin disc of a `radius` [m] about its own y axis, in the colour of the run by default; the rest as for `Box`."""


class Ball(Wheel):
    """A ball of a `radius` [m], with sectors that show how it turns; the rest as for `Box`."""


class Line(eqx.Module):
    """A line between two moving points [m], such as a rod or a spring; `width` [m], by default 3 % of the size of the
    drawing; `colour`: 0xrrggbb, dark by default."""

    begin: Float[Array, "*times 3"] = eqx.field(converter=jnp.asarray)
    end: Float[Array, "*times 3"] = eqx.field(converter=jnp.asarray)
    width: float | None = eqx.field(default=None, kw_only=True, static=True)
    colour: int = eqx.field(default=DARK, kw_only=True, static=True)


def meshes_of(part: Any, colour: int) -> tuple[Mesh, ...]:
    """The meshes of a rigid part at one time. **Arguments:** `colour`: that of the run."""
    colour = colour if part.colour is None else part.colour
    if isinstance(part, Box):
        return (box(part.lengths, (0.0, 0.0, 0.0), colour),)
    radius = float(part.radius)
    if isinstance(part, Ball):
        return ball(radius, (colour, PALE))
    if isinstance(part, Disc):
        return (bar((0.0, 0.06 * radius, 0.0), (0.0, -0.06 * radius, 0.0), radius, colour),)
    return wheel(radius, 0.3 * radius, (DARK if part.colour is None else colour, PALE))


# The part of a surface on which runs take place. It is drawn from the chart of the surface or from nearest points.

#: Vertices along each side of the mesh.
FINE = 97

GREY = 0xEEF1F4

#: Greatest number of lines in each direction.
MOST_LINES = 50

#: Distances between lines on the arena: these numbers times a power of ten [m], or these numbers [deg].
LENGTHS = (1.0, 2.0, 5.0, 10.0)
DEGREES = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0)


def arena(
    surface: AbstractSurface, points: Points, normal: Float[np.ndarray, " 3"], margin: float, spacing: float
) -> Arena:
    """The part of a surface around the given points.

    **Arguments:**

    - `surface`: any surface.
    - `points`: points [m] where bodies touch the surface, in the fixed frame.
    - `normal`: towards the body, at one point of the run.
    - `margin`: distance [m] by which the drawn part extends beyond the points; `spacing`: approximate distance of the
      lines [m].

    **Returns:** an `Arena`.
    """
    points = points[np.all(np.isfinite(points), axis=-1)]
    chart = _Chart(surface, points)
    sides, marks, words = [], [], []
    for number, (place, is_angle, length) in enumerate(zip(chart.places, chart.angles, chart.lengths, strict=True)):
        low, high = place.min() - margin / length, place.max() + margin / length
        if is_angle and high - low >= 2.0 * np.pi:
            low, high = -np.pi, np.pi
        low, high = chart.legal(number, low, high)
        step, text = nice(max(spacing / length, (high - low) / MOST_LINES), is_angle)
        sides.append(np.linspace(low, high, FINE))
        marks.append(step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1))
        words.append(text)
    vertices = chart.grid(*np.meshgrid(*sides, indexing="ij")).reshape(-1, 3)
    # One grid for all lines: evaluating a surface is expensive.
    lines = [(np.full(FINE, mark), sides[1]) for mark in marks[0]]
    lines += [(sides[0], np.full(FINE, mark)) for mark in marks[1]]
    drawn_lines = tuple(chart.grid(*np.moveaxis(np.array(lines), 1, 0))) if lines else ()
    # The front of the mesh is on the side of the normal at the first point.
    triangles = of_grid(FINE, FINE)
    corners = vertices[triangles]
    nearest = corners[np.argmin(np.linalg.norm(corners.mean(axis=1) - points[0], axis=-1))]
    if np.cross(nearest[1] - nearest[0], nearest[2] - nearest[0]) @ normal <= 0.0:
        triangles = triangles[:, ::-1]
    return Arena(Mesh(vertices, triangles, GREY), drawn_lines, "grid " + " x ".join(dict.fromkeys(words)), normal)


# Compile the whole: otherwise every operation would be compiled for every shape.
@eqx.filter_jit
def _charted(surface: AbstractSurface, place: tuple) -> tuple:
    return surface.chart(place)[0]


class _Chart:
    """Two numbers, lengths or angles, for the places of a surface. If these are positions, the numbers are lengths in a tangent
    plane, whose nearest points of the surface are the places.

    - `places`: both numbers at the given points; `angles`: whether a number is an angle; `lengths`: the least length [m]
      along the surface per unit of a number, at these places.
    """

    def __init__(self, surface: AbstractSurface, points: Points):
        self.surface, self.is_patch = surface, len(surface.coordinates) == 3
        if self.is_patch:
            self.middle = fixed(surface, _charted(surface, own(surface, points.mean(axis=0))))
            self.axes = np.stack([fixed(surface, axis) for axis in surface.chart(tuple(own(surface, self.middle)))[1:]])
            self.places = list(((points - self.middle) @ self.axes.T).T)
            self.angles, self.lengths = [False, False], [1.0, 1.0]
            return
        self.angles = [unit == "rad" for _, unit in surface.coordinates]
        places = [np.asarray(number, dtype=float) for number in surface.place_at(own(surface, points.T))]
        self.places = [np.unwrap(place) if angle else place for place, angle in zip(places, self.angles, strict=True)]
        start = self.grid(*self.places)
        shifts = [[place + 1e-6 * (k == number) for k, place in enumerate(self.places)] for number in (0, 1)]
        steps = [np.linalg.norm(self.grid(*shifted) - start, axis=-1) for shifted in shifts]
        self.lengths = [max(float(np.min(step)) / 1e-6, 1e-300) for step in steps]

    def grid(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """The points [m] at two numbers, in the fixed frame."""
        place = first, second
        if self.is_patch:
            flat = self.middle + first[..., None] * self.axes[0] + second[..., None] * self.axes[1]
            place = own(self.surface, np.moveaxis(flat, -1, 0))
        return fixed(self.surface, _charted(self.surface, place))

    def legal(self, number: int, low: float, high: float) -> tuple[float, float]:
        """The part of a range in which a number is legal: a latitude ends at the poles."""
        if self.is_patch:
            return low, high
        candidates = np.linspace(low, high, 401)
        place = [np.full_like(candidates, np.median(values)) for values in self.places]
        place[number] = candidates
        recovered = np.asarray(self.surface.place_at(_charted(self.surface, tuple(place)))[number])
        difference = recovered - candidates
        if self.angles[number]:
            difference = (difference + np.pi) % (2.0 * np.pi) - np.pi
        legal = candidates[np.abs(difference) < 1e-6 * (1.0 + np.abs(candidates))]
        return (low, high) if len(legal) < 2 else (legal[0], legal[-1])


def own(surface: AbstractSurface, position: np.ndarray) -> tuple:
    """A position (3, ...) in the fixed frame, converted to the surface's axes."""
    return surface.in_own_axes(tuple(np.asarray(part, dtype=float) for part in position))


def fixed(surface: AbstractSurface, vector: tuple, xp: ModuleType = np) -> np.ndarray:
    """A vector in the surface's axes, converted to the fixed frame, (..., 3). **Arguments:** `xp`: NumPy, or `jax.numpy` inside
    transformations."""
    components = xp.broadcast_arrays(*(0.0 if part is None else xp.asarray(part) for part in vector))
    return xp.stack(surface.in_fixed_frame(components), axis=-1)


def nice(step: float, is_angle: bool) -> tuple[float, str]:
    """The next round length [m] or angle [rad], and its text."""
    if is_angle:
        degrees = next((candidate for candidate in DEGREES if candidate >= 0.999 * np.degrees(step)), DEGREES[-1])
        return float(np.radians(degrees)), f"{degrees:.3g}°"
    power = 10.0 ** np.floor(np.log10(step))
    length = float(power * next(candidate for candidate in LENGTHS if candidate * power >= 0.999 * step))
    for unit, metres in (("m", 1.0), ("cm", 1e-2), ("mm", 1e-3)):
        if length >= 0.999 * metres:
            return length, f"{length / metres:.3g} {unit}"
    return length, f"{length:.1e} m"
