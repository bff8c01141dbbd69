"""Polygons: sides, distances, validity. Oracles: brute force and winding number."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tsgt.polygon import check_simple, contains, distance_to_edge, edges

SQUARE = ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0))
U_SHAPE = ((0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (6.0, 9.0), (6.0, 3.0), (3.0, 3.0), (3.0, 9.0), (0.0, 9.0))
# Whole numbers make rays through corners and points on edges common.
COORDINATE = st.integers(-6, 6).map(float) | st.floats(-6, 6)
POINT = st.tuples(COORDINATE, COORDINATE)


@st.composite
def star(draw: st.DrawFn) -> tuple[tuple[float, float], ...]:
    """Draw a simple polygon, concave as a rule: corners around the origin in the order of their bearings."""
    n = draw(st.integers(3, 9))
    radii = draw(st.lists(st.floats(0.5, 6), min_size=n, max_size=n))
    shares = np.cumsum([0.0, *draw(st.lists(st.floats(0.5, 1.0), min_size=n, max_size=n))])
    bearings = 2 * math.pi * shares[:-1] / shares[-1]
    corners = tuple((r * math.cos(b), r * math.sin(b)) for r, b in zip(radii, bearings.tolist(), strict=True))
    return corners[::-1] if draw(st.booleans()) else corners


def turns(corners: tuple[tuple[float, float], ...], point: tuple[float, float]) -> float:
    """How often the boundary winds around a point: the angles under which its edges are seen, summed."""
    total = 0.0
    for a, b in edges(corners):
        from_a = complex(a[0] - point[0], a[1] - point[1])
        from_b = complex(b[0] - point[0], b[1] - point[1])
        product = from_b * from_a.conjugate()
        total += math.atan2(product.imag, product.real)
    return total / (2 * math.pi)


@given(star(), POINT)
def test_inside_is_where_the_boundary_winds_around(
    corners: tuple[tuple[float, float], ...], point: tuple[float, float]
) -> None:
    """Ray crossing and winding number agree for every point that is not on the boundary."""
    assume(min(distance_to_edge(point, edge)[0] for edge in edges(corners)) > 1e-6)
    assert contains(corners, point) == (abs(turns(corners, point)) > 0.5)


@given(POINT)
def test_inside_a_concave_polygon_with_parallel_edges(point: tuple[float, float]) -> None:
    """Rays that run along edges and through corners do not confuse a U."""
    x, y = point
    assume(min(distance_to_edge(point, edge)[0] for edge in edges(U_SHAPE)) > 1e-6)
    assert contains(U_SHAPE, point) == (0 < x < 9 and 0 < y < 9 and not (3 < x < 6 and y > 3))


@given(POINT, POINT, POINT)
def test_distance_to_edge_is_the_minimum(
    point: tuple[float, float], a: tuple[float, float], b: tuple[float, float]
) -> None:
    """Of a thousand points; the direction is a unit vector."""
    assume(math.dist(a, b) > 1e-3)
    distance, (u, v) = distance_to_edge(point, (a, b))
    parts = np.linspace(0, 1, 1001)[:, None]
    sampled = np.linalg.norm(np.array(a) * (1 - parts) + np.array(b) * parts - np.array(point), axis=1).min()
    assert distance <= sampled + 1e-9
    assert sampled <= distance + math.dist(a, b) / 1000
    assert math.hypot(u, v) == pytest.approx(1.0)


def test_point_on_the_edge_has_the_normal_as_direction() -> None:
    """Also with rounding."""
    distance, way = distance_to_edge((3.0, 0.0), ((0.0, 0.0), (10.0, 0.0)))
    assert (distance, abs(way[1])) == (0.0, 1.0)
    _, (u, v) = distance_to_edge((0.1, 0.3), ((0.0, 0.0), (1.0, 3.0)))
    assert u + 3 * v == pytest.approx(0.0)


@given(star())
def test_simple_polygon_is_accepted(corners: tuple[tuple[float, float], ...]) -> None:
    """Simple polygon is accepted."""
    assume(all(math.dist(a, b) > 0.1 for a, b in edges(corners)))
    # Spokes at least 2 pi / 18 apart; the polygon is simple, but its spikes may be narrower than the limit.
    assume(min_gap(corners) > 0.01)
    check_simple(corners)


def min_gap(corners: tuple[tuple[float, float], ...]) -> float:
    """Return the least distance from a corner to an edge that it does not belong to."""
    return min(
        distance_to_edge(corner, edge)[0]
        for corner in corners
        for edge in edges(corners)
        if corner not in edge
    )


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        pytest.param([(0, 0), (10, 10), (10, 0), (0, 10)], "edges 1-2 .* and 3-4 .* cross", id="bow tie"),
        pytest.param(
            [*SQUARE, (0, 0)], "corner 5 and corner 1 are the same point.*omit the last", id="closed"
        ),
        pytest.param([(0, 0), (0, 0), (1, 1)], "corner 1 and corner 2 are the same", id="repeated corner"),
        pytest.param([(0, 0), (5, 0), (10, 0)], "edges 1-2 .* fold back", id="no area"),
        pytest.param([(0, 0), (10, 0), (10, 10), (5, 0), (0, 10)], "touch", id="a corner on another edge"),
        pytest.param([(0, 0), (10, 0), (10, 10), (10, -5)], "touch or fold back", id="a spike"),
    ],
)
def test_polygon_that_is_not_simple_is_rejected(corners: list[tuple[float, float]], words: str) -> None:
    """The message states the corners."""
    with pytest.raises(ValueError, match=words):
        check_simple(corners)
