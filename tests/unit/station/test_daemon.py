"""The client daemon with failing instrument, radio and disk."""

from __future__ import annotations

import asyncio
import json
import threading
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import pytest
from harness.hardware.radios import PAPER
from harness.instruments.scripted_instrument import ScriptedInstrument
from harness.radio.client import OFFSET_NS, SCENARIO, START_NS, client_config, field_day
from structlog.testing import capture_logs

from tsgt.config.scenario import StatusFaultConfig
from tsgt.errors import ComputerSuspendedError, RadioError, RecordingError, StreamError
from tsgt.model import Status
from tsgt.radio.classic import MeasurementMessage
from tsgt.radio.classic.messages import Acknowledgement, PingReply, TimeReply
from tsgt.recording import RecordingWriter, read_lines
from tsgt.recording.journal import load_journal
from tsgt.station import ClientDependencies, run_client

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable
    from pathlib import Path

    from tsgt.radio import Radio


async def test_every_measurement_is_journalled_and_newest_is_polled(tmp_path: Path) -> None:
    """The journal has raw values on the station's clock."""
    async with field_day(tmp_path) as day:
        await asyncio.sleep(10.0)
        message = await day.poll()
        await day.kill()
        (journal,) = day.journals()
    assert len(journal) in (26, 27)
    assert [m.sequence for m in journal] == list(range(len(journal)))
    assert [m.host_time_ns for m in journal] == [START_NS + OFFSET_NS + reading.at_ns for reading in day.read]
    assert all(m.stamp_ns == m.host_time_ns for m in journal)
    assert all(0 < m.received_ns - m.stamp_ns < 150_000_000 for m in journal)
    assert message.time_ns in [m.host_time_ns for m in journal[-2:]]
    newest = next(m for m in journal if m.host_time_ns == message.time_ns)
    assert message.slope_distance_m == newest.slope_distance_m
    assert message.horizontal_angle_rad == newest.horizontal_angle_rad
    assert message.status == 0


async def test_ping_is_timestamped_at_rx_done(tmp_path: Path) -> None:
    """`s` returns the RxDone of `e` on the station's own Unix clock, whatever happened in between."""
    async with field_day(tmp_path) as day:
        sent = await day.master.radio.transmit(b"e1")
        async with asyncio.timeout(1.0):
            reply = await day.master.radio.receive()
        assert reply.payload == PingReply(1).to_bytes()
        stamp = await day.ask(b"s1")
    assert isinstance(stamp, TimeReply)
    true_ns = START_NS + sent.done_at_ns
    symbols = (stamp.time_ns - OFFSET_NS - true_ns) / 2_048_000
    assert 0.3 < symbols < 1.2  # RxDone of an SX127x comes 0.65 to 0.95 symbols after the end on the air


async def test_poll_before_first_measurement_gets_a_status(tmp_path: Path) -> None:
    """Without an instrument the master is not left waiting."""
    async with field_day(tmp_path) as day:
        day.line.plugged = False
        await day.kill()
        day.start()
        await asyncio.sleep(0.1)
        message = await day.poll()
    assert (message.status, message.time_ns) == (3, 0)


@pytest.mark.parametrize(
    ("status", "sent", "raw_status"),
    [("tilt", 1, 1290), ("wrong_distance", 2, 1291), ("no_target", 3, None), ("angle_only", 4, 1285)],
)
async def test_error_status_is_journalled_and_sent(
    tmp_path: Path, status: str, sent: int, raw_status: int | None
) -> None:
    """The journal has the instrument's own code."""
    fault = StatusFaultConfig(station=1, status=status, start_s=8.0, end_s=60.0)  # type: ignore[arg-type]
    async with field_day(tmp_path, SCENARIO.model_copy(update={"faults": (fault,)})) as day:
        await asyncio.sleep(7.0)
        message = await day.poll()
        await day.kill()
        (journal,) = day.journals()
    assert (message.status, message.slope_distance_m) == (sent, 0.0)
    assert journal[-1].status is Status(status)
    assert raw_status in (None, journal[-1].raw_status)
    assert journal[-1].slope_distance_m is None
    assert journal[0].status is Status.OK


async def test_unplugged_instrument_recovers(tmp_path: Path) -> None:
    """Meanwhile polls get the last measurement; new ones follow a few seconds after the cable is back."""
    async with field_day(tmp_path) as day:
        with capture_logs() as logs:
            await asyncio.sleep(5.0)
            day.line.plugged = False
            await asyncio.sleep(60.0)
            stale = await day.poll()
            day.line.plugged = True
            await asyncio.sleep(6.0)
            fresh = await day.poll()
    assert START_NS + OFFSET_NS < stale.time_ns < START_NS + OFFSET_NS + 10_000_000_000
    assert fresh.time_ns > stale.time_ns + 55_000_000_000
    events = [entry["event"] for entry in logs]
    assert 1 <= events.count("instrument_lost") <= 2  # it was pulled; there is no such device
    assert events.count("instrument_connected") == 1


async def test_failing_radio_does_not_affect_journal(tmp_path: Path) -> None:
    """The status reports it; measurements are offered again when it recovers."""
    async with field_day(tmp_path) as day:
        await day.kill()
        broken, opened = True, day.open_radio

        @asynccontextmanager
        async def open_radio() -> AsyncGenerator[Radio]:
            if broken:
                raise RadioError("no chip")
            async with opened() as radio:
                yield radio

        day.open_radio = open_radio
        day.read.clear()
        day.start()
        await asyncio.sleep(20.0)
        assert not (await client_status(tmp_path / "client.sock"))["radio_ok"]
        assert await day.ask(b"t1") is None
        broken = False
        await asyncio.sleep(6.0)
        assert (await day.poll()).status == 0
        await day.kill()
        assert len(day.journals()[-1]) == len(day.read) >= 50


async def test_commands_change_mode_and_prism(tmp_path: Path) -> None:
    """`d` stops tracking, `t` then measures a target, `n` with a prism tracks that one once the operator has locked on."""
    async with field_day(tmp_path) as day:
        await asyncio.sleep(1.0)
        assert await day.ask(b"d1", timeout_s=2.0) == Acknowledgement("d", ok=True)
        before = len(day.read)
        day.instrument.aim_at_target(1)
        single = await day.ask(b"t1", timeout_s=5.0)
        assert isinstance(single, MeasurementMessage)
        assert single.slope_distance_m == pytest.approx(20.6216, abs=0.01)
        assert len(day.read) == before
        day.instrument.aim_at_target(2)
        near = await day.ask(b"t1", timeout_s=20.0)
        assert isinstance(near, MeasurementMessage)
        assert (near.status, near.slope_distance_m) == (3, 0.0)  # too near to give a distance
        command_ns = day.clock.realtime_ns()
        assert await day.ask(b"n12", timeout_s=2.0) == Acknowledgement("n", ok=True)
        next_ns = (await day.poll()).time_ns
        assert next_ns == 0 or next_ns > command_ns  # not one of the other prism
        day.instrument.lock_manually(2)
        await asyncio.sleep(4.0)
        assert (await day.poll()).status == 0
        await day.kill()
        (path,) = (tmp_path / "journals").iterdir()
        journal = load_journal(path)
    assert [m.prism for m in journal.measurements] == sorted(m.prism for m in journal.measurements)
    assert {m.prism for m in journal.measurements} == {1, 2}
    assert [target.status for target in journal.targets] == [Status.OK, Status.NO_TARGET]


async def test_failed_command_changes_nothing(tmp_path: Path) -> None:
    """Without an instrument `n` and `d` are refused, and the old prism is tracked after recovery."""
    async with field_day(tmp_path) as day:
        day.line.plugged = False
        await asyncio.sleep(1.0)
        assert await day.ask(b"n13") == Acknowledgement("n", ok=False)
        assert await day.ask(b"d1") == Acknowledgement("d", ok=False)
        day.line.plugged = True
        await day.measuring()
        assert (await day.poll()).status == 0
        await day.kill()
        assert {m.prism for m in day.journals()[0]} == {1}


async def test_failed_single_measurement_gets_a_status(tmp_path: Path) -> None:
    """Direct mode persists when the instrument recovers."""
    async with field_day(tmp_path) as day:
        await asyncio.sleep(1.0)
        assert await day.ask(b"d1", timeout_s=2.0) == Acknowledgement("d", ok=True)
        day.line.plugged = False
        day.instrument.aim_at_target(1)
        failed = await day.ask(b"t1", timeout_s=5.0)
        assert isinstance(failed, MeasurementMessage)
        assert failed.status == 3
        day.line.plugged = True
        await asyncio.sleep(6.0)
        single = await day.ask(b"t1", timeout_s=5.0)
    assert isinstance(single, MeasurementMessage)
    assert single.status == 0


async def test_full_disk_stops_neither_instrument_nor_radio(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lines wait in memory and are journalled when there is room; the status reports it meanwhile."""
    full = False
    write_line = RecordingWriter.write_line

    def write_if_room(writer: RecordingWriter, line: bytes) -> None:
        if full:
            raise RecordingError("no room", path=tmp_path)
        write_line(writer, line)

    monkeypatch.setattr(RecordingWriter, "write_line", write_if_room)
    async with field_day(tmp_path) as day:
        await asyncio.sleep(2.0)
        full = True
        await asyncio.sleep(10.0)
        assert (await day.poll()).time_ns > START_NS + OFFSET_NS + 11_000_000_000
        status = await client_status(tmp_path / "client.sock")
        assert not status["journal_ok"]
        assert 20 <= status["journal_waiting"] <= 28
        full = False
        await asyncio.sleep(1.0)
        assert (await client_status(tmp_path / "client.sock"))["journal_ok"]
        await day.kill()
        assert [m.sequence for m in day.journals()[0]] == list(range(len(day.read)))


async def test_slow_disk_delays_no_reply(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While a write hangs, pings and polls are answered, soon with the measurement that it delays."""
    released, writing = threading.Event(), threading.Event()
    write_line = RecordingWriter.write_line

    def write_slowly(writer: RecordingWriter, line: bytes) -> None:
        if b'"measurement"' in line:
            writing.set()
            released.wait(10.0)
        write_line(writer, line)

    monkeypatch.setattr(RecordingWriter, "write_line", write_slowly)

    # In virtual time the loop's own threads stop the clock; this one does not.
    async def in_bare_thread(function: Callable[[], None]) -> None:
        done = asyncio.Event()
        loop = asyncio.get_running_loop()

        def call() -> None:
            function()
            loop.call_soon_threadsafe(done.set)

        threading.Thread(target=call).start()
        while not done.is_set():  # noqa: ASYNC110 (time has to pass meanwhile)
            await asyncio.sleep(0.001)

    monkeypatch.setattr("tsgt.station.journal.asyncio.to_thread", in_bare_thread)
    async with field_day(tmp_path) as day:
        await asyncio.sleep(1.0)
        assert await asyncio.get_running_loop().run_in_executor(None, writing.wait, 5.0)
        assert await day.ask(b"e1") == PingReply(1)
        assert (await day.poll()).time_ns > 0
        assert not day.journals()[0]
        released.set()


@pytest.mark.slow
async def test_killed_client_has_journalled_all_readings(tmp_path: Path) -> None:
    """Cancelled after any number of steps of the event loop, and restarted."""
    async with field_day(tmp_path) as day:
        for run in range(60):
            await day.kill()
            day.read.clear()
            day.start()
            await day.measuring()
            for _ in range(run):
                await asyncio.sleep(0)
            await day.kill()
            stamps = {START_NS + OFFSET_NS + reading.at_ns for reading in day.read}
            journalled = {
                m.host_time_ns
                for path in (tmp_path / "journals").iterdir()
                for m in load_journal(path).measurements
            }
            assert stamps <= journalled


async def test_journal_starts_with_header_and_station(tmp_path: Path) -> None:
    """A merge needs the station and the origin of its times."""
    async with field_day(tmp_path):
        pass
    (path,) = (tmp_path / "journals").iterdir()
    assert path.name == "station1-20231114T211320Z.jsonl"
    first, second, *_ = read_lines(path)
    assert first.type == "recording"
    assert json.loads(second.data) == {
        "type": "journal",
        "station": 1,
        "unix_at_zero_ns": START_NS + OFFSET_NS,
        "boot": "boot",
        "stream_id": None,
        "first_sequence": 0,
    }


async def test_status_reports_instrument_master_and_journal(tmp_path: Path) -> None:
    """One line, then the connection is closed."""
    async with field_day(tmp_path) as day:
        await day.kill()
        day.start()
        await asyncio.sleep(0.1)
        first = await client_status(tmp_path / "client.sock")
        assert (first["last"], first["master_heard_s"], first["measurements"]) == (None, None, 0)
        await asyncio.sleep(20.0)
        await day.poll()
        status = await client_status(tmp_path / "client.sock")
    assert status["type"] == "client_status"
    assert status["instrument"] == "Leica TCRP1201+ 230001"
    assert (status["mode"], status["prism"], status["locked"]) == ("tracking", 1, True)
    assert status["rate_hz"] == pytest.approx(2.5, abs=0.11)
    assert 0 <= status["last"]["age_s"] < 0.5
    assert status["last"]["status"] in ("ok", "low_accuracy")  # the robot drives
    assert 0 < status["master_heard_s"] < 0.3
    assert status["rssi_dbm"] < 0
    assert status["journal_ok"]
    assert status["radio_ok"]


async def test_second_client_does_not_take_socket(tmp_path: Path) -> None:
    """Two clients with one configuration are a mistake; the error says so, and no journal is left of it."""
    async with field_day(tmp_path) as day:
        files = all_files(tmp_path)
        with pytest.raises(StreamError, match="another program serves this socket"):
            await run_client(
                client_config(tmp_path),
                PAPER,
                ClientDependencies(
                    instrument=ScriptedInstrument(day.clock), open_radio=day.open_radio, clock=day.clock
                ),
            )
        assert all_files(tmp_path) == files


def all_files(folder: Path) -> list[Path]:
    """Return all files in a folder."""
    return sorted(folder.rglob("*"))


async def client_status(path: Path) -> dict[str, Any]:
    """Return the client's status."""
    reader, writer = await asyncio.open_unix_connection(path)
    line = await reader.readline()
    writer.close()
    status = json.loads(line)
    assert isinstance(status, dict)
    return status


async def test_client_that_is_stopped_as_its_computer_resumes_ends(tmp_path: Path) -> None:
    """Both at once: the error of the resume takes the place of the cancellation."""

    async def resumed(*_: object) -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            raise ExceptionGroup("", [ComputerSuspendedError(1.0)]) from None

    async with field_day(tmp_path) as day:
        dependencies = ClientDependencies(
            instrument=ScriptedInstrument(day.clock), open_radio=day.open_radio, clock=day.clock
        )
        with patch("tsgt.station.daemon._run_until_suspended", resumed):
            task = asyncio.create_task(run_client(client_config(tmp_path / "second"), PAPER, dependencies))
            await asyncio.sleep(0.1)
            task.cancel()
            await asyncio.wait([task], timeout=1.0)
    assert task.cancelled()
