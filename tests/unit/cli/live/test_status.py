"""``tsgt status`` of a master and of a client, and its exit code."""

from __future__ import annotations

import dataclasses
import json
import socket
import threading
from typing import TYPE_CHECKING

import click
import pytest
from harness.files.records import IMU_STATUS, ODOMETRY_STATUS, POSE
from harness.files.stream_lines import serving

from tsgt.cli.live.status_text import client_text, duration, master_text, station_label
from tsgt.model import Status
from tsgt.recording import DiskStatus, HelloRecord, RecordingStatus, StationStatus, StatusRecord, encode_line
from tsgt.recording.journal import InstrumentRecord
from tsgt.station import ClientStatus
from tsgt.station.status import LastMeasurement

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt

    from tsgt.recording import PoseRecord

NOW_NS = 1_700_000_000_000_000_000
WIDTH = 40

STATION = StationStatus(
    id=2,
    measurements=100,
    usable=100,
    age_s=0.6,
    status=Status.OK,
    prism=2,
    locked=True,
    answering=True,
    last_heard_s=0.3,
    rate_hz=1.58,
    loss=0.02,
    rssi_dbm=-81.4,
    snr_db=9.0,
    clock_offset_ns=12_345_678_901,
    clock_bound_ns=840_000,
)
MASTER = StatusRecord(stamp_ns=NOW_NS, poses=400, valid_poses=390, stations=(STATION,))
CLIENT = ClientStatus(
    stamp_ns=NOW_NS,
    station=3,
    instrument="simulated total station 3",
    activity="tracking",
    problem="",
    battery_percent=57,
    settings=InstrumentRecord(
        make="Leica",
        prism_type="mini_360",
        prism_constant_m=0.03,
        atmospheric_ppm=8.1,
        temperature_c=20.0,
        pressure_hpa=1013.25,
    ),
    mode="tracking",
    prism=3,
    locked=True,
    last=LastMeasurement(
        age_s=0.2,
        prism=3,
        horizontal_angle_rad=1.0,
        zenith_angle_rad=1.5,
        slope_distance_m=75.1234,
        status=Status.OK,
    ),
    measurements=1234,
    rate_hz=2.5,
    journal="/var/lib/tsgt/station3-20261121T101112Z.jsonl",
    journal_ok=True,
    journal_waiting=0,
    journal_lost=0,
    master_heard_s=0.4,
    rssi_dbm=-79.0,
    snr_db=9.5,
    unknown_packets=2,
    radio_ok=True,
    protocol="superframe",
    authenticated=True,
    joined=True,
    queued=2,
    missed_slots=1,
    rejected_beacons=0,
    refused=0,
    clock_bound_ns=80_000,
)

LIVE = dataclasses.replace(POSE, kind="predicted", quality="good")


def test_master_without_problems() -> None:
    """The text has poses, and rate, loss, signal and clock bound of each station."""
    lines, well = master_text(MASTER)
    text = "\n".join(lines)
    assert well
    for part in ("valid 390", "STATION 2  TRACKING", "1.58 Hz", "loss 2 %", "-81 dBm", "clock bound 0.84 ms"):
        assert part in text


def test_recording_and_disk_are_shown() -> None:
    """Lines that have been waiting for seconds and a disk with little space are problems; lines of the last second are not."""
    recording = RecordingStatus(
        file="master-20261121T055100Z.jsonl",
        bytes=12_345_678,
        last_write_ns=NOW_NS - 100_000_000,
        waiting_lines=2,
        lost_lines=0,
    )
    disk = DiskStatus(free_bytes=20_000_000_000, total_bytes=32_000_000_000)
    lines, well = master_text(dataclasses.replace(MASTER, recording=recording, disk=disk))
    assert well
    assert lines[-3:] == [
        click.style("RECORDING  OK", bold=True, reverse=False),
        "  master-20261121T055100Z.jsonl",
        "  12.3 MB, disk 20.0 GB free",
    ]
    little = dataclasses.replace(disk, free_bytes=900_000_000)
    lines, well = master_text(dataclasses.replace(MASTER, recording=recording, disk=little))
    assert not well
    assert lines[-3] == click.style("RECORDING  DISK NEARLY FULL", bold=True, reverse=True)
    full = dataclasses.replace(recording, last_write_ns=NOW_NS - 9_000_000_000, lost_lines=1)
    lines, well = master_text(dataclasses.replace(MASTER, recording=full))
    assert not well
    assert lines[-5] == click.style("RECORDING  DISK FAILS", bold=True, reverse=True)
    assert lines[-3:] == ["  12.3 MB", "  2 lines not written yet", "  1 lines lost"]


def test_sound_imu_is_shown_with_its_biases() -> None:
    """In narrow lines."""
    imu = dataclasses.replace(
        IMU_STATUS,
        saturated=2,
        use="used",
        gyro_bias_radps=(0.001, -0.002, 0.0005),
        accelerometer_bias_mps2=(0.012, -0.034, 0.05),
    )
    lines, well = master_text(dataclasses.replace(MASTER, imu=imu))
    assert well
    assert lines[-9:] == [
        "",
        click.style("IMU  OK", bold=True, reverse=False),
        "  Acme 7",
        "  199.9 Hz  last 0.0 s",
        "  1 gaps, 3 samples lost",
        "  2 saturated samples",
        "  clock -12.5 ppm",
        "  gyro bias +0.06 -0.11 +0.03 deg/s",
        "  acc. bias +12 -34 +50 mm/s^2",
    ]
    assert max(map(len, lines[-7:])) <= WIDTH


@pytest.mark.parametrize(
    ("change", "word", "sound"),
    [
        ({"age_s": None}, "NO SAMPLES YET", False),
        ({"age_s": 3.0}, "SILENT 3.0 s", False),
        ({"problem": "it repeats the same values"}, "it repeats the same values", False),
        ({"use": "disagrees", "disagreement": "gyro against prisms"}, "DISAGREES WITH THE PRISMS", False),
        ({"use": "wrong_setup", "disagreement": "mounting"}, "ITS SET-UP IS WRONG", False),
        ({"use": "starting"}, "NOT IN USE YET", True),
        ({"use": "unconfirmed", "disagreement": "not confirmed yet"}, "drive curves", False),
    ],
)
def test_problem_of_the_imu_is_shown(change: dict[str, object], word: str, *, sound: bool) -> None:
    """All but a start require action."""
    lines, well = master_text(dataclasses.replace(MASTER, imu=dataclasses.replace(IMU_STATUS, **change)))  # type: ignore[arg-type]
    assert word in "\n".join(lines)
    assert well == sound


def test_sound_wheels_are_shown_with_scale_and_slip() -> None:
    """In narrow lines."""
    lines, well = master_text(dataclasses.replace(MASTER, odometry=ODOMETRY_STATUS))
    assert well
    assert lines[-9:] == [
        "",
        click.style("ODOMETRY  OK", bold=True, reverse=False),
        "  Acme base",
        "  20.0 Hz  last 0.1 s",
        "  1 gaps, 2 samples lost",
        "  3 untrusted samples",
        "  scale +1.25 +/- 0.20 %",
        "  slip -2.1 +/- 1.2 %",
        "  25 % rejected",
    ]


@pytest.mark.parametrize(
    ("change", "word", "sound"),
    [
        ({"age_s": None}, "NO SAMPLES YET", False),
        ({"age_s": 3.0}, "SILENT 3.0 s", False),
        ({"problem": "the encoder is not connected"}, "the encoder is not connected", False),
        ({"use": "disagrees"}, "DISAGREES WITH IMU AND PRISMS", False),
        ({"use": "without_imu"}, "NOT IN USE: NO IMU", True),
    ],
)
def test_problem_of_the_wheels_is_shown(change: dict[str, object], word: str, *, sound: bool) -> None:
    """All but the last require action."""
    odometry = dataclasses.replace(ODOMETRY_STATUS, **change)  # type: ignore[arg-type]
    lines, well = master_text(dataclasses.replace(MASTER, odometry=odometry))
    assert word in "\n".join(lines)
    assert well == sound


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"last_heard_s": None, "answering": None}, "NOT RECEIVED YET"),
        ({"last_heard_s": 12.0, "answering": False}, "SILENT 12 s"),
        ({"status": None, "age_s": None}, "NO MEASUREMENT YET"),
        ({"age_s": 5.0}, "NO MEASUREMENT FOR 5.0 s"),
        ({"status": Status.TILT}, "NOT LEVEL"),
        ({"status": Status.NO_TARGET}, "NO PRISM"),
        ({"status": Status.WRONG_DISTANCE}, "WRONG TARGET"),
        ({"status": Status.ANGLE_ONLY}, "NO DISTANCE"),
    ],
)
def test_station_problem_has_a_label_and_fails(change: dict[str, object], word: str) -> None:
    """Each problem of a station has its label."""
    station = dataclasses.replace(STATION, **change)  # type: ignore[arg-type]
    assert station_label(station) == (word, False)
    assert not master_text(dataclasses.replace(MASTER, stations=(station,)))[1]


def test_station_that_was_not_polled_is_not_silent() -> None:
    """While others are synchronised a station is not polled."""
    station = dataclasses.replace(STATION, last_heard_s=24.0, age_s=24.3)
    assert station_label(station) == ("TRACKING", True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"instrument": None}, "NO INSTRUMENT"),
        ({"last": None}, "NO MEASUREMENT"),
        ({"journal_ok": False, "journal_waiting": 17}, "DISK FAILS"),
        ({"journal_ok": False, "journal_waiting": 17}, "17 lines not written yet"),
        ({"problem": "battery low, 9 %"}, "CHECK THE INSTRUMENT"),
        ({"problem": "battery low, 9 %"}, "battery low, 9 %"),
        ({"instrument": None, "problem": "no response on /dev/ttyUSB0"}, "no response"),
        ({"radio_ok": False}, "NO RADIO"),
        ({"master_heard_s": None}, "MASTER NOT RECEIVED"),
        ({"master_heard_s": 60.0}, "MASTER NOT RECEIVED"),
        ({"joined": False}, "NOT JOINED"),
    ],
)
def test_client_problem_has_a_label_and_fails(change: dict[str, object], words: str) -> None:
    """Each problem of a client has its label."""
    lines, well = client_text(dataclasses.replace(CLIENT, **change))  # type: ignore[arg-type]
    assert not well
    assert any(words in line for line in lines)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"unknown_packets": 0}, "nothing received: master off"),
        ({"unknown_packets": 40}, "40 packets not decoded"),
        ({"unknown_packets": 40, "refused": 9}, "9 beacons failed to authenticate"),
    ],
)
def test_client_reports_why_no_master_is_received(change: dict[str, object], words: str) -> None:
    """Received packets distinguish a missing master from another protocol or key."""
    lines, _ = client_text(dataclasses.replace(CLIENT, master_heard_s=None, **change))  # type: ignore[arg-type]
    assert any(words in line for line in lines)
    assert max(len(line) for line in lines[1:]) <= 40


def test_client_text_has_instrument_settings_and_activity() -> None:
    """Battery, prism constant, atmospheric correction, and unusual activity."""
    text = "\n".join(client_text(CLIENT)[0])
    for part in ("battery 57 %", "prism mini_360 +30.0 mm", "atm. +8.1 ppm: 20.0 C, 1013.2 hPa"):
        assert part in text
    looking = dataclasses.replace(CLIENT, activity="looking for the prism around its last direction")
    assert "  looking for the prism around its last" in client_text(looking)[0]
    assert client_text(dataclasses.replace(CLIENT, activity=f"tracking prism {CLIENT.prism}")) == client_text(
        CLIENT
    )
    silent = dataclasses.replace(CLIENT, settings=None, battery_percent=None, activity="")
    assert not any(
        word in "\n".join(client_text(silent)[0]) for word in ("battery", "prism m", "air", "None")
    )


def test_text_without_terminal_has_no_control_codes(tsgt: Tsgt, tmp_path: Path) -> None:
    """Plain text only."""
    serving = _serve(tmp_path / "s", encode_line(CLIENT))
    outcome = tsgt("status", "--socket", tmp_path / "s")
    serving.join()
    assert outcome.out.startswith("STATION 3  OK\n")


def test_client_reports_lost_journal_lines() -> None:
    """A recovered disk needs no action."""
    lines, well = client_text(dataclasses.replace(CLIENT, journal_lost=3))
    assert well
    assert "  3 lines lost" in lines


def test_client_text_has_queue_slots_and_clock() -> None:
    """A missing key is shown, but is no failure."""
    assert "2 to deliver, 1 missed slots" in client_text(CLIENT)[0]
    assert "  clock bound 0.08 ms" in client_text(CLIENT)[0]
    lines, well = client_text(dataclasses.replace(CLIENT, authenticated=False, rejected_beacons=3))
    assert well
    assert any("NO KEY" in line for line in lines)
    assert "  3 rejected beacons" in lines


def test_direct_mode_needs_no_measurements() -> None:
    """Between two targets nothing is measured."""
    assert client_text(dataclasses.replace(CLIENT, mode="direct", last=None))[1]


def test_lines_have_at_most_40_characters() -> None:
    """For both daemons."""
    troubled = dataclasses.replace(CLIENT, problem="word " * 30, activity="doing " * 20)
    lines = [*master_text(MASTER)[0], *client_text(CLIENT)[0], *client_text(troubled)[0]]
    assert (
        max(len(line.replace("\x1b[1m", "").replace("\x1b[7m", "").replace("\x1b[0m", "")) for line in lines)
        <= WIDTH
    )


@pytest.mark.parametrize(("seconds", "text"), [(0.34, "0.3 s"), (47, "47 s"), (600, "10 min"), (9000, "2 h")])
def test_durations_are_short(seconds: float, text: str) -> None:
    """A number with a suitable unit."""
    assert duration(seconds) == text


def _serve(path: Path, *lines: bytes) -> threading.Thread:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(path))
    listener.listen()

    def answer() -> None:
        connection, _ = listener.accept()
        with connection, listener:
            connection.sendall(b"".join(line + b"\n" for line in lines))

    thread = threading.Thread(target=answer)
    thread.start()
    return thread


def test_master_status_is_read_from_the_stream(tsgt: Tsgt, tmp_path: Path) -> None:
    """Other records before the status are skipped, also such as cannot be read."""
    lines = (encode_line(HelloRecord()), b'{"type":"pose"}', encode_line(LIVE), encode_line(MASTER))
    serving = _serve(tmp_path / "s", *lines)
    outcome = tsgt("status", "--socket", tmp_path / "s")
    serving.join()
    assert outcome.code == 0, outcome.err
    assert outcome.out.startswith("MASTER  22:13:20")


@pytest.mark.parametrize(
    ("poses", "cause"),
    [
        ([dataclasses.replace(LIVE, valid=False, reason="residual")], "the prisms miss their layout"),
        ([dataclasses.replace(LIVE, kind="smoothed", delay_s=1.0)], "no pose yet"),
        ([], "no pose yet"),
    ],
)
def test_pose_that_is_invalid_now_fails(
    tsgt: Tsgt, tmp_path: Path, poses: list[PoseRecord], cause: str
) -> None:
    """However many have been valid before."""
    lines = (encode_line(HelloRecord()), encode_line(MASTER), *map(encode_line, poses), encode_line(MASTER))
    serving = _serve(tmp_path / "s", *lines)
    outcome = tsgt("status", "--socket", tmp_path / "s")
    serving.join()
    assert outcome.code == 3
    assert "NO VALID POSE" in outcome.out
    assert cause in " ".join(outcome.out.split())


def test_other_protocol_version_is_refused(tsgt: Tsgt, tmp_path: Path) -> None:
    """A reader of the old version would misread the stream."""
    hello = dataclasses.replace(HelloRecord(), protocol=2)
    serving = _serve(tmp_path / "s", encode_line(hello), encode_line(MASTER), encode_line(LIVE))
    outcome = tsgt("status", "--socket", tmp_path / "s")
    serving.join()
    assert outcome.code == 1
    assert "protocol version 2" in outcome.err


def test_terminal_styles_headlines_and_removes_control_characters(
    tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Problems are bold and reversed; text from outside cannot control the terminal."""
    monkeypatch.setattr("click.utils.should_strip_ansi", lambda *_: False)
    steering = "\x1b]0;owned\x07\x1b[2J"
    settings = InstrumentRecord(make="Leica", prism_type=steering, prism_constant_m=0.03)
    record = dataclasses.replace(
        CLIENT,
        instrument=steering,
        activity=steering,
        problem=steering,
        journal=steering,
        settings=settings,
    )
    serving = _serve(tmp_path / "s", encode_line(record))
    outcome = tsgt("status", "--socket", tmp_path / "s")
    serving.join()
    first, *others = outcome.out.splitlines()
    assert first == "\x1b[1m\x1b[7mSTATION 3  CHECK THE INSTRUMENT\x1b[0m"
    assert others[0] == "\x1b[1m\x1b[7m?]0;owned??[2J\x1b[0m"
    assert sum("?]0;owned??[2J" in line for line in others) == 5
    assert not any("\x1b" in line or "?[" in line.replace("??[2J", "") for line in others[1:])


def test_client_status_is_printed_as_json(tsgt: Tsgt, tmp_path: Path) -> None:
    """The record is unchanged; a problem gives exit code 3."""
    serving = _serve(tmp_path / "s", encode_line(dataclasses.replace(CLIENT, instrument=None)))
    outcome = tsgt("status", "--socket", tmp_path / "s", "--json")
    serving.join()
    assert outcome.code == 3
    assert json.loads(outcome.out)["station"] == 3


@pytest.mark.parametrize(
    ("lines", "words"),
    [([], "ended without a status"), ([b"SSH-2.0-OpenSSH"], "not a stream of tsgt")],
)
def test_other_server_on_the_socket_is_an_error(
    tsgt: Tsgt, tmp_path: Path, lines: list[bytes], words: str
) -> None:
    """Exit code 1 and one line."""
    serving = _serve(tmp_path / "s", *lines)
    outcome = tsgt("status", "--socket", tmp_path / "s")
    serving.join()
    assert outcome.code == 1
    assert words in outcome.err


def test_missing_socket_is_an_error(tsgt: Tsgt, tmp_path: Path) -> None:
    """Exit code 1 and one line that names the socket."""
    outcome = tsgt("status", "--socket", tmp_path / "nobody")
    assert outcome.code == 1
    assert "no connection to a daemon" in outcome.err


def test_stream_without_status_times_out(tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The timeout applies to the status, not to each line."""
    monkeypatch.setattr("tsgt.cli.live.status.TIMEOUT_S", 0.2)
    path = tmp_path / "a.sock"
    over = threading.Event()

    def talk(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        with connection:
            while not over.wait(0.02):
                try:
                    connection.sendall(b'{"type":"other"}\n')
                except OSError:
                    return

    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()
        talking = threading.Thread(target=talk, args=(listener,))
        talking.start()
        outcome = tsgt("status", "--socket", str(path))
        over.set()
        talking.join()
    assert outcome.code == 1
    assert "no status within" in outcome.err


def test_master_text_of_the_superframe() -> None:
    """A missing key is prominent; counts of zero are omitted."""
    station = dataclasses.replace(
        STATION,
        clock_bound_ns=None,
        stamp_bound_ns=152_000,
        joined=True,
        outstanding=12,
        missed_slots=0,
        rejected_beacons=1,
    )
    record = dataclasses.replace(
        MASTER, stations=(station,), protocol="superframe", authenticated=False, frame_ms=378.2
    )
    text, well = master_text(record)
    plain = "\n".join(text)
    assert well
    assert "frame 378 ms" in plain
    assert "NO KEY" in plain
    assert "timestamp bound 0.15 ms" in plain
    assert "12 outstanding" in plain
    assert "1 rejected beacons" in plain
    assert "missed" not in plain
    assert "NO KEY" not in "\n".join(master_text(dataclasses.replace(record, authenticated=True))[0])


@pytest.mark.parametrize(
    ("outstanding", "rate_hz", "drain_s", "line"),
    [
        (3120, 4.0, 780.0, "  shrinks by 4.0 a second, ends in 13 min"),
        (3120, -2.5, None, "  the backlog does not shrink"),
        (12, 4.0, 3.0, ""),
        (3120, None, None, ""),
    ],
)
def test_drain_of_a_backlog_is_shown(
    outstanding: int, rate_hz: float | None, drain_s: float | None, line: str
) -> None:
    """Its speed and its end, where there is one."""
    station = dataclasses.replace(STATION, outstanding=outstanding, drain_rate_hz=rate_hz, drain_s=drain_s)
    text, _ = master_text(dataclasses.replace(MASTER, stations=(station,)))
    plain = [entry.rstrip() for block in text for entry in block.splitlines()]
    shown = [entry for entry in plain if "shrink" in entry]
    assert [entry.strip() for entry in shown] == ([line.strip()] if line else [])


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Press Ctrl-C when the command would connect again."""

    def interrupt(_delay_s: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tsgt.cli.live.follower.time.sleep", interrupt)


@pytest.mark.usefixtures("interrupted")
@pytest.mark.parametrize("as_json", [False, True])
def test_watch_goes_on_after_unreadable_lines(tsgt: Tsgt, tmp_path: Path, *, as_json: bool) -> None:
    """Each is a warning; a line that the end of the connection has cut is dropped."""
    line = encode_line(MASTER)
    with serving(tmp_path / "s", b"".join([b'["noise"]\n', line, b"\n", line[:60]])):
        outcome = tsgt("status", "--watch", "--socket", tmp_path / "s", *(["--json"] if as_json else []))
    assert outcome.code == 0
    assert len(outcome.out.splitlines()) == 1
    assert outcome.err.startswith("warning: unreadable line: ")
    assert len(outcome.err.splitlines()) == 1


@pytest.mark.usefixtures("interrupted")
def test_watch_refuses_another_protocol_version(tsgt: Tsgt, tmp_path: Path) -> None:
    """Connecting again would not help."""
    hello = encode_line(dataclasses.replace(HelloRecord(), protocol=2))
    with serving(tmp_path / "s", hello + b"\n" + encode_line(MASTER) + b"\n"):
        outcome = tsgt("status", "--watch", "--socket", tmp_path / "s")
    assert outcome.code == 1
    assert outcome.out == ""
    assert "protocol version 2" in outcome.err


@pytest.mark.usefixtures("interrupted")
def test_watch_warns_of_a_status_that_it_cannot_read(tsgt: Tsgt, tmp_path: Path) -> None:
    """As one of a newer version."""
    with serving(tmp_path / "s", b'{"type":"status"}\n{"type":"client_status"}\n'):
        outcome = tsgt("status", "--watch", "--socket", tmp_path / "s")
    assert outcome.code == 0
    assert outcome.err.count("warning: unreadable line: ") == 2
