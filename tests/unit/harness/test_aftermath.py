"""The checks of what killed daemons have left: each finds what it looks for, and nothing in what is as it should be."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.aftermath import aftermath
from harness.records import HEADER, PARAMETERS, measurement

from tsgt.radio.superframe.wire import RESTART_SKIP
from tsgt.recording import encode_line
from tsgt.recording.journal import JournalRecord
from tsgt.simulation.instrument import ReportedDistance
from tsgt.station.geocom import ReturnCode

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from harness.aftermath import Found

    from tsgt.model import PolarMeasurement

MS = 1_000_000
ZERO_NS = 1_700_000_000_000_000_000


def made(number: int) -> PolarMeasurement:
    """Return a measurement of station 1 as the journal has it."""
    made_ns = 400 * MS * number
    stamp_ns = ZERO_NS + made_ns
    return replace(
        measurement(number),
        station=1,
        sequence=number,
        stamp_ns=stamp_ns,
        host_time_ns=stamp_ns,
        received_ns=stamp_ns,
        instrument_time_ns=made_ns,
        slope_distance_m=40.0 + 0.001 * number,
    )


SECOND_RUN = 5 + RESTART_SKIP


def delivered(number: int, *, late_ns: int = 0) -> PolarMeasurement:
    """Return it as the master records it, whose Unix clock is ahead by a minute."""
    stamp_ns = made(number).stamp_ns + 60_000 * MS + late_ns
    return replace(
        made(number), stamp_ns=stamp_ns, host_time_ns=None, received_ns=stamp_ns, stamp_bound_ns=200_000
    )


class Left:
    """A folder with two journals, of a client that was killed once, and two recordings of a master likewise."""

    def __init__(self, folder: Path) -> None:
        self.journals, self.recordings = folder / "journals1", folder / "recordings"
        self.journals.mkdir()
        self.recordings.mkdir()
        self.journal("a", 0, range(5))
        self.journal("b", SECOND_RUN, range(SECOND_RUN, SECOND_RUN + 5))
        self.recording("a", [delivered(number) for number in range(4)])
        self.recording("b", [delivered(number) for number in (3, 4, *range(SECOND_RUN, SECOND_RUN + 5))])

    def journal(self, name: str, first_sequence: int, numbers: Sequence[int], *, stream_id: int = 7) -> Path:
        """Write one."""
        head = JournalRecord(
            station=1, unix_at_zero_ns=ZERO_NS, boot="boot", stream_id=stream_id, first_sequence=first_sequence
        )
        return self._write(self.journals / f"{name}.jsonl", [HEADER, head, *map(made, numbers)])

    def recording(self, name: str, measurements: Sequence[PolarMeasurement]) -> Path:
        """Write one."""
        return self._write(self.recordings / f"{name}.jsonl", [HEADER, PARAMETERS, *measurements])

    def _write(self, path: Path, records: Sequence[object]) -> Path:
        path.write_bytes(b"".join(encode_line(record) + b"\n" for record in records))
        return path

    def found(self, *, queued: int = 0) -> Found:
        """Check it."""
        numbers = (*range(5), *range(SECOND_RUN, SECOND_RUN + 5))
        offered = [
            ReportedDistance(
                instrument_ms=400 * number,
                true_ns=400 * MS * number,
                horizontal_angle_rad=made(number).horizontal_angle_rad,
                zenith_angle_rad=made(number).zenith_angle_rad,
                distance_m=40.0 + 0.001 * number,
                prism=made(number).prism,
                code=ReturnCode.OK,
            )
            for number in numbers
        ]
        recordings = sorted(self.recordings.iterdir())
        return aftermath(recordings, {1: self.journals}, {1: offered}, {1: queued})

    def checks(self, *, queued: int = 0) -> set[str]:
        """Return which checks have found something."""
        return {violation.check for violation in self.found(queued=queued).violations}


@pytest.fixture
def left(tmp_path: Path) -> Left:
    """Return what is as it should be."""
    return Left(tmp_path)


def test_nothing_is_found_where_nothing_is_wrong(left: Left) -> None:
    """A later master may have what an earlier one has, whose acknowledgement was lost."""
    found = left.found()
    assert found.violations == []
    assert found.counts["measurements recorded"] == found.counts["measurements journalled"] == 10
    assert found.counts["recorded again by a later master"] == 1


def test_a_torn_tail_is_counted_and_anything_else_is_found(left: Left) -> None:
    """Half a line at the end, files that were just begun; but no line before the last."""
    for folder in (left.journals, left.recordings):
        with (folder / "b.jsonl").open("ab") as file:
            file.write(b'{"type":"meas')
        (folder / "c.jsonl").touch()
        (folder / "d.jsonl").write_bytes(encode_line(HEADER) + b"\n" + b'{"ty')
    found = left.found()
    assert found.violations == []
    assert found.counts["torn tails of journals"] == found.counts["torn tails of recordings"] == 2
    assert found.counts["journals without a head"] == found.counts["recordings without a head"] == 2
    with (left.journals / "a.jsonl").open("ab") as file:
        file.write(b'{"type":"meas\n')
    assert "torn" in left.checks()


def test_a_line_that_is_json_but_not_whole_is_found(left: Left) -> None:
    """A measurement without its station, say."""
    with (left.journals / "a.jsonl").open("ab") as file:
        file.write(b'{"type":"measurement"}\n')
    assert "torn" in left.checks()


def test_what_is_lost_is_found(left: Left) -> None:
    """Unless it waits in the queue."""
    left.recording("b", [delivered(number) for number in range(SECOND_RUN, SECOND_RUN + 4)])
    assert left.checks(queued=2) == set()
    assert left.checks(queued=1) == {"lost"}


def test_what_is_recorded_twice_is_found(left: Left) -> None:
    """By one master."""
    left.recording("a", [delivered(number) for number in (0, 1, 2, 3, 3)])
    assert left.checks() == {"duplicate"}


def test_a_number_that_is_given_again_is_found(left: Left) -> None:
    """By a run that goes on too early, or begins anew, or leaves one out."""
    left.journal("b", SECOND_RUN - 1, range(SECOND_RUN, SECOND_RUN + 5))
    assert "number" in left.checks()
    left.journal("b", SECOND_RUN, range(SECOND_RUN, SECOND_RUN + 5), stream_id=8)
    assert left.checks() == {"number"}
    left.journal(
        "b", SECOND_RUN, (SECOND_RUN, SECOND_RUN + 2, SECOND_RUN + 1, SECOND_RUN + 3, SECOND_RUN + 4)
    )
    assert left.checks() == {"number"}


def test_another_measurement_under_the_same_number_is_found(left: Left) -> None:
    """As the recording has it, the journal has not."""
    other = replace(delivered(2), slope_distance_m=41.0)
    left.recording("a", [delivered(0), delivered(1), other, delivered(3)])
    assert left.checks() == {"journal"}


def test_a_time_beyond_its_bound_is_found(left: Left) -> None:
    """Whatever the master's Unix clock showed."""
    late = delivered(2, late_ns=2_097_152_000)
    left.recording("a", [delivered(0), delivered(1), late, delivered(3)])
    assert left.checks() == {"time"}
