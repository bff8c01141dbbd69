"""``tsgt atmosphere`` against a simulated client."""

from __future__ import annotations

import json
import socket
import threading
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import pytest

from tsgt.recording import encode_line
from tsgt.recording.journal import InstrumentRecord
from tsgt.station import AtmosphereResponse

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from harness.files.cli import Tsgt

STATUS = b'{"type":"client_status"}'
SETTINGS = InstrumentRecord(
    make="Leica", prism_type="round", prism_constant_m=0.0, atmospheric_ppm=-13.1, temperature_c=-5.0
)


@contextmanager
def client(path: Path, *lines: bytes, drip: bytes = b"") -> Iterator[list[bytes]]:
    """Simulate a client that sends these lines, then a fragment repeatedly; yield the requests it receives.

    What it is requests is collected.
    """
    requests: list[bytes] = []
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(path))
    listener.listen()

    def answer() -> None:
        connection, _ = listener.accept()
        with connection, connection.makefile("rb") as file:
            requests.append(file.readline())
            connection.sendall(b"".join(line + b"\n" for line in lines))
            with suppress(OSError):
                while drip and not over.wait(0.02):
                    connection.sendall(drip)

    over = threading.Event()
    thread = threading.Thread(target=answer)
    thread.start()
    try:
        yield requests
    finally:
        over.set()
        thread.join()
        listener.close()


def test_request_is_sent_and_settings_are_printed(tsgt: Tsgt, tmp_path: Path) -> None:
    """A negative temperature is not an option."""
    with client(tmp_path / "s", STATUS, encode_line(AtmosphereResponse(settings=SETTINGS))) as requests:
        outcome = tsgt("atmosphere", "-5", "987.5", "--socket", tmp_path / "s")
    assert outcome.code == 0, outcome.err
    assert json.loads(requests[0]) == {"type": "atmosphere", "temperature_c": -5.0, "pressure_hpa": 987.5}
    assert outcome.out.splitlines() == [
        "set; distances are corrected by",
        "  prism round +0.0 mm",
        "  atm. -13.1 ppm",
    ]


def test_rejected_request_is_an_error(tsgt: Tsgt, tmp_path: Path) -> None:
    """Exit code 1 and the reason in one line; with --json the record and the same code."""
    answer = encode_line(AtmosphereResponse(problem="no instrument is connected"))
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
        ([b'{"type":"hello"}'], "this is a master"),
        ([b"SSH-2.0-OpenSSH"], "not the response of a client"),
        ([STATUS], "not the response of a client"),
        ([], "not the response of a client"),
    ],
)
def test_other_server_on_the_socket_is_an_error(
    tsgt: Tsgt, tmp_path: Path, lines: list[bytes], words: str
) -> None:
    """Exit code 1 and one line."""
    with client(tmp_path / "s", *lines):
        outcome = tsgt("atmosphere", "20", "1000", "--socket", tmp_path / "s")
    assert outcome.code == 1
    assert words in outcome.err


def test_missing_socket_is_an_error(tsgt: Tsgt, tmp_path: Path) -> None:
    """Exit code 1 and one line that names the socket."""
    outcome = tsgt("atmosphere", "20", "1000", "--socket", tmp_path / "nobody")
    assert outcome.code == 1
    assert "no connection to a client" in outcome.err


def test_incomplete_status_times_out(tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The timeout applies to the whole status, not to each byte."""
    monkeypatch.setattr("tsgt.cli.atmosphere.STATUS_TIMEOUT_S", 0.2)
    with client(tmp_path / "s", drip=b"x"):
        outcome = tsgt("atmosphere", "20", "1000", "--socket", tmp_path / "s")
    assert outcome.code == 1
    assert outcome.err.splitlines() == [
        f"error: {tmp_path / 's'}: no status within 0.2 s; the client is stuck, see its log"
    ]


def test_busy_instrument_is_waited_for(tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The wait is announced, and the error says that the request stays in force."""
    monkeypatch.setattr("tsgt.cli.atmosphere.NOTICE_AFTER_S", 0.05)
    monkeypatch.setattr("tsgt.cli.atmosphere.RESPONSE_TIMEOUT_S", 0.2)
    with client(tmp_path / "s", STATUS, drip=b" "):
        outcome = tsgt("atmosphere", "20", "1000", "--socket", tmp_path / "s")
    assert outcome.code == 1
    waiting, error = outcome.err.splitlines()
    assert waiting == "waiting up to 0.2 s for the busy instrument"
    assert error.startswith(f"error: {tmp_path / 's'}: the instrument has been busy for 0.2 s; ")


def test_invalid_arguments_are_usage_errors(tsgt: Tsgt) -> None:
    """No client is contacted."""
    assert tsgt("atmosphere", "20").code == 2
    assert tsgt("atmosphere", "warm", "1000").code == 2
    assert tsgt("atmosphere", "20", "1000", "--sockets", "x").code == 2
