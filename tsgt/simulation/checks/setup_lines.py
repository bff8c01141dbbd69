"""The published set-up against the parameters, and the recorded beacons against the times that stations received."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import rotation_from_quaternion
from tsgt.recording import encode_line, read_lines

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from tsgt.model import Parameters
    from tsgt.simulation.mission import JournalIndex, MasterLog, MissionResult

_TOLERANCE = 1e-9
_HEAD_LINES = 2

MAX_BEACON_ERROR_US = 1000.0
"""Scatter of the differences between recorded and sent times of beacons in a session; frames differ by milliseconds."""

MIN_BEACONS, MAX_WRONG_SHARE = 10, 0.1


def setup_failures(master_log: MasterLog, result: MissionResult) -> Iterator[str]:
    """Yield the stations and prisms that a published set-up places elsewhere than the parameters."""
    parameters = master_log.parameters or result.parameters
    frames = {each.station: np.array(each.T_station1_station) for each in parameters.stations}
    prisms = {each.prism: each.position_m for each in result.parameters.prisms}
    for setup in master_log.setups:
        for station in setup.stations:
            rotation = rotation_from_quaternion(np.array(station.orientation_xyzw))
            frame = frames[station.id]
            if not np.allclose(rotation, frame[:3, :3], atol=_TOLERANCE) or not np.allclose(
                station.position_m, frame[:3, 3], atol=_TOLERANCE
            ):
                yield f"station {station.id}: the published set-up has another frame than the parameters"
        for prism in setup.prisms:
            if not np.allclose(prism.position_m, prisms[prism.id], atol=_TOLERANCE):
                yield f"prism {prism.id}: the published set-up has another position than the parameters"


def parameter_failures(master_log: MasterLog, parameters: Parameters) -> Iterator[str]:
    """Yield a recording whose parameters are not those that the master was started with."""
    path = master_log.recording()
    if path is None:
        return
    lines = [line.data for _, line in zip(range(_HEAD_LINES), read_lines(path), strict=False)]
    if len(lines) == _HEAD_LINES and lines[1] != encode_line(parameters):
        yield f"{path.name}: its parameters are not those in force"


def beacon_failures(master_log: MasterLog, indices: Mapping[int, JournalIndex]) -> Iterator[str]:
    """Yield the first station whose journal dates beacons otherwise than the recording does."""
    for number, index in indices.items():
        differences_us: dict[int, list[float]] = {}
        for (session, counter), stamp_ns in master_log.beacons_ns.items():
            sent_us = index.sent_us.get((session, counter))
            if sent_us is not None:
                differences_us.setdefault(session, []).append(
                    (stamp_ns - master_log.unix_at_zero_ns) / 1e3 - sent_us
                )
        for session, each in differences_us.items():
            errors_us = np.abs(np.array(each) - np.median(each))
            wrong = np.count_nonzero(errors_us > MAX_BEACON_ERROR_US)
            if len(each) >= MIN_BEACONS and wrong > MAX_WRONG_SHARE * len(each):
                yield (
                    f"{wrong} of {len(each)} beacons of session {session} are recorded at other times than they were sent at by "
                    f"the journal of station {number}: off by up to {errors_us.max() / 1e3:.1f} ms"
                )
                return
