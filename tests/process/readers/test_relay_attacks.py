"""Clients without the key at a relay that runs as a process: what they cost its readers."""

from __future__ import annotations

import re
import socket
import time
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from harness.missions.processes import TIMEOUT_S, Program, free_port
from harness.readers.network import TSGT, Master

from tsgt.client import Pose, Stream
from tsgt.radio.key_file import write_key

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

READER, WITHOUT_KEY, EVERYWHERE = "127.0.0.1", "127.0.0.9", "0.0.0.0"  # noqa: S104 (as in the guide)
LARGEST_RSS_KB = 80_000


@contextmanager
def relay(folder: Path) -> Iterator[tuple[int, int]]:
    """Run a relay on all loopback addresses; gives its process id and port."""
    write_key(folder / "relay.key")
    port = free_port(EVERYWHERE)
    command = [
        *TSGT, "relay", "--socket", str(folder / "s"), "--key", str(folder / "relay.key"), "--listen", f"{EVERYWHERE}:{port}",
    ]  # fmt: skip
    with Master(folder / "s").running(), Program(command, folder, "relay") as program:
        program.wait_for("relay_source_connected")
        yield program.process.pid, port


def connect(port: int, address: str) -> socket.socket:
    """Connect from an address."""
    connection = socket.socket()
    connection.settimeout(TIMEOUT_S)
    connection.bind((address, 0))
    connection.connect((READER, port))
    return connection


def drip(port: int, address: str) -> socket.socket:
    """Begin a request, and never end it."""
    connection = connect(port, address)
    with suppress(OSError):
        connection.recv(100)
        connection.sendall(b"1")
    return connection


def shout(port: int, address: str) -> socket.socket:
    """Send far too much."""
    connection = connect(port, address)
    with suppress(OSError):
        connection.sendall(b"1" * 1_000_000)
    return connection


def others(number: int) -> str:
    """Return an address that nobody else has."""
    return f"127.1.{number // 250}.{number % 250 + 1}"


@pytest.mark.parametrize(
    ("attack", "address"),
    [
        (connect, lambda _: WITHOUT_KEY),
        (connect, others),
        (drip, lambda _: WITHOUT_KEY),
        (drip, others),
        (shout, lambda _: WITHOUT_KEY),
    ],
    ids=["silent", "silent-many-addresses", "slow", "slow-many-addresses", "huge"],
)
def test_thousand_connections_keep_no_reader_out(
    tmp_path: Path, attack: Callable[[int, str], socket.socket], address: Callable[[int], str]
) -> None:
    """One reader goes on without a gap, another one connects meanwhile, and the relay stays small."""
    with relay(tmp_path) as (pid, port), ExitStack() as opened:
        source, key = f"relay://{READER}:{port}", tmp_path / "relay.key"
        first = opened.enter_context(Stream(source, key=key))
        poses = first.poses()
        next(poses)
        for number in range(1000):
            with suppress(OSError):
                opened.enter_context(attack(port, address(number)))
        second = opened.enter_context(Stream(source, key=key))
        started = time.monotonic()
        assert isinstance(next(second.poses()), Pose)
        assert time.monotonic() - started < 10
        until = time.monotonic() + 0.5
        while time.monotonic() < until:
            next(poses)
        assert first.gaps == 0
        status = Path(f"/proc/{pid}/status").read_text()
        descriptors = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    found = re.search(r"VmRSS:\s+(\d+)", status)
    assert found is not None
    assert int(found[1]) < LARGEST_RSS_KB
    assert descriptors < 100
    assert (tmp_path / "relay.err").read_bytes().count(b"relay_reader_rejected") <= 4
