"""The master's daemon with simulated stations, radio driver and channel, on virtual time."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
from contextlib import asynccontextmanager
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import pytest
from harness.drives.scene import START, driving, stationary_scene
from harness.hardware.radios import PAPER
from harness.inertial import imu
from harness.instruments.bridge import FakeStart
from harness.missions.field import DISK, STATIONS, TRUE, field_of, running

from tsgt.config import AlarmsConfig, GeofenceConfig, ImuConfig
from tsgt.errors import ComputerSuspendedError, ConfigError, RadioError, StreamError
from tsgt.geometry import rotation_from_quaternion
from tsgt.master.monitors.geofence import run_geofence_command
from tsgt.master.monitors.imu import ImuUseMonitor
from tsgt.master.reload import RELOAD_SIGNAL, reloading
from tsgt.master.replay import greeting, replayed
from tsgt.model import ImuSamples, PolarMeasurement, Status
from tsgt.recording import (
    ClockRecord,
    DiskStatus,
    EventRecord,
    PoseRecord,
    SetupRecord,
    StatusRecord,
    encode_line,
    load_recording,
    read_imu_samples,
    read_lines,
    write_target_checks,
)
from tsgt.service import run
from tsgt.simulation.lora import radio_opener

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path

    from harness.missions.field import Field

    from tsgt.model import Parameters
    from tsgt.radio import Radio, Transmission

DRIVING = stationary_scene().moving(driving)
MS = 1_000_000


def events(field: Field) -> list[str]:
    """Return the names of the events so far, with their stations."""
    return [f"{e.event} {e.station or ''}".strip() for e in field.of(EventRecord)]


def stamp_errors_ms(measurements: list[PolarMeasurement]) -> list[float]:
    """Return the errors of the stamps against the scene's instants, in ms."""
    errors_ms = []
    for measurement in measurements:
        off_ns = (measurement.stamp_ns - START - measurement.station) % (400 * MS)
        errors_ms.append(min(off_ns, 400 * MS - off_ns) / MS)
    return errors_ms


@pytest.mark.parametrize(
    ("authors", "rate_hz", "error_ms"), [(False, 1.6, 0.5), (True, 1.5, 4.0)], ids=["ours", "authors'"]
)
@pytest.mark.slow
async def test_poses_are_correct(tmp_path: Path, *, authors: bool, rate_hz: float, error_ms: float) -> None:
    """Stations with wrong clocks are commanded to track, synchronised and polled; stamps and poses are correct."""
    async with field_of(tmp_path, DRIVING, authors=authors) as field, running(field.master()):
        await asyncio.sleep(40)
    poses = [pose for pose in field.of(PoseRecord) if pose.valid]
    assert len(poses) > 0.85 * len(field.of(PoseRecord))
    for pose in poses:
        assert pose.position_m is not None
        assert pose.orientation_xyzw is not None
        rotation, position = DRIVING.motion((pose.stamp_ns - START) / 1e9)
        assert pose.position_m == pytest.approx(position, abs=0.02)
        assert rotation_from_quaternion(np.array(pose.orientation_xyzw)) == pytest.approx(rotation, abs=0.03)
    assert max(stamp_errors_ms(field.of(PolarMeasurement))) < error_ms
    status = next(s for s in field.of(StatusRecord) if s.stamp_ns > START + 20_000 * MS)
    for station in status.stations:
        assert station.rate_hz is not None
        assert station.rate_hz >= rate_hz
        assert station.prism == station.id
        assert station.locked
        assert station.loss == 0
        assert station.snr_db is not None
        assert station.clock_bound_ns is not None
    assert events(field) == []


@pytest.mark.slow
async def test_repeated_measurement_is_published_once(tmp_path: Path) -> None:
    """Polls are more frequent than measurements when only one station responds."""
    async with field_of(tmp_path) as field:
        await field.stations[2].kill()
        await field.stations[3].kill()
        async with running(field.master()):
            await asyncio.sleep(60)
    times = [m.host_time_ns for m in field.of(PolarMeasurement)]
    assert len(times) > 50
    assert len(times) == len(set(times))


@pytest.mark.slow
@pytest.mark.parametrize("authors", [False, True], ids=["ours", "authors'"])
async def test_error_status_invalidates_the_pose(tmp_path: Path, *, authors: bool) -> None:
    """Tilt, wrong distance, too near, no prism: no valid pose, but status, measurement and event."""
    async with field_of(tmp_path, authors=authors) as field, running(field.master()):
        await asyncio.sleep(20)
        for status in (Status.TILT, Status.WRONG_DISTANCE, Status.ANGLE_ONLY, Status.NO_TARGET):
            field.stations[2].instrument.status = status
            await asyncio.sleep(5)
            seen = [m for m in field.of(PolarMeasurement) if m.station == 2][-1]
            assert seen.status is status
            assert field.of(StatusRecord)[-1].stations[1].status is status
            assert field.of(EventRecord)[-1].event == "instrument_status"
            last = field.of(PoseRecord)[-1]
            assert not last.valid
            assert last.reason == "station_status"
        field.stations[2].instrument.status = Status.OK
        await asyncio.sleep(5)
        assert field.of(PoseRecord)[-1].valid
    untimed = [m for m in field.of(PolarMeasurement) if m.stamp_sigma_ns == 1_000_000_000]
    assert [m.status for m in untimed] == (
        [Status.TILT, Status.WRONG_DISTANCE, Status.NO_TARGET] if authors else []
    )


@pytest.mark.slow
async def test_restarted_station_with_another_clock_recovers(tmp_path: Path) -> None:
    """The other stations are not affected; the station recovers within seconds and its new clock is detected."""
    async with field_of(tmp_path, DRIVING) as field, running(field.master()):
        await asyncio.sleep(40)
        await field.stations[2].kill()
        await asyncio.sleep(30)
        lost_at = len(field.records)
        field.stations[2].clock.step(3_600_000 * MS)
        field.stations[2].start()
        await asyncio.sleep(15)
    assert events(field) == ["station_lost 2", "station_recovered 2", "station_clock_stepped 2"]
    assert max(stamp_errors_ms(field.of(PolarMeasurement))) < 0.2
    others = [m for m in field.records[:lost_at] if isinstance(m, PolarMeasurement) and m.station == 1]
    gaps = [b.stamp_ns - a.stamp_ns for a, b in pairwise(others)]
    assert max(gaps) < 2500 * MS  # the synchronisation of another one
    assert field.of(PoseRecord)[-1].valid


@pytest.mark.slow
async def test_clock_step_of_a_station_loses_no_measurement(tmp_path: Path) -> None:
    """Measurements are held until the next synchronisation."""
    async with field_of(tmp_path, authors=True) as field, running(field.master()):
        await asyncio.sleep(30)
        before = len(field.of(PolarMeasurement))
        field.stations[1].clock.step(-60_000 * MS)
        await asyncio.sleep(10)
    after = field.of(PolarMeasurement)[before:]
    assert [m.sequence for m in after if m.station == 1] == sorted(
        m.sequence for m in after if m.station == 1
    )
    assert events(field) == ["station_clock_stepped 1"]
    assert max(stamp_errors_ms(field.of(PolarMeasurement))) < 4.0
    stepped_ns = field.of(EventRecord)[-1].stamp_ns
    found = next(c for c in field.of(ClockRecord) if c.stamp_ns > stepped_ns)
    assert found.station == 1
    assert found.restarted
    assert found.stamp_ns - stepped_ns < 2000 * MS


@pytest.mark.slow
async def test_station_in_direct_mode_is_commanded_to_track(tmp_path: Path) -> None:
    """The first command is to track, so that no poll is taken for a command to measure a target."""
    async with field_of(tmp_path) as field:
        field.stations[1].instrument.direct_mode = True
        async with running(field.master()):
            await asyncio.sleep(20)
    assert not field.stations[1].instrument.direct_mode
    assert field.of(StatusRecord)[-1].stations[0].measurements > 10


@pytest.mark.slow
async def test_refused_track_command_is_repeated(tmp_path: Path) -> None:
    """A station that does not track has an event, is not polled, and is used as soon as it tracks."""
    async with field_of(tmp_path) as field:
        field.stations[1].instrument.refuses = True
        async with running(field.master()):
            await asyncio.sleep(20)
            assert events(field) == ["station_not_tracking 1"]
            assert not [m for m in field.of(PolarMeasurement) if m.station == 1]
            assert [m for m in field.of(PolarMeasurement) if m.station == 2]
            field.stations[1].instrument.refuses = False
            await asyncio.sleep(15)
    assert events(field) == ["station_not_tracking 1", "station_tracking 1"]
    assert field.of(PoseRecord)[-1].valid


@pytest.mark.parametrize("protocol", [{}, {"clock_filter": "paper"}], ids=["regression", "paper"])
async def test_recording_equals_stream_and_replay(tmp_path: Path, protocol: dict[str, Any]) -> None:
    """Header and parameters, then the lines of the stream; a replay reproduces them bit for bit."""
    fence = GeofenceConfig(
        name="yard", polygon_m=((29.5, 0), (40, 0), (40, 40), (29.5, 40)), hysteresis_m=0.1
    )
    async with (
        field_of(tmp_path, DRIVING) as field,
        running(field.master(field.config(protocol=protocol, geofences=(fence,)))),
    ):
        await asyncio.sleep(25)
        field.stations[3].instrument.status = Status.NO_TARGET
        await asyncio.sleep(5)
        await field.stations[3].kill()
        await asyncio.sleep(10.03)
    streamed = [encode_line(record) for record in field.records]
    lines = list(read_lines(field.recording()))
    assert [line.type for line in lines[:2]] == ["recording", "parameters"]
    assert [line.data for line in lines[2:]] == streamed
    assert [line for _, some in replayed(field.recording()) for line in some] == streamed
    assert {"geofence_exited", "geofence_entered", "station_lost 3"} <= set(events(field))


async def test_second_master_leaves_no_recording(tmp_path: Path) -> None:
    """Another one serves the socket; systemd would start it every two seconds."""
    async with field_of(tmp_path, DRIVING) as field, running(field.master()):
        await asyncio.sleep(1)
        with pytest.raises(StreamError, match="another program serves this socket"):
            await field.master()
    assert len(list((tmp_path / "recordings").iterdir())) == 1


async def test_master_that_is_stopped_as_its_computer_resumes_ends(tmp_path: Path) -> None:
    """Both at once: the error of the resume takes the place of the cancellation."""

    async def resumed(*_: object) -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            raise ExceptionGroup("", [ComputerSuspendedError(1.0)]) from None

    async with field_of(tmp_path, DRIVING) as field:
        with patch("tsgt.master.daemon.run_master", resumed):
            task = asyncio.create_task(field.master(suspended_ns=lambda: 0))
            await asyncio.sleep(0.1)
            task.cancel()
            await asyncio.wait([task], timeout=1.0)
    assert task.cancelled()


@pytest.mark.slow
async def test_suspended_master_begins_anew(tmp_path: Path) -> None:
    """Its clock stood still: nothing more is published on the old timeline, an event says why, stations join the new session."""
    suspended_ns = 0
    async with (
        field_of(tmp_path, DRIVING) as field,
        running(field.master(suspended_ns=lambda: suspended_ns)),
    ):
        await asyncio.sleep(12)
        published, first = len(field.records), field.recording()
        assert field.of(PoseRecord)[-1].valid
        suspended_ns = 8_000_000_000
        await asyncio.sleep(12)
    assert isinstance(field.records[published], SetupRecord)
    assert events(field)[-1] == "computer_resumed"
    assert len(list((tmp_path / "recordings").iterdir())) == 2
    lines = [encode_line(record) for record in field.records]
    assert [line.data for line in list(read_lines(first))[2:]] == lines[:published]
    assert [line.data for line in list(read_lines(field.recording()))[2:]] == lines[published:]
    again = field.records[published:]
    assert {m.station for m in again if isinstance(m, PolarMeasurement)} == set(STATIONS)
    assert [pose for pose in again if isinstance(pose, PoseRecord)][-1].valid


UNCALIBRATED = replace(DRIVING.parameters, prisms=(), no_poses="not calibrated")


@pytest.mark.slow
async def test_uncalibrated_master_takes_a_calibration_while_it_runs(tmp_path: Path) -> None:
    """Until then it records raw measurements, and says why there are no poses; a replay gives the same lines."""
    async with (
        field_of(tmp_path, DRIVING) as field,
        running(field.master(parameters=UNCALIBRATED, read_setup=lambda: DRIVING.parameters)),
    ):
        await asyncio.sleep(15)
        assert events(field) == ["setup_missing"]
        assert {m.station for m in field.of(PolarMeasurement)} == set(STATIONS)
        assert field.of(PoseRecord) == []
        assert field.of(StatusRecord)[-1].no_poses == "not calibrated"
        assert field.of(SetupRecord)[-1].stations == ()
        os.kill(os.getpid(), RELOAD_SIGNAL)
        await asyncio.sleep(10)
    assert events(field) == ["setup_missing", "setup_applied"]
    assert field.of(PoseRecord)[-1].valid
    assert field.of(StatusRecord)[-1].no_poses is None
    assert [each.id for each in field.of(SetupRecord)[-1].stations] == list(STATIONS)
    streamed = [encode_line(record) for record in field.records]
    assert [line for _, some in replayed(field.recording()) for line in some] == streamed
    assert greeting(field.recording()).no_poses == "not calibrated"
    loaded = load_recording(field.recording())
    applied_ns = field.of(SetupRecord)[-1].stamp_ns
    assert loaded.parameters == DRIVING.parameters
    assert min(each.stamp_ns for each in loaded.measurements) >= applied_ns
    assert loaded.left_out == sum(m.stamp_ns < applied_ns for m in field.of(PolarMeasurement))
    whole = load_recording(field.recording(), whole=True)
    assert len(whole.measurements) == loaded.left_out + len(loaded.measurements)


async def test_use_of_the_imu_is_watched_anew_with_a_new_set_up(tmp_path: Path) -> None:
    """A contradiction of a station is an event once per set-up, because the estimator begins again."""
    with patch("tsgt.master.daemon.ImuUseMonitor", side_effect=ImuUseMonitor) as made:
        async with (
            field_of(tmp_path, DRIVING) as field,
            running(field.master(read_setup=lambda: DRIVING.parameters)),
        ):
            await asyncio.sleep(2)
            os.kill(os.getpid(), RELOAD_SIGNAL)
            await asyncio.sleep(1)
    assert events(field) == ["setup_applied"]
    assert made.call_count == 2


async def test_signal_is_ignored_while_the_master_ends() -> None:
    """Or restarts after a suspension: its default ends the process."""
    with reloading(lambda: DRIVING.parameters, lambda _: None, lambda _: None):
        pass
    assert signal.getsignal(RELOAD_SIGNAL) == signal.SIG_IGN


COLLINEAR = replace(
    DRIVING.parameters,
    prisms=tuple(
        replace(prism, position_m=(0.3 * prism.prism, 0.0, 1.0)) for prism in DRIVING.parameters.prisms
    ),
)

UNUSABLE = [ConfigError("frames.toml: not TOML"), UNCALIBRATED, COLLINEAR]


@pytest.mark.parametrize("found", UNUSABLE)
async def test_unusable_set_up_leaves_the_old_one(tmp_path: Path, found: ConfigError | Parameters) -> None:
    """A broken or missing file and prisms in a line are an event, and poses go on; the recording agrees."""

    def read_setup() -> Parameters:
        if isinstance(found, ConfigError):
            raise found
        return found

    async with field_of(tmp_path, DRIVING) as field, running(field.master(read_setup=read_setup)):
        await asyncio.sleep(10)
        os.kill(os.getpid(), RELOAD_SIGNAL)
        await asyncio.sleep(5)
    assert events(field) == ["setup_rejected"]
    assert len(field.of(SetupRecord)) == 1
    assert field.of(PoseRecord)[-1].valid
    loaded = load_recording(field.recording())
    assert (loaded.parameters, loaded.left_out) == (DRIVING.parameters, 0)


@pytest.mark.parametrize("found", UNUSABLE)
async def test_unusable_set_up_after_a_suspension_leaves_the_old_one(
    tmp_path: Path, found: ConfigError | Parameters
) -> None:
    """The master restarts with what was in force before: not the set-up of its start, which a reload has replaced."""
    suspended_ns = 0
    at_start = replace(DRIVING.parameters, prisms=DRIVING.parameters.prisms[::-1])

    def read_setup() -> Parameters:
        if not suspended_ns:
            return DRIVING.parameters
        if isinstance(found, ConfigError):
            raise found
        return found

    async with (
        field_of(tmp_path, DRIVING) as field,
        running(field.master(parameters=at_start, read_setup=read_setup, suspended_ns=lambda: suspended_ns)),
    ):
        await asyncio.sleep(5)
        os.kill(os.getpid(), RELOAD_SIGNAL)
        await asyncio.sleep(5)
        suspended_ns = 8_000_000_000
        await asyncio.sleep(12)
    assert events(field) == ["setup_applied", "computer_resumed"]
    assert field.of(PoseRecord)[-1].valid
    assert load_recording(field.recording()).parameters == DRIVING.parameters


class ImuProgram:
    """Starts a program that prints samples on a task of its own, until it is told to end."""

    def __init__(self) -> None:
        self.start = FakeStart(TRUE, imu.HELLO)
        self.silent = False

    async def run(self) -> None:
        """Print ten samples every 50 ms."""
        for number in range(0, 10**6, 10):
            await asyncio.sleep(0.05)
            if self.start.programs and not self.silent:
                self.start.programs[-1].print_lines(imu.samples(number, 10))


IMU = ImuConfig(
    command=("imu",), position_m=(0, 0, 0), orientation_xyzw=(0.0, 0.0, 0.0, 1.0), gravity_mps2=9.81
)


@pytest.mark.slow
async def test_samples_of_the_imu_are_recorded_and_not_streamed(tmp_path: Path) -> None:
    """Status and events show it; its loss leaves the poses alone, and a replay skips the samples."""
    program = ImuProgram()
    async with (
        field_of(tmp_path) as field,
        running(program.run()),
        running(field.master(field.config(imu=IMU), start_imu=program.start)),
    ):
        await asyncio.sleep(15)
        program.silent = True
        await asyncio.sleep(5)
        program.silent = False
        await asyncio.sleep(5)
    assert events(field) == ["imu_lost", "imu_recovered"]
    status = next(s for s in field.of(StatusRecord) if s.stamp_ns > START + 12_000 * MS)
    assert status.imu is not None
    assert status.imu.rate_hz == pytest.approx(200, abs=12)
    assert status.imu.problem == ""
    samples = list(read_imu_samples(field.recording()))
    assert samples == field.of(ImuSamples)
    assert sum(len(record.stamp_ns) for record in samples) > 3500
    others = [encode_line(record) for record in field.records if not isinstance(record, ImuSamples)]
    assert [line.data for line in read_lines(field.recording())][2:] == others
    assert [line for _, some in replayed(field.recording()) for line in some] == others
    assert field.of(PoseRecord)[-1].valid


async def test_useless_program_of_the_imu_harms_nothing(tmp_path: Path) -> None:
    """It prints garbage, floods and dies, again and again."""
    start = FakeStart(TRUE, b"garbage\n" * 100, imu.HELLO, imu.samples(0, 10), b"x\n" * 6000)
    async with field_of(tmp_path) as field, running(field.master(field.config(imu=IMU), start_imu=start)):
        await asyncio.sleep(12)
    assert len(start.programs) > 5
    assert field.of(PoseRecord)[-1].valid
    assert events(field) == ["imu_lost"]


@pytest.mark.parametrize("at_ms", [0, 1, 30, 200, 1000, 1777, 4000, 4100, 5321, 9000])
async def test_master_stops_within_a_second_and_restarts(tmp_path: Path, at_ms: int) -> None:
    """Its last lines are on disk; the next run has a new recording, and poses."""
    async with field_of(tmp_path) as field:
        task = asyncio.create_task(field.master())
        await asyncio.sleep(at_ms / 1e3)
        task.cancel()
        stopped_ns = TRUE.monotonic_ns()
        await asyncio.wait([task])
        assert TRUE.monotonic_ns() - stopped_ns < 1000 * MS
        assert task.cancelled()
        if at_ms:  # earlier it has neither socket nor recording
            lines = [line.data for line in read_lines(field.recording())]
            assert lines[2:] == [encode_line(record) for record in field.records]
        field.records.clear()
        async with running(field.master()):
            await asyncio.sleep(12)
        assert field.of(PoseRecord)[-1].valid
        assert len(list((tmp_path / "recordings").iterdir())) == (2 if at_ms else 1)


@pytest.mark.slow
async def test_failed_radio_is_reopened(tmp_path: Path) -> None:
    """One event reports the failure, status records continue, and poses recover."""
    async with field_of(tmp_path) as field:
        works = True

        @asynccontextmanager
        async def open_radio() -> AsyncGenerator[Radio]:
            if not works:
                raise RadioError("no chip answers")
            async with field.open_radio()() as radio:
                transmit = radio.transmit

                async def breakable(payload: bytes, *, at_ns: int | None = None) -> Transmission:
                    if not works:
                        raise RadioError("unplugged")
                    return await transmit(payload, at_ns=at_ns)

                with patch.object(radio, "transmit", breakable):
                    yield radio

        async with running(field.master(open_radio=open_radio)):
            await asyncio.sleep(15)
            works = False
            await asyncio.sleep(15)
            assert events(field) == ["radio_failed"]
            assert not any(station.answering for station in field.of(StatusRecord)[-1].stations)
            works = True
            await asyncio.sleep(15)
            assert events(field) == ["radio_failed", "radio_recovered"]
            assert field.of(PoseRecord)[-1].valid
    assert len(field.of(StatusRecord)) >= 44


async def test_unix_clock_step_of_the_master_is_reported(tmp_path: Path) -> None:
    """Stamps stay on the timeline of the start."""
    async with field_of(tmp_path) as field:
        clock = _Steppable()
        async with running(field.master(clock=clock)):
            await asyncio.sleep(15)
            clock.ahead_ns = 5000 * MS
            await asyncio.sleep(5)
    (event,) = field.of(EventRecord)
    assert event.event == "unix_clock_stepped"
    assert "set by +5.000 s" in event.message
    assert max(stamp_errors_ms(field.of(PolarMeasurement))) < 0.1
    assert all(pose.valid for pose in field.of(PoseRecord)[-20:])


class _Steppable:
    """The true time with a Unix clock that somebody sets."""

    def __init__(self) -> None:
        self.ahead_ns = 0
        self.monotonic_ns = TRUE.monotonic_ns
        self.sleep_until = TRUE.sleep_until

    def realtime_ns(self) -> int:
        return TRUE.realtime_ns() + self.ahead_ns


@pytest.mark.slow
async def test_interference_does_not_corrupt_measurements(tmp_path: Path) -> None:
    """Unknown packets in the pauses cost measurements, but corrupt none."""
    async with field_of(tmp_path) as field:

        async def jam() -> None:
            rng = np.random.default_rng(1)
            async with radio_opener(field.air, "interferer", TRUE, rng, PAPER)() as radio:
                while True:
                    await radio.transmit(rng.bytes(int(rng.integers(1, 40))))
                    await asyncio.sleep(float(rng.uniform(0.5, 2.0)))

        async with running(jam()), running(field.master()):
            await asyncio.sleep(60)
    assert all(status.poses for status in field.of(StatusRecord)[-5:])
    assert max(stamp_errors_ms(field.of(PolarMeasurement))) < 1.0
    assert {m.station for m in field.of(PolarMeasurement)} == set(STATIONS)


def test_geofence_command_runs_at_a_crossing(tmp_path: Path) -> None:
    """The command has the event in its environment; a failure is only logged."""

    async def commands() -> None:
        script = f'echo "$TSGT_EVENT $TSGT_FENCE" > {tmp_path}/said'
        await run_geofence_command(("sh", "-c", script), event="geofence_exited", fence="yard")
        await run_geofence_command(("/nonexistent",), event="geofence_exited", fence="yard")
        await run_geofence_command(("false",), event="geofence_exited", fence="yard")

    run(commands)
    assert (tmp_path / "said").read_text() == "geofence_exited yard\n"


def test_geofence_name_is_not_executed(tmp_path: Path) -> None:
    """The command runs without a shell, and the name is not an argument."""
    name = f'";touch {tmp_path}/owned;$(touch {tmp_path}/owned)`touch {tmp_path}/owned`'

    async def commands() -> None:
        script = f'printf %s "$TSGT_FENCE" > {tmp_path}/said'
        await run_geofence_command(("sh", "-c", script), event="geofence_exited", fence=name)
        await run_geofence_command(("touch", f"{tmp_path}/$TSGT_FENCE"), event="geofence_exited", fence=name)

    run(commands)
    assert (tmp_path / "said").read_text() == name
    assert {each.name for each in tmp_path.iterdir()} == {"said", "$TSGT_FENCE"}


@pytest.mark.slow
async def test_stalled_link_stops_watchdog_notifications(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Systemd is notified while transactions end, and no more after a minute without one."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "10000000")

        signs_of_life = 0

        def notified() -> None:
            nonlocal signs_of_life
            signs_of_life += b"WATCHDOG=1" in systemd.recv(1000)

        asyncio.get_running_loop().add_reader(systemd, notified)
        async with field_of(tmp_path) as field:
            stuck = asyncio.Event()

            @asynccontextmanager
            async def open_radio() -> AsyncGenerator[Radio]:
                async with field.open_radio()() as radio:
                    transmit = radio.transmit

                    async def hanging(payload: bytes, *, at_ns: int | None = None) -> Transmission:
                        if stuck.is_set():
                            await asyncio.Event().wait()
                        return await transmit(payload, at_ns=at_ns)

                    with patch.object(radio, "transmit", hanging):
                        yield radio

            async with running(field.master(open_radio=open_radio)):
                await asyncio.sleep(30)
                assert signs_of_life >= 5
                stuck.set()
                await asyncio.sleep(70)
                before = signs_of_life
                await asyncio.sleep(30)
                assert signs_of_life == before
        asyncio.get_running_loop().remove_reader(systemd)


async def test_status_has_recording_disk_and_target_checks(tmp_path: Path) -> None:
    """And a disk that is nearly full is an event."""
    async with field_of(tmp_path, superframe=True) as field:
        config = field.config()
        config.recording.directory.mkdir()
        write_target_checks(config.recording.directory, {2: True}, START - 60_000 * MS)
        async with running(field.master(config)):
            await asyncio.sleep(3.5)
            status = field.of(StatusRecord)[-1]
            assert events(field) == []
            field.disk = DiskStatus(free_bytes=500_000_000, total_bytes=32_000_000_000)
            await asyncio.sleep(4)
            assert events(field) == ["disk_low"]
            last = field.of(StatusRecord)[-1]
        recording = config.recording.directory / (field.of(SetupRecord)[0].recording or "")
    assert status.recording is not None
    assert status.recording.last_write_ns is not None
    assert status.stamp_ns - 1000 * MS < status.recording.last_write_ns <= status.stamp_ns
    assert 1000 < status.recording.bytes < recording.stat().st_size
    assert (status.recording.file, status.recording.waiting_lines) == (recording.name, 0)
    assert status.disk == DISK
    assert last.disk == field.disk
    ages_s = [station.last_target_check_age_s for station in status.stations]
    assert (ages_s[0], ages_s[2]) == (None, None)
    assert ages_s[1] == pytest.approx(60 + (status.stamp_ns - START) / 1e9)


async def test_alarms_leave_the_machine(tmp_path: Path) -> None:
    """An event of the master that is an alarm; a program that never ends delays nothing, and is stopped at the end."""
    alarms: list[bytes] = []
    stopped = asyncio.Event()

    async def hang(_command: object, _environment: object, *, stdin: bytes) -> str:
        alarms.append(stdin)
        try:
            await asyncio.sleep(1000)
        finally:
            stopped.set()
        return ""

    config = AlarmsConfig(site="yard", command=("siren",))
    async with field_of(tmp_path, superframe=True) as field:
        with patch("tsgt.master.alarms.run_command", hang):
            async with running(field.master(field.config(alarms=config))):
                field.disk = DiskStatus(free_bytes=500_000_000, total_bytes=32_000_000_000)
                await asyncio.sleep(6)
    (line,) = alarms
    assert json.loads(line)["event"] == "disk_low"
    assert json.loads(line)["site"] == "yard"
    assert len(field.of(StatusRecord)) == 6
    assert stopped.is_set()


async def test_setup_is_recorded_and_streamed(tmp_path: Path) -> None:
    """The same line, after the parameters and after the greeting; a replay begins with it."""
    fence = GeofenceConfig(name="site", polygon_m=((-9.0, -9.0), (9.0, -9.0), (0.0, 9.0)), margin_m=0.5)
    async with field_of(tmp_path, superframe=True) as field:
        config = field.config(geofences=(fence,))
        async with running(field.master(config)):
            await asyncio.sleep(2)
            reader, writer = await asyncio.open_unix_connection(config.stream.socket)
            greeting = [(await reader.readline()).removesuffix(b"\n") for _ in range(2)]
            writer.close()
    (setup,) = field.of(SetupRecord)
    recorded = [line for line in read_lines(field.recording()) if line.type != "recording"]
    assert [line.type for line in recorded[:2]] == ["parameters", "setup"]
    assert greeting[1] == recorded[1].data == encode_line(setup)
    assert next(replayed(field.recording()))[1] == [encode_line(setup)]
    assert (setup.protocol, setup.authenticated) == ("superframe", True)
    assert [(each.name, each.allowed_side, each.margin_m) for each in setup.geofences] == [
        ("site", "inside", 0.5)
    ]
