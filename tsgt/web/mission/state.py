"""What the page shows, from the lines of the stream. Sans-I/O: lines and the time come in, views go out.

Lines come some sixty times a second, views go out five times, so a line is decoded only when its numbers are shown.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from tsgt.client.delay import LeastDelay
from tsgt.model import NO_MEASUREMENT, NewestMeasurement, PolarMeasurement
from tsgt.recording import (
    PROTOCOL_VERSION,
    EventRecord,
    HelloRecord,
    PoseRecord,
    SetupRecord,
    StatusRecord,
    Typed,
    decode,
)
from tsgt.web.frames import add, inverse, product, rotate, subtract
from tsgt.web.mission import findings, stations
from tsgt.web.mission.figures import figures
from tsgt.web.mission.history import EVENTS, History, Residuals, Share, Trail
from tsgt.web.mission.stations import rounded
from tsgt.web.mission.verdict import (
    POSE_AGE_LIMIT_S,
    SILENCE_LIMIT_S,
    Finding,
    Hold,
    Level,
    PoseFacts,
    StreamFacts,
    judge,
    repeats,
    stream_findings,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.model import Row4, Vector3

_TYPE = re.compile(rb'\{"type":"(\w+)"')
_SMOOTHED = b'"kind":"smoothed"'
_DELAYED = b'"delay_s":'
_VALID = b'"valid":true'

POSE_INTERVAL_S = 0.08
"""Poses that come sooner after the last decoded one are only counted, unless their validity has changed; the newest of them is
decoded when the state is looked at.
"""

SMOOTHED_AGE_LIMIT_S = 3.0

UNREADABLE_S = 3.0
"""For this long a line that cannot be read is a finding; lines of a master come each second at least."""

MAX_TEXT = 300


class Cursors(NamedTuple):
    """How much of the histories somebody has; ``setup``: which set-up."""

    trail: int
    residuals: int
    events: int
    setup: int


class _Pose:
    """The newest decoded pose of a series, and when it arrived."""

    def __init__(self, record: PoseRecord, at_s: float) -> None:
        self.record = record
        self.at_s = at_s


class MissionState:
    """Everything that is known of the mission from one stream.

    Parameters
    ----------
    source
        Name of the stream or recording, for the page.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self._connected = False
        self._problem = "not connected yet"
        self.trail = Trail()
        self.residuals = Residuals()
        self.events = History(EVENTS)
        self._setup_number = 0
        self._frames: Any = None
        self._hold = Hold()
        self._forget()

    def _forget(self) -> None:
        """Forget what only holds of one connection; the histories stay."""
        self._line_s = -math.inf
        self._least_delay = LeastDelay()
        self._delay_s = 0.0
        self._setup: SetupRecord | None = None
        self._status: StatusRecord | None = None
        self._status_s = 0.0
        self._newest: dict[int, NewestMeasurement] = {}  # of each station
        self._forget_poses()
        self._share = Share()
        self._unreadable_s: dict[str, float] = {}  # when the last line of a type came that could not be read
        self._fences = findings.FenceMonitor()
        self._standing = findings.StandingEvents()
        self._stamp_ns = 0

    def _forget_poses(self) -> None:
        self._live: _Pose | None = None
        self._live_valid: bool | None = None
        self._not_decoded: tuple[bytes, float] | None = None  # the newest live pose, and when it arrived
        self._smoothed: _Pose | None = None
        self._sights: dict[int, stations.Sight] = {}
        self.trail.interrupt()

    # --- in ---------------------------------------------------------------------------------------------------

    def connected(self, now_s: float) -> None:
        """Take note of a new connection to the stream."""
        self._forget()
        self._connected = True
        self._line_s = now_s

    def disconnected(self, problem: str) -> None:
        """Take note that there is no connection; ``problem``: why, in one line."""
        self._connected = False
        self._problem = problem

    def line(self, data: bytes, now_s: float) -> None:
        """Take a line of the stream.

        Raises
        ------
        ValueError
            It is no line of the stream, or the stream has another protocol version.
        """
        found = _TYPE.match(data)
        name = found[1].decode() if found else decode(Typed, data).type
        if now_s - self._line_s > SILENCE_LIMIT_S:  # lines may have waited meanwhile: the next status tells
            self._delay_s = math.inf
        self._line_s = now_s
        take = self._takers().get(name)
        if take is None:
            return
        try:
            take(data, now_s)
        except ValueError:
            self._unreadable_s[name] = now_s
            raise

    def _takers(self) -> dict[str, Callable[[bytes, float], None]]:
        return {
            "hello": self._take_hello,
            "setup": self._take_setup,
            "pose": self._take_pose,
            "measurement": self._take_measurement,
            "status": self._take_status,
            "event": self._take_event,
        }

    def _take_hello(self, data: bytes, _now_s: float) -> None:
        hello = decode(HelloRecord, data)
        if hello.protocol != PROTOCOL_VERSION:
            raise ValueError(
                f"the stream has protocol version {hello.protocol}, this program knows {PROTOCOL_VERSION}"
            )

    def _take_setup(self, data: bytes, _now_s: float) -> None:
        self._setup = decode(SetupRecord, data)
        self._setup_number += 1
        frames = (
            self._setup.frame,
            [(each.id, each.position_m, each.orientation_xyzw) for each in self._setup.stations],
        )
        if self._frames is not None and frames != self._frames:
            self._forget_poses()
            self.trail.clear()
        self._frames = frames

    def _take_pose(self, data: bytes, now_s: float) -> None:
        if _SMOOTHED in data:
            self._take_smoothed(data, now_s)
            return
        valid = _VALID in data
        self._not_decoded = data, now_s
        try:
            if valid != self._live_valid or self._pose_age_s(now_s) >= POSE_INTERVAL_S:
                self._live_valid = valid
                self._decode_newest()
        except ValueError:
            valid = False
            raise
        finally:
            self._share.count(now_s, valid=valid)

    def _decode_newest(self) -> None:
        if self._not_decoded is None:
            return
        (data, now_s), self._not_decoded = self._not_decoded, None
        record = decode(PoseRecord, data)
        self._live = _Pose(record, now_s)
        self._stamp_ns = max(self._stamp_ns, record.stamp_ns)
        if record.valid and record.position_m is not None:
            self.trail.point(record.position_m, now_s)
        else:
            self.trail.interrupt()
        self.residuals.point(
            {each.prism: each.residual_m for each in record.stations if each.residual_m is not None}, now_s
        )

    def _take_smoothed(self, data: bytes, now_s: float) -> None:
        """Decode only the series that comes first: at the least delay, else the final one."""
        delays = self._setup.smoothed_delays_s if self._setup is not None else ()
        if (_DELAYED in data) != bool(delays):
            return
        if self._smoothed is not None and now_s - self._smoothed.at_s < POSE_INTERVAL_S:
            return
        record = decode(PoseRecord, data)
        if not delays or record.delay_s == min(delays):
            self._smoothed = _Pose(record, now_s)

    def _take_measurement(self, data: bytes, now_s: float) -> None:
        measurement = decode(PolarMeasurement, data)
        number = measurement.station
        if self._newest.get(number, NO_MEASUREMENT).is_newer_than(measurement):  # it is of the backlog
            if number in self._sights:
                self._sights[number] = replace(self._sights[number], heard_s=now_s)
            return
        self._newest[number] = NewestMeasurement.of(measurement)
        self._sights[number] = stations.sight(measurement, self._setup_of(number), now_s)

    def _take_status(self, data: bytes, now_s: float) -> None:
        self._status, self._status_s = decode(StatusRecord, data), now_s
        self._stamp_ns = self._status.stamp_ns
        heard_s = [each.last_heard_s for each in self._status.stations if each.last_heard_s is not None]
        if heard_s:
            self._standing.received(self._stamp_ns - round(min(heard_s) * 1e9))
        now_ns = round(now_s * 1e9)
        self._least_delay.sample(self._stamp_ns, now_ns)
        self._delay_s = (now_ns - self._least_delay.here_ns(self._stamp_ns)) / 1e9

    def _take_event(self, data: bytes, _now_s: float) -> None:
        event = decode(EventRecord, data)
        self._standing.take(event)
        self.events.add(
            {
                "stamp_ms": event.stamp_ns // 1_000_000,
                "event": plain(event.event),
                "text": plain(event.message),
                "station": event.station,
                "kind": findings.kind(event.event),
            }
        )

    # --- out --------------------------------------------------------------------------------------------------

    @property
    def setup(self) -> SetupRecord | None:
        """The set-up in force; None while it is unknown."""
        return self._setup

    @property
    def frames(self) -> Any:
        """What the frame of trail and poses is compared by: the frames of the stations in it."""
        return self._frames

    def live(self, now_s: float) -> bool:
        """Return whether the stream tells of the present: it is neither lost nor silent nor late."""
        return not stream_findings(self._stream(now_s))

    def sight_points(self, now_s: float) -> dict[int, Vector3]:
        """Return where each station has just measured its prism, by its number."""
        return {
            number: sight.point_m
            for number, sight in self._sights.items()
            if sight.point_m is not None and now_s - sight.measured_s < stations.SIGHT_AGE_S
        }

    def cursors(self) -> Cursors:
        """Return the ends of the histories, and the number of the set-up."""
        return Cursors(self.trail.count, self.residuals.count, self.events.count, self._setup_number)

    def view(self, now_s: float) -> dict[str, Any]:
        """Return everything that the page shows except the histories."""
        if self._not_decoded is not None:
            arrived_s = self._not_decoded[1]
            try:
                self._decode_newest()
            except ValueError:  # It is no pose: the one before stays, and ages
                self._unreadable_s["pose"] = arrived_s
        found = self.findings_now(now_s)
        shown = self._hold.update(found[0], now_s)
        others = [
            each for each in found if each.level is not Level.GOOD and not repeats(shown.cause, each.cause)
        ]
        live = found[0].level is not Level.STREAM_STOPPED
        return {
            "now_s": round(now_s, 2),
            "source": self._source,
            "stamp_ms": self._stamp_ns // 1_000_000,
            "verdict": {
                "words": shown.level.words,
                "cause": shown.cause,
                "urgent": shown.urgent,
            },
            "alarms": [
                {"words": each.level.words, "text": each.cause, "urgent": each.urgent} for each in others[:8]
            ],
            "pose": self._pose_view(now_s) if live else None,
            "figures": figures(
                self._live.record if self._live is not None else None,
                self._recent_smoothed(now_s),
                self._setup.limits if self._setup is not None else None,
                self._status,
                share=self._share.value(now_s),
                elapsed_s=self._pose_age_s(now_s),
            )
            if live
            else {},
            "stations": self._tiles(now_s) if live else self._silent_tiles(),
            "imu": findings.imu_view(self._status) if live else None,
            "odometry": findings.odometry_view(self._status) if live else None,
            "radio": findings.radio_view(self._status, self._setup) if live else None,
            **(findings.storage_view(self._status, self._setup) if live else {}),
        }

    def findings_now(self, now_s: float) -> list[Finding]:
        """Return everything that the operator has to know, the verdict first."""
        conditions = self._conditions(now_s)
        radio_failure = self._standing.radio_failure
        pose, limits = self._live, self._setup.limits if self._setup is not None else None
        facts = None
        if pose is not None:
            record = pose.record
            facts = PoseFacts(
                age_s=self._pose_age_s(now_s),
                valid=record.valid and bool(self._live_valid),
                explanation=findings.explanation(record, limits, conditions, radio_failure),
                degradations=findings.degradations(record, self._recent_smoothed(now_s), limits, conditions),
            )
        unreadable = [name for name, at_s in self._unreadable_s.items() if now_s - at_s < UNREADABLE_S]
        others = [
            *self._fences.findings(self._setup, self._position()),
            *self._standing.fences(),
            *findings.line_findings(unreadable, None if self._status is None else now_s - self._status_s),
            *findings.storage_findings(self._status),
            *self._standing.findings(),
            *findings.station_findings(self._status, conditions, radio_failure),
            *findings.imu_findings(self._status),
            *findings.odometry_findings(self._status),
        ]
        uncalibrated = None if self._status is None else self._status.no_poses
        waiting_for = (
            uncalibrated
            or (findings.unreadable_lines("pose") if "pose" in unreadable else "")
            or radio_failure
            or findings.waiting_for(conditions)
        )
        return judge(self._stream(now_s), facts, waiting_for, others)

    def setup_view(self) -> dict[str, Any] | None:
        """Return what the map shows of the set-up; None while it is unknown."""
        setup = self._setup
        if setup is None:
            return None
        return {
            "frame": plain(setup.frame),
            "child_frame": plain(setup.child_frame),
            "estimator": plain(setup.estimator),
            "stations": [
                {"id": each.id, "at": [rounded(each.position_m[0], 2), rounded(each.position_m[1], 2)]}
                for each in setup.stations
            ],
            "fences": [
                {
                    "name": plain(fence.name),
                    "allowed_side": fence.allowed_side,
                    "margin_m": fence.margin_m,
                    "polygon": [[rounded(x, 2), rounded(y, 2)] for x, y in fence.polygon_m],
                }
                for fence in setup.geofences
            ],
        }

    def _stream(self, now_s: float) -> StreamFacts:
        return StreamFacts(
            connected=self._connected,
            problem=self._problem,
            silence_s=now_s - self._line_s,
            delay_s=self._delay_s,
        )

    def _conditions(self, now_s: float) -> dict[int, stations.Condition]:
        if self._status is None:
            return {}
        if self._standing.radio_failure:  # nothing is known of them
            return {
                each.id: stations.Condition("silent", "the radio failed") for each in self._status.stations
            }
        elapsed_s = now_s - self._status_s
        return {
            each.id: stations.condition(each, elapsed_s, self._sights.get(each.id), now_s)
            for each in self._status.stations
        }

    def _recent_smoothed(self, now_s: float) -> PoseRecord | None:
        pose = self._smoothed
        return pose.record if pose is not None and now_s - pose.at_s < SMOOTHED_AGE_LIMIT_S else None

    def _pose_age_s(self, now_s: float) -> float:
        """Return the time since the newest readable live pose arrived."""
        return math.inf if self._live is None else now_s - self._live.at_s

    def _valid_now(self, now_s: float) -> bool:
        """Return whether there is a valid pose of now."""
        pose = self._live
        fresh = self._pose_age_s(now_s) <= POSE_AGE_LIMIT_S
        return pose is not None and pose.record.valid and bool(self._live_valid) and fresh

    def _position(self) -> tuple[float, float] | None:
        record = self._live.record if self._live is not None else None
        if record is None or not record.valid or record.position_m is None:
            return None
        return record.position_m[0], record.position_m[1]

    def _pose_view(self, now_s: float) -> dict[str, Any] | None:
        if self._live is None:
            return None
        record = self._live.record
        if record.position_m is None or record.orientation_xyzw is None:
            return None
        position, orientation = self.robot(record.position_m, record.orientation_xyzw)
        ahead = rotate(orientation, (1.0, 0.0, 0.0))
        prisms = self._setup.prisms if self._setup is not None else ()
        velocity = record.velocity_mps
        return {
            "at": [rounded(each, 3) for each in record.position_m],
            "heading_rad": rounded(math.atan2(ahead[1], ahead[0]), 4),
            "prisms": {
                each.id: [rounded(x, 2) for x in add(position, rotate(orientation, each.position_m))[:2]]
                for each in prisms
            },
            "speed_mps": None if velocity is None else rounded(math.hypot(*velocity), 2),
            "valid": self._valid_now(now_s),
            "age_s": rounded(self._pose_age_s(now_s), 2),
            "kind": record.kind,
        }

    def robot(self, position: Vector3, orientation: Row4) -> tuple[Vector3, Row4]:
        """Return the pose of the frame ``robot``, from that of the reference point."""
        if self._setup is None:
            return position, orientation
        point = self._setup.reference_point
        q = product(orientation, inverse(point.orientation_xyzw))
        return subtract(position, rotate(q, point.position_m)), q

    def _tiles(self, now_s: float) -> list[dict[str, Any]]:
        if self._status is None:
            return []
        elapsed_s = now_s - self._status_s
        conditions = self._conditions(now_s)
        return [
            stations.tile(
                each,
                self._setup_of(each.id),
                conditions[each.id],
                self._sights.get(each.id),
                elapsed_s,
                now_s,
            )
            for each in self._status.stations
        ]

    def _silent_tiles(self) -> list[dict[str, Any]]:
        """Return tiles that state nothing: without a stream nothing is known of a station."""
        known = self._status.stations if self._status is not None else ()
        return [{"id": each.id, "state": "unknown", "words": "unknown"} for each in known]

    def _setup_of(self, station: int) -> Any:
        known = self._setup.stations if self._setup is not None else ()
        return next((each for each in known if each.id == station), None)


def plain(text: str) -> str:
    """Return text from outside in one line of bounded length, without control characters."""
    return "".join(sign if sign.isprintable() else " " for sign in text[:MAX_TEXT])
