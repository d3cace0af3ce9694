"""Meshes of simple solids, in a body's own axes."""

import numpy as np
from jaxtyping import Float

from .stage import Mesh

#: Number of corners of a circle, and of sectors with alternating colours.
SEGMENTS, SECTORS = 48, 6


def revolved(profile: list[tuple[float, float]] | Float[np.ndarray, "points 2"], colour: int) -> Mesh:
    """The solid of revolution of a profile about the z axis: points (distance from the axis, z) [m], from the top
    downwards."""
    profile = np.asarray(profile, dtype=float)
    angle = np.linspace(0.0, 2.0 * np.pi, SEGMENTS + 1)
    radius, height = profile.T
    vertices = np.stack(
        [
            radius * np.cos(angle)[:, None],
            radius * np.sin(angle)[:, None],
            np.broadcast_to(height, (len(angle), len(height))),
        ],
        axis=-1,
    )
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
    return (
        Mesh(mesh.vertices, mesh.triangles[first], colours[0]),
        Mesh(mesh.vertices, mesh.triangles[~first], colours[1]),
    )


def rod(radius: float, begin: float, end: float, knob: float, colour: int) -> Mesh:
    """A round rod along the z axis, with a knob of another radius about its upper end [m]."""
    polar = np.linspace(0.0, np.pi - np.arcsin(min(1.0, radius / knob)), 13)
    cap = [(knob * np.sin(a), end + knob * np.cos(a)) for a in polar]
    return revolved([*cap, (radius, begin)], colour)


def box(lengths: tuple[float, float, float], centre: tuple[float, float, float], colour: int) -> Mesh:
    """A box with edges along the axes [m]."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    vertices = np.concatenate([corners[list(side)] for side in sides]) * lengths + np.asarray(centre)
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
    spokes = [
        bar(
            (-inner * np.cos(a), 0.0, -inner * np.sin(a)),
            (inner * np.cos(a), 0.0, inner * np.sin(a)),
            0.35 * half,
            colour,
        )
        for a, colour in zip(np.pi * np.arange(3) / 3.0, (colours[1], colours[0], colours[0]), strict=True)
    ]
    return tyre._replace(vertices=tyre.vertices @ rotation), *spokes
