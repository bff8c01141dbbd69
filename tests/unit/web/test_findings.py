"""Geofences, and lasting states that events begin and end."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest
from harness.files.records import IMU_STATUS, POSE, SETUP, START
from harness.readers.web import feed, mission, pose, station, status

from tsgt.recording import EventRecord, SetupGeofence, SetupRecord, ValidityLimits
from tsgt.web.mission.findings import explanation

if TYPE_CHECKING:
    from tsgt.web.mission.state import MissionState

RADIO = "the radio of the master failed, no station can be reached: SPI timeout"
LAYOUT = "the prisms miss their layout by 9.0 mm, limit 5.0 mm"
GOOD = "GOOD: all stations track, the pose is valid"


def event(name: str, message: str, at_s: float) -> EventRecord:
    """Return an event."""
    return EventRecord(stamp_ns=START + round(at_s * 1e9), event=name, message=message)


def fenced(**fences_m: float) -> SetupRecord:
    """Return a set-up with squares as geofences, by name and size, with a margin of 2 m."""
    return replace(
        SETUP,
        geofences=tuple(
            SetupGeofence(
                name=name.replace("_", " "),
                allowed_side="inside",
                polygon_m=((0.0, 0.0), (size, 0.0), (size, size), (0.0, size)),
                margin_m=2.0,
            )
            for name, size in fences_m.items()
        ),
    )


def at(state: MissionState, now_s: float, x_m: float = 10.0, y_m: float = 10.0) -> list[str]:
    """Return verdict and alarms, with the robot there and all stations tracking."""
    feed(state, status(now_s), pose(now_s, position_m=(x_m, y_m, 0.0)), now_s=now_s)
    view = state.view(now_s)
    return [
        f"{view['verdict']['words']}: {view['verdict']['cause']}",
        *(each["text"] for each in view["alarms"]),
    ]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("radio_failed", RADIO),
        ("geofence_exited", "geofence site exited: no valid pose for 2 s"),
        ("disk_failed", "the disk of the recording fails"),
    ],
)
def test_lost_lines_end_what_the_stream_tells_anew(name: str, message: str) -> None:
    """The event that ended it may be among them."""
    state = mission()
    feed(state, event(name, message, 10.0), now_s=10.0)
    assert at(state, 10.0)[0].startswith("CARE: ")
    feed(state, event("lines_lost", "this reader was too slow and lost 1500 lines here", 70.0), now_s=70.0)
    assert at(state, 70.0) == [GOOD]


def test_lost_lines_do_not_end_the_alarm_of_the_layout() -> None:
    """Nothing but its events tells of it: an alarm too long is better than none."""
    state = mission()
    feed(state, event("layout_residual_high", LAYOUT, 10.0), now_s=10.0)
    feed(state, event("lines_lost", "this reader was too slow and lost 1500 lines here", 70.0), now_s=70.0)
    assert at(state, 70.0) == [f"CARE: {LAYOUT}"]
    feed(state, event("setup_applied", "new set-up in force", 71.0), now_s=71.0)
    assert at(state, 72.0) == [GOOD]


def test_station_that_is_received_ends_a_failure_of_the_radio() -> None:
    """Also where `radio_recovered` was lost; a packet from before the failure does not."""
    state = mission()
    feed(state, event("radio_failed", RADIO, 10.0), now_s=10.0)
    before = [station(number, last_heard_s=1.5) for number in (1, 2, 3)]
    feed(state, status(11.0, *before), pose(11.0), now_s=11.0)
    assert state.view(11.0)["verdict"]["cause"] == RADIO
    after = [station(1, last_heard_s=0.5), *before[1:]]
    feed(state, status(12.0, *after), pose(12.0), now_s=12.0)
    assert state.view(12.0)["verdict"]["words"] == "GOOD"


def test_new_set_up_ends_a_wrong_one_of_the_imu() -> None:
    """The estimator starts anew, and the advice is again to drive."""
    state = mission()
    wrong = "the set-up of the IMU is wrong: latency 50 ms +/- 2 ms; calibrate it anew"
    feed(
        state,
        event("imu_setup_wrong", wrong, 1.0),
        event("setup_applied", "new set-up in force", 2.0),
        now_s=2.0,
    )
    imu = replace(IMU_STATUS, age_s=0.01, problem="", use="unconfirmed", disagreement="not confirmed yet")
    feed(state, status(3.0, imu=imu), pose(3.0), now_s=3.0)
    view = state.view(3.0)
    assert view["verdict"]["cause"].endswith(
        "drive curves, accelerate and brake; after a knock check its bracket"
    )
    assert view["alarms"] == []


def test_geofences_with_names_that_begin_alike_are_both_told() -> None:
    """Each is a finding of its own."""
    state = mission(fenced(pit=50.0, pit_road=60.0))
    assert at(state, 10.0, 70.0, 70.0) == ["CARE: outside the geofence pit", "outside the geofence pit road"]


def test_robot_beyond_the_limit_is_not_called_outside() -> None:
    """The master's limit is the boundary less the margin less the uncertainty."""
    state = mission(fenced(pit=50.0))
    exited = "geofence pit exited: the robot is 0.50 m beyond its limit at x 48.50, y 20.00 m"
    feed(state, event("geofence_exited", exited, 10.0), now_s=10.0)
    assert at(state, 10.0, 48.5, 20.0) == [
        "CARE: beyond the limit of the geofence pit",
        "1.5 m from the boundary of the geofence pit",
    ]
    assert state.view(10.0)["verdict"]["urgent"]
    assert at(state, 11.0, 50.5, 20.0)[0] == "CARE: outside the geofence pit"


@pytest.mark.parametrize("limit_m", [48.0, 50.0])
def test_parked_robot_does_not_change_the_verdict(limit_m: float) -> None:
    """At the margin and at the boundary of a fence, with poses of 3 mm noise: the page would beep with each change."""
    state, noise = mission(fenced(pit=50.0)), random.Random(1)  # noqa: S311 (no secret)
    shown = [at(state, i / 5, limit_m + noise.gauss(0.0, 0.003), 20.0)[0][:12] for i in range(500)]
    assert sum(a != b for a, b in pairwise(shown)) <= 1
    assert at(state, 101.0, limit_m - 0.2, 20.0) != at(state, 103.0, limit_m + 0.2, 20.0)


@pytest.mark.parametrize(
    ("sigma_m", "words"),
    [
        (0.002, "the measurements do not confirm the pose yet"),
        (0.1, "position uncertain: 100 mm, limit 50 mm"),
    ],
)
def test_cause_of_an_uncertain_pose(sigma_m: float, words: str) -> None:
    """A pose within the limits may rest on a wrong prism, or on measurements that contradict each other."""
    limits = ValidityLimits(
        promise="",
        reference_point="robot",
        position_sigma_m=0.01,
        rotation_sigma_rad=0.01,
        predicted_position_sigma_m=0.05,
        predicted_rotation_sigma_rad=0.05,
        residual_m=0.02,
        tilt_rad=1.0,
        outage_s=1.0,
    )
    covariance = tuple(
        (sigma_m if row < 3 else 0.001) ** 2 if row == column else 0.0
        for row in range(6)
        for column in range(6)
    )
    uncertain = replace(
        POSE, kind="predicted", estimator="continuous", valid=False, reason="uncertain", covariance=covariance
    )
    assert explanation(uncertain, limits, {}) == words
