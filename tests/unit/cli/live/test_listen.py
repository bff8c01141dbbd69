"""``tsgt listen`` against a simulated server."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.files.records import EVENT, HELLO, NO_POSE, POINT, POSE, STATUS, measurement
from harness.files.stream_lines import serving

from tsgt.recording import encode_line

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt

LINES = [encode_line(record) for record in (HELLO, measurement(0), POINT, POSE, NO_POSE, STATUS, EVENT)]


POSE_TEXT = (
    "22:13:20.050  pose  interpolated  valid  robot 1.000 2.000 -0.100 m  yaw 73.74 pitch 0.00 roll 0.00 deg"
    "  residual 2.1 mm  ages 1: 0.25 s"
)
STATUS_TEXT = (
    "22:13:22.000  status  19 of 20 poses valid; station 1: 4 of 5 usable, last ok 0.20 s ago; "
    "station 2: no measurement yet"
)


def test_control_characters_are_replaced(tsgt: Tsgt, tmp_path: Path) -> None:
    """Messages of a stream cannot control the terminal."""
    steering = replace(EVENT, message="\x1b]0;owned\x07\x1b[2J\r\nnext \u202e\u009b1m end")
    with serving(tmp_path / "s", encode_line(steering) + b"\n"):
        outcome = tsgt("listen", "--socket", tmp_path / "s")
    assert outcome.out.endswith(": ?]0;owned??[2J??next ??1m end\n")


def test_every_record_is_one_line(tsgt: Tsgt, tmp_path: Path) -> None:
    """The end of the stream is success."""
    with serving(tmp_path / "s", b"".join(line + b"\n" for line in LINES)):
        outcome = tsgt("listen", "--socket", tmp_path / "s")
    assert outcome.code == 0
    assert outcome.err == ""
    assert outcome.out.splitlines() == [
        f"tsgt {HELLO.version}, stream protocol 1: setup, measurement, point, pose, clock, beacon, status, event",
        "22:13:20.000  station 1 prism 1  horizontal 5.7296 deg  zenith 85.9437 deg  30.0000 m  ok",
        "22:13:20.000  station 2 prism 2  1.000 -2.500 0.333 m  ok",
        POSE_TEXT,
        "22:13:20.100  pose  interpolated  invalid (outage)  ages 1: -",
        STATUS_TEXT,
        "22:13:23.000  event lines_lost: lost 7 lines",
    ]


def test_json_is_the_stream_byte_for_byte(tsgt: Tsgt, tmp_path: Path) -> None:
    """With --json lines of unknown types are printed as well."""
    data = b"".join(line + b"\n" for line in [*LINES, b'{"type":"weather", "wind":  1}'])
    with serving(tmp_path / "s", data):
        outcome = tsgt("listen", "--socket", tmp_path / "s", "--json")
    assert outcome.out.encode() == data


def test_unknown_types_and_keys_are_ignored(tsgt: Tsgt, tmp_path: Path) -> None:
    """Lines of a newer server are printed as far as known."""
    event = json.dumps(json.loads(encode_line(EVENT)) | {"colour": "red"}).encode()
    with serving(tmp_path / "s", b'{"type":"weather"}\n' + event + b"\n"):
        outcome = tsgt("listen", "--socket", tmp_path / "s")
    assert outcome.out == "22:13:23.000  event lines_lost: lost 7 lines\n"
    assert outcome.err == ""


@pytest.mark.parametrize("options", [(), ("--json",), ("--kind", "pose")])
def test_other_protocol_version_is_refused(tsgt: Tsgt, tmp_path: Path, options: tuple[str, ...]) -> None:
    """Its fields may have another meaning."""
    hello = json.dumps(json.loads(encode_line(HELLO)) | {"protocol": 2}).encode()
    with serving(tmp_path / "s", hello + b"\n" + encode_line(POSE) + b"\n"):
        outcome = tsgt("listen", "--socket", tmp_path / "s", *options)
    assert outcome.code == 1
    assert outcome.out == ""
    assert "protocol version 2" in outcome.err


def test_connection_without_a_line_is_an_error(tsgt: Tsgt, tmp_path: Path) -> None:
    """As a master closes it that has too many readers."""
    with serving(tmp_path / "s", b""):
        outcome = tsgt("listen", "--socket", tmp_path / "s")
    assert outcome.code == 1
    assert "closed without a line; are there too many readers?" in outcome.err


def test_invalid_line_is_reported(tsgt: Tsgt, tmp_path: Path) -> None:
    """One line on stderr, and listening continues."""
    with serving(tmp_path / "s", b'{"type":"event"}\ngarbage\n' + LINES[-1] + b"\n"):
        outcome = tsgt("listen", "--socket", tmp_path / "s")
    assert outcome.code == 0
    assert len(outcome.err.splitlines()) == 2
    assert outcome.out.splitlines()[-1].endswith("lost 7 lines")


def test_count_stops_listening(tsgt: Tsgt, tmp_path: Path) -> None:
    """The command ends after the given number of lines."""
    with serving(tmp_path / "s", b"".join(line + b"\n" for line in LINES)):
        outcome = tsgt("listen", "--socket", tmp_path / "s", "--json", "--count", "3")
    assert len(outcome.out.splitlines()) == 3


def test_missing_server_is_one_line(tsgt: Tsgt, tmp_path: Path) -> None:
    """The error says what to do."""
    outcome = tsgt("listen", "--socket", tmp_path / "s")
    assert outcome.code == 1
    assert len(outcome.err.splitlines()) == 1
    assert "start tsgt-master, tsgt demo or tsgt replay" in outcome.err


def test_stale_socket_is_one_line(tsgt: Tsgt, tmp_path: Path) -> None:
    """The error has the reason."""
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(str(tmp_path / "s"))
    outcome = tsgt("listen", "--socket", tmp_path / "s")
    assert outcome.code == 1
    assert "Connection refused" in outcome.err


@pytest.mark.slow
def test_listening_needs_neither_numpy_nor_scipy() -> None:
    """The command starts fast on a small computer."""
    check = "import sys, tsgt.cli.live.listen; sys.exit(bool({'numpy', 'scipy'} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", check], check=False).returncode == 0


def test_lines_are_selected(tsgt: Tsgt, tmp_path: Path) -> None:
    """By kind and time, as text and as received; --count counts the lines printed."""
    data = b"".join(line + b"\n" for line in LINES)
    with serving(tmp_path / "s", data):
        outcome = tsgt("listen", "--socket", tmp_path / "s", "--kind", "pose,event", "--count", 2, "--json")
    assert outcome.out.encode().splitlines() == [LINES[3], LINES[4]]
    with serving(tmp_path / "s2", data):
        outcome = tsgt("listen", "--socket", tmp_path / "s2", "--since", "2023-11-14T22:13:21.5Z")
    assert [line[:12] for line in outcome.out.splitlines()[1:]] == ["22:13:22.000", "22:13:23.000"]


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--kind", "poses", "unknown kind 'poses'; known: pose, smoothed"),
        ("--since", "yesterday", "is neither a time such as"),
        ("--rate", "0", "--rate"),
        ("--rate", "1e10", "--rate"),
    ],
)
def test_wrong_selection_is_a_usage_error(
    tsgt: Tsgt, tmp_path: Path, option: str, value: str, message: str
) -> None:
    """Before anything is connected."""
    outcome = tsgt("listen", "--socket", tmp_path / "s", option, value)
    assert outcome.code == 2
    assert message in outcome.err


def test_warning_of_lost_lines_is_never_hidden(tsgt: Tsgt, tmp_path: Path) -> None:
    """Whatever was selected."""
    with serving(tmp_path / "s", b"".join(line + b"\n" for line in LINES)):
        outcome = tsgt("listen", "--socket", tmp_path / "s", "--kind", "pose", "--json")
    assert outcome.err == "warning: lost 7 lines\n"
