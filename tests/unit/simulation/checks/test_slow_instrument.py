"""The limit of timestamp errors where an instrument is slower than usual, in journals without a mission."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.files.records import HEADER, measurement

from tsgt.recording import encode_line
from tsgt.recording.journal import JournalRecord
from tsgt.simulation.checks.invariants import reading_mismatches
from tsgt.simulation.instrument import ReportedDistance
from tsgt.simulation.mission import JournalIndex, StationLog
from tsgt.station.geocom import ReturnCode

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.model import PolarMeasurement

MS = 1_000_000
ZERO_NS = 1_700_000_000_000_000_000
INTERVAL_MS = 400
SWITCHED_ON_AGAIN = 30  # the number of the first distance after that


def _journalled(number: int) -> PolarMeasurement:
    on_ms = INTERVAL_MS * (SWITCHED_ON_AGAIN - 10) if number >= SWITCHED_ON_AGAIN else 0
    stamp_ns = ZERO_NS + INTERVAL_MS * MS * number
    return replace(
        measurement(number),
        sequence=number,
        stamp_ns=stamp_ns,
        host_time_ns=stamp_ns,
        received_ns=stamp_ns,
        instrument_time_ns=(INTERVAL_MS * number - on_ms) * MS,
        slope_distance_m=40.0 + 0.001 * number,
    )


def _wrong(
    folder: Path, late_ms: Sequence[float], slowed_by: Sequence[float], starts: Sequence[int] = ()
) -> list[str]:
    """Return what is wrong with distances that are stamped this much too late, the client restarted before some of them."""
    measured = [_journalled(number) for number in range(len(late_ms))]
    reported = [
        ReportedDistance(
            instrument_ms=(each.instrument_time_ns or 0) // MS,
            true_ns=INTERVAL_MS * MS * number,
            horizontal_angle_rad=each.horizontal_angle_rad,
            zenith_angle_rad=each.zenith_angle_rad,
            distance_m=each.slope_distance_m or 0.0,
            prism=each.prism,
            code=ReturnCode.OK,
            slowed_by=slow,
        )
        for number, (each, slow) in enumerate(zip(measured, slowed_by, strict=True))
    ]
    stamps_ns = {
        each.stamp_ns: truth.true_ns + round(late * MS)
        for each, truth, late in zip(measured, reported, late_ms, strict=True)
    }
    for first, end in zip([0, *starts], [*starts, len(measured)], strict=True):
        head = JournalRecord(station=1, unix_at_zero_ns=ZERO_NS, boot="boot", first_sequence=first)
        lines = [encode_line(record) + b"\n" for record in (HEADER, head, *measured[first:end])]
        (folder / f"{first:03}.jsonl").write_bytes(b"".join(lines))
    station_log = StationLog(1, folder, reported, stamps_ns)
    return [found.detail for found in reading_mismatches(station_log, JournalIndex(station_log))]


def test_client_that_starts_while_the_instrument_is_slow(tmp_path: Path) -> None:
    """It sees no faster response, so that its timestamps are late by as much as the fastest one is slower."""
    assert _wrong(tmp_path, [0.0, 0.0, 70.0, 70.0], [1.0, 3.0, 3.5, 3.6], starts=[2]) == []


def test_client_that_starts_while_the_instrument_is_slow_has_a_limit(tmp_path: Path) -> None:
    """Responses take 20 to 60 ms, three times as long 60 to 180 ms, of which the configuration subtracts 20 ms."""
    wrong = _wrong(tmp_path, [159.0, 161.0, -161.0], [3.0, 3.0, 3.0])
    assert [text.split(":")[1].strip() for text in wrong] == [
        "timestamp error 161.0 ms, limit 160 ms",
        "timestamp error -161.0 ms, limit 160 ms",
    ]


def test_client_that_knows_the_usual_instrument_has_the_usual_limit(tmp_path: Path) -> None:
    """Slower responses do not make the timestamps of a client wrong that has seen faster ones."""
    assert len(_wrong(tmp_path, [0.0, 41.0, 39.0, 41.0], [1.0, 1.0, 4.0, 4.0])) == 2


def test_power_cycle_begins_anew(tmp_path: Path) -> None:
    """The count of the instrument restarts, and what the client has seen before says nothing about it."""
    usual, slow = SWITCHED_ON_AGAIN, 5
    late_ms = [0.0] * usual + [60.0] * slow
    assert _wrong(tmp_path, late_ms, [1.0] * usual + [3.0] * slow) == []
    again = tmp_path / "again"
    again.mkdir()
    assert len(_wrong(again, late_ms, [3.0] * usual + [1.0] * slow)) == slow


@pytest.mark.parametrize(("slowed_by", "wrong"), [(1.0, 1), (2.0, 0)])
def test_median_is_that_of_clients_that_know_the_usual_instrument(
    tmp_path: Path, slowed_by: float, wrong: int
) -> None:
    """Otherwise a systematic error is expected."""
    assert len(_wrong(tmp_path, [20.0] * 60, [slowed_by] * 60)) == wrong
