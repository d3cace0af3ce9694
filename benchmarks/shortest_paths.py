"""Lengths of the shortest paths on an empty plane between two poses, with a least turning radius of 1.

Forwards only: Dubins, Am. J. Math. 79 (1957) 497. With reverse: Reeds and Shepp, Pacific J. Math. 145 (1990) 367; the numbers
of their formulas are in the comments.
"""

from collections.abc import Iterator

import numpy as np
from numpy import arctan2, cos, hypot, pi, sin, sqrt


def wrapped(angle: float) -> float:
    """An angle in [-pi, pi)."""
    return (angle + pi) % (2.0 * pi) - pi


def dubins(x: float, y: float, turn: float) -> float:
    """Length of the shortest path forwards from the origin, along the x axis, to (`x`, `y`), turned by `turn` [rad]."""
    lengths = []
    for side in (1.0, -1.0):
        y_here, turn_here = side * y, side * turn
        # The centres of the circles to the left of the start and to the left or right of the goal.
        for same in (1.0, -1.0):
            ahead, aside = x - same * sin(turn_here), y_here - 1.0 + same * cos(turn_here)
            away, angle = hypot(ahead, aside), arctan2(aside, ahead)
            if same < 0.0 and away < 2.0:
                continue
            straight = away if same > 0.0 else sqrt(away**2 - 4.0)
            angle += 0.0 if same > 0.0 else arctan2(2.0, straight)
            last = turn_here - angle if same > 0.0 else angle - turn_here
            lengths.append(angle % (2.0 * pi) + straight + last % (2.0 * pi))
            if same > 0.0 and away <= 4.0:
                # The middle circle touches both of them, on one side of the line between them or on the other.
                apex = np.arccos(away / 4.0)
                for sign in (1.0, -1.0):
                    toward = angle + sign * apex
                    first, middle = toward + pi / 2.0, pi + 2.0 * sign * apex
                    lengths.append(first % (2.0 * pi) + middle % (2.0 * pi) + (turn_here - first + middle) % (2.0 * pi))
    return float(min(lengths))


def _words(x: float, y: float, turn: float) -> Iterator[tuple[float, ...]]:
    """Lengths of the pieces of Reeds and Shepp's words that begin forwards and to the left; negative ones are in reverse."""
    same, other = (x - sin(turn), y - 1.0 + cos(turn)), (x + sin(turn), y - 1.0 - cos(turn))
    (near, near_angle), (far, far_angle) = ((hypot(*v), arctan2(v[1], v[0])) for v in (same, other))
    if near_angle >= 0.0 and (last := wrapped(turn - near_angle)) >= 0.0:  # 8.1
        yield near_angle, near, last
    if near <= 4.0:  # 8.3, 8.4
        u = -2.0 * np.arcsin(near / 4.0)
        t = wrapped(near_angle + u / 2.0 + pi)
        if t >= 0.0:
            yield t, u, wrapped(turn - t + u)
    if far >= 2.0:
        u = sqrt(far**2 - 4.0)
        t = wrapped(far_angle + arctan2(2.0, u))
        if t >= 0.0 and (v := wrapped(t - turn)) >= 0.0:  # 8.2
            yield t, u, v
        u = 4.0 - sqrt(far**2 - 4.0)
        t = wrapped(arctan2((4.0 - u) * other[0] - 2.0 * other[1], -2.0 * other[0] + (u - 4.0) * other[1]))
        if u <= 0.0 <= t and (v := wrapped(t - turn)) >= 0.0:  # 8.11
            yield t, pi / 2.0, u, pi / 2.0, v
        u, t = 2.0 - far, arctan2(other[0], -other[1])
        if u <= 0.0 <= t and (v := wrapped(t + pi / 2.0 - turn)) <= 0.0:  # 8.10
            yield t, pi / 2.0, u, v
    if near >= 2.0:  # 8.9
        straight = sqrt(near**2 - 4.0)
        u, t = 2.0 - straight, wrapped(near_angle + arctan2(straight, -2.0))
        if u <= 0.0 <= t and (v := wrapped(turn - pi / 2.0 - t)) <= 0.0:
            yield t, pi / 2.0, u, v
    for ratio, sign in (((2.0 + far) / 4.0, 1.0), ((20.0 - far**2) / 16.0, -1.0)):  # 8.7, 8.8
        if 0.0 <= ratio <= 1.0:
            u = sign * np.arccos(ratio)
            v = -sign * u
            bend = wrapped(u - v)
            a, b = sin(u) - sin(bend), cos(u) - cos(bend) - 1.0
            t = arctan2(other[1] * a - other[0] * b, other[0] * a + other[1] * b)
            t = wrapped(t + pi if 2.0 * (cos(bend) - cos(v) - cos(u)) + 3.0 < 0.0 else t)
            last = wrapped(t - u + v - turn)
            if t >= 0.0 >= sign * last:
                yield t, u, u, last


def reeds_shepp(x: float, y: float, turn: float) -> float:
    """Length of the shortest path with reverse from the origin, along the x axis, to (`x`, `y`), turned by `turn` [rad]."""
    poses = [(x, y, turn), (x * cos(turn) + y * sin(turn), x * sin(turn) - y * cos(turn), turn)]
    lengths = [
        sum(map(abs, word))
        for x, y, turn in poses
        for flip in (1.0, -1.0)
        for side in (1.0, -1.0)
        for word in _words(flip * x, side * y, flip * side * turn)
    ]
    return float(min(lengths))
