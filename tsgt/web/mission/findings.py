"""What the records say that the operator has to know: pose, fences, storage, stations, IMU, wheels, lasting events. Sans-I/O."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

from tsgt.polygon import contains, distance_to_edge, edges
from tsgt.recording.conditions import (
    DiskCondition,
    RecordingCondition,
    SensorCondition,
    disk_condition,
    imu_condition,
    odometry_condition,
    recording_condition,
)
from tsgt.web.frames import worst_sigma
from tsgt.web.mission.verdict import Finding, Level

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tsgt.recording import (
        EventRecord,
        PoseRecord,
        RecordingStatus,
        SetupRecord,
        StatusRecord,
        ValidityLimits,
    )
    from tsgt.web.mission.stations import Condition

ALARMS = frozenset(
    {
        "station_lost", "battery_low", "radio_failed", "geofence_exited", "layout_residual_high", "imu_setup_wrong", "imu_lost",
        "beacon_time_rejected", "link_delay_anomaly", "unauthenticated", "station_contradicted", "disk_full", "disk_failed",
        "setup_missing", "setup_rejected", "other_master",
    }
)  # fmt: skip
"""Events that need the operator."""

_END = {
    "radio_failed": {"radio_recovered"},
    "layout_residual_high": {"layout_residual_normal", "setup_applied"},
    "imu_setup_wrong": {"imu_setup_confirmed", "setup_applied"},
    "disk_full": {"disk_low", "disk_failed", "disk_recovered"},
    "disk_failed": {"disk_low", "disk_full", "disk_recovered"},
}
"""Events that begin a lasting state that no status tells, or tells later, each with those that end it."""

_ONLY_EVENTS_TELL = frozenset({"layout_residual_high"})
"""The other lasting states, and those of geofences, follow from status and poses as well, roughly."""

_URGENT = frozenset({"radio_failed", "disk_full", "disk_failed"})

_GOOD_NEWS = frozenset(
    {
        "station_recovered", "battery_recovered", "station_measuring", "station_tracking", "radio_recovered", "imu_setup_confirmed",
        "disk_recovered", "imu_recovered", "imu_plausible", "imu_used", "odometry_recovered", "odometry_agrees", "geofence_entered", "layout_residual_normal",
        "setup_applied",
    }
)  # fmt: skip

_FENCE = re.compile(r"geofence (.*?) (?:exited|entered)(: no valid pose)?")

STATUS_AGE_LIMIT_S = 3.0
"""A master sends a status each second."""

FENCE_HYSTERESIS_M = 0.1
"""A robot that is parked at a fence does not change the verdict by the noise of its poses."""

UNCONFIRMED = "the set-up of the IMU is not confirmed: drive curves, accelerate and brake; after a knock check its bracket"
"""The operator has to act: without that poses do without the IMU, or rest on one that may be set up wrongly."""

DISK_FULL = "the disk is full"

NONE_RECEIVED = "no station is received: the master's radio?"


def kind(event: str) -> str:
    """Return how the page shows an event: ``alarm``, ``good`` or ``note``."""
    return "alarm" if event in ALARMS else "good" if event in _GOOD_NEWS else "note"


class StandingEvents:
    """Lasting states that only events tell: from the event that begins one to the event that ends it."""

    def __init__(self) -> None:
        self._messages: dict[str, str] = {}
        self._fences: dict[str, str] = {}
        self._radio_failed_ns = 0

    def take(self, event: EventRecord) -> None:
        """Take an event."""
        if event.event == "lines_lost":  # perhaps those that ended them
            self._fences.clear()
            for name in self._messages.keys() - _ONLY_EVENTS_TELL:
                del self._messages[name]
        elif (fence := _FENCE.match(event.message)) and event.event.startswith("geofence_"):
            if event.event == "geofence_exited":
                # The limit: the boundary less margin and uncertainty. The robot may be inside.
                where = "perhaps outside" if fence[2] else "beyond the limit of"
                self._fences[fence[1]] = f"{where} the geofence {fence[1]}{fence[2] or ''}"
            else:
                self._fences.pop(fence[1], None)
        elif event.event in _END:
            self._messages[event.event] = DISK_FULL if event.event == "disk_full" else event.message
            if event.event == "radio_failed":
                self._radio_failed_ns = event.stamp_ns
        for begin, ends in _END.items():
            if event.event in ends:
                self._messages.pop(begin, None)

    def received(self, at_ns: int) -> None:
        """Take note that a station was received at a time on the master's Unix clock: the radio works."""
        if at_ns > self._radio_failed_ns:
            self._messages.pop("radio_failed", None)

    def fences(self) -> list[Finding]:
        """Return the geofences whose limit the robot has crossed, or may have crossed."""
        return [Finding(Level.CARE, text, urgent=True) for text in self._fences.values()]

    @property
    def radio_failure(self) -> str:
        """Why the master's radio cannot be used; empty while it can."""
        return self._messages.get("radio_failed", "")

    def findings(self) -> list[Finding]:
        """Return the other lasting states."""
        return [
            Finding(Level.CARE, message, urgent=name in _URGENT) for name, message in self._messages.items()
        ]


def explanation(
    pose: PoseRecord,
    limits: ValidityLimits | None,
    conditions: Mapping[int, Condition],
    radio_failure: str = "",
) -> str:
    """Return why a pose is invalid, for people."""
    match pose.reason:
        case "outage" | "station_status":
            if radio_failure or _none_received(conditions):
                return radio_failure or NONE_RECEIVED
            return _missing(pose, conditions) or "a prism is not measured"
        case "uncertain":
            return _uncertain(pose, limits)
        case "residual":
            limit = "" if limits is None else f", limit {1e3 * limits.residual_m:.0f} mm"
            found = "" if pose.residual_m is None else f" by {1e3 * pose.residual_m:.0f} mm{limit}"
            return f"the prisms miss their layout{found}: tripod or prism moved?"
        case "degenerate_geometry":
            return "the prisms seen give no rotation: too close to a line"
        case "tilt":
            return "the robot would lean too far: prisms swapped or layout mirrored?"
        case "contradicted":
            return "the IMU contradicted the stations: tripod or prism moved? Check them, then restart the master"
    return "the pose is invalid"


def degradations(
    pose: PoseRecord,
    smoothed: PoseRecord | None,
    limits: ValidityLimits | None,
    conditions: Mapping[int, Condition],
) -> tuple[str, ...]:
    """Return what degrades a valid pose, for people, the worst first.

    Predictions without an IMU are uncertain whenever the robot may accelerate, so uncertainty is judged by the smoothed
    pose where one is sent.
    """
    degraded_by = set(pose.degraded_by)
    if smoothed is not None:
        degraded_by.discard("uncertain")
        degraded_by |= set(smoothed.degraded_by) & {"uncertain"}
    texts = {
        "imu_disagrees": "the IMU disagrees with the prisms: IMU, tripod or prism moved? Check the tripods first",
        "prism_missing": _missing(pose, conditions) or "a prism is not measured",
        "old_measurements": "the pose rests on old measurements",
        "ambiguous": "measurements contradict each other",
        "imu_unconfirmed": UNCONFIRMED,
        "residual": "the prisms nearly miss their layout: tripod or prism moved?",
        "uncertain": _uncertain(smoothed or pose, limits),
    }
    found = [text for name, text in texts.items() if name in degraded_by]
    if smoothed is not None and not smoothed.valid:
        found.append(f"{smoothed.delay_s or 0:g} s later: {explanation(smoothed, limits, conditions)}")
    return tuple(found)


def _missing(pose: PoseRecord, conditions: Mapping[int, Condition]) -> str:
    """Return which prisms are not measured: those that the pose names, else those of stations in trouble, else the oldest."""
    troubled = {number for number, found in conditions.items() if not found.ok}
    missing = (
        [each for each in pose.stations if each.reason]
        or [each for each in pose.stations if each.id in troubled]
        or sorted(pose.stations, key=lambda each: -math.inf if each.age_s is None else -each.age_s)[:1]
    )
    texts = []
    for each in missing:
        found = conditions.get(each.id)
        age = (
            ""
            if each.age_s is None
            else f" for {each.age_s:.1f} s"
            if each.age_s < 10
            else f" for {each.age_s:.0f} s"
        )
        words = f" ({found.words})" if found is not None and not found.ok else ""
        texts.append(f"station {each.id} has not measured prism {each.prism}{age}{words}")
    return "; ".join(texts)


def _uncertain(pose: PoseRecord, limits: ValidityLimits | None) -> str:
    if pose.covariance is None:
        return "the pose is not known well enough"
    smoothed = pose.kind == "smoothed"
    position_mm = 1e3 * worst_sigma(pose.covariance, 0)
    rotation_deg = math.degrees(worst_sigma(pose.covariance, 3))
    position_limit = rotation_limit = None
    if limits is not None:
        position_limit = limits.position_sigma_m if smoothed else limits.predicted_position_sigma_m
        rotation_limit = limits.rotation_sigma_rad if smoothed else limits.predicted_rotation_sigma_rad
    if position_limit is None or rotation_limit is None:
        return f"uncertain: {position_mm:.0f} mm, {rotation_deg:.1f} deg"
    position_share, rotation_share = (
        position_mm / 1e3 / position_limit,
        math.radians(rotation_deg) / rotation_limit,
    )
    if not pose.valid and max(position_share, rotation_share) <= 1.0:
        return "the measurements do not confirm the pose yet"
    if position_share >= rotation_share:
        return f"position uncertain: {position_mm:.0f} mm, limit {1e3 * position_limit:.0f} mm"
    return f"rotation uncertain: {rotation_deg:.1f} deg, limit {math.degrees(rotation_limit):.1f} deg"


def waiting_for(conditions: Mapping[int, Condition]) -> str:
    """Return what a pose waits for."""
    missing = _stations_in_words(conditions)
    if missing:
        return "; ".join(missing)
    return "the estimator is starting" if conditions else "no status yet"


def _none_received(conditions: Mapping[int, Condition]) -> bool:
    return len(conditions) > 1 and all(found.state == "silent" for found in conditions.values())


def _stations_in_words(conditions: Mapping[int, Condition]) -> list[str]:
    """Return what the stations do that need the operator, those that do the same together."""
    by_words: dict[str, list[str]] = {}
    for number, found in conditions.items():
        if not found.ok:
            by_words.setdefault(found.words, []).append(str(number))
    return [
        f"station {numbers[0]}: {words}"
        if len(numbers) == 1
        else f"stations {', '.join(numbers[:-1])} and {numbers[-1]}: {words}"
        for words, numbers in by_words.items()
    ]


class FenceMonitor:
    """Which geofences the robot is outside of, or close to, with a hysteresis."""

    def __init__(self) -> None:
        self._outside: set[str] = set()
        self._close: set[str] = set()

    def findings(self, setup: SetupRecord | None, position: tuple[float, float] | None) -> list[Finding]:
        """Return the findings at a position; None: there is no valid pose."""
        if setup is None or position is None:
            return []
        found = []
        for fence in setup.geofences:
            name = fence.name
            try:
                distance_m = min(distance_to_edge(position, edge)[0] for edge in edges(fence.polygon_m))
                allowed = contains(fence.polygon_m, position) == (fence.allowed_side == "inside")
            except ArithmeticError:  # a polygon that no master has accepted
                continue
            inside_m = distance_m if allowed else -distance_m
            outside = _below(inside_m, 0.0, name, self._outside)
            close = _below(inside_m, fence.margin_m, name, self._close)
            if outside:
                found.append(Finding(Level.CARE, f"outside the geofence {name}", urgent=True))
            elif close:
                text = f"{distance_m:.1f} m from the boundary of the geofence {name}"
                found.append(Finding(Level.CARE, text))
        return found


def _below(value_m: float, limit_m: float, name: str, below: set[str]) -> bool:
    """Return whether a value is below its limit, which is higher for a name that was below; keep the name if it is."""
    is_below = value_m < limit_m + (FENCE_HYSTERESIS_M if name in below else 0.0)
    (below.add if is_below else below.discard)(name)
    return is_below


def unreadable_lines(name: str) -> str:
    """Return that lines of a type cannot be read: the master is newer, and this program was not restarted with it."""
    return f"{name} lines cannot be read: restart or update tsgt web"


def line_findings(unreadable: Sequence[str], status_age_s: float | None) -> list[Finding]:
    """Return what is wrong with the lines themselves: types that cannot be read, and a status that is old."""
    texts = [unreadable_lines(name) for name in unreadable]
    if status_age_s is not None and status_age_s > STATUS_AGE_LIMIT_S:
        texts.append(f"no status of the master for {status_age_s:.0f} s")
    return [Finding(Level.CARE, text) for text in texts]


def station_findings(
    status: StatusRecord | None, conditions: Mapping[int, Condition], radio_failure: str = ""
) -> list[Finding]:
    """Return which stations need the operator; none where the radio fails, which another finding tells."""
    if status is None or radio_failure:
        return []
    if _none_received(conditions):
        return [Finding(Level.CARE, NONE_RECEIVED, urgent=True)]
    notes = [
        f"station {station.id}: {station.action_required}"
        for station in status.stations
        if station.action_required and station.id in conditions and conditions[station.id].ok
    ]
    return [Finding(Level.CARE, text) for text in (*_stations_in_words(conditions), *notes)]


def imu_findings(status: StatusRecord | None) -> list[Finding]:
    """Return what is wrong with the robot's IMU."""
    imu = status.imu if status is not None else None
    if imu is None:
        return []
    texts = {
        SensorCondition.NO_SAMPLES: "the IMU gives no samples",
        SensorCondition.SILENT: "the IMU gives no samples",
        SensorCondition.FAULTY: f"IMU: {imu.problem}",
        SensorCondition.WRONG_SETUP: "the set-up of the IMU is wrong",
        SensorCondition.UNCONFIRMED: UNCONFIRMED,
        SensorCondition.DISAGREES: "the IMU disagrees with the prisms",
    }
    return _finding(texts, imu_condition(imu))


def _finding(texts: Mapping[SensorCondition, str], condition: SensorCondition) -> list[Finding]:
    return [Finding(Level.CARE, texts[condition])] if condition in texts else []


def imu_view(status: StatusRecord | None) -> dict[str, Any] | None:
    """Return what the page shows of the IMU; None without one."""
    imu = status.imu if status is not None else None
    if imu is None:
        return None
    return {"device": imu.device[:60], "use": imu.use, "rate_hz": imu.rate_hz, "problem": imu.problem[:200]}


def odometry_findings(status: StatusRecord | None) -> list[Finding]:
    """Return what is wrong with the robot's wheel odometry."""
    odometry = status.odometry if status is not None else None
    if odometry is None:
        return []
    texts = {
        SensorCondition.NO_SAMPLES: "the wheel odometry gives no samples",
        SensorCondition.SILENT: "the wheel odometry gives no samples",
        SensorCondition.FAULTY: f"wheel odometry: {odometry.problem}",
        SensorCondition.DISAGREES: "the wheel odometry disagrees with IMU and prisms",
    }
    return _finding(texts, odometry_condition(odometry))


def odometry_view(status: StatusRecord | None) -> dict[str, Any] | None:
    """Return what the page shows of the wheel odometry; None without one."""
    odometry = status.odometry if status is not None else None
    if odometry is None:
        return None
    return {
        "device": odometry.device[:60],
        "use": odometry.use,
        "rate_hz": odometry.rate_hz,
        "problem": odometry.problem[:200],
        "slip": odometry.slip,
        "rejected": odometry.rejected,
    }


def radio_view(status: StatusRecord | None, setup: SetupRecord | None) -> dict[str, Any]:
    """Return protocol and authentication of the radio."""
    known = status if status is not None and status.protocol is not None else setup
    return {
        "protocol": known.protocol if known is not None else None,
        "authenticated": known.authenticated if known is not None else None,
        "frame_ms": status.frame_ms if status is not None else None,
    }


def storage_view(status: StatusRecord | None, setup: SetupRecord | None) -> dict[str, Any]:
    """Return recording and disk."""
    recording = status.recording if status is not None else None
    disk = status.disk if status is not None else None
    return {
        "recording": {"file": setup.recording if setup is not None else None}
        if status is None or recording is None
        else {
            "file": recording.file,
            "bytes": recording.bytes,
            "write_age_s": None
            if recording.last_write_ns is None
            else round((status.stamp_ns - recording.last_write_ns) / 1e9, 1),
            "bad": bool(_recording_findings(status.stamp_ns, recording)),
        },
        "disk": None
        if disk is None
        else {
            "free_bytes": disk.free_bytes,
            "total_bytes": disk.total_bytes,
            "bad": disk_condition(disk) != DiskCondition.OK,
        },
    }


def storage_findings(status: StatusRecord | None) -> list[Finding]:
    """Return what is wrong with recording and disk."""
    if status is None:
        return []
    found = [] if status.recording is None else _recording_findings(status.stamp_ns, status.recording)
    condition = disk_condition(status.disk)
    if status.disk is not None and condition != DiskCondition.OK:
        full = condition == DiskCondition.FULL
        words = DISK_FULL if full else "the disk is nearly full"
        found.append(Finding(Level.CARE, f"{words}: {status.disk.free_bytes / 1e6:.0f} MB left", urgent=full))
    return found


def _recording_findings(now_ns: int, recording: RecordingStatus) -> list[Finding]:
    found = []
    match recording_condition(recording, now_ns):
        case RecordingCondition.NOT_WRITTEN:
            since = (
                ""
                if recording.last_write_ns is None
                else f" for {(now_ns - recording.last_write_ns) / 1e9:.0f} s"
            )
            found.append(Finding(Level.CARE, f"nothing has been recorded{since}", urgent=True))
        case RecordingCondition.SLOW:
            waiting = f"the disk is slow: {recording.waiting_lines} lines wait to be recorded"
            found.append(Finding(Level.CARE, waiting, urgent=True))
    if recording.lost_lines:
        found.append(
            Finding(Level.CARE, f"{recording.lost_lines} lines of the recording are lost", urgent=True)
        )
    return found
