"""What a new run of the client finds in the journals of earlier ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.records import HEADER, measurement
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
    """Make the line that says whose journal it is."""
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


def numbers(backlog: Backlog) -> list[int]:
    """Return what is queued."""
    return [each.sequence for each in backlog.queued]


def acknowledged(oldest: int) -> AcknowledgedRecord:
    """Say how far the master has got."""
    return AcknowledgedRecord(stamp_ns=5, oldest=oldest)


def reception(counter: int, *, received_ns: int = 8_000) -> ReceptionRecord:
    """Say that this beacon was heard then, on the computer's clock."""
    return ReceptionRecord(
        stamp_ns=ZERO_NS + received_ns, stamp_sigma_ns=3, session=77, counter=counter, sent_us=400
    )


def measured(*sequences: int) -> list[PolarMeasurement]:
    """Make measurements with these numbers."""
    return [measurement(sequence) for sequence in sequences]


def test_without_journals_everything_begins(tmp_path: Path) -> None:
    """Also where there are only those of another station, or of the protocol classic, or none at all."""
    assert read_backlog(tmp_path / "missing", 1) == Backlog()
    journal(tmp_path, "station1-a", head(0, stream_id=None), *measured(0, 1))
    journal(tmp_path, "station1-b", head(0, station=2), *measured(0, 1))
    (tmp_path / "station1-c.jsonl").write_bytes(b"\0" * 100)
    (tmp_path / "station1-d.jsonl").write_bytes(b"")
    assert read_backlog(tmp_path, 1) == Backlog()


def test_what_is_not_acknowledged_is_left(tmp_path: Path) -> None:
    """The numbers go on, with room for those that the journal has lost."""
    journal(
        tmp_path, "station1-a", head(0), acknowledged(0), *measured(0, 1, 2), acknowledged(2), *measured(3)
    )
    backlog = read_backlog(tmp_path, 1)
    assert (backlog.stream_id, backlog.first_sequence) == (7, 4 + RESTART_SKIP)
    assert numbers(backlog) == [2, 3]
    assert backlog.queued[0] == queued_measurement(measurement(2), ZERO_NS, "b")
    assert backlog.queued[0].at_ns == measurement(2).stamp_ns - ZERO_NS


def test_several_runs_are_left_in_order(tmp_path: Path) -> None:
    """By their numbers, for the names come from a clock that may be wrong; no further back than need be."""
    journal(tmp_path, "station1-9", head(0), acknowledged(0), *measured(0, 1))
    journal(tmp_path, "station1-1", head(1002, boot="c"), acknowledged(1), *measured(1002))
    journal(tmp_path, "station1-5", head(2003), acknowledged(1), *measured(2003))
    backlog = read_backlog(tmp_path, 1)
    assert numbers(backlog) == [1, 1002, 2003]
    assert [each.boot for each in backlog.queued] == ["b", "c", "b"]
    assert backlog.first_sequence == 2004 + RESTART_SKIP
    journal(tmp_path, "station1-6", head(3004), acknowledged(3004))
    backlog = read_backlog(tmp_path, 1)
    assert (numbers(backlog), backlog.first_sequence) == ([], 3004 + RESTART_SKIP)


def test_receptions_of_beacons_come_back(tmp_path: Path) -> None:
    """On the computer's own clock, with what names its start."""
    journal(tmp_path, "station1-a", head(0), reception(5))
    assert read_backlog(tmp_path, 1).receptions == (
        BeaconReception(session=77, counter=5, received_ns=8_000, sigma_ns=3, sent_us=400, boot="b"),
    )


def test_receptions_go_as_far_back_as_the_clock_of_what_is_left(tmp_path: Path) -> None:
    """A run that has heard nobody leaves measurements whose time rests on what earlier ones have heard."""
    journal(tmp_path, "station1-a", head(0, boot="a"), reception(1), *measured(0))
    journal(tmp_path, "station1-b", head(1001), reception(2, received_ns=500), *measured(1001))
    journal(tmp_path, "station1-c", head(2002), acknowledged(2002), *measured(2002))
    backlog = read_backlog(tmp_path, 1)
    assert numbers(backlog) == [2002]
    assert [each.counter for each in backlog.receptions] == [2]


def test_receptions_of_one_clock_are_in_order_whatever_the_names_say(tmp_path: Path) -> None:
    """Also those of a run that had numbers of its own, as its disk took nothing at first."""
    journal(tmp_path, "station1-a", head(500, stream_id=8), reception(3, received_ns=700), *measured(500))
    journal(tmp_path, "station1-b", head(0), reception(2, received_ns=500), *measured(0))
    journal(tmp_path, "station1-c", head(1001), acknowledged(1001), *measured(1001))
    assert [each.counter for each in read_backlog(tmp_path, 1).receptions] == [2, 3]


def test_what_has_been_heard_is_not_sought_without_need(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A computer that runs for weeks leaves many journals."""
    read = []
    tail = backlog_module._tail

    def noted(head: JournalRecord, path: Path) -> object:
        read.append(path.stem)
        return tail(head, path)

    monkeypatch.setattr(backlog_module, "MAX_MEASUREMENTS", 2)
    monkeypatch.setattr(backlog_module, "_tail", noted)
    journal(tmp_path, "station1-a", head(0), reception(1), *measured(0))
    journal(tmp_path, "station1-b", head(1001), reception(2), reception(3, received_ns=9_000))
    journal(tmp_path, "station1-c", head(2002), acknowledged(2002), *measured(2002))
    assert [each.counter for each in read_backlog(tmp_path, 1).receptions] == [2, 3]
    journal(tmp_path, "station1-d", head(3003), acknowledged(3003))
    assert read_backlog(tmp_path, 1).receptions == ()
    assert read == ["station1-c", "station1-b", "station1-d"]


def test_runs_of_unknown_starts_of_the_computer_share_no_clock(tmp_path: Path) -> None:
    """Nor with the new run."""
    journal(tmp_path, "station1-a", head(0, boot=""), *measured(0))
    journal(tmp_path, "station1-b", head(1001, boot=""), *measured(1001))
    boots = {each.boot for each in read_backlog(tmp_path, 1).queued}
    assert len(boots) == 2
    assert "" not in boots


def test_damage_costs_what_is_damaged(tmp_path: Path) -> None:
    """A torn end, a line of garbage."""
    journal(tmp_path, "station1-a", head(0), *measured(0, 1), tail=b'garbage\n{"type":"measurement","sta')
    assert numbers(read_backlog(tmp_path, 1)) == [0, 1]


def test_an_unreadable_journal_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The client starts all the same."""
    journal(tmp_path, "station1-a", head(0), *measured(0))
    heads = backlog_module._head

    def then_gone(path: Path, station: int) -> JournalRecord | None:
        found = heads(path, station)
        path.unlink()
        return found

    monkeypatch.setattr(backlog_module, "_head", then_gone)
    with capture_logs() as logs:
        assert numbers(read_backlog(tmp_path, 1)) == []
    assert [entry["event"] for entry in logs] == ["journal_unreadable"]


def test_what_is_too_much_stays_in_the_journal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest; and it is said."""
    monkeypatch.setattr(backlog_module, "MAX_MEASUREMENTS", 3)
    journal(tmp_path, "station1-a", head(0), *measured(*range(5)))
    with capture_logs() as logs:
        assert numbers(read_backlog(tmp_path, 1)) == [2, 3, 4]
    assert logs == [{"event": "measurements_discarded", "log_level": "warning", "measurements": 2}]


def test_of_a_long_journal_the_end_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that ran for days starts as fast as any other."""
    monkeypatch.setattr(backlog_module, "_TAIL_BYTES", 1000)
    journal(tmp_path, "station1-a", head(0), *measured(*range(99)), acknowledged(5), *measured(99))
    backlog = read_backlog(tmp_path, 1)
    assert 1 <= len(backlog.queued) < 10
    assert backlog.first_sequence == 100 + RESTART_SKIP


def test_numbers_go_on_however_long_beacons_were_heard_after_the_last_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A night without instruments: their end of the journal holds nothing else."""
    monkeypatch.setattr(backlog_module, "_TAIL_BYTES", 1000)
    heard = [reception(number, received_ns=8_000 + number) for number in range(50)]
    journal(tmp_path, "station1-a", head(0), *measured(*range(3000)), acknowledged(3000), *heard)
    backlog = read_backlog(tmp_path, 1)
    assert (numbers(backlog), backlog.first_sequence) == ([], 3000 + RESTART_SKIP)


def test_what_was_delivered_long_ago_is_not_left_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long ago that was said."""
    monkeypatch.setattr(backlog_module, "_TAIL_BYTES", 1000)
    heard = [reception(number, received_ns=8_000 + number) for number in range(50)]
    journal(tmp_path, "station1-a", head(0), acknowledged(0), *measured(0, 1, 2))
    journal(tmp_path, "station1-b", head(1003), *measured(1003, 1004), acknowledged(1005), *heard)
    assert numbers(read_backlog(tmp_path, 1)) == []


def test_what_was_left_before_a_run_with_numbers_of_its_own_is_still_left(tmp_path: Path) -> None:
    """It began while the disk took nothing, and later the disk took its journal all the same."""
    journal(tmp_path, "station1-a", head(0), acknowledged(0), *measured(0, 1, 2))
    anew = head(700_000, stream_id=8)
    journal(tmp_path, "station1-b", anew, *measured(700_000, 700_001), acknowledged(700_001))
    backlog = read_backlog(tmp_path, 1)
    assert (backlog.stream_id, numbers(backlog)) == (7, [0, 1, 2])
    assert backlog.first_sequence == 3 + RESTART_SKIP


def test_numbers_that_are_on_the_air_and_on_no_disk_are_not_given_again(tmp_path: Path) -> None:
    """Even if a disk has taken nothing for a quarter of an hour, 20 times a second."""
    journal(tmp_path, "station1-a", head(0), acknowledged(0), *measured(*range(10)))
    assert read_backlog(tmp_path, 1).first_sequence > 10 + 15 * 60 * 20
