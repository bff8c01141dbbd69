"""The client daemon on the superframe, between a simulated total station and a scripted master."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING

import pytest
from harness.hardware.radios import MS, running_timeline
from harness.radio.client import START_NS, field_day
from harness.radio.scripted_master import KEY, TIMING, ScriptedMaster
from structlog.testing import capture_logs
from unit.station.test_daemon import client_status

from tsgt.clock import UnixTimeline
from tsgt.config import SuperframeConfig
from tsgt.errors import RecordingError
from tsgt.radio.superframe import SuperframeStation
from tsgt.radio.superframe.wire import GRANT_BYTES, RESTART_SKIP, CommandResponse, EncodedCommand
from tsgt.recording import RecordingWriter, read_lines
from tsgt.recording.journal import load_journal
from tsgt.simulation.kernel import VirtualClock

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Sequence
    from pathlib import Path

    from harness.radio.client import Field
    from harness.radio.scripted_master import ReceivedMessage

    from tsgt.model import PolarMeasurement
    from tsgt.radio.superframe import InstrumentState

SUPERFRAME = SuperframeConfig(kind="superframe")


class OnAir:
    """The scripted master on a radio, with station 1 only."""

    def __init__(self, day: Field) -> None:
        self._day = day
        self._clock = VirtualClock(START_NS)
        self.master = ScriptedMaster(stations=1, station=1, session_interval=4)

    async def frame(self, commands: Sequence[EncodedCommand] = ()) -> ReceivedMessage | None:
        """Run one frame, from beacon to reply."""
        radio = self._day.master.radio
        payload = self.master.beacon(commands=commands)
        self.master.sent_by_radio(await radio.transmit(payload))
        deadline_ns = self.master.beacon_done_ns + 400 * MS
        with suppress(TimeoutError):
            async with asyncio.timeout((deadline_ns - self._clock.monotonic_ns()) / 1e9):
                return self.master.take((await radio.receive()).payload)
        return None

    async def frames(self, seconds: float) -> None:
        """Run frames for a duration."""
        end_ns = self._clock.monotonic_ns() + round(seconds * 1e9)
        while self._clock.monotonic_ns() < end_ns:
            await self.frame()

    async def drained(self, day: Field) -> None:
        """Run frames until nothing is queued."""
        await self.frames(5.0)
        assert (await client_status(day.folder / "client.sock"))["queued"] <= 3


@asynccontextmanager
async def superframe_day(folder: Path) -> AsyncGenerator[tuple[Field, OnAir]]:
    """Set up a station with the key, and its master."""
    async with field_day(folder, protocol=SUPERFRAME, key=KEY) as day:
        yield day, OnAir(day)


def journalled(folder: Path) -> list[PolarMeasurement]:
    """Return the measurements of all journals."""
    measurements = [
        measurement
        for path in (folder / "journals").iterdir()
        for measurement in load_journal(path).measurements
    ]
    return sorted(measurements, key=lambda measurement: measurement.sequence)


async def test_every_measurement_is_delivered_with_its_time(tmp_path: Path) -> None:
    """The station's clock is an hour and 10 ppm off the master's."""
    async with superframe_day(tmp_path) as (day, air):
        await air.frames(60.0)
        await day.kill()
        true_ns = {reading.at_ns: day.clock.true_ns(reading.at_ns) for reading in day.read}
    assert len(air.master.received) >= len(day.read) - 2
    unix_at_zero_ns = UnixTimeline(journalled(tmp_path)[0].stamp_ns - day.read[0].at_ns).unix_at_zero_ns
    for measurement in journalled(tmp_path):
        if measurement.sequence in air.master.received:
            error_ns = (
                air.master.received[measurement.sequence] - true_ns[measurement.stamp_ns - unix_at_zero_ns]
            )
            assert abs(error_ns) < 100_000


@pytest.mark.slow
async def test_killed_client_loses_no_measurement(tmp_path: Path) -> None:
    """Restarted after any number of steps of the event loop, it delivers all readings."""
    async with superframe_day(tmp_path) as (day, air):
        air.master.session_interval = 1
        for run in range(25):
            await air.frames(4.0)
            await day.kill()
            day.start()
            for _ in range(7 * run):
                await asyncio.sleep(0)
        await air.drained(day)
        await day.kill()
        sequences = [measurement.sequence for measurement in journalled(tmp_path)]
        assert len(set(sequences)) == len(sequences) >= len(day.read) > 25
        assert set(sequences[:-3]) <= set(air.master.received)
        assert set(air.master.received) <= set(sequences)


@pytest.mark.slow
async def test_restarted_computer_delivers_backlog(tmp_path: Path) -> None:
    """Measured while the master was away; timed on the clock before the restart by journalled beacons."""
    async with superframe_day(tmp_path) as (day, air):
        await air.frames(20.0)
        await asyncio.sleep(10.0)
        await day.kill()
        before = {measurement.sequence for measurement in journalled(tmp_path)}
        assert len(before - set(air.master.received)) > 20
        day.boot = "another"
        day.start()
        await asyncio.sleep(1.0)
        await air.frames(15.0)
        assert before <= set(air.master.received)


async def test_measurements_on_unknown_clock_are_discarded(tmp_path: Path) -> None:
    """The master was restarted too, so that their time cannot be determined."""
    async with superframe_day(tmp_path) as (day, air):
        await air.frames(5.0)
        await asyncio.sleep(5.0)
        await day.kill()
        day.boot = "another"
        with capture_logs() as logs:
            day.start()
            await asyncio.sleep(0.1)
            new = OnAir(day)
            new.master.session = 0x77
            await new.frames(5.0)
        assert [entry["event"] for entry in logs].count("measurements_discarded") == 1
        assert (await client_status(tmp_path / "client.sock"))["queued"] <= 2
        assert min(new.master.received) > 1000


async def test_commands_are_executed_and_responded_to(tmp_path: Path) -> None:
    """Another prism, single measurements, back again, and a search."""
    async with superframe_day(tmp_path) as (day, air):
        await air.frames(3.0)

        async def order(command_id: int, kind: int, argument: int = 0) -> ReceivedMessage:
            for _ in range(20):
                answered = await air.frame([EncodedCommand(1, command_id, kind, argument)])
                if answered and (answered.reply.response or answered.reply.single_measurement):
                    await air.frame()  # which acknowledges it
                    return answered
            raise AssertionError

        assert (await order(1, 2)).reply.response == CommandResponse(1, ok=True)
        assert (await client_status(tmp_path / "client.sock"))["mode"] == "direct"
        day.instrument.aim_at_target(1)
        shot = (await order(2, 3)).reply.single_measurement
        assert shot is not None
        assert shot.distance == pytest.approx(206_216, abs=100)
        assert (await order(3, 0, 1)).reply.response == CommandResponse(3, ok=True)
        assert (await client_status(tmp_path / "client.sock"))["prism"] == 2
        day.instrument.aim_at_prism(2)
        assert (await order(4, 1)).reply.response == CommandResponse(4, ok=True)
        assert (await order(5, 3)).reply.response == CommandResponse(5, ok=False)  # it is not in direct mode
        await air.frames(5.0)
        await day.kill()
        (path,) = (tmp_path / "journals").iterdir()
        assert len(load_journal(path).targets) == 1
        usable = [measurement for measurement in journalled(tmp_path) if measurement.status.usable]
        assert {measurement.prism for measurement in usable} == {1, 2}


async def test_run_with_failing_disk_starts_its_own_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next run could not know which sequence numbers it has used."""

    def refuse(_: RecordingWriter, __: bytes) -> None:
        raise RecordingError("no room", path=tmp_path)

    async with superframe_day(tmp_path) as (day, air):
        await air.frames(4.0)
        await day.kill()
        with monkeypatch.context() as patch:
            patch.setattr(RecordingWriter, "write_line", refuse)
            day.start()
            await asyncio.sleep(3.0)
        await asyncio.sleep(3.0)
        await day.kill()
    heads = [load_journal(path).head for path in (tmp_path / "journals").iterdir()]
    before, after = sorted(heads, key=lambda head: head.first_sequence)
    assert after.stream_id != before.stream_id
    assert after.first_sequence > before.first_sequence + 2 * RESTART_SKIP


async def test_measurement_is_delivered_after_the_disk_accepts_or_refuses_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk does not stop delivery."""
    full = False
    write_line = RecordingWriter.write_line

    def write_if_room(writer: RecordingWriter, line: bytes) -> None:
        if full:
            raise RecordingError("no room", path=tmp_path)
        write_line(writer, line)

    monkeypatch.setattr(RecordingWriter, "write_line", write_if_room)
    async with superframe_day(tmp_path) as (day, air):
        await air.frames(4.0)
        full = True
        await air.frames(6.0)
        assert len(air.master.received) >= len(day.read) - 2
        full = False
        await air.frames(1.0)


@pytest.mark.slow
async def test_journal_has_receptions_and_acknowledgements(tmp_path: Path) -> None:
    """A restart needs them."""
    async with superframe_day(tmp_path) as (day, air):
        await air.frames(20.0)
        await day.kill()
    (path,) = (tmp_path / "journals").iterdir()
    types = [line.type for line in read_lines(path)]
    assert types[:3] == ["recording", "journal", "acknowledged"]
    assert types.count("reception") > 20
    assert 3 <= types.count("acknowledged") <= 6


@pytest.mark.slow
async def test_status_reports_delivery(tmp_path: Path) -> None:
    """Before and after a master is there."""
    async with superframe_day(tmp_path) as (day, air):
        await asyncio.sleep(5.0)
        before = await client_status(day.folder / "client.sock")
        assert (before["protocol"], before["authenticated"], before["joined"]) == ("superframe", True, False)
        assert (before["queued"], before["clock_bound_ns"]) == (13, None)
        await air.frames(20.0)
        after = await client_status(day.folder / "client.sock")
    assert after["joined"]
    assert (after["missed_slots"], after["rejected_beacons"]) == (0, 0)
    assert after["queued"] <= 2
    assert 0 < after["clock_bound_ns"] < 200_000
    assert after["master_heard_s"] < 0.5


async def test_station_without_key_is_reported(tmp_path: Path) -> None:
    """In log and status; a master with a key does not accept it, nor it the master."""
    with capture_logs() as logs:
        async with field_day(tmp_path, protocol=SUPERFRAME) as day:
            air = OnAir(day)
            await air.frames(10.0)
            status = await client_status(tmp_path / "client.sock")
    assert [entry["event"] for entry in logs if entry["event"] == "unauthenticated"] == ["unauthenticated"]
    assert [entry["event"] for entry in logs].count("beacon_authentication_failed") == 1
    assert (status["authenticated"], status["joined"], status["master_heard_s"]) == (False, False, None)
    assert not air.master.received


async def test_reply_starts_at_slot(tmp_path: Path) -> None:
    """Within the radio's own precision: the guard time is for others."""
    async with superframe_day(tmp_path) as (day, air):
        await air.frames(10.0)
        payload = air.master.beacon()
        air.master.sent_by_radio(await day.master.radio.transmit(payload))
        packet = await day.master.radio.receive()
        began_ns = packet.received_at_ns - TIMING.reception_ns - TIMING.airtime_ns(len(packet.payload))
        slot_ns = air.master.beacon_done_ns - 67_000 + TIMING.turnaround_ns
        assert abs(began_ns - slot_ns) < MS
        air.master.take(packet.payload)


async def test_reply_composed_too_slowly_is_not_transmitted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would collide with the next slot; the next reply has its measurements."""
    timeline, compose = running_timeline(), SuperframeStation.compose

    def slow(station: SuperframeStation, state: InstrumentState, now_ns: int) -> bytes | None:
        reply = compose(station, state, now_ns)
        timeline.advance(100 * MS)
        return reply

    async with superframe_day(tmp_path) as (_, air):
        await air.frames(5.0)
        air.master.grant = GRANT_BYTES.index(26)
        with monkeypatch.context() as patch, capture_logs() as logs:
            patch.setattr(SuperframeStation, "compose", slow)
            assert await air.frame() is None
        answered = await air.frame()
        status = await client_status(tmp_path / "client.sock")
    assert [(entry["event"], entry["missed_slots"]) for entry in logs] == [("slot_missed", 1)]
    assert status["missed_slots"] == 1
    assert answered is not None
    assert answered.sequences


async def test_first_sequence_is_synced_before_its_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a power cut the next run would otherwise use the same numbers."""
    synced: list[bytes] = []
    sync = RecordingWriter.sync

    def watched(writer: RecordingWriter) -> None:
        (path,) = (tmp_path / "journals").iterdir()
        synced.append(path.read_bytes())
        sync(writer)

    monkeypatch.setattr(RecordingWriter, "sync", watched)
    async with superframe_day(tmp_path) as (day, air):
        await air.frame()
        await day.kill()
    assert b"first_sequence" in synced[0]
    assert b"measurement" not in synced[0]
