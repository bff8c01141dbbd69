"""A tile for each station: what it does, in words and numbers. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from tsgt.model import Status
from tsgt.recording.conditions import StationCondition, station_condition
from tsgt.web.frames import add, direction, rotate

if TYPE_CHECKING:
    from tsgt.model import PolarMeasurement, Vector3
    from tsgt.recording import SetupStation, StationStatus

SIGHT_AGE_S = 3.0
"""A line of sight is drawn to where the station last measured its prism, this long."""

LABELS = {
    Status.OK: "tracking",
    Status.LOW_ACCURACY: "tracking",
    Status.ANGLE_ONLY: "no distance",
    Status.NO_TARGET: "no prism",
    Status.TILT: "not level",
    Status.WRONG_DISTANCE: "wrong target",
    Status.ERROR: "error",
}


@dataclass(frozen=True, slots=True)
class Sight:
    """The newest measurement of a station."""

    measured_s: float  # when it arrived
    heard_s: float  # when the last measurement arrived, of the backlog as well
    status: Status
    range_m: float | None
    point_m: Vector3 | None
    """The prism in the frame of the poses, without corrections of a few centimetres."""


def sight(measurement: PolarMeasurement, station: SetupStation | None, now_s: float) -> Sight:
    """Return what a measurement says of the line of sight."""
    point = None
    distance_m = measurement.slope_distance_m
    if station is not None and distance_m is not None and measurement.status.usable:
        x, y, z = direction(measurement.horizontal_angle_rad, measurement.zenith_angle_rad)
        in_station = (distance_m * x, distance_m * y, distance_m * z)
        point = add(station.position_m, rotate(station.orientation_xyzw, in_station))
    return Sight(now_s, now_s, measurement.status, distance_m, point)


@dataclass(frozen=True, slots=True)
class Condition:
    """What a station does: tracking, searching or silent, and the words for it."""

    state: str
    words: str

    @property
    def ok(self) -> bool:
        """Whether no action is required."""
        return self.state == "tracking"


def condition(station: StationStatus, elapsed_s: float, newest: Sight | None, now_s: float) -> Condition:
    """Return what a station does; ``elapsed_s``: age of its status."""
    if station.last_heard_s is not None:
        heard_s, status = station.last_heard_s + elapsed_s, station.status
        age_s = None if station.age_s is None else station.age_s + elapsed_s
        if newest is not None:  # a measurement that came after the status
            measured_s = now_s - newest.measured_s
            heard_s = min(heard_s, now_s - newest.heard_s)
            if age_s is None or measured_s < age_s:
                status, age_s = newest.status, measured_s
        station = replace(station, last_heard_s=heard_s, age_s=age_s, status=status)
    found = station_condition(station)
    match found:
        case StationCondition.NOT_RECEIVED:
            return Condition("silent", "not received yet")
        case StationCondition.SILENT:
            return Condition("silent", f"silent for {duration(station.last_heard_s or 0.0)}")
        case StationCondition.NO_MEASUREMENT:
            return Condition("searching", "no measurement yet")
        case StationCondition.NO_NEW_MEASUREMENT:
            return Condition("searching", f"no new measurement for {duration(station.age_s or 0.0)}")
    words = "" if station.status is None else LABELS[station.status]
    return Condition("tracking" if found == StationCondition.TRACKING else "searching", words)


def note(station: StationStatus) -> str:
    """Return what the station's client says of its instrument beyond that it tracks."""
    activity = station.activity or ""
    return station.action_required or ("" if activity == "tracking" else activity)


def tile(
    station: StationStatus,
    setup: SetupStation | None,
    found: Condition,
    newest: Sight | None,
    elapsed_s: float,
    now_s: float,
) -> dict[str, Any]:
    """Return what the page shows of a station."""
    fresh = newest is not None and now_s - newest.measured_s < SIGHT_AGE_S
    bound_ns = station.clock_bound_ns if station.clock_bound_ns is not None else station.stamp_bound_ns
    return {
        "id": station.id,
        "state": found.state,
        "words": found.words,
        "note": note(station),
        "prism": station.prism if station.prism is not None else setup.prism if setup else None,
        "rate_hz": rounded(station.rate_hz, 2),
        "range_m": rounded(newest.range_m, 3) if newest is not None and fresh else None,
        "bound_ms": None if bound_ns is None else rounded(bound_ns / 1e6, 2),
        "backlog": station.outstanding,
        "drain_s": rounded(station.drain_s, 0),
        "missed_slots": station.missed_slots,
        "rssi_dbm": rounded(station.rssi_dbm, 0),
        "snr_db": rounded(station.snr_db, 0),
        "loss": rounded(station.loss, 2),
        "battery_percent": station.battery_percent,
        "air_ppm": rounded(station.atmospheric_ppm, 1),
        "check_s": rounded(station.last_target_check_age_s, 0),
        "age_s": None if station.age_s is None else rounded(station.age_s + elapsed_s, 1),
        "heard_s": None if station.last_heard_s is None else rounded(station.last_heard_s + elapsed_s, 1),
        "sight": [rounded(each, 2) for each in newest.point_m[:2]]
        if newest is not None and fresh and newest.point_m is not None
        else None,
    }


def duration(seconds: float) -> str:
    """Return a short duration: 4 s, 3 min, 2 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.0f} h"


def rounded(number: float | None, digits: int) -> float | None:
    """Round a number for the page; None stays None, as does what no JSON can hold."""
    return None if number is None or not math.isfinite(number) else round(number, digits)
