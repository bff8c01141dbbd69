# ruff: noqa: ASYNC240 (the temporary folder answers at once)
from __future__ import annotations

import asyncio
import json
import socket
import stat
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import pytest
from harness.hardware.radios import running_timeline
from harness.radio.air import SYMBOL_NS, RecordingListener, frame, listening, modulation
from structlog.testing import capture_logs

from tsgt.errors import StreamError
from tsgt.recording import encode_line
from tsgt.simulation.lora import AirClient, AirServer, LinkModel, LogDistanceLoss, air_server
from tsgt.simulation.lora.air_client import WELCOME_TIMEOUT_S
from tsgt.simulation.lora.air_messages import MAX_LINE_BYTES, FrameMessage, Transmit
from tsgt.simulation.lora.link import FixedLoss

if TYPE_CHECKING:
    from pathlib import Path

JOIN = b'{"type":"join","name":"raw"}\n'


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the socket is."""
    return tmp_path / "air.sock"


class Radio:
    """A client with a listener that records its events."""

    def __init__(self, client: AirClient) -> None:
        self.client = client
        self.listener = RecordingListener()
        self.port = client.join(self.listener)


class Field:
    """A server with clients that join on request, on virtual time."""

    def __init__(self, path: Path, link: LinkModel | None = None) -> None:
        self.path = path
        self.link = link or LinkModel()
        self.timeline = running_timeline()
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        server = AirServer(self.path, self.link, np.random.default_rng(0), now_ns=self.timeline.now_ns)
        self.server = await self._stack.enter_async_context(server)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def radio(self, name: str, *, crystal_ppm: float = 0.0) -> Radio:
        """Join the channel."""
        client = AirClient(self.path, name, self.timeline, crystal_ppm=crystal_ppm)
        return Radio(await self._stack.enter_async_context(client))

    async def at(self, symbols: float) -> None:
        """Wait until this many symbols after the start."""
        await asyncio.sleep(symbols * SYMBOL_NS / 1e9 - asyncio.get_running_loop().time())


async def settle() -> None:
    """Let the event loop run everything that is ready."""
    for _ in range(20):
        await asyncio.sleep(0)


async def test_frames_pass_between_processes_as_within_one(path: Path) -> None:
    """A receiver at another connection gets the same events at the same times as within one process."""
    async with Field(path, LinkModel(path_loss=FixedLoss(pairs_db={("tx", "rx"): 100.0}))) as field:
        tx, rx = await field.radio("tx", crystal_ppm=5.0), await field.radio("rx")
        rx.port.listen(listening())
        tx.port.transmit(frame())
        await field.at(100.0)
    assert rx.listener.events == [
        (5 * SYMBOL_NS, "preamble"),
        (frame().header_end_ns, "header"),
        (frame().end_ns, "received"),
    ]
    (reception,) = rx.listener.receptions
    assert reception.payload == frame().payload
    assert reception.rssi_dbm == pytest.approx(-86.0)
    assert reception.frequency_error_hz == pytest.approx(905e6 * 5e-6)
    assert tx.listener.events == []


async def test_delayed_message_does_not_change_the_times(path: Path) -> None:
    """A frame whose message is late is received with its true times."""
    async with Field(path) as field:
        tx, rx = await field.radio("tx"), await field.radio("rx")
        rx.port.listen(listening())
        await field.at(7.0)
        tx.port.transmit(frame(0.0))
        await field.at(100.0)
    assert [at_ns for at_ns, _ in rx.listener.events] == [
        5 * SYMBOL_NS,
        frame().header_end_ns,
        frame().end_ns,
    ]


async def test_rssi_and_activity_are_known_locally(path: Path) -> None:
    """The client answers RSSI and activity detection without the server."""
    async with Field(path) as field:
        tx, rx = await field.radio("tx"), await field.radio("rx")
        rx.port.listen(listening())
        tx.port.transmit(frame())
        await field.at(4.0)
        assert rx.port.rssi_dbm(4 * SYMBOL_NS) == pytest.approx(-66.0, abs=0.1)
        assert rx.port.preamble_present(modulation(), 4 * SYMBOL_NS)


async def test_cut_is_forwarded(path: Path) -> None:
    """A frame that its sender cuts is cut for all."""
    async with Field(path) as field:
        tx, rx = await field.radio("tx"), await field.radio("rx")
        rx.port.listen(listening())
        tx.port.transmit(frame())
        await field.at(30.0)
        tx.port.stop_transmitting(30 * SYMBOL_NS)
        await field.at(100.0)
    assert rx.listener.outcomes == ["damaged"]


async def test_link_may_change_at_run_time(path: Path) -> None:
    """Changes of attenuation and loss at the server apply from the next frame on."""
    async with Field(path) as field:
        tx, rx = await field.radio("tx"), await field.radio("rx")
        rx.port.listen(listening())
        for number, (attenuation_db, loss_probability) in enumerate([(0, 0), (80, 0), (0, 1), (0, 0)]):
            field.link.set_attenuation("rx", "tx", attenuation_db)
            field.link.loss_probability = loss_probability
            tx.port.transmit(frame(number * 100.0))
            await field.at(number * 100.0 + 100.0)
    assert [at_ns for at_ns, what in rx.listener.events if what == "received"] == [
        frame().end_ns,
        frame(300.0).end_ns,
    ]


async def test_disconnect_cuts_the_frame(path: Path) -> None:
    """The frame of a client that disconnects is cut, and its name is free again."""
    async with Field(path) as field:
        rx = await field.radio("rx")
        rx.port.listen(listening())
        async with AirClient(path, "tx", field.timeline) as client:
            client.join(RecordingListener()).transmit(frame())
            await field.at(30.0)
        await field.at(100.0)
        assert field.server.radio_names == {"rx"}
        again = await field.radio("tx", crystal_ppm=20.0)
        again.port.transmit(frame(100.0))
        await field.at(200.0)
    assert rx.listener.outcomes == ["damaged", "received"]
    assert rx.listener.receptions[-1].frequency_error_hz == pytest.approx(905e6 * 20e-6)


async def test_names_are_unique(path: Path) -> None:
    """A second radio with the same name is rejected with the reason; the first stays."""
    async with Field(path) as field:
        await field.radio("tx")
        with pytest.raises(StreamError, match=rf"^{path}: .*radio 'tx' has joined already[^\n]*$"):
            await field.radio("tx")
        assert field.server.radio_names == {"tx"}


async def test_missing_server_is_an_error(path: Path) -> None:
    """The error names the socket and suggests to start a server."""
    with pytest.raises(StreamError, match=rf"^{path}: no air server \([^\n]+\); start one$"):
        await AirClient(path, "tx", running_timeline()).__aenter__()


async def test_silent_server_times_out(path: Path) -> None:
    """A server that does not respond to the join is an error."""
    connected: list[asyncio.StreamWriter] = []
    server = await asyncio.start_unix_server(lambda _, writer: connected.append(writer), path)
    start_s = asyncio.get_running_loop().time()
    with pytest.raises(StreamError, match="does not respond"):
        await AirClient(path, "tx", running_timeline()).__aenter__()
    assert asyncio.get_running_loop().time() - start_s == pytest.approx(WELCOME_TIMEOUT_S)
    connected[0].close()
    server.close()
    await settle()


@pytest.mark.parametrize("answer", [b"hello\n", b'{"type":"left","sender":"x"}\n', b"\xff\x00\n"], ids=repr)
async def test_invalid_message_from_the_server_is_an_error(path: Path, answer: bytes) -> None:
    """Another kind of server is detected."""

    async def talk(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(answer)
        writer.close()

    server = await asyncio.start_unix_server(talk, path)
    with pytest.raises(StreamError, match="invalid message from the server"):
        await AirClient(path, "tx", running_timeline()).__aenter__()
    server.close()
    await settle()


async def test_clients_of_a_stopped_server_are_disconnected(path: Path) -> None:
    """The client raises, receives nothing more, and its port remains usable without effect."""
    async with AsyncExitStack() as stack:
        field = Field(path)
        async with field:
            client = AirClient(path, "rx", field.timeline)
            rx = Radio(await stack.enter_async_context(client))
            tx = await field.radio("tx")
            rx.port.listen(listening())
            tx.port.transmit(frame())
            await field.at(30.0)
            with capture_logs() as logs:
                await field.server.__aexit__()
                with pytest.raises(
                    StreamError,
                    match=rf"^{path}: radio 'rx' is disconnected .*: the server has closed the connection$",
                ):
                    await client.wait_disconnected()
        assert {entry["name"] for entry in logs if entry["event"] == "air_lost"} == {"rx", "tx"}
        rx.port.listen(listening(30.0))
        rx.port.transmit(frame(31.0))
        rx.port.stop_transmitting(40 * SYMBOL_NS)
        await asyncio.sleep(1.0)
        assert rx.listener.outcomes == []


async def test_client_may_leave(path: Path) -> None:
    """A client that leaves logs no error."""
    with capture_logs() as logs:
        async with Field(path) as field, AirClient(path, "rx", field.timeline) as client:
            Radio(client)
    assert [entry["event"] for entry in logs] == ["air_opened", "air_joined", "air_left"]


def transmit_line(**changes: Any) -> bytes:
    """Encode a message that transmits a frame, with changes in the frame."""
    line = json.loads(encode_line(Transmit(frame=FrameMessage.of(frame()))))
    line["frame"] |= changes
    return json.dumps(line).encode() + b"\n"


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        (b"hello\n", "JSON"),
        (b"\xff\xfe\x00\n", "JSON"),
        (b"[1, 2]\n", ""),
        (b'{"type":"measurement"}\n', "unknown message type 'measurement'"),
        (b'{"type":"join","name":""}\n', "name"),
        (transmit_line(), "first message must be of type 'join'"),
        (JOIN + JOIN, "has joined as 'raw' already"),
        (JOIN + b'{"type":"stop","at_ns":1e99}\n', "at_ns"),
        (JOIN + transmit_line(start_ns=10**15), "start is not now"),
        (JOIN + transmit_line(spreading_factor=5), "spreading_factor"),
        (JOIN + transmit_line(bandwidth_hz=0), "bandwidth_hz"),
        (JOIN + transmit_line(power_dbm=1e999), "power_dbm"),
        (JOIN + transmit_line(payload_hex="0g"), "payload_hex"),
        (JOIN + transmit_line(payload_hex="00" * 256), "payload_hex"),
        (JOIN + b"x" * (MAX_LINE_BYTES + 1), "longer than"),
    ],
    ids=lambda value: repr(value)[:40],
)
async def test_client_with_invalid_messages_is_rejected(path: Path, lines: bytes, reason: str) -> None:
    """It is disconnected, the reason is logged, and other clients are unaffected."""
    async with Field(path) as field:
        tx, rx = await field.radio("tx"), await field.radio("rx")
        rx.port.listen(listening())
        tx.port.transmit(frame())
        with capture_logs() as logs:
            reader, writer = await asyncio.open_unix_connection(path)
            writer.write(lines)
            *_, refusal = (await reader.read()).splitlines()
            writer.close()
            await settle()
        assert json.loads(refusal)["type"] == "rejected"
        dropped = [entry for entry in logs if entry["event"] == "air_client_dropped"]
        assert len(dropped) == 1
        assert reason in dropped[0]["reason"]
        assert "\n" not in dropped[0]["reason"]
        assert field.server.radio_names == {"tx", "rx"}
        await field.at(100.0)
    assert rx.listener.outcomes == ["received"]


async def test_line_may_arrive_in_parts(path: Path) -> None:
    """A message is processed when its line is complete."""
    async with Field(path) as field:
        reader, writer = await asyncio.open_unix_connection(path)
        for byte in JOIN:
            writer.write(bytes([byte]))
            await asyncio.sleep(0)
        assert json.loads(await reader.readline())["type"] == "welcome"
        assert field.server.radio_names == {"raw"}
        writer.close()
        await settle()


async def test_client_that_does_not_read_is_disconnected(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A blocked client does not fill the server's memory."""
    monkeypatch.setattr(air_server, "MAX_WAITING_BYTES", 10_000)
    async with Field(path) as field:
        tx = await field.radio("tx")
        with socket.socket(socket.AF_UNIX) as sleepy, capture_logs() as logs:
            sleepy.connect(str(path))
            sleepy.sendall(JOIN)
            await settle()
            assert field.server.radio_names == {"tx", "raw"}
            for _ in range(1000):
                tx.port.transmit(frame())
                await settle()
        assert field.server.radio_names == {"tx"}
        reasons = [entry["reason"] for entry in logs if entry["event"] == "air_client_dropped"]
        assert reasons == ["it does not read"]


async def test_radio_without_position_is_rejected(path: Path) -> None:
    """The link model must know a radio; otherwise other radios' frames would fail."""
    link = LinkModel(path_loss=LogDistanceLoss(positions_m={"tx": (0, 0, 0)}))
    async with Field(path, link) as field:
        tx = await field.radio("tx")
        with pytest.raises(StreamError, match="radio 'rx' has no position in the link model"):
            await field.radio("rx")
        tx.port.transmit(frame())
        await settle()
        assert field.server.radio_names == {"tx"}


async def test_socket_is_private_and_exclusive(path: Path) -> None:
    """Mode 600; a stale socket is replaced, a live one is an error."""
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(str(path))
    async with Field(path) as field:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        with pytest.raises(StreamError, match="another program serves this socket"):
            await AirServer(path, field.link, np.random.default_rng(0)).__aenter__()
    assert not path.exists()
