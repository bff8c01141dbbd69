"""Serial ports on pseudo-terminals in real time."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from structlog.testing import capture_logs

from tsgt.clock import SystemClock
from tsgt.errors import InstrumentError
from tsgt.station.geocom import GeoComConnection, Rpc
from tsgt.station.serial import serial_port
from tsgt.station.serial.serial_port import latency_timer_ms, open_serial_port, port_holder

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.station.serial import Port


@dataclass
class Pty:
    """A pseudo-terminal whose other end is ours."""

    master: int
    path: Path

    def unplug(self) -> None:
        """Remove the device."""
        if self.master >= 0:
            os.close(self.master)
        self.master = -1


@pytest.fixture
def pty() -> Iterator[Pty]:
    """Return a pseudo-terminal that no process has open."""
    master, slave = os.openpty()
    made = Pty(master, Path(os.ttyname(slave)))
    os.close(slave)
    yield made
    made.unplug()


async def opened(path: Path, baud: int = 115_200) -> Port:
    """Open it."""
    return await open_serial_port(path, baud, SystemClock())


def test_bytes_are_sent_received_and_timestamped(pty: Pty) -> None:
    """Received bytes have their time of arrival."""

    async def run() -> None:
        port = await opened(pty.path)
        assert (port.name, port.baud) == (str(pty.path), 115_200)
        port.write(b"%R1Q,0,1:\r\n")
        await asyncio.sleep(0.01)
        assert os.read(pty.master, 100) == b"%R1Q,0,1:\r\n"
        before_ns = time.monotonic_ns()
        os.write(pty.master, b"%R1P,0,1:0\r\n\x03\xff")
        chunk = await port.read()
        assert chunk.data == b"%R1P,0,1:0\r\n\x03\xff"
        assert before_ns < chunk.at_ns < time.monotonic_ns()
        await port.close()

    asyncio.run(run())


def test_cancelled_read_loses_nothing(pty: Pty) -> None:
    """Later bytes are left for the next reader."""

    async def run() -> None:
        port = await opened(pty.path)
        with suppress(TimeoutError):
            async with asyncio.timeout(0.001):
                await port.read()
        os.write(pty.master, b"one")
        assert (await port.read()).data == b"one"
        os.write(pty.master, b"two")
        await asyncio.sleep(0.01)
        assert port.drain() == b"two"
        assert port.drain() == b""
        await port.close()

    asyncio.run(run())


def test_unplugged_port_fails_and_returns_under_another_name(pty: Pty, tmp_path: Path) -> None:
    """Readers fail at once; the same link then leads to another device."""
    link = tmp_path / "instrument"
    link.symlink_to(pty.path)

    async def run() -> None:
        port = await opened(link)
        asyncio.get_running_loop().call_later(0.01, pty.unplug)
        for _ in range(2):
            with pytest.raises(InstrumentError, match="instrument: the line is gone, probably unplugged"):
                await port.read()
        with pytest.raises(InstrumentError):
            port.write(b"x")
        with pytest.raises(InstrumentError):
            port.drain()
        await port.close()
        with pytest.raises(InstrumentError, match=r"there is no .*instrument: plug the cable in"):
            await opened(link)
        other, slave = os.openpty()
        link.unlink()
        link.symlink_to(os.ttyname(slave))
        port = await opened(link)
        os.write(other, b"back")
        assert (await port.read()).data == b"back"
        await port.close()
        os.close(other)
        os.close(slave)

    asyncio.run(run())


def test_close_after_unplug_does_not_fail(pty: Pty) -> None:
    """The error of the terminal interface is no OSError."""

    async def run() -> None:
        port = await opened(pty.path)
        pty.unplug()
        await port.close()
        await port.close()
        with pytest.raises(InstrumentError):
            await port.read()

    asyncio.run(run())


def test_write_after_unplug_fails(
    pty: Pty, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    """Writer and reader get the error."""

    async def run() -> None:
        port = await opened(pty.path)
        reader = asyncio.create_task(port.read())
        await asyncio.sleep(0)
        pty.unplug()
        for _ in range(2):
            with pytest.raises(InstrumentError, match="the line is gone, probably unplugged"):
                port.write(b"%R1Q,0,1:\r\n")
        with pytest.raises(InstrumentError, match="the line is gone, probably unplugged"):
            await reader
        await port.close()

    asyncio.run(run())
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


def test_blocked_line_does_not_delay_close(pty: Pty) -> None:
    """Unsent bytes are dropped."""

    async def run() -> None:
        port = await opened(pty.path)
        for _ in range(200):
            port.write(bytes(1000))
        began_s = time.monotonic()
        await port.close()
        assert time.monotonic() - began_s < 1.0

    asyncio.run(run())


def test_busy_port_names_its_holder(pty: Pty) -> None:
    """After the holder has closed it, the port can be opened."""

    async def run() -> None:
        first = await opened(pty.path)
        with pytest.raises(InstrumentError, match=rf"is taken by .+ \(process {os.getpid()}\)"):
            await opened(pty.path)
        await first.close()
        second = await opened(pty.path)
        await second.close()

    asyncio.run(run())


def test_holder_of_a_port_is_found(pty: Pty, tmp_path: Path) -> None:
    """Any process that has the device open, under any name."""
    assert port_holder(pty.path) is None
    link = tmp_path / "instrument"
    link.symlink_to(pty.path)
    with pty.path.open("rb", buffering=0) as device:
        holder = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], stdin=device)
    try:
        found = port_holder(link)
        assert found is not None
        assert found.endswith(f" (process {holder.pid})")
    finally:
        holder.kill()
        holder.wait(timeout=10)


def test_holder_of_another_user_is_found_by_its_lock(pty: Pty, tmp_path: Path) -> None:
    """Open files of other users are not visible, but locks are."""
    status = pty.path.stat()
    place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    (tmp_path / "proc/77").mkdir(parents=True)
    (tmp_path / "proc/77/comm").write_text("tsgt-client\n")
    (tmp_path / "proc/locks").write_text(
        f"1: POSIX  ADVISORY  READ 5 00:19:4 128 128\n2: FLOCK  ADVISORY  WRITE 77 {place} 0 EOF\n"
    )
    assert port_holder(pty.path, root=tmp_path) == "tsgt-client (process 77)"
    (tmp_path / "proc/locks").write_text("")
    assert port_holder(pty.path, root=tmp_path) is None
    assert port_holder(pty.path, root=tmp_path / "nowhere") is None


@pytest.mark.parametrize("name", ["/dev/null", "/tmp", "/dev/nothing"])
def test_other_files_are_no_ports(name: str) -> None:
    """A device without a line, a folder, a missing file: an error of ours."""
    with pytest.raises(InstrumentError, match=name):
        asyncio.run(opened(Path(name)))


def adapter(root: Path, path: Path) -> Path:
    """Make the files of an FTDI adapter; return that of its latency timer."""
    folder = root / "sys/bus/usb-serial/devices" / path.name
    folder.mkdir(parents=True)
    return folder / "latency_timer"


def test_latency_timer_is_read(tmp_path: Path) -> None:
    """In milliseconds, through a link; None without such an adapter."""
    device, link = tmp_path / "ttyUSB7", tmp_path / "instrument"
    link.symlink_to(device)
    assert latency_timer_ms(link, root=tmp_path) is None
    adapter(tmp_path, device).write_text("16\n")
    assert latency_timer_ms(link, root=tmp_path) == 16


def test_latency_timer_is_lowered(pty: Pty, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If it is writable."""
    timer = adapter(tmp_path, pty.path)
    timer.write_text("16\n")
    monkeypatch.setattr(serial_port, "_ROOT", tmp_path)

    async def run() -> None:
        await (await opened(pty.path)).close()

    with capture_logs() as logs:
        asyncio.run(run())
    assert timer.read_text() == "1"
    assert logs == []


def test_slow_latency_timer_is_a_single_warning(
    pty: Pty, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However often the port is opened."""
    adapter(tmp_path, pty.path).symlink_to(
        "/proc/sys/kernel/ngroups_max"
    )  # a number that not even root can set
    monkeypatch.setattr(serial_port, "_ROOT", tmp_path)
    serial_port._warn_latency.cache_clear()

    async def run() -> None:
        for _ in range(3):
            await (await opened(pty.path)).close()

    with capture_logs() as logs:
        asyncio.run(run())
    assert [(entry["event"], entry["latency_ms"]) for entry in logs] == [("serial_latency", 65_536)]


def test_connection_works_over_a_port(pty: Pty) -> None:
    """The reply is timestamped after the request."""

    async def run() -> None:
        connection = GeoComConnection(await opened(pty.path), SystemClock())
        loop = asyncio.get_running_loop()

        def answer() -> None:
            transaction = os.read(pty.master, 100).decode().split(",")[2].rstrip(":\r\n")
            os.write(pty.master, f"%R1P,0,{transaction}:0,1,2,3\r\n".encode())

        loop.add_reader(pty.master, answer)
        reply = await connection.call(Rpc.MOT_READ_LOCK_STATUS, timeout_s=2.0)
        assert reply.values == (1, 2, 3)
        assert reply.sent_ns <= reply.first_byte_ns < time.monotonic_ns()
        loop.remove_reader(pty.master)
        await connection.close()

    asyncio.run(run())
