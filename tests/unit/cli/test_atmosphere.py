"""`tsgt atmosphere`: what it says to a client, and what it makes of the answer."""

from __future__ import annotations

import json
import socket
import threading
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import pytest

from tsgt.recording import encode_line
from tsgt.recording.journal import InstrumentRecord
from tsgt.station import Answer

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from harness.cli import Tsgt

STATUS = b'{"type":"client_status"}'
SETTINGS = InstrumentRecord(
    make="Leica", prism_type="round", prism_constant_m=0.0, atmospheric_ppm=-13.1, temperature_c=-5.0
)


@contextmanager
def client(path: Path, *lines: bytes, drip: bytes = b"") -> Iterator[list[bytes]]:
    """Play a client that says these lines to whoever comes, and then a bit of one again and again, for as long as it is heard.

    What it is told is collected.
    """
    told: list[bytes] = []
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(path))
    listener.listen()

    def answer() -> None:
        connection, _ = listener.accept()
        with connection, connection.makefile("rb") as file:
            told.append(file.readline())
            connection.sendall(b"".join(line + b"\n" for line in lines))
            with suppress(OSError):
                while drip and not over.wait(0.02):
                    connection.sendall(drip)

    over = threading.Event()
    thread = threading.Thread(target=answer)
    thread.start()
    try:
        yield told
    finally:
        over.set()
        thread.join()
        listener.close()


def test_the_air_is_told_and_the_settings_are_shown(tsgt: Tsgt, tmp_path: Path) -> None:
    """A temperature below zero is no option."""
    with client(tmp_path / "s", STATUS, encode_line(Answer(settings=SETTINGS))) as told:
        outcome = tsgt("atmosphere", "-5", "987.5", "--socket", tmp_path / "s")
    assert outcome.code == 0, outcome.err
    assert json.loads(told[0]) == {"type": "atmosphere", "temperature_c": -5.0, "pressure_hpa": 987.5}
    assert outcome.out.splitlines() == [
        "set; distances are measured with",
        "  prism round +0.0 mm",
        "  air -13.1 ppm",
    ]


def test_what_is_refused_is_an_error(tsgt: Tsgt, tmp_path: Path) -> None:
    """Exit code 1 and the reason, in one line; with --json the record and the same code."""
    answer = encode_line(Answer(problem="no instrument is connected"))
    with client(tmp_path / "s", STATUS, answer):
        outcome = tsgt("atmosphere", "20", "1000", "--socket", tmp_path / "s")
    assert outcome.code == 1
    assert outcome.err.splitlines() == [f"error: {tmp_path / 's'}: no instrument is connected"]
    with client(tmp_path / "t", STATUS, answer):
        outcome = tsgt("atmosphere", "20", "1000", "--socket", tmp_path / "t", "--json")
    assert outcome.code == 1
    assert json.loads(outcome.out)["problem"] == "no instrument is connected"


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([b'{"type":"hello"}'], "that is a master"),
        ([b"SSH-2.0-OpenSSH"], "does not answer as a client"),
        ([STATUS], "does not answer as a client"),
        ([], "does not answer as a client"),
    ],
)
def test_something_else_on_the_socket_is_an_error(
    tsgt: Tsgt, tmp_path: Path, lines: list[bytes], words: str
) -> None:
    """One line that says what is wrong, and exit code 1."""
    with client(tmp_path / "s", *lines):
        outcome = tsgt("atmosphere", "20", "1000", "--socket", tmp_path / "s")
    assert outcome.code == 1
    assert words in outcome.err


def test_nobody_at_the_socket(tsgt: Tsgt, tmp_path: Path) -> None:
    """One line that names the socket, and exit code 1."""
    outcome = tsgt("atmosphere", "20", "1000", "--socket", tmp_path / "nobody")
    assert outcome.code == 1
    assert "nobody answers" in outcome.err


def test_a_client_that_says_nothing_whole_is_not_waited_for(
    tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time limit is for its status as a whole, not for the next byte, and not that of an instrument."""
    monkeypatch.setattr("tsgt.cli.atmosphere.STATUS_S", 0.2)
    with client(tmp_path / "s", drip=b"x"):
        outcome = tsgt("atmosphere", "20", "1000", "--socket", tmp_path / "s")
    assert outcome.code == 1
    assert outcome.err.splitlines() == [
        f"error: {tmp_path / 's'}: no status within 0.2 s; the client is stuck, see its log"
    ]


def test_an_instrument_that_is_busy_is_waited_for_and_that_is_said(
    tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """First that it is waited for, and in the end that the air is not forgotten."""
    monkeypatch.setattr("tsgt.cli.atmosphere.QUIET_S", 0.05)
    monkeypatch.setattr("tsgt.cli.atmosphere.ANSWER_S", 0.2)
    with client(tmp_path / "s", STATUS, drip=b" "):
        outcome = tsgt("atmosphere", "20", "1000", "--socket", tmp_path / "s")
    assert outcome.code == 1
    waiting, error = outcome.err.splitlines()
    assert waiting == "waiting for the instrument, which is busy; 0.2 s at most"
    assert error.startswith(
        f"error: {tmp_path / 's'}: the instrument has not been free for 0.2 s; it is told as"
    )


def test_a_typing_mistake_is_a_usage_error(tsgt: Tsgt) -> None:
    """Before anybody is asked."""
    assert tsgt("atmosphere", "20").code == 2
    assert tsgt("atmosphere", "warm", "1000").code == 2
    assert tsgt("atmosphere", "20", "1000", "--sockets", "x").code == 2
