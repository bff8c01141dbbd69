"""Live events on the use of the robot's IMU and wheels: taken, left out with the cause, and predictions that moved too far. Sans-I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.master.publisher import Observer
from tsgt.model import MIN_PRISMS
from tsgt.recording import EventRecord

if TYPE_CHECKING:
    from tsgt.recording import PoseRecord, StatusRecord

MAX_JUMP_SIGMAS = 5.0
"""Distance by which new measurements may move a prediction, in sigmas that it stated."""

JUMP_INTERVAL_NS = 10_000_000_000  # at most one event

AGREED_STATUSES = 5
"""One a second, in which wheels that disagreed must have been used again, so that wheels that spin now and then are no stream of events."""

_CAUSES = {
    "starting": "its trajectory is not certain enough",
    "silent": "there is no sample",
    "disagrees": "it disagrees with the measurements of the prisms, because its samples are wrong, or it, a tripod or a prism has moved",
    "wrong_setup": "its set-up is wrong",
    "unconfirmed": "its set-up is not confirmed by driving yet: drive curves, accelerate and brake",
}


class ImuUseMonitor(Observer):
    """Watches the predicted poses of one set-up, and whether the IMU has contradicted one or two stations."""

    def __init__(self) -> None:
        self._use = "starting"
        self._contradicted = False
        self._reported = False  # that it is not used
        self._sigmas = (math.inf, math.inf)
        self._next_jump_ns = -(2**63)

    def pose(self, record: PoseRecord, now_ns: int) -> list[EventRecord]:
        """Take a pose that was published at ``now_ns``; return ``imu_used``, ``imu_not_used``, ``pose_jump`` and ``station_contradicted``."""
        if record.kind != "predicted" or record.imu is None:
            return []
        events = self._jump(record, now_ns)
        self._sigmas = _sigmas(record)
        if record.reason == "contradicted" and not self._contradicted:
            self._contradicted = True
            events.append(_contradiction([each.id for each in record.stations], now_ns))
        # With three stations they are valid again once the prisms check each other.
        self._contradicted &= not record.valid
        if record.imu != self._use:
            # While it is not used its cause may change; there is one event, and one when it is used again. There is none
            # for the first seconds, but for an IMU that is not used until the robot drives.
            lost = self._use == "used" or (record.imu == "unconfirmed" and not self._reported)
            if record.imu == "used" or lost:
                events.append(_event(record.imu, now_ns))
                self._reported = lost
            self._use = record.imu
        return events

    def _jump(self, record: PoseRecord, now_ns: int) -> list[EventRecord]:
        if record.jump_m is None or record.jump_rad is None or now_ns < self._next_jump_ns:
            return []
        jumps = (record.jump_m, record.jump_rad)
        if all(jump <= MAX_JUMP_SIGMAS * sigma for jump, sigma in zip(jumps, self._sigmas, strict=True)):
            return []
        self._next_jump_ns = now_ns + JUMP_INTERVAL_NS
        message = (
            f"new measurements moved the predicted pose by {1e3 * record.jump_m:.1f} mm and "
            f"{math.degrees(record.jump_rad):.2f} deg, more than {MAX_JUMP_SIGMAS:g} sigmas"
        )
        return [EventRecord(stamp_ns=now_ns, event="pose_jump", message=message)]


class OdometryUseMonitor(Observer):
    """Watches in the status whether the wheel odometry disagrees with IMU and prisms."""

    def __init__(self) -> None:
        self._disagrees = False
        self._agreed = 0  # Successive statuses in which it was used again

    def status(self, record: StatusRecord) -> list[EventRecord]:
        """Take a status; return ``odometry_disagrees`` and ``odometry_agrees``."""
        use = None if record.odometry is None else record.odometry.use
        if use == "disagrees":
            self._agreed = 0
            if not self._disagrees:
                self._disagrees = True
                message = (
                    "the wheel odometry disagrees with IMU and prisms and hardly counts: wheels spin, stick or are lifted, "
                    "or its scale, direction or latency is wrong"
                )
                return [EventRecord(stamp_ns=record.stamp_ns, event="odometry_disagrees", message=message)]
        elif self._disagrees and use == "used":
            self._agreed += 1
            if self._agreed == AGREED_STATUSES:
                self._disagrees, self._agreed = False, 0
                message = "the wheel odometry agrees with IMU and prisms again"
                return [EventRecord(stamp_ns=record.stamp_ns, event="odometry_agrees", message=message)]
        return []


def _contradiction(stations: list[int], now_ns: int) -> EventRecord:
    until, stayed = "the master is restarted or takes a new set-up", "then stayed at the new position"
    if len(stations) >= MIN_PRISMS:
        until = "all three are measured again"
        measured, whose = "those stations that still measure", "a tripod or prism"
    elif len(stations) == 1:
        measured, whose = f"station {stations[0]}", "its tripod or prism"
        stayed += ", or its instrument was not level"
    else:
        measured, whose = f"stations {' and '.join(map(str, stations))}", "a tripod or prism"
    message = (
        f"measurements of {measured} contradicted the IMU and {stayed}: {whose} may have moved; "
        f"poses are invalid until {until}. Check the stations first: tsgt calibrate check"
    )
    station = stations[0] if len(stations) == 1 else None
    return EventRecord(stamp_ns=now_ns, event="station_contradicted", message=message, station=station)


def _event(use: str, now_ns: int) -> EventRecord:
    if use == "used":
        return EventRecord(stamp_ns=now_ns, event="imu_used", message="poses rest on the IMU")
    message = f"poses do not rest on the IMU: {_CAUSES[use]}"
    return EventRecord(stamp_ns=now_ns, event="imu_not_used", message=message)


def _sigmas(record: PoseRecord) -> tuple[float, float]:
    """Return the sigmas of position in m and rotation in rad in the least certain direction; infinite without a pose."""
    if record.covariance is None or not record.valid:
        return math.inf, math.inf
    covariance = np.array(record.covariance).reshape(6, 6)
    position, rotation = (
        math.sqrt(max(float(np.linalg.eigvalsh(covariance[part, part])[-1]), 0.0))
        for part in (slice(0, 3), slice(3, 6))
    )
    return position, rotation
