"""Planted defects of what the master computes, publishes and records: of poses, status and files.

As in `defects.py`, each function replaces one right function by a defective one.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.estimation import observations, pose_output, tracks
from tsgt.estimation.pose_batch import PoseBatch
from tsgt.master.classic import ingest
from tsgt.master.monitors.layout import LayoutMonitor
from tsgt.master.recording_thread import RecordingThread
from tsgt.master.station_events import StationEventDetector
from tsgt.master.statistics import Statistics
from tsgt.master.stream_server import StreamServer
from tsgt.simulation.mission import mission
from tsgt.station.links import superframe as station_link

if TYPE_CHECKING:
    from collections.abc import Callable

    from harness.missions.defects import Planting

_LAST_DIGIT = re.compile(rb"[0-9](?=[^0-9]*$)")


def date_station_late(seconds: float) -> Callable[[Planting], None]:
    """Return a planting: `continuous` takes the measurements of station 2 too late."""

    def plant(planting: Planting) -> None:
        def measured_at(original: Any) -> Any:
            def defective(measurement: Any, station: Any) -> int:
                late_ns = round(seconds * 1e9) if station.station == 2 else 0
                return int(original(measurement, station)) + late_ns

            return defective

        planting.replace_attribute(observations, "measured_at_ns", measured_at)

    return plant


def quadruple_covariance(planting: Planting) -> None:
    """Publish four times the covariance."""

    def ros_covariance(original: Any) -> Any:
        return lambda *arguments: original(*arguments) * 4

    planting.replace_attribute(pose_output, "ros_covariance", ros_covariance)


def record_other_digit(planting: Planting) -> None:
    """Change the last digit of every fiftieth pose on disk."""
    count = 0

    def put(original: Any) -> Any:
        def defective(disk: Any, line: bytes) -> None:
            nonlocal count
            if line.startswith(b'{"type":"pose"'):
                count += 1
                if count % 50 == 0:
                    line = _LAST_DIGIT.sub(lambda digit: b"7" if digit[0] != b"7" else b"3", line)
            original(disk, line)

        return defective

    planting.replace_attribute(RecordingThread, "put", put)


def skip_streamed_line(planting: Planting) -> None:
    """Send every hundredth line to no reader."""
    count = 0

    def publish(original: Any) -> Any:
        def defective(server: Any, line: bytes) -> None:
            nonlocal count
            count += 1
            if count % 100:
                original(server, line)

        return defective

    planting.replace_attribute(StreamServer, "publish", publish)


def reverse_velocities(planting: Planting) -> None:
    """Publish velocities with the wrong sign."""

    def records(original: Any) -> Any:
        def defective(batch: Any) -> Any:
            return original(replace(batch, velocity_mps=-batch.velocity_mps))

        return defective

    planting.replace_attribute(PoseBatch, "records", records)


def skip_epoch(planting: Planting) -> None:
    """Publish no pose for every hundredth epoch."""

    def records(original: Any) -> Any:
        def defective(batch: Any) -> Any:
            return (pose for pose in original(batch) if pose.stamp_ns // 50_000_000 % 100)

        return defective

    planting.replace_attribute(PoseBatch, "records", records)


def lose_polled_measurement(planting: Planting) -> None:
    """Lose every fiftieth measurement that a poll has brought, protocol classic."""
    count = 0

    def reply(original: Any) -> Any:
        def defective(*arguments: Any, **named: Any) -> Any:
            nonlocal count
            result = original(*arguments, **named)
            count += result.measurement is not None
            lost = result.measurement is not None and count % 50 == 0
            return result._replace(measurement=None) if lost else result

        return defective

    planting.replace_attribute(ingest.StationIngest, "reply", reply)


def mirror_horizontal_angles(planting: Planting) -> None:
    """Take horizontal angles as positive counter-clockwise."""

    def cartesian(original: Any) -> Any:
        return lambda horizontal_rad, *rest: original(-np.asarray(horizontal_rad), *rest)

    for module in (tracks, observations):
        planting.replace_attribute(module, "polar_to_cartesian", cartesian)


def swap_prisms(planting: Planting) -> None:
    """Give the master a layout in which prisms 1 and 2 are swapped."""

    def run_master(original: Any) -> Any:
        def defective(config: Any, parameters: Any, *arguments: Any, **named: Any) -> Any:
            one, two, *others = parameters.prisms
            swapped = (replace(one, position_m=two.position_m), replace(two, position_m=one.position_m))
            return original(config, replace(parameters, prisms=(*swapped, *others)), *arguments, **named)

        return defective

    planting.replace_attribute(mission, "run_master", run_master)


def never_journal_acknowledgements(planting: Planting) -> None:
    """Journal no acknowledgements."""
    planting.replace_attribute(
        station_link.SuperframeLink, "_write_acknowledged", lambda _: lambda _link: None
    )


def count_all_poses_as_valid(planting: Planting) -> None:
    """Count all poses as valid in the status."""

    def pose(original: Any) -> Any:
        return lambda statistics, *, valid: original(statistics, valid=valid or True)

    planting.replace_attribute(Statistics, "pose", pose)


def publish_age_zero(planting: Planting) -> None:
    """Publish 0 as the age of each prism's last measurement."""

    def shares(original: Any) -> Any:
        def defective(batch: Any) -> Any:
            return original(replace(batch, age_s=0 * batch.age_s))

        return defective

    planting.replace_attribute(PoseBatch, "_shares", shares)


def keep_first_packet_time(planting: Planting) -> None:
    """State in the status that a station was last heard when it was first heard."""

    def packet(original: Any) -> Any:
        def defective(statistics: Any, station: int, now_ns: int, **signal: float) -> None:
            first_ns = statistics._stations[station].received_ns
            original(statistics, station, now_ns if first_ns is None else first_ns, **signal)

        return defective

    planting.replace_attribute(Statistics, "packet", packet)


def report_no_lost_station(planting: Planting) -> None:
    """Publish no event of a station that is lost."""
    planting.replace_attribute(
        StationEventDetector,
        "tick",
        lambda _: lambda _detector, _now_ns, *, realtime_ns: [],  # noqa: ARG005
    )


def report_no_layout(planting: Planting) -> None:
    """Publish no event of prisms that miss their layout."""
    planting.replace_attribute(LayoutMonitor, "pose", lambda _: lambda _monitor, _record, _now_ns: [])


def state_nothing_outstanding(planting: Planting) -> None:
    """State in the status that no measurement is outstanding."""

    def superframe_state(original: Any) -> Any:
        return lambda statistics, state: original(statistics, replace(state, outstanding=0))

    planting.replace_attribute(Statistics, "superframe_state", superframe_state)
