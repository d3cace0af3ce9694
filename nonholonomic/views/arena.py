"""The part of a surface on which runs take place. It is drawn from the chart of the surface or from nearest points."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..geometry import AbstractSurface, vector_of
from .meshes import of_grid
from .stage import Arena, Mesh

#: Vertices along each side of the mesh.
FINE = 97

GREY = 0xEEF1F4

#: Greatest number of lines in each direction.
MOST_LINES = 50

#: Distances between lines on the arena: these numbers times a power of ten [m], or these numbers [deg].
LENGTHS = (1.0, 2.0, 5.0, 10.0)
DEGREES = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0)


def arena(
    surface: AbstractSurface,
    points: Float[np.ndarray, "points 3"],
    normal: Float[np.ndarray, " 3"],
    margin: float,
    spacing: float,
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
    chart = _Patch(surface, points) if len(surface.coordinates) == 3 else _Chart(surface, points)
    (first, second), (step_1, step_2), words = chart.ranges(margin, spacing)
    mesh = chart.grid(*np.meshgrid(np.linspace(*first, FINE), np.linspace(*second, FINE), indexing="ij"))
    # One grid for all lines: evaluating a surface is expensive.
    grid_lines = [(np.full(FINE, a), np.linspace(*second, FINE)) for a in marks(first, step_1)]
    grid_lines += [(np.linspace(*first, FINE), np.full(FINE, b)) for b in marks(second, step_2)]
    lines = chart.grid(*np.moveaxis(np.array(grid_lines), 1, 0)) if grid_lines else ()
    ground = facing(Mesh(mesh.reshape(-1, 3), of_grid(FINE, FINE), GREY), points, normal)
    return Arena(ground, tuple(lines), words, normal)


def facing(mesh: Mesh, points: Float[np.ndarray, "points 3"], normal: Float[np.ndarray, " 3"]) -> Mesh:
    """The mesh of a surface with its front on the side to which `normal` points at the first of the points."""
    corners = mesh.vertices[mesh.triangles]
    nearest = corners[np.argmin(np.linalg.norm(corners.mean(axis=1) - points[0], axis=-1))]
    front = np.cross(nearest[1] - nearest[0], nearest[2] - nearest[0]) @ normal
    return mesh if front > 0.0 else mesh._replace(triangles=mesh.triangles[:, ::-1])


# Compile the whole: otherwise every operation would be compiled for every shape.
@eqx.filter_jit
def _charted(surface: AbstractSurface, place: tuple) -> tuple:
    return surface.chart(place)[0]


@eqx.filter_jit
def _nearest(surface: AbstractSurface, position: tuple) -> tuple:
    return surface.nearest(position)


class _Chart:
    """A surface whose places are two numbers, lengths or angles."""

    def __init__(self, surface: AbstractSurface, points: Float[np.ndarray, "points 3"]):
        self.surface = surface
        self.places = [np.asarray(number, dtype=float) for number in surface.place_at(own(surface, points.T))]
        self.angles = [unit == "rad" for _, unit in surface.coordinates]
        for number, angle in enumerate(self.angles):
            if angle:
                self.places[number] = np.unwrap(self.places[number])

    def grid(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return fixed(self.surface, _charted(self.surface, (first, second)))

    def ranges(self, margin: float, spacing: float) -> tuple[list[tuple[float, float]], list[float], str]:
        """The ranges of both numbers, the steps between lines, and their descriptions."""
        lengths = [self._length(number) for number in (0, 1)]
        intervals, steps, words = [], [], []
        for number, angle in enumerate(self.angles):
            low, high = self.places[number].min(), self.places[number].max()
            extra = margin / max(lengths[number], 1e-300)
            if angle and high - low + 2.0 * extra >= 2.0 * np.pi:
                low, high = -np.pi, np.pi
            else:
                low, high = low - extra, high + extra
            low, high = self._legal(number, low, high)
            step = nice(max(spacing / max(lengths[number], 1e-300), (high - low) / MOST_LINES), angle)
            intervals.append((low, high))
            steps.append(step)
            words.append(f"{np.degrees(step):.3g}°" if angle else in_words(step))
        return intervals, steps, "grid " + " x ".join(dict.fromkeys(words))

    def _length(self, number: int) -> float:
        """Least length [m] along the surface per unit of a number, at the run's places."""
        shifted = [place + 1e-6 * (k == number) for k, place in enumerate(self.places)]
        return float(np.min(np.linalg.norm(self.grid(*shifted) - self.grid(*self.places), axis=-1)) / 1e-6)

    def _legal(self, number: int, low: float, high: float) -> tuple[float, float]:
        """The part of a range in which numbers are legal: a latitude ends at the poles."""
        candidates = np.linspace(low, high, 401)
        place = [np.full_like(candidates, np.median(values)) for values in self.places]
        place[number] = candidates
        recovered = np.asarray(self.surface.place_at(_charted(self.surface, tuple(place)))[number])
        difference = recovered - candidates
        if self.angles[number]:
            difference = (difference + np.pi) % (2.0 * np.pi) - np.pi
        legal = candidates[np.abs(difference) < 1e-6 * (1.0 + np.abs(candidates))]
        return (low, high) if len(legal) < 2 else (legal[0], legal[-1])


class _Patch:
    """A surface whose places are positions: the nearest points to a part of its tangent plane."""

    def __init__(self, surface: AbstractSurface, points: Float[np.ndarray, "points 3"]):
        self.surface = surface
        self.middle = fixed(surface, _nearest(surface, own(surface, points.mean(axis=0))))
        _, east, north = surface.chart(tuple(own(surface, self.middle)))
        self.axes = np.stack([fixed(surface, east), fixed(surface, north)])
        self.spread = (points - self.middle) @ self.axes.T

    def grid(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        flat = self.middle + first[..., None] * self.axes[0] + second[..., None] * self.axes[1]
        return fixed(self.surface, _nearest(self.surface, own(self.surface, np.moveaxis(flat, -1, 0))))

    def ranges(self, margin: float, spacing: float) -> tuple[list[tuple[float, float]], list[float], str]:
        ranges = [(part.min() - margin, part.max() + margin) for part in self.spread.T]
        step = nice(max(spacing, max(high - low for low, high in ranges) / MOST_LINES), False)
        return ranges, [step, step], f"grid {in_words(step)}"


def own(surface: AbstractSurface, position: np.ndarray) -> tuple:
    """A position (3, ...) in the fixed frame, converted to the surface's axes."""
    return surface.in_own_axes(vector_of(np.asarray(part, dtype=float) for part in position))


def fixed(surface: AbstractSurface, vector: tuple) -> np.ndarray:
    """A vector in the surface's axes, converted to the fixed frame, (..., 3)."""
    example = next(part for part in vector if part is not None)
    components = vector_of(
        np.zeros_like(np.asarray(example, dtype=float)) if part is None else np.asarray(part) for part in vector
    )
    return np.stack(np.broadcast_arrays(*(np.asarray(part) for part in surface.in_fixed_frame(components))), axis=-1)


def nice(step: float, angle: bool) -> float:
    """The next round number."""
    if angle:
        return float(
            np.radians(next((candidate for candidate in DEGREES if candidate >= 0.999 * np.degrees(step)), DEGREES[-1]))
        )
    unit = 10.0 ** np.floor(np.log10(step))
    return float(unit * next(candidate for candidate in LENGTHS if candidate * unit >= 0.999 * step))


def in_words(length: float) -> str:
    """A round length with its unit."""
    for unit, metres in (("m", 1.0), ("cm", 1e-2), ("mm", 1e-3)):
        if length >= 0.999 * metres:
            return f"{length / metres:.3g} {unit}"
    return f"{length:.1e} m"


def marks(range_: tuple[float, float], step: float) -> np.ndarray:
    """The multiples of a step in a range."""
    return step * np.arange(np.ceil(range_[0] / step - 1e-9), np.floor(range_[1] / step + 1e-9) + 1)
