"""The backlog that a new run of the client reads from the journals of earlier ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.files.records import HEADER, measurement
from structlog.testing import capture_logs

from tsgt.radio.superframe import BeaconReception
from tsgt.radio.superframe.wire import RESTART_SKIP
from tsgt.recording import encode_line
from tsgt.recording.journal import AcknowledgedRecord, JournalRecord, ReceptionRecord
from tsgt.station import backlog as backlog_module
from tsgt.station.backlog import Backlog, queued_measurement, read_backlog

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from tsgt.model import PolarMeasurement

ZERO_NS = 1_000


def head(
    first_sequence: int,
    *,
    station: int = 1,
    boot: str = "b",
    stream_id: int | None = 7,
    zero_ns: int = ZERO_NS,
) -> JournalRecord:
    """Return a journal's second line."""
    return JournalRecord(
        station=station,
        unix_at_zero_ns=zero_ns,
        boot=boot,
        stream_id=stream_id,
        first_sequence=first_sequence,
    )


def journal(folder: Path, name: str, *records: object, tail: bytes = b"") -> None:
    """Write a journal."""
    lines = b"".join(encode_line(record) + b"\n" for record in (HEADER, *records))
    (folder / f"{name}.jsonl").write_bytes(lines + tail)


def queued_sequences(backlog: Backlog) -> list[int]:
    """Return the queued sequence numbers."""
    return [each.sequence for each in backlog.queued]


def acknowledged(oldest: int) -> AcknowledgedRecord:
    """Return the record of a cumulative acknowledgement."""
    return AcknowledgedRecord(stamp_ns=5, oldest=oldest)


def reception(counter: int, *, received_ns: int = 8_000) -> ReceptionRecord:
    """Return the record of a beacon's reception, at a time on the computer's clock."""
    return ReceptionRecord(
        stamp_ns=ZERO_NS + received_ns, stamp_sigma_ns=3, session=77, counter=counter, sent_us=400
    )


def measured(*sequences: int) -> list[PolarMeasurement]:
    """Return measurements with these sequence numbers."""
    return [measurement(sequence) for sequence in sequences]


def test_no_journals_give_an_empty_backlog(tmp_path: Path) -> None:
    """So do journals of other stations, of the classic protocol, and unreadable files."""
    assert read_backlog(tmp_path / "missing", 1) == Backlog()
    journal(tmp_path, "station1-a", head(0, stream_id=None), *measured(0, 1))
    journal(tmp_path, "station1-b", head(0, station=2), *measured(0, 1))
    (tmp_path / "station1-c.jsonl").write_bytes(b"\0" * 100)
    (tmp_path / "station1-d.jsonl").write_bytes(b"")
    assert read_backlog(tmp_path, 1) == Backlog()


def test_unacknowledged_measurements_are_queued(tmp_path: Path) -> None:
    """Sequence numbers continue after a gap for those that the journal may have lost."""
    journal(
        tmp_path, "station1-a", head(0), acknowledged(0), *measured(0, 1, 2), acknowledged(2), *measured(3)
    )
    backlog = read_backlog(tmp_path, 1)
    assert (backlog.stream_id, backlog.first_sequence) == (7, 4 + RESTART_SKIP)
    assert queued_sequences(backlog) == [2, 3]
    assert backlog.queued[0] == queued_measurement(measurement(2), ZERO_NS, "b")
    assert backlog.queued[0].at_ns == measurement(2).stamp_ns - ZERO_NS


def test_runs_are_ordered_by_sequence_number(tmp_path: Path) -> None:
    """File names come from a clock that may be wrong. Only the necessary journals are read."""
    journal(tmp_path, "station1-9", head(0), acknowledged(0), *measured(0, 1))
    journal(tmp_path, "station1-1", head(1002, boot="c"), acknowledged(1), *measured(1002))
    journal(tmp_path, "station1-5", head(2003), acknowledged(1), *measured(2003))
    backlog = read_backlog(tmp_path, 1)
    assert queued_sequences(backlog) == [1, 1002, 2003]
    assert [each.boot for each in backlog.queued] == ["b", "c", "b"]
    assert backlog.first_sequence == 2004 + RESTART_SKIP
    journal(tmp_path, "station1-6", head(3004), acknowledged(3004))
    backlog = read_backlog(tmp_path, 1)
    assert (queued_sequences(backlog), backlog.first_sequence) == ([], 3004 + RESTART_SKIP)


def test_beacon_receptions_are_restored(tmp_path: Path) -> None:
    """Times are on the computer's own clock, with the boot that identifies it."""
    journal(tmp_path, "station1-a", head(0), reception(5))
    assert read_backlog(tmp_path, 1).receptions == (
        BeaconReception(session=77, counter=5, received_ns=8_000, sigma_ns=3, sent_us=400, boot="b"),
    )


def test_receptions_of_earlier_runs_on_same_clock_are_restored(tmp_path: Path) -> None:
    """The times of a run without receptions rest on those of earlier runs."""
    journal(tmp_path, "station1-a", head(0, boot="a"), reception(1), *measured(0))
    journal(tmp_path, "station1-b", head(1001), reception(2, received_ns=500), *measured(1001))
    journal(tmp_path, "station1-c", head(2002), acknowledged(2002), *measured(2002))
    backlog = read_backlog(tmp_path, 1)
    assert queued_sequences(backlog) == [2002]
    assert [each.counter for each in backlog.receptions] == [2]


def test_receptions_are_in_chronological_order(tmp_path: Path) -> None:
    """Also those of a run with its own stream id, because its disk failed at first."""
    journal(tmp_path, "station1-a", head(500, stream_id=8), reception(3, received_ns=700), *measured(500))
    journal(tmp_path, "station1-b", head(0), reception(2, received_ns=500), *measured(0))
    journal(tmp_path, "station1-c", head(1001), acknowledged(1001), *measured(1001))
    assert [each.counter for each in read_backlog(tmp_path, 1).receptions] == [2, 3]


def test_only_necessary_journals_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A computer that runs for weeks leaves many journals."""
    read = []
    tail = backlog_module._tail

    def noted(head: JournalRecord, path: Path) -> object:
        read.append(path.stem)
        return tail(head, path)

    monkeypatch.setattr(backlog_module, "MAX_RECEPTIONS", 2)
    monkeypatch.setattr(backlog_module, "_tail", noted)
    journal(tmp_path, "station1-a", head(0), reception(1), *measured(0))
    journal(tmp_path, "station1-b", head(1001), reception(2), reception(3, received_ns=9_000))
    journal(tmp_path, "station1-c", head(2002), acknowledged(2002), *measured(2002))
    assert [each.counter for each in read_backlog(tmp_path, 1).receptions] == [2, 3]
    journal(tmp_path, "station1-d", head(3003), acknowledged(3003))
    assert read_backlog(tmp_path, 1).receptions == ()
    assert read == ["station1-c", "station1-b", "station1-d"]


def test_runs_with_unknown_boot_share_no_clock(tmp_path: Path) -> None:
    """Neither with each other nor with the new run."""
    journal(tmp_path, "station1-a", head(0, boot=""), *measured(0))
    journal(tmp_path, "station1-b", head(1001, boot=""), *measured(1001))
    boots = {each.boot for each in read_backlog(tmp_path, 1).queued}
    assert len(boots) == 2
    assert "" not in boots


def test_damaged_lines_are_skipped(tmp_path: Path) -> None:
    """A torn end, a line of garbage."""
    journal(tmp_path, "station1-a", head(0), *measured(0, 1), tail=b'garbage\n{"type":"measurement","sta')
    assert queued_sequences(read_backlog(tmp_path, 1)) == [0, 1]


def test_unreadable_journal_is_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The client starts all the same."""
    journal(tmp_path, "station1-a", head(0), *measured(0))
    heads = backlog_module._head

    def then_gone(path: Path, station: int) -> JournalRecord | None:
        found = heads(path, station)
        path.unlink()
        return found

    monkeypatch.setattr(backlog_module, "_head", then_gone)
    with capture_logs() as logs:
        assert queued_sequences(read_backlog(tmp_path, 1)) == []
    assert [entry["event"] for entry in logs] == ["journal_unreadable"]


def test_oldest_measurements_beyond_capacity_are_discarded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The number is logged."""
    monkeypatch.setattr(backlog_module, "QUEUE_CAPACITY", 3)
    journal(tmp_path, "station1-a", head(0), *measured(*range(5)))
    with capture_logs() as logs:
        assert queued_sequences(read_backlog(tmp_path, 1)) == [2, 3, 4]
    assert logs == [{"event": "measurements_discarded", "log_level": "warning", "measurements": 2}]


def test_only_tail_of_long_journal_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that ran for days starts as fast as any other."""
    monkeypatch.setattr(backlog_module, "_TAIL_BYTES", 1000)
    journal(tmp_path, "station1-a", head(0), *measured(*range(99)), acknowledged(98), *measured(99))
    read = []

    def noted(measurement: PolarMeasurement, zero_ns: int, boot: str) -> object:
        read.append(measurement)
        return queued_measurement(measurement, zero_ns, boot)

    monkeypatch.setattr(backlog_module, "queued_measurement", noted)
    backlog = read_backlog(tmp_path, 1)
    assert queued_sequences(backlog) == [98, 99]
    assert len(read) < 10
    assert backlog.first_sequence == 100 + RESTART_SKIP


def test_tail_is_extended_to_the_oldest_measurement_not_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a long outage they fill more than the tail."""
    monkeypatch.setattr(backlog_module, "_TAIL_BYTES", 1000)
    journal(tmp_path, "station1-a", head(0), *measured(*range(99)), acknowledged(5), *measured(99))
    assert queued_sequences(read_backlog(tmp_path, 1)) == list(range(5, 100))


def test_backlog_of_a_day_is_whole(tmp_path: Path) -> None:
    """Every measurement that a journal holds arrives, whatever the length of the outage."""
    journal(tmp_path, "station1-a", head(0), acknowledged(0), *measured(*range(15_000)))
    assert queued_sequences(read_backlog(tmp_path, 1)) == list(range(15_000))


def test_tail_is_extended_to_last_measurement(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A night without instruments leaves beacon receptions only at the end of the journal."""
    monkeypatch.setattr(backlog_module, "_TAIL_BYTES", 1000)
    receptions = [reception(number, received_ns=8_000 + number) for number in range(50)]
    journal(tmp_path, "station1-a", head(0), *measured(*range(3000)), acknowledged(3000), *receptions)
    backlog = read_backlog(tmp_path, 1)
    assert (queued_sequences(backlog), backlog.first_sequence) == ([], 3000 + RESTART_SKIP)


def test_tail_is_extended_to_last_acknowledgement(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements delivered long ago are not queued again."""
    monkeypatch.setattr(backlog_module, "_TAIL_BYTES", 1000)
    receptions = [reception(number, received_ns=8_000 + number) for number in range(50)]
    journal(tmp_path, "station1-a", head(0), acknowledged(0), *measured(0, 1, 2))
    journal(tmp_path, "station1-b", head(1003), *measured(1003, 1004), acknowledged(1005), *receptions)
    assert queued_sequences(read_backlog(tmp_path, 1)) == []


def test_backlog_survives_run_with_own_stream_id(tmp_path: Path) -> None:
    """That run started while the disk failed, and its journal was written later."""
    journal(tmp_path, "station1-a", head(0), acknowledged(0), *measured(0, 1, 2))
    new_stream = head(700_000, stream_id=8)
    journal(tmp_path, "station1-b", new_stream, *measured(700_000, 700_001), acknowledged(700_001))
    backlog = read_backlog(tmp_path, 1)
    assert (backlog.stream_id, queued_sequences(backlog)) == (7, [0, 1, 2])
    assert backlog.first_sequence == 3 + RESTART_SKIP


def test_sequence_numbers_skip_a_quarter_of_an_hour(tmp_path: Path) -> None:
    """A disk may have failed that long at 20 measurements a second."""
    journal(tmp_path, "station1-a", head(0), acknowledged(0), *measured(*range(10)))
    assert read_backlog(tmp_path, 1).first_sequence > 10 + 15 * 60 * 20
