"""Polygons seen from above: which side of the boundary a point lies on, how far from each edge, and which are sound.

Plain Python, as both the configuration, which refuses unsound polygons, and the geo-fence stand on it.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

Point = tuple[float, float]

APART_M = 0.001
"""Corners and edges closer than this count as touching: nobody stakes out an area finer."""


def edges(corners: Sequence[Point]) -> list[tuple[Point, Point]]:
    """Return the edges in order; the last corner is joined to the first."""
    return list(itertools.pairwise([*corners, corners[0]]))


def contains(corners: Sequence[Point], point: Point) -> bool:
    """Tell whether a point lies inside; for a point on the boundary either answer may come.

    It does when a ray to the east crosses the boundary an odd number of times. Each edge holds its southern end
    and not its northern one, so that a ray through a corner counts once.
    """
    x, y = point
    inside = False
    for (ax, ay), (bx, by) in edges(corners):
        if (ay <= y) != (by <= y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            inside = not inside
    return inside


def distance_to_edge(point: Point, edge: tuple[Point, Point]) -> tuple[float, Point]:
    """Return the distance from a point to an edge, and the unit vector along the shortest way.

    Its sense is either of the two. For a point on the edge it is the edge's normal.
    """
    (ax, ay), (bx, by) = edge
    along_x, along_y = bx - ax, by - ay
    length = math.hypot(along_x, along_y)
    part = ((point[0] - ax) * along_x + (point[1] - ay) * along_y) / length**2
    part = min(max(part, 0.0), 1.0)
    off_x, off_y = point[0] - ax - part * along_x, point[1] - ay - part * along_y
    distance = math.hypot(off_x, off_y)
    # Rounding spoils the direction of a way that is much shorter than the edge.
    if distance <= 1e-9 * length:
        return distance, (-along_y / length, along_x / length)
    return distance, (off_x / distance, off_y / distance)


def check_simple(corners: Sequence[Point]) -> None:
    """Refuse what does not bound one area: corners that coincide, edges that cross, touch or fold back.

    Raises
    ------
    ValueError
        With the numbers of the corners, from 1, and their coordinates.
    """
    sides = edges(corners)
    n = len(sides)
    for i, (a, b) in enumerate(sides):
        if math.dist(a, b) < APART_M:
            hint = "; leave the last out, it is joined to the first by itself" if i == n - 1 else ""
            raise ValueError(
                f"corner {i + 1} and corner {(i + 1) % n + 1} are the same point, {_at(a)}{hint}"
            )
    for i, j in itertools.combinations(range(n), 2):
        if _touch(sides[i], sides[j], adjacent=j - i in (1, n - 1)):
            first, second = (f"{k + 1}-{(k + 1) % n + 1} from {_at(sides[k][0])}" for k in (i, j))
            raise ValueError(
                f"edges {first} and {second} cross, touch or fold back; give the corners in order around one area"
            )


def _touch(first: tuple[Point, Point], second: tuple[Point, Point], *, adjacent: bool) -> bool:
    """Tell whether two edges come closer than they may; adjacent ones share a corner, which does not count."""
    if not adjacent and _cross(first, second):
        return True
    return any(
        distance_to_edge(end, other)[0] < APART_M
        for end, other in _ends(first, second)
        if not (adjacent and end in other)
    )


def _ends(
    first: tuple[Point, Point], second: tuple[Point, Point]
) -> Iterator[tuple[Point, tuple[Point, Point]]]:
    """Each end of either edge, with the other edge."""
    yield from ((end, second) for end in first)
    yield from ((end, first) for end in second)


def _cross(first: tuple[Point, Point], second: tuple[Point, Point]) -> bool:
    """Tell whether each edge has the ends of the other on different sides."""
    return all(
        (_side(one, other[0]) > 0) != (_side(one, other[1]) > 0)
        for one, other in ((first, second), (second, first))
    )


def _side(edge: tuple[Point, Point], point: Point) -> float:
    (ax, ay), (bx, by) = edge
    return (bx - ax) * (point[1] - ay) - (by - ay) * (point[0] - ax)


def _at(point: Point) -> str:
    return f"[{point[0]:g}, {point[1]:g}]"
