"""Geofences: crossing, uncertainty, margin, hysteresis, loss of the pose."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.records import NO_POSE, POSE, SECOND, START
from hypothesis import given
from hypothesis import strategies as st

from tsgt.config import GeofenceConfig
from tsgt.master.monitors.geofence import Geofence

if TYPE_CHECKING:
    from tsgt.recording import PoseRecord

SQUARE = ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0))
BAY = ((0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (6.0, 9.0), (6.0, 3.0), (3.0, 3.0), (3.0, 9.0), (0.0, 9.0))


def fence(**changes: object) -> Geofence:
    """Return a geofence around the square with exact positions."""
    settings = {"name": "yard", "polygon_m": SQUARE, "sigmas": 0.0, "hysteresis_m": 0.5}
    return Geofence(GeofenceConfig.model_validate(settings | changes))


def at(x: float, y: float, *, sigma_x_m: float = 0.0, sigma_y_m: float = 0.0, rho: float = 0.0) -> PoseRecord:
    """Build a valid pose at x, y."""
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = [
        [sigma_x_m**2, rho * sigma_x_m * sigma_y_m],
        [rho * sigma_x_m * sigma_y_m, sigma_y_m**2],
    ]
    return dataclasses.replace(POSE, position_m=(x, y, 0.0), covariance=tuple(covariance.ravel().tolist()))


def run(watched: Geofence, poses: list[PoseRecord]) -> list[str]:
    """Return the event of each pose, 0.1 s apart; an empty string for none."""
    words = []
    for number, pose in enumerate(poses):
        events = watched.pose(pose, START + number * SECOND // 10)
        assert len(events) <= 1
        words.append(events[0].event if events else "")
    return words


def test_first_pose_beyond_the_boundary_is_an_exit() -> None:
    """The event states geofence, position and distance; its stamp is that of the detection."""
    watched = fence()
    assert watched.pose(at(9.9, 5.0), START) == []
    (event,) = watched.pose(at(10.25, 5.0), START + 7)
    assert (event.event, event.stamp_ns) == ("geofence_exited", START + 7)
    assert event.message == "geofence yard exited: the robot is 0.25 m beyond its limit at x 10.25, y 5.00 m"


def test_start_beyond_the_boundary_is_an_exit() -> None:
    """The first valid pose arms the geofence; a start on the allowed side is no event."""
    assert run(fence(), [at(11, 5)]) == ["geofence_exited"]
    assert run(fence(), [at(5, 5)]) == [""]


def test_entry_requires_the_hysteresis() -> None:
    """Driving along the boundary gives one event."""
    poses = [at(x, 5) for x in (9.0, 10.1, 9.9, 10.1, 9.6, 9.4, 9.9)]
    assert run(fence(), poses) == ["", "geofence_exited", "", "", "", "geofence_entered", ""]


def test_allowed_side_outside_inverts_the_geofence() -> None:
    """Driving into a forbidden area is an exit."""
    poses = [at(x, 5) for x in (12.0, 10.1, 9.9, 10.4, 10.6)]
    assert run(fence(allowed_side="outside"), poses) == ["", "", "geofence_exited", "", "geofence_entered"]


def test_margin_shifts_the_boundary() -> None:
    """A robot whose front is a metre ahead of its origin has to turn a metre earlier."""
    assert run(fence(margin_m=1.0), [at(8.9, 5), at(9.1, 5)]) == ["", "geofence_exited"]
    assert run(fence(margin_m=1.0, allowed_side="outside"), [at(11.1, 5), at(10.9, 5)]) == [
        "",
        "geofence_exited",
    ]


def test_uncertainty_counts_across_the_edge_only() -> None:
    """0.2 m of sigma along an edge is harmless; across it three sigmas are an exit."""
    along, across = at(9.5, 5, sigma_y_m=0.2), at(9.5, 5, sigma_x_m=0.2)
    assert run(fence(sigmas=3.0), [along, across]) == ["", "geofence_exited"]


def test_distant_edge_counts_in_an_uncertain_direction() -> None:
    """The east edge is nearer, but the robot may have crossed the north edge."""
    assert run(fence(sigmas=3.0), [at(9.5, 9.0, sigma_y_m=0.4)]) == ["geofence_exited"]


def test_oblique_edge_uses_the_covariance_of_x_and_y() -> None:
    """0.7 m from an edge at 45 degrees: an error towards it may be a crossing, an error along it not."""
    diamond = ((10.0, 0.0), (0.0, 10.0), (-10.0, 0.0), (0.0, -10.0))
    poses = [at(4.5, 4.5, sigma_x_m=0.3, sigma_y_m=0.3, rho=rho) for rho in (-0.9, 0.9)]
    assert run(fence(polygon_m=diamond, sigmas=2.0), poses) == ["", "geofence_exited"]


def test_uncertainty_counts_on_the_boundary() -> None:
    """Whichever side rounding puts the point on; without uncertainty it is still inside."""
    for point in ((10.0, 5.0), (0.0, 5.0), (5.0, 0.0), (5.0, 10.0), (0.0, 0.0), (10.0, 10.0)):
        assert run(fence(), [at(*point)]) == [""]
        assert run(fence(sigmas=1.0), [at(*point, sigma_x_m=0.1, sigma_y_m=0.1)]) == ["geofence_exited"]


@given(
    x=st.floats(-2, 11), y=st.floats(-2, 11), sx=st.floats(0, 1), sy=st.floats(0, 1), rho=st.floats(-0.99, 0.99),
    allowed_side=st.sampled_from(["inside", "outside"]), margin=st.floats(0, 1),
)  # fmt: skip
def test_clearance_agrees_with_brute_force(
    x: float, y: float, sx: float, sy: float, rho: float, allowed_side: str, margin: float
) -> None:
    """Oracle: points of the boundary in steps of 5 mm."""
    corners = np.array(BAY)
    steps = np.linspace(0, 1, 1801)[:, None]
    offsets = np.concatenate(
        [a * (1 - steps) + b * steps for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    ) - [x, y]
    inside = 0 < x < 9 and 0 < y < 9 and not (3 < x < 6 and y > 3)
    left_at_all = inside != (allowed_side == "inside")
    # Per edge the nearest point counts, in its own direction.
    per_edge = offsets.reshape(len(BAY), -1, 2)
    lengths = np.linalg.norm(per_edge, axis=2)
    nearest = per_edge[np.arange(len(BAY)), lengths.argmin(axis=1)]
    distance = lengths.min(axis=1)
    if distance.min() < 0.2:  # the oracle's steps are too coarse for a direction
        return
    u = nearest / distance[:, None]
    covariance = np.array([[sx**2, rho * sx * sy], [rho * sx * sy, sy**2]])
    spare = float((distance - 2.0 * np.sqrt(np.einsum("ni,ij,nj->n", u, covariance, u))).min()) - margin
    if not left_at_all and math.isclose(spare, 0.0, abs_tol=0.05):
        # Near the limit the oracle's directions, off by 2.5 mm at 200 mm or more, decide nothing.
        return
    expected = "geofence_exited" if left_at_all or spare < 0 else ""
    pose = at(x, y, sigma_x_m=sx, sigma_y_m=sy, rho=rho)
    assert run(fence(polygon_m=BAY, sigmas=2.0, allowed_side=allowed_side, margin_m=margin), [pose]) == [
        expected
    ]


@given(st.lists(st.tuples(st.floats(-2, 12), st.floats(-2, 12), st.integers(0, 3 * SECOND)), max_size=30))
def test_events_alternate(steps: list[tuple[float, float, int]]) -> None:
    """Exits and entries alternate, whatever the robot does and however long poses are missing."""
    watched, now_ns, events = fence(sigmas=1.0), START, []
    for x, y, wait_ns in steps:
        now_ns += wait_ns
        events += watched.pose(at(x, y, sigma_x_m=0.1), now_ns)
    words = [event.event for event in events]
    assert words == (["geofence_exited", "geofence_entered"] * len(words))[: len(words)]


def test_missing_pose_is_an_exit() -> None:
    """One event at the deadline; invalid poses do not postpone it. The next valid pose inside is an entry."""
    watched = fence(lost_after_s=2.0)
    assert watched.next_deadline_ns() is None
    assert watched.tick(START) == []
    watched.pose(at(5, 5), START)
    assert watched.next_deadline_ns() == START + 2 * SECOND
    assert watched.pose(NO_POSE, START + SECOND) == []
    assert watched.tick(START + 2 * SECOND - 1) == []
    (event,) = watched.tick(START + 2 * SECOND)
    assert event.event == "geofence_exited"
    assert event.message == "geofence yard exited: no valid pose for 2 s"
    assert watched.next_deadline_ns() is None
    assert watched.tick(START + 9 * SECOND) == []
    # Within the hysteresis: it was loss that made it leave, not the boundary.
    assert [e.event for e in watched.pose(at(9.9, 5), START + 10 * SECOND)] == ["geofence_entered"]


def test_missing_pose_is_detected_without_tick() -> None:
    """An invalid or valid pose after the deadline has the effect of the tick."""
    watched = fence()
    watched.pose(at(5, 5), START)
    assert [e.event for e in watched.pose(NO_POSE, START + 2 * SECOND)] == ["geofence_exited"]
    watched.pose(at(5, 5), START + 3 * SECOND)
    late = watched.pose(at(5, 5), START + 6 * SECOND)
    assert [e.event for e in late] == ["geofence_exited", "geofence_entered"]


def test_missing_pose_beyond_the_boundary_is_no_second_exit() -> None:
    """The entry needs the hysteresis."""
    watched = fence()
    watched.pose(at(11, 5), START)
    assert watched.tick(START + 5 * SECOND) == []
    assert watched.pose(at(9.9, 5), START + 6 * SECOND) == []
    assert [e.event for e in watched.pose(at(9.0, 5), START + 7 * SECOND)] == ["geofence_entered"]


def test_geofence_without_a_valid_pose_is_not_armed() -> None:
    """A master that starts before its stations raises no alarm."""
    watched = fence()
    assert watched.pose(NO_POSE, START) == []
    assert watched.tick(START + 100 * SECOND) == []


def test_invalid_polygon_is_rejected_by_the_configuration() -> None:
    """With the message of the check."""
    with pytest.raises(ValueError, match=r"edges 1-2 .* and 3-4 .* cross"):
        fence(polygon_m=((0.0, 0.0), (10.0, 10.0), (10.0, 0.0), (0.0, 10.0)))
    with pytest.raises(ValueError, match="less than or equal to 1000000"):
        fence(polygon_m=((0.0, 0.0), (1e300, 0.0), (0.0, 1e300)))
