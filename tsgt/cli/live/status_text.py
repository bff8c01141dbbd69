"""The status of a daemon as text, legible on a small screen in sunlight."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsgt.cli.output import printable
from tsgt.cli.render import clock_time
from tsgt.model import Status
from tsgt.recording.conditions import (
    MAX_AGE_S,
    DiskCondition,
    RecordingCondition,
    SensorCondition,
    StationCondition,
    disk_condition,
    imu_condition,
    odometry_condition,
    recording_condition,
    station_condition,
)

if TYPE_CHECKING:
    from tsgt.recording import (
        ImuStatus,
        OdometryStatus,
        RecordingStatus,
        StationStatus,
        StatusRecord,
    )
    from tsgt.recording.journal import InstrumentRecord
    from tsgt.station import ClientStatus

MAX_MASTER_AGE_S = 10.0
"""While the master synchronises another station, a client receives nothing for a second or two."""

MIN_BACKLOG = 20  # fewer measurements are merely on their way
MAX_DRAIN_S = 1e6

WIDTH = 40
"""Characters of the narrowest terminal used in the field."""

NO_MASTER = "MASTER NOT RECEIVED"
NO_KEY = "NO KEY: anybody can take part"

LABELS = {
    Status.OK: "TRACKING",
    Status.LOW_ACCURACY: "TRACKING",
    Status.ANGLE_ONLY: "NO DISTANCE",
    Status.NO_TARGET: "NO PRISM",
    Status.TILT: "NOT LEVEL",
    Status.WRONG_DISTANCE: "WRONG TARGET",
    Status.ERROR: "ERROR",
}


Block = list[str]
"""Lines of at most :data:`WIDTH` characters that belong together; the first is a headline."""


def master_text(record: StatusRecord, no_pose: str = "") -> tuple[list[str], bool]:
    """Return a master's status in lines of at most 40 characters, and whether no action is required.

    ``no_pose``: why there is no valid pose now; empty if there is one.
    """
    head = [
        f"MASTER  {clock_time(record.stamp_ns)} UTC",
        f"poses {record.poses}, valid {record.valid_poses}",
    ]
    if record.frame_ms is not None:
        head.append(f"frame {record.frame_ms:.0f} ms")
    if record.no_poses is not None:
        head += [_headline("NOT CALIBRATED: no poses", ok=False), *wrapped(printable(record.no_poses), "  ")]
    elif no_pose:
        head += [_headline("NO VALID POSE", ok=False), *wrapped(no_pose, "  ")]
    if record.protocol == "superframe" and not record.authenticated:
        head.append(_headline(NO_KEY, ok=False))
    blocks, problems = master_blocks(record)
    return [
        *head,
        *(line for block in blocks for line in ("", *block)),
    ], not problems and not no_pose and record.no_poses is None


def master_blocks(record: StatusRecord) -> tuple[list[Block], list[str]]:
    """Return stations, IMU, wheels and recording of a master's status, and what requires action, the most urgent first."""
    blocks, problems = [], []
    for station in record.stations:
        label, ok = station_label(station)
        blocks.append([_headline(f"STATION {station.id}  {label}", ok=ok), *_station_lines(station)])
        needed = station.action_required if ok else label
        problems += [f"station {station.id}: {needed}"] if needed else []
    if record.imu is not None:
        label, ok = imu_label(record.imu)
        blocks.append([_headline(f"IMU  {label}", ok=ok), *_imu_lines(record.imu)])
        problems += [] if ok else [f"IMU: {label}"]
    if record.odometry is not None:
        label, ok = odometry_label(record.odometry)
        blocks.append([_headline(f"ODOMETRY  {label}", ok=ok), *_odometry_lines(record.odometry)])
        problems += [] if ok else [f"wheel odometry: {label}"]
    labels = _recording_labels(record)
    problems += [problem for _, problem in labels]
    if record.recording is not None:
        headline = _headline(f"RECORDING  {labels[0][0] if labels else 'OK'}", ok=not labels)
        blocks.append([headline, *_recording_lines(record.recording, record)])
    return blocks, problems


def _recording_labels(record: StatusRecord) -> list[tuple[str, str]]:
    """Return each problem of recording and disk in a word or two, and as what requires action, the most urgent first."""
    disk = disk_condition(record.disk)
    found = []
    if record.recording is not None:
        match recording_condition(record.recording, record.stamp_ns):
            case RecordingCondition.NOT_WRITTEN:
                found.append(("DISK FAILS", "the disk of the recording fails"))
            case RecordingCondition.SLOW:
                found.append(("DISK SLOW", "the disk of the recording is slow"))
        if record.recording.lost_lines:
            found.append(("LINES LOST", f"{record.recording.lost_lines} lines of the recording are lost"))
    if disk == DiskCondition.FULL:
        found.insert(0, ("DISK FULL", "the disk is full"))
    elif disk == DiskCondition.NEARLY_FULL:
        found.append(("DISK NEARLY FULL", "the disk is nearly full"))
    return found


def _recording_lines(recording: RecordingStatus, record: StatusRecord) -> Block:
    lines = wrapped(recording.file, "  ")
    space = "" if record.disk is None else f", disk {_size_text(record.disk.free_bytes)} free"
    lines.append(f"  {_size_text(recording.bytes)}{space}")
    if recording_condition(recording, record.stamp_ns) != RecordingCondition.WRITTEN:
        lines.append(f"  {recording.waiting_lines} lines not written yet")
    if recording.lost_lines:
        lines.append(f"  {recording.lost_lines} lines lost")
    return lines


def _size_text(size: int) -> str:
    """Return a size in MB or GB."""
    return f"{size / 1e6:.1f} MB" if size < 1_000_000_000 else f"{size / 1e9:.1f} GB"


def imu_label(imu: ImuStatus) -> tuple[str, bool]:
    """Return the state of the IMU in a word or two, and whether no action is required."""
    condition = imu_condition(imu)
    return _sensor_label(condition, imu.age_s), condition.ok


_SENSOR_LABELS = {
    SensorCondition.NO_SAMPLES: "NO SAMPLES YET",
    SensorCondition.FAULTY: "CHECK IT",
    SensorCondition.WRONG_SETUP: "ITS SET-UP IS WRONG",
    SensorCondition.DISAGREES: "DISAGREES WITH THE PRISMS",
    SensorCondition.UNCONFIRMED: "NOT CONFIRMED",
    SensorCondition.STARTING: "NOT IN USE YET",
    SensorCondition.WITHOUT_IMU: "NOT IN USE: NO IMU",
    SensorCondition.USED: "OK",
}


def _sensor_label(condition: SensorCondition, age_s: float | None) -> str:
    if condition == SensorCondition.SILENT and age_s is not None:
        return f"SILENT {duration(age_s)}"
    return _SENSOR_LABELS[condition]


def _imu_lines(imu: ImuStatus) -> list[str]:
    rate = "" if imu.rate_hz is None else f"{imu.rate_hz:.1f} Hz  "
    age = "" if imu.age_s is None else f"last {duration(imu.age_s)}"
    lines = [*wrapped(imu.device, "  "), f"  {rate}{age}".rstrip()]
    if imu.gaps:
        lines.append(f"  {imu.gaps} gaps, {imu.lost} samples lost")
    if imu.saturated:
        lines.append(f"  {imu.saturated} saturated samples")
    if imu.clock_skew_ppm is not None:
        lines.append(f"  clock {imu.clock_skew_ppm:+.1f} ppm")
    if imu.gyro_bias_radps is not None:
        x, y, z = map(math.degrees, imu.gyro_bias_radps)
        lines.append(f"  gyro bias {x:+.2f} {y:+.2f} {z:+.2f} deg/s")
    if imu.accelerometer_bias_mps2 is not None:
        x, y, z = (1e3 * each for each in imu.accelerometer_bias_mps2)
        lines.append(f"  acc. bias {x:+.0f} {y:+.0f} {z:+.0f} mm/s^2")
    for text in (imu.problem, imu.disagreement):
        lines += wrapped(text, "  ")
    if imu_condition(imu) == SensorCondition.UNCONFIRMED:
        lines.append("  drive curves, accelerate and brake")
    return [line for line in lines if line.strip()]


def odometry_label(odometry: OdometryStatus) -> tuple[str, bool]:
    """Return the state of the wheel odometry in a word or two, and whether no action is required."""
    condition = odometry_condition(odometry)
    if condition == SensorCondition.DISAGREES:
        return "DISAGREES WITH IMU AND PRISMS", False
    return _sensor_label(condition, odometry.age_s), condition.ok


def _odometry_lines(odometry: OdometryStatus) -> list[str]:
    rate = "" if odometry.rate_hz is None else f"{odometry.rate_hz:.1f} Hz  "
    age = "" if odometry.age_s is None else f"last {duration(odometry.age_s)}"
    lines = [*wrapped(odometry.device, "  "), f"  {rate}{age}".rstrip()]
    if odometry.gaps:
        lines.append(f"  {odometry.gaps} gaps, {odometry.lost} samples lost")
    if odometry.untrusted:
        lines.append(f"  {odometry.untrusted} untrusted samples")
    if odometry.scale is not None and odometry.scale_sigma is not None:
        lines.append(f"  scale {100 * odometry.scale:+.2f} +/- {100 * odometry.scale_sigma:.2f} %")
    if odometry.slip is not None and odometry.slip_sigma is not None:
        lines.append(f"  slip {100 * odometry.slip:+.1f} +/- {100 * odometry.slip_sigma:.1f} %")
    if odometry.rejected:
        lines.append(f"  {100 * odometry.rejected:.0f} % rejected")
    return [line for line in [*lines, *wrapped(odometry.problem, "  ")] if line.strip()]


def station_label(station: StationStatus) -> tuple[str, bool]:
    """Return the state of a station in a word or two, and whether no action is required."""
    condition = station_condition(station)
    match condition:
        case StationCondition.NOT_RECEIVED:
            label = "NOT RECEIVED YET"
        case StationCondition.SILENT:
            label = f"SILENT {duration(station.last_heard_s or 0.0)}"
        case StationCondition.NO_MEASUREMENT:
            label = "NO MEASUREMENT YET"
        case StationCondition.NO_NEW_MEASUREMENT:
            label = f"NO MEASUREMENT FOR {duration(station.age_s or 0.0)}"
        case _:
            label = "" if station.status is None else LABELS[station.status]
    return label, condition == StationCondition.TRACKING


def _station_lines(station: StationStatus) -> list[str]:
    if station.last_heard_s is None:
        return ["  off, out of range, or another key,", "  protocol or radio: run `tsgt status` there"]
    lines = []
    prism = "" if station.prism is None else f"prism {station.prism}  "
    rate = "" if station.rate_hz is None else f"{station.rate_hz:.2f} Hz  "
    age = "" if station.age_s is None else f"last {duration(station.age_s)}"
    lines.append(f"  {prism}{rate}{age}".rstrip())
    loss = "" if station.loss is None else f"loss {100 * station.loss:.0f} %  "
    strength = "" if station.rssi_dbm is None else f"{station.rssi_dbm:.0f} dBm  "
    snr = "" if station.snr_db is None else f"SNR {station.snr_db:.0f}"
    lines.append(f"  {loss}{strength}{snr}".rstrip())
    if station.clock_bound_ns is not None:
        lines.append(f"  clock bound {station.clock_bound_ns / 1e6:.2f} ms")
    elif station.stamp_bound_ns is not None:
        lines.append(f"  timestamp bound {station.stamp_bound_ns / 1e6:.2f} ms")
    counts = {
        "outstanding": station.outstanding,
        "missed slots": station.missed_slots,
        "rejected beacons": station.rejected_beacons,
    }
    lines += [f"  {count} {name}" for name, count in counts.items() if count]
    lines += _drain_lines(station)
    if station.battery_percent is not None:
        lines.append(f"  battery {station.battery_percent} %")
    if station.atmospheric_ppm is not None:
        lines.append(f"  atm. {station.atmospheric_ppm:+.1f} ppm")
    if station.activity and station.activity != "tracking":
        lines += wrapped(station.activity, "  ")
    if station.problem:
        lines += [_headline(line, ok=False) for line in wrapped(station.problem, "  ")]
    if station.last_target_check_age_s is not None:
        lines.append(f"  targets checked {duration(station.last_target_check_age_s)} ago")
    return [line for line in lines if line.strip()]


def _drain_lines(station: StationStatus) -> list[str]:
    """Return how soon a backlog has arrived; nothing while only the newest measurements are on their way."""
    if not station.outstanding or station.outstanding < MIN_BACKLOG or station.drain_rate_hz is None:
        return []
    if station.drain_s is None or station.drain_s > MAX_DRAIN_S:
        return ["  the backlog does not shrink"]
    return [f"  shrinks by {station.drain_rate_hz:.1f} a second, ends in {duration(station.drain_s)}"]


def client_text(record: ClientStatus) -> tuple[list[str], bool]:
    """Return a client's status in lines of at most 40 characters, and whether no action is required."""
    problems = _client_problems(record)
    lines = [_headline(f"STATION {record.station}  {problems[0] if problems else 'OK'}", ok=not problems)]
    lines += [_headline(problem, ok=False) for problem in problems[1:]]
    lines += [_headline(part, ok=False) for part in wrapped(record.problem)]
    lines += ["", *_instrument_lines(record)]
    if record.mode == "direct":
        lines.append("direct: single measurements")
    elif record.instrument is not None:
        lines.append(f"tracking prism {record.prism}, {record.rate_hz:.2f} Hz")
    if not lines[-1].startswith(record.activity):
        lines += wrapped(record.activity, "  ")
    if (last := record.last) is not None:
        distance = "no distance" if last.slope_distance_m is None else f"{last.slope_distance_m:.4f} m"
        lines += [
            f"last {duration(last.age_s)}: {LABELS[last.status]}",
            f"  hz {math.degrees(last.horizontal_angle_rad):.4f} v {math.degrees(last.zenith_angle_rad):.4f} deg",
            f"  {distance}",
        ]
    lines += ["", f"{record.measurements} measured, journal {'ok' if record.journal_ok else 'FAILS'}"]
    if record.journal_waiting:
        lines.append(f"  {record.journal_waiting} lines not written yet")
    if record.journal_lost:
        lines.append(f"  {record.journal_lost} lines lost")
    lines.append(f"  {printable(Path(record.journal).name)}")
    if record.master_heard_s is None:
        lines.append("master not received yet")
    else:
        lines.append(f"master received {duration(record.master_heard_s)} ago")
        lines.append(f"  {record.rssi_dbm or 0:.0f} dBm  SNR {record.snr_db or 0:.0f}")
    if NO_MASTER in problems:
        lines += _reception_hints(record)
    if record.protocol == "superframe":
        lines += _superframe_lines(record)
    return lines, not problems


def _instrument_lines(record: ClientStatus) -> list[str]:
    lines = wrapped(record.instrument or "no instrument")
    if record.battery_percent is not None:
        lines.append(f"  battery {record.battery_percent} %")
    if (settings := record.settings) is not None:
        lines += setting_lines(settings)
    return lines


def setting_lines(settings: InstrumentRecord) -> list[str]:
    """Return prism constant and atmospheric correction, as far as known, in lines of at most 40 characters."""
    lines = []
    if settings.prism_constant_m is not None:
        lines.append(f"  prism {printable(settings.prism_type)} {1e3 * settings.prism_constant_m:+.1f} mm")
    if settings.atmospheric_ppm is not None:
        air = f"  atm. {settings.atmospheric_ppm:+.1f} ppm"
        if settings.temperature_c is not None and settings.pressure_hpa is not None:
            air += f": {settings.temperature_c:.1f} C, {settings.pressure_hpa:.1f} hPa"
        lines.append(air)
    return lines


def wrapped(text: str, indent: str = "") -> list[str]:
    """Wrap a text from outside and remove its control characters."""
    lines = textwrap.wrap(
        text, WIDTH, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
    )
    # Before styling, which adds control characters of our own.
    return [printable(line) for line in lines]


def _reception_hints(record: ClientStatus) -> list[str]:
    """Return what the radio receives instead of the master, and what to compare with its configuration."""
    if record.refused and record.unknown_packets:
        return [f"  {record.refused} beacons failed to authenticate:", "  compare the keys"]
    if record.unknown_packets:
        return [
            f"  {record.unknown_packets} packets not decoded:",
            "  compare protocols, keys and software",
            "  versions",
        ]
    return ["  nothing received: master off, too far,", "  or other frequency, SF, bandwidth"]


def _superframe_lines(record: ClientStatus) -> list[str]:
    lines = [f"{record.queued} to deliver, {record.missed_slots} missed slots"]
    if record.clock_bound_ns is not None:
        lines.append(f"  clock bound {record.clock_bound_ns / 1e6:.2f} ms")
    if record.rejected_beacons:
        lines.append(f"  {record.rejected_beacons} rejected beacons")
    if not record.authenticated:
        lines.append(_headline(NO_KEY, ok=False))
    return lines


def _client_problems(record: ClientStatus) -> list[str]:
    """Return what requires action, the most urgent first."""
    last = record.last
    problems = []
    if record.instrument is None:
        problems.append("NO INSTRUMENT")
    elif record.problem:
        problems.append("CHECK THE INSTRUMENT")
    if record.instrument is not None and record.mode == "tracking":
        if last is None or (last.status.usable and last.age_s > MAX_AGE_S):
            problems.append(
                "NO MEASUREMENT" if last is None else f"NO MEASUREMENT FOR {duration(last.age_s)}"
            )
        elif not last.status.usable:
            problems.append(LABELS[last.status])
    if not record.journal_ok:
        problems.append("DISK FAILS")
    if not record.radio_ok:
        problems.append("NO RADIO")
    elif record.master_heard_s is None or record.master_heard_s > MAX_MASTER_AGE_S:
        problems.append(NO_MASTER)
    elif record.joined is False:
        problems.append("NOT JOINED")
    return problems


def duration(seconds: float) -> str:
    """Return a short duration: 0.4 s, 12 s, 3 min, 2 h."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.0f} h"


def _headline(text: str, *, ok: bool) -> str:
    """Style a headline, reversed if action is required; click removes the style without a terminal."""
    return click.style(text, bold=True, reverse=not ok)
