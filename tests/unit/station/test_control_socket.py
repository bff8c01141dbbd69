"""The control socket of a client: status, requests, and connections without either."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

import pytest
from harness.hardware.radios import PAPER
from harness.instruments.scripted_instrument import ScriptedInstrument
from harness.radio.client import client_config

from tsgt.errors import InstrumentRefusedError, RadioError, RecordingError
from tsgt.recording import RecordingWriter, encode_line, read_lines
from tsgt.recording.recorder import Recorder
from tsgt.simulation.kernel import VirtualClock
from tsgt.station import AtmosphereRequest, ClientDependencies, Condition, run_client
from tsgt.station.control_socket import MAX_CONNECTIONS

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    from tsgt.radio import Radio

START_NS = 1_700_000_000_000_000_000
WARM = encode_line(AtmosphereRequest(temperature_c=25.0, pressure_hpa=1000.0))


def no_radio() -> AbstractAsyncContextManager[Radio]:
    """Raise an error."""
    raise RadioError("no chip")


@asynccontextmanager
async def client(folder: Path) -> AsyncGenerator[ScriptedInstrument]:
    """Run a client without a radio and with a connected instrument."""
    clock = VirtualClock(START_NS)
    instrument = ScriptedInstrument(clock)
    config = client_config(folder)
    running = asyncio.create_task(
        run_client(config, PAPER, ClientDependencies(instrument=instrument, open_radio=no_radio, clock=clock))
    )
    try:
        await asyncio.sleep(2.0)
        yield instrument
    finally:
        start_ns = clock.monotonic_ns()
        running.cancel()
        await asyncio.wait([running])
        assert clock.monotonic_ns() - start_ns < 500_000_000


async def talk(folder: Path, request: bytes = b"") -> list[dict[str, Any]]:
    """Send a request and return the client's lines."""
    reader, writer = await asyncio.open_unix_connection(folder / "client.sock")
    writer.write(request)
    lines = (await reader.read()).splitlines()
    writer.close()
    return [json.loads(line) for line in lines]


def journalled(folder: Path, kind: str) -> list[dict[str, Any]]:
    """Return the lines of a type in the only journal."""
    (path,) = (folder / "journals").iterdir()
    return [json.loads(line.data) for line in read_lines(path) if line.type == kind]


async def test_excess_connections_are_closed(tmp_path: Path) -> None:
    """A second later there is room again."""
    async with client(tmp_path):
        connections = [
            await asyncio.open_unix_connection(tmp_path / "client.sock") for _ in range(MAX_CONNECTIONS + 5)
        ]
        async with asyncio.timeout(0.01):
            lines = [await reader.readline() for reader, _ in connections]
        assert [bool(line) for line in lines] == [True] * MAX_CONNECTIONS + [False] * 5
        await asyncio.sleep(1.1)
        assert len(await talk(tmp_path, b"?\n")) == 2
        for _, writer in connections:
            writer.close()


async def test_silent_connection_gets_status_and_is_closed(tmp_path: Path) -> None:
    """The status comes at once, the end after a second."""
    async with client(tmp_path):
        reader, writer = await asyncio.open_unix_connection(tmp_path / "client.sock")
        async with asyncio.timeout(0.01):
            assert json.loads(await reader.readline())["type"] == "client_status"
        async with asyncio.timeout(1.1):
            assert await reader.read() == b""
        writer.close()


async def test_atmosphere_is_set_and_journalled(tmp_path: Path) -> None:
    """Response, status and journal have the settings as read back."""
    async with client(tmp_path) as instrument:
        instrument.give()
        first, response = await talk(tmp_path, WARM + b"\n")
        instrument.give()
        await asyncio.sleep(0.1)
        (after,) = await talk(tmp_path)
    assert first["settings"]["temperature_c"] is None
    assert (response["type"], response["problem"]) == ("answer", "")
    assert response["settings"]["temperature_c"] == 25.0
    assert response["settings"]["atmospheric_ppm"] == 10.0
    assert after["settings"] == response["settings"]
    before, changed = journalled(tmp_path, "instrument")
    assert before["temperature_c"] is None
    assert changed == response["settings"]
    first_ns, second_ns = (line["stamp_ns"] for line in journalled(tmp_path, "measurement"))
    assert before["stamp_ns"] <= first_ns < changed["stamp_ns"] <= second_ns


async def test_refused_atmosphere_is_reported(tmp_path: Path) -> None:
    """The response has the instrument's reason."""
    async with client(tmp_path) as instrument:
        instrument.atmosphere_error = InstrumentRefusedError("it has no such setting")
        _, response = await talk(tmp_path, WARM + b"\n")
    assert response["problem"] == "it has no such setting"


@pytest.mark.parametrize(
    ("request_line", "words"),
    [
        (b"hello\n", "invalid request"),
        (b'{"type":"reboot"}\n', "field type"),
        (b'{"type":"atmosphere","temperature_c":20.0}\n', "field pressure_hpa"),
        (b'{"type":"atmosphere","temperature_c":1013.0,"pressure_hpa":20.0}\n', "field temperature_c"),
        (b'{"type":"atmosphere","temperature_c":NaN,"pressure_hpa":1000.0}\n', "invalid request"),
    ],
)
async def test_invalid_request_is_reported(tmp_path: Path, request_line: bytes, words: str) -> None:
    """The response names the error, and nothing is set."""
    async with client(tmp_path) as instrument:
        before = instrument.record
        _, response = await talk(tmp_path, request_line)
        assert words in response["problem"]
        assert instrument.record == before


async def test_request_without_end_is_closed(tmp_path: Path) -> None:
    """The client continues."""
    async with client(tmp_path):
        with suppress(ConnectionResetError):
            await talk(tmp_path, b"x" * 10_000)
        assert len(await talk(tmp_path)) == 1


async def test_open_connections_delay_neither_others_nor_shutdown(tmp_path: Path) -> None:
    """Fifty connections stay open."""
    async with client(tmp_path):
        others = [await asyncio.open_unix_connection(tmp_path / "client.sock") for _ in range(50)]
        async with asyncio.timeout(0.01):
            reader, writer = await asyncio.open_unix_connection(tmp_path / "client.sock")
            await reader.readline()
    for _, writer_ in (*others, (reader, writer)):
        writer_.close()


async def test_status_has_condition_of_instrument(tmp_path: Path) -> None:
    """While disconnected, the problem is the connection error."""
    async with client(tmp_path) as instrument:
        instrument.condition = Condition(
            activity="looking around", problem="point the telescope at prism 1", battery_percent=9
        )
        (status,) = await talk(tmp_path)
        instrument.plugged = False
        instrument.fail()
        await asyncio.sleep(1.0)
        (without,) = await talk(tmp_path)
    assert (status["activity"], status["problem"]) == ("looking around", "point the telescope at prism 1")
    assert status["battery_percent"] == 9
    assert (without["instrument"], without["settings"]) == (None, None)
    assert without["problem"] == "nobody answers; is the cable in?"


async def test_full_disk_is_reported_with_waiting_and_lost_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Measuring continues."""
    full = False
    write_line = RecordingWriter.write_line

    def write_if_room(writer: RecordingWriter, line: bytes) -> None:
        if full:
            raise RecordingError("no room", path=tmp_path)
        write_line(writer, line)

    monkeypatch.setattr(RecordingWriter, "write_line", write_if_room)
    monkeypatch.setattr(Recorder.__init__, "__kwdefaults__", {"max_pending_lines": 10})
    notified: list[str] = []

    def notify(*_assignments: str, status: Callable[[], str] | None = None) -> None:
        if status is not None:
            notified.append(status())

    monkeypatch.setattr("tsgt.service.daemon.sd_notify", notify)
    async with client(tmp_path) as instrument:
        full = True
        for _ in range(15):
            instrument.give()
            await asyncio.sleep(0.1)
        await asyncio.sleep(1.0)
        (status,) = await talk(tmp_path)
        full = False
    assert (status["journal_ok"], status["journal_waiting"], status["journal_lost"]) == (False, 10, 5)
    assert status["measurements"] == 15
    assert any("disk fails: 10 lines not written, 5 lines lost" in line for line in notified)
    assert len(journalled(tmp_path, "measurement")) == 10
