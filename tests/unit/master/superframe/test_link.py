"""The master's daemon with the superframe, with stations on one simulated channel, on virtual time."""

from __future__ import annotations

import asyncio
import json
import math
import threading
from collections import Counter
from contextlib import asynccontextmanager
from functools import partial
from itertools import pairwise
from statistics import mean, median
from typing import TYPE_CHECKING
from unittest.mock import patch

import numpy as np
import pytest
from harness.drives.scene import START, driving, stationary_scene
from harness.missions.field import STATIONS, TRUE, field_of, running
from structlog.testing import capture_logs

from tsgt.errors import RadioError, RecordingError
from tsgt.master.publisher import Publisher
from tsgt.master.replay import replayed
from tsgt.model import PolarMeasurement, Status
from tsgt.recording import (
    BeaconRecord,
    EventRecord,
    PoseRecord,
    RecordingWriter,
    StationStatus,
    StatusRecord,
    encode_line,
    read_lines,
)
from tsgt.recording.recorder import Recorder
from tsgt.simulation.lora import LinkModel

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable
    from pathlib import Path

    from harness.missions.field import Field

    from tsgt.model import Measurement
    from tsgt.radio import Radio, Transmission

MS = 1_000_000
SECOND = 1000 * MS


def events(field: Field) -> list[str]:
    """Return the names of the events so far, with their stations."""
    return [f"{e.event} {e.station or ''}".strip() for e in field.of(EventRecord)]


def station_status(field: Field, station: int) -> StationStatus:
    """Return the last status of a station."""
    return field.of(StatusRecord)[-1].stations[station - 1]


def undelivered(field: Field, *, until_s: float) -> dict[int, set[int]]:
    """Which measurements made until then have not come, by station; each that has, has come once and is stamped right."""
    came: dict[int, Counter[int]] = {number: Counter() for number in STATIONS}
    for measurement in field.of(PolarMeasurement):
        came[measurement.station][measurement.sequence] += 1
        made_ns = field.stations[measurement.station].notes.made_ns[measurement.sequence]
        assert measurement.stamp_bound_ns is not None
        assert abs(measurement.stamp_ns - made_ns) <= measurement.stamp_bound_ns
    for numbers in came.values():
        assert set(numbers.values()) <= {1}
    made = {number: station.notes.made_ns for number, station in field.stations.items()}
    return {
        number: {sequence for sequence, at_ns in made[number].items() if at_ns < START + until_s * SECOND}
        - set(came[number])
        for number in STATIONS
    }


NOTHING: dict[int, set[int]] = {number: set() for number in STATIONS}


async def test_every_measurement_is_delivered(tmp_path: Path) -> None:
    """2.5 Hz per station with stamps accurate to microseconds; poses are valid, and the status is correct."""
    scene = stationary_scene().moving(driving)
    async with field_of(tmp_path, scene, superframe=True) as field, running(field.master()):
        await asyncio.sleep(40)
    assert undelivered(field, until_s=39) == NOTHING
    measurements = field.of(PolarMeasurement)
    errors_ns = [abs(m.stamp_ns - field.stations[m.station].notes.made_ns[m.sequence]) for m in measurements]
    assert max(errors_ns) < 100_000
    assert median(errors_ns) < 17_000
    assert all(m.host_time_ns is None and m.raw_status == 0 for m in measurements)
    poses = [pose for pose in field.of(PoseRecord) if pose.stamp_ns > START + 3 * SECOND]
    assert all(pose.valid for pose in poses)
    status = field.of(StatusRecord)[-1]
    assert (status.protocol, status.authenticated) == ("superframe", True)
    assert status.frame_ms == pytest.approx(378, abs=10)
    for station in status.stations:
        assert station.rate_hz == pytest.approx(2.5, abs=0.11)
        assert (station.joined, station.outstanding, station.missed_slots, station.rejected_beacons) == (
            True,
            0,
            0,
            0,
        )
        assert (station.prism, station.locked, station.loss) == (station.id, True, 0)
        assert station.stamp_bound_ns is not None
        assert station.stamp_bound_ns < 300_000
    assert events(field) == []


@pytest.mark.slow
async def test_beacons_are_recorded(tmp_path: Path) -> None:
    """With number and TxDone; frames last as long as their packets."""
    async with field_of(tmp_path, superframe=True) as field, running(field.master()):
        await asyncio.sleep(30)
    beacons = field.of(BeaconRecord)
    assert [beacon.counter for beacon in beacons] == list(range(len(beacons)))
    assert len({beacon.session for beacon in beacons}) == 1
    lengths_ms = [(after.stamp_ns - before.stamp_ns) / MS for before, after in pairwise(beacons[20:])]
    assert mean(lengths_ms) == pytest.approx(378, abs=8)


@pytest.mark.slow
async def test_phase_lock_reduces_the_age(tmp_path: Path) -> None:
    """Frames of 400 ms, the instruments' period."""
    ages_ms = {}
    for locked in (False, True):
        folder = tmp_path / str(locked)
        folder.mkdir()
        async with field_of(folder, superframe=True) as field:
            config = field.config(protocol={"phase_lock": locked})
            async with running(field.master(config)):
                await asyncio.sleep(60)
        live = [m for m in field.of(PolarMeasurement) if m.stamp_ns > START + 30 * SECOND]
        ages_ms[locked] = median((m.received_ns - m.stamp_ns) / MS for m in live)
    assert ages_ms[True] < 220 < ages_ms[False] < 310


@pytest.mark.slow
async def test_lossy_channel_loses_no_measurement(tmp_path: Path) -> None:
    """At 20 % packet loss everything is delivered, and the status is the newest."""
    async with (
        field_of(tmp_path, superframe=True, link=LinkModel(loss_probability=0.2)) as field,
        running(field.master()),
    ):
        await asyncio.sleep(120)
    assert undelivered(field, until_s=110) == NOTHING
    for number in STATIONS:
        station = station_status(field, number)
        assert station.age_s is not None
        assert station.age_s < 4
        assert station.loss is not None
        assert 0.1 < station.loss < 0.7


async def test_missing_key_is_reported(tmp_path: Path) -> None:
    """Stations and masters with different keys, or without one, ignore each other."""
    with capture_logs() as logs:
        async with field_of(tmp_path, superframe=True) as field, running(field.master(key=None)):
            await asyncio.sleep(10)
    assert events(field) == ["unauthenticated", "station_lost 1", "station_lost 2", "station_lost 3"]
    assert [log["log_level"] for log in logs if log["event"] == "unauthenticated"] == ["warning"]
    assert field.of(StatusRecord)[-1].authenticated is False
    assert field.of(PolarMeasurement) == []


# --- Disk -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
async def test_unwritten_measurements_are_not_acknowledged(tmp_path: Path) -> None:
    """With a full disk poses continue and stations keep everything; later all is written once."""
    write_line = RecordingWriter.write_line
    full = threading.Event()

    def failing(writer: RecordingWriter, line: bytes) -> None:
        if full.is_set():
            raise RecordingError("no room", path=tmp_path)
        write_line(writer, line)

    async with field_of(tmp_path, superframe=True) as field:
        with patch.object(RecordingWriter, "write_line", failing):
            async with running(field.master()):
                await asyncio.sleep(20)
                before = [len(station.notes.send_queue) for station in field.stations.values()]
                full.set()
                await asyncio.sleep(20)
                assert min(len(station.notes.send_queue) for station in field.stations.values()) > 40
                assert max(before) < 5
                assert field.of(PoseRecord)[-1].valid
                full.clear()
                await asyncio.sleep(20)
                assert max(len(station.notes.send_queue) for station in field.stations.values()) < 5
    assert undelivered(field, until_s=58) == NOTHING
    written = [line.data for line in read_lines(field.recording()) if line.type == "measurement"]
    assert written == [encode_line(m) for m in field.of(PolarMeasurement)]


@pytest.mark.parametrize("full_s", [4.7, 4.8, 4.9])
@pytest.mark.slow
async def test_lost_line_does_not_repeat_a_measurement(tmp_path: Path, full_s: float) -> None:
    """A disk that stays full loses the oldest lines; a measurement that it keeps is written once, whatever preceded it."""
    write_line, publish = RecordingWriter.write_line, Publisher.measurement
    full = threading.Event()

    def failing(writer: RecordingWriter, line: bytes) -> None:
        if full.is_set():
            raise RecordingError("no room", path=tmp_path)
        write_line(writer, line)

    def after_others(publisher: Publisher, measurement: Measurement) -> None:
        for _ in range(5):
            publisher.put(EventRecord(stamp_ns=measurement.received_ns, event="test", message=""))
        publish(publisher, measurement)

    async with field_of(tmp_path, superframe=True) as field:
        with (
            patch.object(RecordingWriter, "write_line", failing),
            patch.object(Publisher, "measurement", after_others),
            patch("tsgt.master.daemon.Recorder", partial(Recorder, max_pending_lines=60)),
        ):
            async with running(field.master()):
                await asyncio.sleep(5)
                full.set()
                await asyncio.sleep(full_s)
                full.clear()
                await asyncio.sleep(4)
    written = [line.data for line in read_lines(field.recording()) if line.type == "measurement"]
    stamps = Counter((each["station"], each["stamp_ns"]) for each in map(json.loads, written))
    assert len(stamps) > 60
    assert stamps.most_common(1)[0][1] == 1


@pytest.mark.slow
async def test_hanging_disk_does_not_delay_frames(tmp_path: Path) -> None:
    """Beacons wait for it for some milliseconds."""
    write_line = RecordingWriter.write_line
    hangs = threading.Event()
    freed = threading.Event()

    def hanging(writer: RecordingWriter, line: bytes) -> None:
        if hangs.is_set():
            freed.wait(20)
        write_line(writer, line)

    async with field_of(tmp_path, superframe=True) as field:
        with (
            patch.object(RecordingWriter, "write_line", hanging),
            # Not in the executor, where virtual time would stand still with it.
            patch("tsgt.master.recording_thread.asyncio.to_thread", _in_a_thread_of_its_own),
        ):
            async with running(field.master()):
                await asyncio.sleep(10)
                frames = len(field.of(BeaconRecord))
                hangs.set()
                try:
                    await asyncio.sleep(10)
                    assert len(field.of(BeaconRecord)) - frames > 12
                    assert min(len(station.notes.send_queue) for station in field.stations.values()) > 15
                finally:
                    hangs.clear()
                    freed.set()
                await asyncio.sleep(10)
    assert undelivered(field, until_s=28) == NOTHING


async def test_slow_disk_costs_its_time_and_no_retransmissions(tmp_path: Path) -> None:
    """An fsync of 40 ms, as of an SD card, makes a frame longer by as much; a retransmission of all would cost 100 ms."""

    async def slowly(function: Callable[..., object], *arguments: object) -> object:
        await asyncio.sleep(0.04)
        return function(*arguments)

    async with field_of(tmp_path, superframe=True) as field:
        with patch("tsgt.master.recording_thread.asyncio.to_thread", slowly):
            async with running(field.master()):
                await asyncio.sleep(15)
    assert field.of(StatusRecord)[-1].frame_ms == pytest.approx(418, abs=15)


async def _in_a_thread_of_its_own(function: Callable[..., object], *arguments: object) -> object:
    """Run a function in a thread while virtual time goes on."""
    results: list[object] = []
    thread = threading.Thread(target=lambda: results.append(function(*arguments)))
    thread.start()
    while thread.is_alive():
        await asyncio.sleep(0.001)
        thread.join(0.0005)
    return results[0]


# --- Radio and stations -----------------------------------------------------------------------------------------------


@pytest.mark.slow
async def test_radio_failure_continues_the_session(tmp_path: Path) -> None:
    """No station has to join again; nothing is lost or duplicated."""
    async with field_of(tmp_path, superframe=True) as field:
        fails = False

        @asynccontextmanager
        async def open_radio() -> AsyncGenerator[Radio]:
            async with field.open_radio()() as radio:
                transmit = radio.transmit

                async def breakable(payload: bytes, *, at_ns: int | None = None) -> Transmission:
                    nonlocal fails
                    sent = await transmit(payload, at_ns=at_ns)
                    if fails:
                        fails = False
                        raise RadioError("the end was not reported")
                    return sent

                with patch.object(radio, "transmit", breakable):
                    yield radio

        async with running(field.master(open_radio=open_radio)):
            for _ in range(5):
                await asyncio.sleep(8.123)
                fails = True
            await asyncio.sleep(8)
    assert undelivered(field, until_s=47) == NOTHING
    assert events(field) == ["radio_failed", "radio_recovered"] * 5
    beacons = field.of(BeaconRecord)
    assert len({beacon.session for beacon in beacons}) == 1
    assert all(after.counter > before.counter for before, after in pairwise(beacons))


@pytest.mark.slow
async def test_killed_station_delivers_its_backlog(tmp_path: Path) -> None:
    """With correct times; skipped numbers are not waited for."""
    async with field_of(tmp_path, superframe=True) as field, running(field.master()):
        await asyncio.sleep(20.1)
        await field.stations[2].kill()
        await asyncio.sleep(1.03)
        field.stations[2].start()
        await asyncio.sleep(20)
        numbers = [m.sequence for m in field.of(PolarMeasurement) if m.station == 2]
        assert max(numbers) > 1000
        assert station_status(field, 2).outstanding == 0
    assert undelivered(field, until_s=40) == NOTHING


@pytest.mark.slow
async def test_backlog_follows_live_data_after_an_outage(tmp_path: Path) -> None:
    """The status never shows an old measurement as the newest."""
    link = LinkModel()
    async with field_of(tmp_path, superframe=True, link=link) as field, running(field.master()):
        await asyncio.sleep(20)
        link.set_attenuation("master", "station-3", 200)
        await asyncio.sleep(60)
        assert "station_lost 3" in events(field)
        link.set_attenuation("master", "station-3", 0)
        await asyncio.sleep(5)
        age_s = station_status(field, 3).age_s
        assert age_s is not None
        assert age_s < 1.5
        missing = station_status(field, 3).outstanding
        assert missing is not None
        assert missing > 20
        await asyncio.sleep(25)
        assert station_status(field, 3).outstanding == 0
    assert undelivered(field, until_s=109) == NOTHING
    back = [m for m in field.of(PolarMeasurement) if m.station == 3 and m.received_ns > START + 80 * SECOND]
    late = [m for m in back if m.stamp_ns < START + 79 * SECOND]
    assert len(late) > 140
    assert max(m.received_ns for m in late) < START + 100 * SECOND
    assert events(field) == ["station_lost 3", "station_recovered 3"]


@pytest.mark.slow
async def test_late_status_is_not_the_present_one(tmp_path: Path) -> None:
    """Late status is not the present one."""
    link = LinkModel()
    async with field_of(tmp_path, superframe=True, link=link) as field, running(field.master()):
        await asyncio.sleep(20)
        link.set_attenuation("master", "station-1", 200)
        await asyncio.sleep(5)
        field.stations[1].instrument.status = Status.TILT
        await asyncio.sleep(20)
        field.stations[1].instrument.status = Status.OK
        await asyncio.sleep(5)
        link.set_attenuation("master", "station-1", 0)
        await asyncio.sleep(20)
    tilted = [m for m in field.of(PolarMeasurement) if m.status is Status.TILT]
    assert len(tilted) == pytest.approx(50, abs=2)
    assert "instrument_status 1" not in events(field)


@pytest.mark.slow
async def test_station_in_direct_mode_is_commanded_to_track(tmp_path: Path) -> None:
    """A refusal and its end are events."""
    async with field_of(tmp_path, superframe=True) as field:
        tool = field.stations[1].instrument
        await field.stations[1].kill()
        tool.direct_mode = tool.refuses = True
        field.stations[1].start()
        async with running(field.master()):
            await asyncio.sleep(10)
            assert events(field) == ["station_not_tracking 1"]
            assert station_status(field, 1).prism is None
            tool.refuses = False
            await asyncio.sleep(40)
            assert events(field) == ["station_not_tracking 1", "station_tracking 1"]
            assert station_status(field, 1).prism == 1
    assert not tool.direct_mode


@pytest.mark.slow
async def test_lost_prism_gets_search_commands(tmp_path: Path) -> None:
    """Every 5 s, in its own circles, until it is reacquired; the others are not affected."""
    scene = stationary_scene().moving(driving)
    with capture_logs() as logs:
        async with field_of(tmp_path, scene, superframe=True) as field, running(field.master()):
            tool = field.stations[2].instrument
            await asyncio.sleep(20)
            assert tool.searches == []
            tool.status = Status.NO_TARGET
            await asyncio.sleep(14)
            tool.status = Status.OK
            await asyncio.sleep(20)
    assert len(tool.searches) == 3
    assert field.stations[1].instrument.searches == field.stations[3].instrument.searches == []
    after_s = [at_ns / SECOND - 20 for at_ns, _ in tool.searches]
    assert after_s == pytest.approx([2.6, 7.8, 13.0], abs=0.4)
    for at_ns, towards in tool.searches:
        assert towards.spread_rad < math.radians(5)
        for ahead_s in (0.0, 1.0):
            true = scene.measure(2, at_ns / SECOND + ahead_s)
            aside_rad = math.hypot(
                math.remainder(towards.horizontal_angle_rad - true.horizontal_angle_rad, math.tau),
                towards.zenith_angle_rad - true.zenith_angle_rad,
            )
            assert aside_rad < towards.spread_rad
    assert events(field) == ["instrument_status 2", "instrument_status 2"]
    ordered = [log for log in logs if log["event"] == "search_commanded"]
    assert [log["station"] for log in ordered] == [2, 2, 2]
    assert undelivered(field, until_s=53) == NOTHING
    assert station_status(field, 1).rate_hz == pytest.approx(2.5, abs=0.11)


@pytest.mark.slow
async def test_search_commands_do_not_delay_others(tmp_path: Path) -> None:
    """Phase-locked frames keep their length, and measurements their age."""
    async with field_of(tmp_path, superframe=True) as field:
        async with running(field.master(field.config(protocol={"phase_lock": True}))):
            await asyncio.sleep(40)
            field.stations[2].instrument.status = Status.NO_TARGET
            await asyncio.sleep(40)
        assert len(field.stations[2].instrument.searches) == 6
    middle_ns = START + 40 * SECOND
    lengths_ms = [
        (after.stamp_ns - before.stamp_ns) / MS
        for before, after in pairwise(field.of(BeaconRecord))
        if before.stamp_ns > middle_ns
    ]
    assert mean(lengths_ms) == pytest.approx(400, abs=0.5)
    for number in (1, 3):
        ages_ms: dict[bool, list[float]] = {False: [], True: []}
        for m in field.of(PolarMeasurement):
            if m.station == number and m.stamp_ns > START + 30 * SECOND:
                ages_ms[m.stamp_ns > middle_ns].append((m.received_ns - m.stamp_ns) / MS)
        assert median(ages_ms[True]) < median(ages_ms[False]) + 2
        assert max(ages_ms[True]) < max(ages_ms[False]) + 40


@pytest.mark.slow
async def test_station_in_direct_mode_gets_no_search_command(tmp_path: Path) -> None:
    """Its operator aims at targets; it is commanded to track."""
    async with field_of(tmp_path, superframe=True) as field, running(field.master()):
        tool = field.stations[1].instrument
        await asyncio.sleep(10)
        await field.stations[1].kill()
        tool.direct_mode = tool.refuses = True
        tool.status = Status.NO_TARGET
        field.stations[1].start()
        await asyncio.sleep(20)
        assert station_status(field, 1).status is Status.NO_TARGET
        assert tool.searches == []
        assert "station_not_tracking 1" in events(field)


@pytest.mark.slow
async def test_refused_search_is_no_refusal_to_track(tmp_path: Path) -> None:
    """It is repeated after 5 s, without an event."""
    async with field_of(tmp_path, superframe=True) as field, running(field.master()):
        tool = field.stations[3].instrument
        await asyncio.sleep(10)
        tool.status, tool.refuses = Status.NO_TARGET, True
        await asyncio.sleep(10)
    assert len(tool.searches) == 2
    assert events(field) == ["instrument_status 3"]


@pytest.mark.slow
async def test_expired_search_command_is_withdrawn(tmp_path: Path) -> None:
    """A station that was away gets a new one, or none."""
    link = LinkModel()
    driven = stationary_scene().moving(lambda time_s: (np.eye(3), np.array([30.0, time_s - 20.0, -1.0])))
    async with field_of(tmp_path, driven, superframe=True, link=link) as field, running(field.master()):
        tool = field.stations[3].instrument
        await asyncio.sleep(10)
        tool.status = Status.NO_TARGET
        await asyncio.sleep(1.6)
        link.set_attenuation("master", "station-3", 200)
        with capture_logs() as logs:
            await asyncio.sleep(20)
        assert [log["event"] for log in logs].count("search_commanded") == 1
        assert tool.searches == []
        link.set_attenuation("master", "station-3", 0)
        await asyncio.sleep(5)
    ((at_ns, towards),) = tool.searches
    true = driven.measure(3, at_ns / SECOND)
    aside_rad = math.remainder(towards.horizontal_angle_rad - true.horizontal_angle_rad, math.tau)
    assert abs(aside_rad) < towards.spread_rad


# --- Time -------------------------------------------------------------------------------------------------------------


class _Seventies:
    """The true time on a computer whose clock showed 1970 at its start, half a minute ago."""

    def __init__(self) -> None:
        self.monotonic_ns = TRUE.monotonic_ns
        self.sleep_until = TRUE.sleep_until

    def realtime_ns(self) -> int:
        return TRUE.monotonic_ns() - 30 * SECOND


@pytest.mark.slow
async def test_measurements_from_before_1970_are_kept(tmp_path: Path) -> None:
    """A master without a battery clock: recordings have no negative times, so the bound covers the difference."""
    async with field_of(tmp_path, superframe=True) as field:
        await asyncio.sleep(60)
        async with running(field.master(clock=_Seventies())):
            await asyncio.sleep(20)
    early = [m for m in field.of(PolarMeasurement) if m.stamp_ns == 0]
    assert len(early) > 200
    for m in early:
        true_ns = field.stations[m.station].notes.made_ns[m.sequence] - START - 30 * SECOND
        assert m.stamp_bound_ns is not None
        assert abs(true_ns) <= m.stamp_bound_ns


@pytest.mark.slow
async def test_replay_equals_the_stream(tmp_path: Path) -> None:
    """Beacons and late measurements included."""
    link = LinkModel(loss_probability=0.2)
    async with field_of(tmp_path, superframe=True, link=link) as field, running(field.master()):
        await asyncio.sleep(30)
        link.set_attenuation("master", "station-3", 200)
        await asyncio.sleep(10)
        link.set_attenuation("master", "station-3", 0)
        await asyncio.sleep(20)
    streamed = [encode_line(record) for record in field.records]
    assert [line for _, some in replayed(field.recording()) for line in some] == streamed
