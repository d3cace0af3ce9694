"""The contents of pages and animations: bodies that move, traces, arrows and curves, on stages with one arena each.

This module does not depend on tops or strollers. Lengths are in metres in the fixed frame (x, y, z), z up; times in
seconds.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..text import in_unit, require_unit_of

Points = Float[np.ndarray, "times 3"]


class Mesh(NamedTuple):
    """Triangles of one colour, 0xrrggbb, in the axes of their body."""

    vertices: Float[np.ndarray, "vertices 3"]
    triangles: Int[np.ndarray, "triangles 3"]
    colour: int


class Body(NamedTuple):
    """A rigid body: position of its origin, rotation as a quaternion (x, y, z, w) for each time, and meshes."""

    name: str
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
    """A vector that changes over time: its start, and its components in `unit`.

    It is drawn `scale` metres long per unit, and no longer than `limit` [m]. With `through`, it is visible through the
    body and has a ball at its start. `shown`: whether a page shows it at first.
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

    @property
    def drawn(self) -> Points:
        """The vectors with their drawn lengths [m]."""
        lengths = self.scale * np.linalg.norm(self.vector, axis=-1, keepdims=True)
        scaled = lengths if self.limit is None else np.minimum(lengths, self.limit)
        return self.scale * self.vector * np.divide(scaled, lengths, out=np.ones_like(lengths), where=lengths > 0.0)


class Curve(NamedTuple):
    """A number over time, with a label that names its unit.

    `factor` converts the values, in SI units, to the unit of the label.
    """

    label: str
    values: Float[np.ndarray, " times"]
    factor: float = 1.0

    @property
    def drawn(self) -> Float[np.ndarray, " times"]:
        """The values in the unit of the label."""
        return self.factor * self.values

    def drawn_in(self, unit: str | Sequence[str] | None) -> "Curve":
        """The curve in another unit, if its label ends in a unit that can be converted. **Arguments:** as for `in_unit`."""
        name, bracket, si = self.label.removesuffix("]").rpartition(" [")
        if unit is None or not bracket:
            return self
        text, factor = in_unit(si, unit)
        return self._replace(label=f"{name} [{text}]", factor=factor)


class Show(NamedTuple):
    """The drawing of one run: `size` is a length [m] of the body, and `colour` the colour of its curves.

    `normal` is the arena's unit normal at the body, towards the body; `note` states what the model omits.
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


class Arena(NamedTuple):
    """A part of a surface: its mesh, the lines on it and their spacing as text, and a normal towards the body."""

    mesh: Mesh
    lines: tuple[Float[np.ndarray, "points 3"], ...]
    spacing: str
    normal: Float[np.ndarray, " 3"]


class Stage(NamedTuple):
    """An arena and the runs on it, seen by one camera, which follows runs that go far, or all runs if `follows` is
    true; `rise` is its height above the ground in units of its distance along the ground."""

    title: str
    arena: Arena
    shows: tuple[Show, ...]
    follows: bool = False
    rise: float = 0.3


def curves_in(stages: list[Stage], unit: str | Sequence[str] | None) -> list[Stage]:
    """The stages with their curves in other units, as for `in_unit`.

    **Raises:** `ValueError` if no curve can be drawn in the unit.
    """
    labels = dict.fromkeys(curve.label for stage in stages for show in stage.shows for curve in show.curves)
    parts = [label.removesuffix("]").partition(" [") for label in labels]
    require_unit_of(unit, {name: si or "1" for name, _, si in parts})

    def in_units(show: Show) -> Show:
        return show._replace(curves=tuple(curve.drawn_in(unit) for curve in show.curves))

    return [stage._replace(shows=tuple(map(in_units, stage.shows))) for stage in stages]


#: Colours of a page's runs, for the curves and one half of the body; arrows have other colours.
COLOURS = (0xC8412B, 0x2A6FB0, 0x2E8B57, 0x8C5A3C, 0xD0679D, 0x3B9AA8)

#: Colour of the other half of the body.
PALE = 0xF4E9D2
DARK = 0x3A3A3E


def distinguished_by_colour(shows: tuple[Show, ...]) -> tuple[Show, ...]:
    """The shows of a stage; if there are several, the traces of each get its colour."""
    if len(shows) == 1:
        return shows
    return tuple(
        show._replace(traces=tuple(trace._replace(colour=show.colour) for trace in show.traces)) for show in shows
    )


def finite(points: Points) -> Points:
    """Points, with NaN replaced by the last finite point before."""
    is_finite = np.all(np.isfinite(points), axis=-1)
    last = np.maximum.accumulate(np.where(is_finite, np.arange(len(points)), 0))
    return np.nan_to_num(points[last])


def css(colour: int) -> str:
    """A colour in the notation of CSS and matplotlib."""
    return f"#{colour:06x}"


def turned(rotation: Float[np.ndarray, "times 3 3"]) -> Float[np.ndarray, "times 4"]:
    """Quaternions (x, y, z, w) of rotation matrices."""
    m = np.asarray(rotation, dtype=float)
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    # Four times the products of the quaternion's components; the column of the largest component has no cancellation.
    products = np.empty((len(m), 4, 4))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        products[:, i, i] = 1.0 - trace + 2.0 * m[:, i, i]
        products[:, i, j] = products[:, j, i] = m[:, i, j] + m[:, j, i]
        products[:, i, 3] = products[:, 3, i] = m[:, k, j] - m[:, j, k]
    products[:, 3, 3] = 1.0 + trace
    component = np.argmax(np.diagonal(products, axis1=1, axis2=2), axis=-1)
    axis = products[np.arange(len(m)), component]
    return axis / np.linalg.norm(axis, axis=-1, keepdims=True)


def matrices(orientation: Float[np.ndarray, "times 4"]) -> Float[np.ndarray, "times 3 3"]:
    """Rotation matrices of quaternions (x, y, z, w)."""
    x, y, z, w = orientation.T
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def nearest(times: Float[np.ndarray, " times"], at: Float[np.ndarray, " frames"]) -> Int[np.ndarray, " frames"]:
    """The indices of the times that are nearest to the given times."""
    index = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    return index - (at - times[index - 1] < times[index] - at)
