"""Where poses come from: addresses, key files, names."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from tsgt.client import Stream
from tsgt.client.source import RelaySource, SocketSource, parse_source, read_key_file
from tsgt.errors import StreamError


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("/run/tsgt/poses.sock", SocketSource(Path("/run/tsgt/poses.sock"))),
        ("relay://192.168.1.10", RelaySource("192.168.1.10", 27690, tls=False)),
        ("relays://robot.local:99", RelaySource("robot.local", 99, tls=True)),
        ("relay://[fe80::1%eth0]:99", RelaySource("fe80::1%eth0", 99, tls=False)),
    ],
)
def test_sources_are_recognised(text: str, expected: object) -> None:
    """And written in the same way."""
    source = parse_source(text)
    assert source == expected
    assert parse_source(str(source)) == source


@pytest.mark.parametrize(
    "text",
    [
        "relay://",
        "relay://a b",
        "http://robot",
        "relay://robot:0",
        "relay://robot:65536",
        "relay://robot/x",
        "relay://::1",
    ],
)
def test_other_addresses_are_errors(text: str) -> None:
    """Nothing is guessed."""
    with pytest.raises(ValueError, match="expected"):
        parse_source(text)


def test_key_file_is_read(tmp_path: Path) -> None:
    """As `tsgt relay --make-key` writes it."""
    path = tmp_path / "key"
    path.write_text("0f" * 32 + "\n")
    path.chmod(0o600)
    assert read_key_file(path) == b"\x0f" * 32


@pytest.mark.parametrize(
    ("content", "mode", "error"),
    [
        ("0f" * 32, 0o640, "only its owner"),
        ("0f" * 31, 0o600, "not a key"),
        ("", 0o600, "not a key"),
        ("0f" * 999, 0o600, "not a key"),
    ],
)
def test_bad_key_files_are_errors(tmp_path: Path, content: str, mode: int, error: str) -> None:
    """Also one that others may read."""
    path = tmp_path / "key"
    path.write_text(content)
    path.chmod(mode)
    with pytest.raises(StreamError, match=error):
        Stream("relay://127.0.0.1", key=path)
    with pytest.raises(StreamError, match="cannot be read"):
        read_key_file(tmp_path / "nothing")


def test_relay_needs_a_key() -> None:
    """It says so at once."""
    with pytest.raises(StreamError, match="needs its key"):
        Stream("relay://127.0.0.1")


def test_names_are_looked_up() -> None:
    """Each address of a name is tried; a name without one is a problem like another."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with Stream(f"relay://localhost:{port}", key=bytes(32), reconnect=True) as stream:
            listener.settimeout(0.01)
            for _ in range(500):
                stream.latest()
                try:
                    connection, _ = listener.accept()
                except TimeoutError:
                    continue
                connection.close()
                break
            else:
                pytest.fail("no connection")
    with (
        Stream("relay://nobody.invalid", key=bytes(32), reconnect=False) as stream,
        pytest.raises(StreamError, match="no computer of this name"),
    ):
        next(iter(stream))
