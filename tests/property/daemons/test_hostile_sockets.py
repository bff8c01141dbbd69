"""Arbitrary data from the other end of a socket: no crash, and other peers are served."""

from __future__ import annotations

import asyncio
import json
import socket
import tempfile
import unicodedata
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.cli import called
from harness.files.damage import Damage, damages, examples
from harness.files.records import CLOCK, EVENT, HELLO, NO_POSE, POINT, POSE, STATUS, measurement
from harness.files.stream_lines import lines, serving
from harness.hardware.radios import PAPER, running_timeline
from harness.instruments.scripted_instrument import ScriptedInstrument
from harness.radio.air import RecordingListener, frame
from harness.radio.client import client_config
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from tsgt.errors import RadioError, StreamError
from tsgt.master.stream_server import StreamServer
from tsgt.recording import MAX_LINE_BYTES
from tsgt.recording.journal import InstrumentRecord
from tsgt.simulation.kernel import VirtualClock, run_virtual
from tsgt.simulation.lora import AirClient, AirServer, LinkModel
from tsgt.simulation.lora.air_messages import (
    FrameMessage,
    Incoming,
    Join,
    Left,
    Stop,
    Stopped,
    Transmit,
    Welcome,
)
from tsgt.simulation.lora.link import FixedLoss
from tsgt.station import AtmosphereRequest, AtmosphereResponse, ClientDependencies, run_client

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AbstractAsyncContextManager

    from tsgt.radio import Radio

FRAME = FrameMessage.of(frame())
SETTINGS = InstrumentRecord(make="Leica", prism_type="round", prism_constant_m=0.0, atmospheric_ppm=8.1)


STREAM = lines(HELLO, measurement(0), POINT, POSE, NO_POSE, STATUS, CLOCK, EVENT)
STATUS_STREAM = lines(HELLO, POSE, STATUS)
REQUESTS = [lines(AtmosphereRequest(temperature_c=25.0, pressure_hpa=1000.0)), STREAM]
TO_AIR = [lines(Join(name="x"), Transmit(frame=FRAME), Stop(at_ns=5_000_000), Transmit(frame=FRAME))]
FROM_AIR = [
    lines(
        Welcome(seed=3, noise_figure_db=6.0),
        Incoming(sender="a", crystal_ppm=1.0, loss_db=80.0, loss_probability=0.0, frame=FRAME),
        Stopped(sender="a", at_ns=30_000_000),
        Incoming(sender="b", crystal_ppm=1.0, loss_db=80.0, loss_probability=0.0, frame=FRAME),
        Left(sender="b"),
    )
]
closings = st.sampled_from(["reads on", "says no more", "goes"])


async def settle() -> None:
    """Run the event loop until it is idle."""
    for _ in range(30):
        await asyncio.sleep(0)


@contextmanager
def connected(path: Path, content: bytes, closing: str) -> Iterator[None]:
    """Send data to a server, then disconnect or stay."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(path))
        connection.setblocking(False)
        with suppress(OSError):  # it has had enough
            connection.send(content)
        if closing == "goes":
            connection.close()
        elif closing == "says no more":
            connection.shutdown(socket.SHUT_WR)
        yield


@examples(20)
@given(peers=st.lists(st.tuples(damages, closings), min_size=1, max_size=4))
def test_input_from_stream_readers_is_ignored(peers: list[tuple[Damage, str]]) -> None:
    """Input from stream readers is ignored."""

    async def run(folder: Path) -> None:
        path = folder / "s"
        async with StreamServer(path, b"hello") as server:
            reader, writer = await asyncio.open_unix_connection(path)
            with ExitStack() as stack:
                for number, (damage, closing) in enumerate(peers):
                    stack.enter_context(connected(path, damage.to([STREAM, *REQUESTS]), closing))
                    await settle()
                    server.publish(b"%d" % number)
            server.publish(b"end")
            for expected in (b"hello", *(b"%d" % number for number in range(len(peers))), b"end"):
                assert await reader.readline() == expected + b"\n"
            writer.close()
            await settle()

    _in_folder(run)


def _no_radio() -> AbstractAsyncContextManager[Radio]:
    raise RadioError("no chip")


@examples(15)
@given(peers=st.lists(st.tuples(damages, closings), min_size=1, max_size=4))
def test_arbitrary_requests_to_the_client(peers: list[tuple[Damage, str]]) -> None:
    """The next one gets its status, and its command is executed."""

    async def run(folder: Path) -> None:
        clock = VirtualClock(1_700_000_000_000_000_000)
        instrument = ScriptedInstrument(clock)
        config = client_config(folder)
        path = folder / "client.sock"
        running = asyncio.create_task(
            run_client(
                config, PAPER, ClientDependencies(instrument=instrument, open_radio=_no_radio, clock=clock)
            )
        )
        await asyncio.sleep(2.0)
        with ExitStack() as stack:
            for damage, closing in peers:
                stack.enter_context(connected(path, damage.to(REQUESTS), closing))
                await settle()
            reader, writer = await asyncio.open_unix_connection(path)
            writer.write(REQUESTS[0])
            instrument.give()
            status, answer = (await reader.read()).splitlines()
            writer.close()
        assert json.loads(status)["type"] == "client_status"
        assert json.loads(answer)["problem"] in ("", "superseded by a later request")
        running.cancel()
        await asyncio.wait([running])
        assert running.cancelled() or running.exception() is None

    _in_folder(run)


@examples(20)
@given(peers=st.lists(st.tuples(damages, closings), min_size=1, max_size=3))
def test_unknown_peers_at_the_air_server(peers: list[tuple[Damage, str]]) -> None:
    """Two radios of the demo still exchange packets."""

    async def run(folder: Path) -> None:
        path = folder / "air"
        timeline = running_timeline()
        link = LinkModel(path_loss=FixedLoss(default_db=80.0))
        server = AirServer(path, link, np.random.default_rng(1), now_ns=timeline.now_ns)
        async with (
            server,
            AirClient(path, "tx", timeline) as sender,
            AirClient(path, "rx", timeline) as receiver,
        ):
            port = sender.join(RecordingListener())
            receiver.join(RecordingListener())
            with ExitStack() as stack:
                for damage, closing in peers:
                    stack.enter_context(connected(path, damage.to(TO_AIR), closing))
                    await settle()
                assert {"tx", "rx"} <= server.radio_names
                port.transmit(frame(start_ns=timeline.now_ns()))
                await settle()
                assert {"tx", "rx"} <= server.radio_names

    _in_folder(run)


@examples(20)
@given(damage=damages)
def test_client_of_a_hostile_air_server(damage: Damage) -> None:
    """It joins, is rejected, or loses the server; nothing else."""

    async def run(folder: Path) -> None:
        path = folder / "air"
        content = damage.to(FROM_AIR)

        async def serve(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            with suppress(OSError):
                writer.write(content)
                await writer.drain()
            writer.close()

        server = await asyncio.start_unix_server(serve, path)
        timeline = running_timeline()
        with suppress(StreamError):
            async with AirClient(path, "rx", timeline) as client:
                client.join(RecordingListener())
                await asyncio.sleep(0.5)
                await client.wait_disconnected()
        server.close()
        await settle()

    _in_folder(run)


def _in_folder(run: object) -> None:
    problems: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder, capture_logs():

        async def watched() -> None:
            asyncio.get_running_loop().set_exception_handler(lambda _, context: problems.append(context))
            await run(Path(folder))  # type: ignore[operator]

        run_virtual(watched)
    assert problems == []


# --- Commands that read from a socket


COMMANDS = {
    "listen": (("listen",), [STREAM]),
    "status": (("status",), [STATUS_STREAM, STREAM]),
    "atmosphere": (
        ("atmosphere", "20", "1000"),
        [b'{"type":"client_status"}\n' + lines(AtmosphereResponse(settings=SETTINGS))],
    ),
}


@pytest.mark.parametrize("command", COMMANDS)
@examples(25)
@given(damage=damages)
def test_commands_with_a_hostile_server(command: str, damage: Damage) -> None:
    """They show lines or one error, and print only text."""
    arguments, samples = COMMANDS[command]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "s"
        with serving(path, damage.to(samples)):
            outcome = called(*arguments, "--socket", path)
    assert outcome.code in (0, 1, 3)
    assert (outcome.code == 1) == outcome.err.startswith("error: ") or command == "listen"
    for character in outcome.out + outcome.err:
        assert character == "\n" or unicodedata.category(character) != "Cc", repr(character)


@pytest.mark.parametrize("command", COMMANDS)
def test_endless_line_has_bounded_memory(command: str) -> None:
    """Endless line has bounded memory."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "s"
        with serving(path, b"x" * (3 * MAX_LINE_BYTES)):
            outcome = called(*COMMANDS[command][0], "--socket", path)
    assert outcome.code == 1
    assert outcome.out == ""
    assert outcome.err.startswith("error: ")
    assert len(outcome.err) < 1000
