"""Events on the use of the IMU."""

from __future__ import annotations

from dataclasses import replace

from harness.files.records import ODOMETRY_STATUS, POSE, SECOND, START, STATUS

from tsgt.master.monitors.imu import AGREED_STATUSES, JUMP_INTERVAL_NS, ImuUseMonitor, OdometryUseMonitor

PREDICTED = replace(POSE, kind="predicted", estimator="continuous", imu="used")
SIGMA = 1e-3  # of POSE, per axis


def names(monitor: ImuUseMonitor, *uses: str) -> list[str]:
    """Event names of successive poses."""
    return [
        event.event
        for use in uses
        for event in monitor.pose(replace(PREDICTED, imu=use), START)  # type: ignore[arg-type]
    ]


def test_use_and_loss_are_events_once() -> None:
    """Also when the cause of a loss changes."""
    uses = ("starting", "used", "used", "silent", "silent", "starting", "used", "disagrees")
    assert names(ImuUseMonitor(), *uses) == ["imu_used", "imu_not_used", "imu_used", "imu_not_used"]


def test_unconfirmed_setup_is_an_event() -> None:
    """The operator has to drive; it is no loss."""
    monitor = ImuUseMonitor()
    assert names(monitor, "starting") == []
    (event,) = monitor.pose(replace(PREDICTED, imu="unconfirmed"), START)
    assert event.event == "imu_not_used"
    assert "not confirmed by driving yet" in event.message
    assert names(monitor, "unconfirmed", "starting", "unconfirmed", "used") == ["imu_used"]


def test_contradicted_station_is_an_event_once() -> None:
    """With its number."""
    monitor = ImuUseMonitor()
    monitor.pose(PREDICTED, START)
    contradicted = replace(PREDICTED, valid=False, reason="contradicted")
    (event,) = monitor.pose(contradicted, START)
    assert (event.event, event.station) == ("station_contradicted", PREDICTED.stations[0].id)
    assert not monitor.pose(contradicted, START + SECOND)


def test_contradiction_of_three_stations_ends_and_may_come_again() -> None:
    """While fewer of them measure; a valid pose ends it."""
    monitor = ImuUseMonitor()
    monitor.pose(PREDICTED, START)
    three = replace(PREDICTED, stations=(PREDICTED.stations[0],) * 3)
    contradicted = replace(three, valid=False, reason="contradicted")
    for second in range(2):
        (event,) = monitor.pose(contradicted, START + second * SECOND)
        assert (event.event, event.station) == ("station_contradicted", None)
        assert "until all three are measured again" in event.message
        assert not monitor.pose(three, START + second * SECOND)


def test_event_names_the_cause() -> None:
    """In words."""
    monitor = ImuUseMonitor()
    monitor.pose(PREDICTED, START)
    (event,) = monitor.pose(replace(PREDICTED, imu="disagrees"), START + SECOND)
    assert event.stamp_ns == START + SECOND
    assert "disagrees with the measurements" in event.message


def test_poses_without_imu_are_ignored() -> None:
    """And smoothed ones, which are late."""
    monitor = ImuUseMonitor()
    monitor.pose(PREDICTED, START)
    assert not monitor.pose(replace(PREDICTED, imu=None), START)
    assert not monitor.pose(replace(PREDICTED, kind="smoothed", imu="silent"), START)


def test_jump_beyond_the_stated_sigma_is_an_event() -> None:
    """Of the pose before the jump, and not again at once."""
    monitor = ImuUseMonitor()
    monitor.pose(PREDICTED, START)
    assert not monitor.pose(replace(PREDICTED, jump_m=4.9 * SIGMA, jump_rad=0.0), START)
    far = replace(PREDICTED, jump_m=0.0, jump_rad=5.1 * SIGMA)
    assert [event.event for event in monitor.pose(far, START)] == ["pose_jump"]
    assert not monitor.pose(far, START + SECOND)
    assert monitor.pose(far, START + JUMP_INTERVAL_NS)
    monitor.pose(replace(PREDICTED, covariance=None), START)
    assert not monitor.pose(far, START + 3 * JUMP_INTERVAL_NS)


def test_wheels_that_disagree_are_an_event_until_they_have_agreed_for_a_while() -> None:
    """Neither their loss nor that of the IMU counts as agreement."""
    monitor = OdometryUseMonitor()
    uses = [
        "used",
        "disagrees",
        "used",
        "disagrees",
        "silent",
        "without_imu",
        *["used"] * (AGREED_STATUSES + 2),
    ]
    events = [
        (second, event.event)
        for second, use in enumerate(uses)
        for event in monitor.status(replace(STATUS, odometry=replace(ODOMETRY_STATUS, use=use)))  # type: ignore[arg-type]
    ]
    assert events == [(1, "odometry_disagrees"), (5 + AGREED_STATUSES, "odometry_agrees")]
    assert monitor.status(STATUS) == []
