from __future__ import annotations

import json
import math
from contextlib import suppress
from dataclasses import replace
from typing import Any

import pytest
from harness.files.records import IMU_STATUS, ODOMETRY_STATUS, SETUP, START, measurement
from harness.readers.web import feed, mission, pose, station, status

from tsgt.model import ReferencePoint, Status
from tsgt.recording import DiskStatus, EventRecord, RecordingStatus, SetupRecord, StationShare, encode_line
from tsgt.web.messages import encode, message
from tsgt.web.mission.history import Share
from tsgt.web.mission.state import MissionState

LEFT = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
"""A quarter turn about the z axis."""


def event(name: str, message: str, at_s: float = 0.0) -> EventRecord:
    """Return an event."""
    return EventRecord(stamp_ns=START + round(at_s * 1e9), event=name, message=message)


def verdict(state: MissionState, now_s: float) -> tuple[str, str]:
    """Return the words and the cause that the page shows."""
    shown = state.view(now_s)["verdict"]
    return shown["words"], shown["cause"]


def running(setup: SetupRecord = SETUP) -> MissionState:
    """Return the state of a mission in which all is well, at 10 s."""
    state = mission(setup)
    feed(state, status(10.0), pose(10.0), now_s=10.0)
    return state


def test_all_is_well() -> None:
    """Stations track, the pose is valid, the stream flows."""
    assert verdict(running(), 10.1) == ("GOOD", "all stations track, the pose is valid")


def test_silent_master_is_no_green() -> None:
    """1.5 s after the last line at the latest, and at once when the stream ends."""
    state = running()
    assert verdict(state, 11.6)[0] == "STREAM STOPPED"
    state = running()
    state.disconnected("the stream has ended")
    assert verdict(state, 10.1) == ("STREAM STOPPED", "the stream has ended")


def test_stream_without_poses_is_no_green() -> None:
    """A status each second does not make an old pose a live one."""
    state = running()
    feed(state, status(11.2), now_s=11.2)
    view = state.view(11.3)
    assert view["verdict"]["words"] == "NO POSE"
    assert not view["pose"]["valid"]
    assert view["figures"]["live"] is None


def test_sigmas_have_both_limits() -> None:
    """A pose can be uncertain by its rotation alone."""
    limits = replace(
        SETUP.limits, predicted_position_sigma_m=0.15, predicted_rotation_sigma_rad=math.radians(5)
    )
    shown = running(replace(SETUP, limits=limits)).view(10.1)["figures"]
    assert (shown["sigma_limit_mm"], shown["rotation_limit_deg"]) == (150.0, 5.0)
    assert shown["live"] == {"position_mm": 1.0, "rotation_deg": 0.06}


def test_late_lines_are_no_live_view() -> None:
    """Lines that have waited on their way look like those of now; their stamps say otherwise."""
    state = running()
    feed(state, status(10.5), pose(10.5), now_s=13.5)
    assert verdict(state, 13.5) == ("STREAM STOPPED", "the stream arrives 3 s late")


def test_connection_made_anew_knows_nothing_of_before() -> None:
    """The pose from before is not shown as one of now."""
    state = running()
    state.disconnected("gone")
    state.connected(11.0)
    view = state.view(11.1)
    assert (view["verdict"]["words"], view["pose"], view["stations"]) == ("NO POSE", None, [])


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"last_heard_s": None}, "station 2: not received yet"),
        ({"last_heard_s": 7.0, "answering": False}, "station 2: silent for 7 s"),
        ({"status": Status.NO_TARGET}, "station 2: no prism"),
        ({"status": Status.TILT}, "station 2: not level"),
        ({"age_s": 9.0}, "station 2: no new measurement for 9 s"),
    ],
)
def test_station_that_needs_the_operator_is_named(changes: dict[str, Any], cause: str) -> None:
    """The pose is still valid: care."""
    state = mission()
    feed(state, status(10.0, station(1), station(2, **changes), station(3)), pose(10.0), now_s=10.0)
    assert verdict(state, 10.1) == ("CARE", cause)


def test_all_stations_silent_is_the_radio() -> None:
    """One cause instead of three."""
    state = mission()
    silent = [station(number, last_heard_s=6.0, answering=False) for number in (1, 2, 3)]
    feed(state, status(10.0, *silent), pose(10.0), now_s=10.0)
    assert verdict(state, 10.1) == ("CARE", "no station is received: the master's radio?")
    feed(state, pose(11.0, valid=False, reason="outage", quality="invalid"), now_s=11.0)
    assert verdict(state, 11.1) == ("NO POSE", "no station is received: the master's radio?")
    assert state.view(11.1)["alarms"] == []


def test_failed_radio_is_the_cause_of_silent_stations() -> None:
    """As the master tells it, once."""
    state = mission()
    failure = "the radio of the master failed, no station can be reached: SPI timeout"
    silent = [station(number, last_heard_s=6.0, answering=False) for number in (1, 2, 3)]
    lost = pose(10.0, valid=False, reason="outage", quality="invalid")
    feed(state, event("radio_failed", failure, 10.0), status(10.0), now_s=10.0)
    assert {each["state"] for each in state.view(10.0)["stations"]} == {"silent"}
    feed(state, status(10.0, *silent), lost, now_s=10.0)
    assert verdict(state, 10.1) == ("NO POSE", failure)
    assert state.view(10.1)["alarms"] == []
    feed(state, status(12.0, *silent), now_s=12.0)
    assert verdict(state, 12.0) == ("NO POSE", f"no pose for 2 s: {failure}")


def test_full_disk_is_told_by_its_event_already() -> None:
    """Up to a second before the next status, which then says how much is left."""
    state = running()
    feed(state, event("disk_full", "the disk of the recording is full, 5 lines wait in memory"), now_s=10.1)
    assert verdict(state, 10.2) == ("CARE", "the disk is full")
    disk = DiskStatus(free_bytes=3_000_000, total_bytes=10**10)
    feed(state, status(11.0, disk=disk), pose(11.0), now_s=11.0)
    assert verdict(state, 11.1) == ("CARE", "the disk is full: 3 MB left")
    assert state.view(11.1)["alarms"] == []
    feed(state, event("disk_low", "0.9 GB are free"), status(12.0), pose(12.0), now_s=12.0)
    feed(state, pose(13.2), status(13.2), now_s=13.2)
    assert verdict(state, 13.3)[0] == "GOOD"


def test_unconfirmed_imu_is_a_finding() -> None:
    """The operator has to drive; it is no disagreement, although the status says what is open."""
    state = mission()
    imu = replace(
        IMU_STATUS, use="unconfirmed", disagreement="not confirmed by driving yet: mounting, latency"
    )
    feed(state, status(10.0, imu=imu), pose(10.0), now_s=10.0)
    assert verdict(state, 10.1) == (
        "CARE",
        "the set-up of the IMU is not confirmed: drive curves, accelerate and brake; after a knock check its bracket",
    )


def test_missing_prism_is_explained_with_what_its_station_does() -> None:
    """The reason of an invalid pose, for people."""
    state = mission()
    shares = (
        StationShare(id=1, prism=1, age_s=0.3, residual_m=None, reason=""),
        StationShare(id=2, prism=2, age_s=4.2, residual_m=None, reason="outage"),
    )
    lost = pose(10.0, valid=False, reason="outage", quality="invalid", position_m=None, orientation_xyzw=None,
                covariance=None, stations=shares)  # fmt: skip
    feed(state, status(10.0, station(1), station(2, status=Status.NO_TARGET)), lost, now_s=10.0)
    assert verdict(state, 10.1) == ("NO POSE", "station 2 has not measured prism 2 for 4.2 s (no prism)")
    assert state.view(10.1)["pose"] is None


def test_robot_outside_its_fence_is_urgent() -> None:
    """By its position, also when it left before this program started."""
    state = mission()
    feed(state, status(10.0), pose(10.0, position_m=(60.0, 60.0, 0.0)), now_s=10.0)
    shown = state.view(10.1)["verdict"]
    assert (shown["words"], shown["cause"], shown["urgent"]) == ("CARE", "outside the geofence site", True)


def test_event_of_the_fence_lasts_until_the_robot_is_back() -> None:
    """The master's fence counts uncertainty and lost poses, which a position alone does not tell."""
    state = running()
    feed(state, event("geofence_exited", "geofence site exited: no valid pose for 2 s"), now_s=10.1)
    assert verdict(state, 10.2) == ("CARE", "perhaps outside the geofence site: no valid pose")
    feed(state, event("geofence_entered", "geofence site entered: the robot is 3 m within"), now_s=10.3)
    feed(state, pose(11.2), now_s=11.2)
    assert verdict(state, 11.3)[0] == "GOOD"


@pytest.mark.parametrize(
    ("recording", "disk", "cause"),
    [
        ({}, DiskStatus(free_bytes=20_000_000, total_bytes=10**10), "the disk is full: 20 MB left"),
        ({}, DiskStatus(free_bytes=400_000_000, total_bytes=10**10), "the disk is nearly full: 400 MB left"),
        ({"last_write_ns": START + 4 * 10**9}, None, "nothing has been recorded for 6 s"),
        ({"waiting_lines": 700}, None, "the disk is slow: 700 lines wait to be recorded"),
        ({"lost_lines": 3}, None, "3 lines of the recording are lost"),
        ({}, DiskStatus(free_bytes=10**9, total_bytes=10**10), ""),
    ],
)
def test_trouble_with_the_recording_is_told(
    recording: dict[str, int], disk: DiskStatus | None, cause: str
) -> None:
    """Before the field day is lost."""
    good = {
        "file": "r.jsonl",
        "bytes": 1000,
        "last_write_ns": START + 10**10,
        "waiting_lines": 3,
        "lost_lines": 0,
    }
    state = mission()
    record = RecordingStatus(**(good | recording))  # type: ignore[arg-type]
    feed(state, status(10.0, recording=record, disk=disk), pose(10.0), now_s=10.0)
    assert verdict(state, 10.1) == (
        ("CARE", cause) if cause else ("GOOD", "all stations track, the pose is valid")
    )


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"age_s": 4.0}, "the wheel odometry gives no samples"),
        ({"problem": "no encoder"}, "wheel odometry: no encoder"),
        ({"use": "disagrees"}, "the wheel odometry disagrees with IMU and prisms"),
    ],
)
def test_trouble_with_the_wheels_is_told(changes: dict[str, Any], cause: str) -> None:
    """Sound ones are a fact."""
    state = mission()
    feed(state, status(10.0, odometry=ODOMETRY_STATUS), pose(10.0), now_s=10.0)
    assert verdict(state, 10.1)[0] == "GOOD"
    assert state.view(10.1)["odometry"]["slip"] == ODOMETRY_STATUS.slip
    feed(state, status(10.5, odometry=replace(ODOMETRY_STATUS, **changes)), now_s=10.5)
    assert verdict(state, 10.6) == ("CARE", cause)


def test_heading_and_prisms_are_those_of_the_robot() -> None:
    """Not of a reference point that is turned against it: a camera that looks to the left of the robot."""
    camera = ReferencePoint(name="camera", position_m=(1.0, 0.0, 0.0), orientation_xyzw=LEFT)
    state = running(replace(SETUP, reference_point=camera, child_frame="camera"))
    # The camera looks along +y, so the robot drives along +x; its origin is a metre behind the camera.
    feed(state, pose(11.0, orientation_xyzw=LEFT), now_s=11.0)
    shown = state.view(11.0)["pose"]
    assert shown["heading_rad"] == pytest.approx(0.0, abs=1e-3)
    assert shown["prisms"][1] == pytest.approx([8.5, 10.0])


def test_sight_line_ends_where_the_station_measured() -> None:
    """By the convention of angles: horizontal ones run clockwise, from the x axis."""
    state = running()
    seen = replace(
        measurement(0), horizontal_angle_rad=math.pi / 2, zenith_angle_rad=math.pi / 2, slope_distance_m=20.0
    )
    feed(state, seen, now_s=10.1)
    tile = state.view(10.2)["stations"][0]
    assert (tile["sight"], tile["range_m"]) == ([pytest.approx(0.0, abs=1e-9), -20.0], 20.0)


def test_measurement_of_the_backlog_is_no_sight_of_now() -> None:
    """It comes after newer ones, with an earlier stamp and number; that its station is received is all that it says of now."""
    state = mission()
    lost = station(1, status=Status.NO_TARGET, last_heard_s=2.5, answering=False)
    feed(state, status(300.0, lost), pose(300.0), now_s=300.0)
    feed(state, replace(measurement(750), status=Status.NO_TARGET, slope_distance_m=None), now_s=300.1)
    feed(state, measurement(50), now_s=301.0)
    tile = state.view(301.1)["stations"][0]
    assert (tile["state"], tile["words"]) == ("searching", "no prism")
    assert (tile["range_m"], tile["sight"], state.sight_points(301.1)) == (None, None, {})
    for sequence, now_s in enumerate((302.0, 303.0, 303.9), 51):
        feed(state, measurement(sequence), now_s=now_s)
    assert state.view(304.0)["stations"][0]["state"] == "searching"  # not silent


def test_sight_of_a_clock_that_was_set_back_is_shown() -> None:
    """Its stamp is earlier, but its number continues; after a new connection any number does."""
    state = running()
    feed(state, measurement(20), now_s=10.1)
    feed(state, replace(measurement(0), sequence=21, slope_distance_m=40.0), now_s=10.5)
    assert state.view(10.6)["stations"][0]["range_m"] == 40.0
    state.connected(11.0)
    feed(state, SETUP, status(11.0), replace(measurement(0), slope_distance_m=50.0), now_s=11.0)
    assert state.view(11.1)["stations"][0]["range_m"] == 50.0


def test_script_in_texts_stays_text_and_short() -> None:
    """Of an event: it is passed on as one line of bounded length, in JSON."""
    state = running()
    feed(state, event("</script>", "<script>alert(1)</script>\n\x1b[2J" + "x" * 900), now_s=10.1)
    sent = encode(message(state, state.view(10.2), None, 10.2))
    shown = json.loads(sent)["events"]["items"][0]
    assert b"\n" not in sent
    assert shown["text"].startswith("<script>alert(1)</script>  [2J")
    assert len(shown["text"]) == 300


def test_histories_are_sent_once() -> None:
    """A reader gets everything at first and then what is new; the set-up when it changes."""
    state = running()
    first = message(state, {}, None, 10.0)
    cursors = state.cursors()
    feed(state, pose(10.5, position_m=(11.0, 10.0, 0.0)), now_s=10.5)
    then = message(state, {}, cursors, 10.5)
    assert first["trail"]["items"] == [[10.0, 10.0, 0.0]]
    assert then["trail"] == {"first": 1, "items": [[11.0, 10.0, 0.0]]}
    assert ("setup" in first, "setup" in then) == (True, False)
    feed(state, SETUP, now_s=10.6)
    assert "setup" in message(state, {}, cursors, 10.6)


def test_poses_are_decoded_no_more_often_than_shown() -> None:
    """At 100 Hz most are only counted; the newest is shown, and one that becomes invalid is seen at once."""
    state = running()
    before = state.cursors().trail
    lines = [encode_line(pose(10 + i / 100, position_m=(10.0 + i, 10.0, 0.0))) for i in range(1, 6)]
    for i, line in enumerate(lines):
        state.line(line, 10.0 + (i + 1) / 100)
    assert state.view(10.06)["pose"]["at"][0] == 15.0
    assert state.cursors().trail == before + 1
    feed(state, pose(10.06, valid=False, reason="tilt", quality="invalid"), now_s=10.06)
    assert verdict(state, 10.07)[0] == "NO POSE"


def test_line_that_is_no_pose_leaves_the_pose_before() -> None:
    """It is decoded only when the page is made, which goes on."""
    state = running()
    state.line(b'{"type":"pose","valid":true}\n', 10.01)
    assert state.view(10.02)["pose"]["at"][0] == 10.0


NEWER = "restart or update tsgt web"


def newer_pose(at_s: float) -> bytes:
    """Return the line of a valid pose with a value that this program does not know."""
    line = encode_line(pose(at_s, quality="degraded", degraded_by=("residual",)))
    return line.replace(b'"residual"]', b'"wheel_slip"]')


def test_unreadable_poses_are_no_poses() -> None:
    """Although they come, and say that they are valid: the pose shown ages, and the cause is named."""
    state = running()
    for i in range(1, 41):
        at_s = 10 + i / 20
        if i % 20 == 0:
            feed(state, status(at_s), now_s=at_s)
        with suppress(ValueError):
            state.line(newer_pose(at_s), at_s)
        view = state.view(at_s)
        assert view["pose"]["age_s"] == pytest.approx(i / 20)
    assert not view["pose"]["valid"]
    assert view["figures"]["live"] is None
    assert verdict(state, 12.0) == ("NO POSE", f"no pose for 2 s: pose lines cannot be read: {NEWER}")
    assert view["alarms"] == []
    assert view["figures"]["valid_share"] < 0.1


def test_old_status_is_a_finding() -> None:
    """What it says of stations and disk is not of now; why it is old is told where that is known."""
    state = running()
    for second in range(11, 14):
        feed(state, pose(second), now_s=second)
    assert verdict(state, 13.0)[0] == "GOOD"
    feed(state, pose(14.0), now_s=14.0)
    assert verdict(state, 14.0) == ("CARE", "no status of the master for 4 s")
    newer = encode_line(status(14.0)).replace(b'"status":"ok"', b'"status":"levitating"')
    with pytest.raises(ValueError, match="status"):
        state.line(newer, 14.0)
    assert verdict(state, 14.0) == ("CARE", f"status lines cannot be read: {NEWER}")
    assert [each["text"] for each in state.view(14.0)["alarms"]] == ["no status of the master for 4 s"]
    feed(state, status(17.5), pose(17.5), now_s=17.5)
    state.view(17.5)
    feed(state, pose(18.6), now_s=18.6)
    assert verdict(state, 18.6)[0] == "GOOD"


def moved(setup: SetupRecord) -> SetupRecord:
    """Return a set-up in which station 1, which defines the frame, stands 30 m away."""
    stations = tuple(
        replace(each, position_m=(-30.0, 0.0, 0.0)) if each.id > 1 else each for each in setup.stations
    )
    return replace(setup, stations=stations)


def test_nothing_of_the_old_frame_is_shown_in_a_new_one() -> None:
    """Neither trail nor pose nor sight line; a reader that has the old trail starts anew."""
    state = running()
    feed(state, replace(measurement(0), zenith_angle_rad=math.pi / 2), now_s=10.0)
    cursors = state.cursors()
    feed(state, moved(SETUP), now_s=10.01)
    view = state.view(10.02)
    assert (view["pose"], view["stations"][0]["sight"], state.trail.since(0)["items"]) == (None, None, [])
    feed(state, pose(10.05, position_m=(-20.0, 10.0, 0.0)), now_s=10.05)
    then = message(state, {}, cursors, 10.1)["trail"]
    assert then["items"] == [[-20.0, 10.0, 0.0]]
    assert then["first"] > cursors.trail


def test_trail_stays_with_the_same_frames() -> None:
    """The set-up is sent again to a reader that has lost lines, or with other prisms; a connection made anew interrupts the trail."""
    state = running()
    feed(state, replace(SETUP, prisms=SETUP.prisms[:2]), now_s=10.1)
    assert state.view(10.2)["pose"] is not None
    state.connected(11.0)
    feed(state, SETUP, pose(11.0), now_s=11.0)
    assert state.trail.since(0)["items"] == [[10.0, 10.0, 0.0], None, [10.0, 10.0, 0.0]]
    state.connected(12.0)
    feed(state, moved(SETUP), pose(12.0), now_s=12.0)
    assert state.trail.since(0)["items"] == [[10.0, 10.0, 0.0]]


def test_share_of_valid_poses_is_rounded_down() -> None:
    """One invalid pose in a minute is not 100 %."""
    state = mission()
    for i in range(3000):
        feed(state, pose(i / 50, **({"valid": False, "reason": "tilt"} if i == 1500 else {})), now_s=i / 50)
    feed(state, status(60.0), now_s=60.0)
    assert state.view(60.0)["figures"]["valid_share"] == 0.999


def test_share_keeps_a_minute_although_nobody_asks() -> None:
    """A program may only look at the findings, for days."""
    share = Share()
    for second in range(300):
        share.count(float(second), valid=second >= 240)
    assert len(share._seconds) == 61
    assert share.value(299.0) == pytest.approx(60 / 61)


def test_absurd_numbers_do_not_end_the_page() -> None:
    """Of a covariance, or of the corners of a fence: what has no finite value is not shown."""
    state = running()
    feed(state, pose(10.1, covariance=(1e200,) + (0.0,) * 35, degraded_by=("uncertain",)), now_s=10.1)
    assert state.view(10.2)["figures"]["live"] == {"position_mm": None, "rotation_deg": 0.0}
    far = replace(SETUP.geofences[0], polygon_m=((0.0, 0.0), (1e200, 0.0), (0.0, 1e200)))
    feed(state, replace(SETUP, geofences=(far,)), pose(10.3), now_s=10.3)
    assert state.view(10.4)["verdict"]["words"] == "CARE"  # held


def test_other_protocol_is_refused() -> None:
    """Fields may have another meaning."""
    with pytest.raises(ValueError, match="protocol version 2"):
        MissionState("s").line(
            b'{"type":"hello","protocol":2,"version":"9","capabilities":[],"limits":null}', 0.0
        )
