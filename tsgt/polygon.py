"""Plane polygons: point in polygon, distance to an edge, validity. Used by the configuration and by geofences."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

Point = tuple[float, float]

MIN_SEPARATION_M = 0.001
"""Corners and edges closer than this touch; areas are not staked out more finely."""


def edges(corners: Sequence[Point]) -> list[tuple[Point, Point]]:
    """Return the edges in order, including the one from the last corner to the first."""
    return list(itertools.pairwise([*corners, corners[0]]))


def contains(corners: Sequence[Point], point: Point) -> bool:
    """Return whether a point lies inside; for a point on the boundary either is possible.

    Even-odd rule with a ray to the east. Each edge includes its southern end and excludes its northern one, so that a
    ray through a corner counts once.
    """
    x, y = point
    inside = False
    for (ax, ay), (bx, by) in edges(corners):
        if (ay <= y) != (by <= y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            inside = not inside
    return inside


def distance_to_edge(point: Point, edge: tuple[Point, Point]) -> tuple[float, Point]:
    """Return the distance from a point to an edge, and the unit vector along the shortest path, of either sign.

    For a point on the edge the vector is the edge's normal.
    """
    (ax, ay), (bx, by) = edge
    along_x, along_y = bx - ax, by - ay
    length = math.hypot(along_x, along_y)
    part = ((point[0] - ax) * along_x + (point[1] - ay) * along_y) / length**2
    part = min(max(part, 0.0), 1.0)
    off_x, off_y = point[0] - ax - part * along_x, point[1] - ay - part * along_y
    distance = math.hypot(off_x, off_y)
    # Rounding makes the direction of a much shorter path than the edge unreliable.
    if distance <= 1e-9 * length:
        return distance, (-along_y / length, along_x / length)
    return distance, (off_x / distance, off_y / distance)


def check_simple(corners: Sequence[Point]) -> None:
    """Raise ValueError for a polygon that is not simple: corners coincide, edges cross, touch or fold back."""
    sides = edges(corners)
    n = len(sides)
    for i, (a, b) in enumerate(sides):
        if math.dist(a, b) < MIN_SEPARATION_M:
            hint = "; omit the last, the polygon is closed automatically" if i == n - 1 else ""
            raise ValueError(
                f"corner {i + 1} and corner {(i + 1) % n + 1} are the same point, {_format(a)}{hint}"
            )
    for i, j in itertools.combinations(range(n), 2):
        if _touch(sides[i], sides[j], adjacent=j - i in (1, n - 1)):
            first, second = (f"{k + 1}-{(k + 1) % n + 1} from {_format(sides[k][0])}" for k in (i, j))
            raise ValueError(
                f"edges {first} and {second} cross, touch or fold back; give the corners in order around one area"
            )


def _touch(first: tuple[Point, Point], second: tuple[Point, Point], *, adjacent: bool) -> bool:
    """Return whether two edges touch, apart from the common corner of adjacent ones."""
    if not adjacent and _cross(first, second):
        return True
    return any(
        distance_to_edge(end, other)[0] < MIN_SEPARATION_M
        for end, other in _ends(first, second)
        if not (adjacent and end in other)
    )


def _ends(
    first: tuple[Point, Point], second: tuple[Point, Point]
) -> Iterator[tuple[Point, tuple[Point, Point]]]:
    """Yield each end of either edge with the other edge."""
    yield from ((end, second) for end in first)
    yield from ((end, first) for end in second)


def _cross(first: tuple[Point, Point], second: tuple[Point, Point]) -> bool:
    """Return whether each edge has the ends of the other on different sides."""
    return all(
        (_side(one, other[0]) > 0) != (_side(one, other[1]) > 0)
        for one, other in ((first, second), (second, first))
    )


def _side(edge: tuple[Point, Point], point: Point) -> float:
    (ax, ay), (bx, by) = edge
    return (bx - ax) * (point[1] - ay) - (by - ay) * (point[0] - ax)


def _format(point: Point) -> str:
    return f"[{point[0]:g}, {point[1]:g}]"
