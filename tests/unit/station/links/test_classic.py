"""What the client makes of the paper's protocol: which measurement is offered, and how orders are answered."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from harness.radios import MS

from tsgt.clock import UnixTimeline
from tsgt.errors import RadioError
from tsgt.model import PolarMeasurement, Status
from tsgt.radio import DirectCommand, MeasureCommand, Packet, SearchCommand, TrackCommand, Transmission
from tsgt.radio.classic import MeasurementMessage
from tsgt.radio.classic.messages import Acknowledgement, TimeReply, decode_reply
from tsgt.recording.journal import TargetRecord
from tsgt.simulation.kernel import VirtualClock
from tsgt.station.links import ClassicLink
from tsgt.station.session import ClientSession

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from tsgt.radio import Command, LoRaSettings
    from tsgt.radio.classic.messages import Reply

START = 1_600_000_000_000_000_000


class Air:
    """A radio whose other end is the test."""

    def __init__(self) -> None:
        self.arriving: asyncio.Queue[Packet] = asyncio.Queue()
        self.sent: asyncio.Queue[bytes] = asyncio.Queue()
        self.broken = False

    async def configure(self, settings: LoRaSettings) -> None:
        """Do nothing."""

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmission:
        """Hand the packet to the test."""
        if self.broken:
            raise RadioError("it is broken")
        self.sent.put_nowait(payload)
        return Transmission(started_at_ns=at_ns or 0, done_at_ns=at_ns or 0, stamp_sigma_ns=1)

    async def receive(self) -> Packet:
        """Return what the test sends."""
        return await self.arriving.get()

    async def close(self) -> None:
        """Do nothing."""


class Client:
    """A link with its session, and the orders that have come."""

    def __init__(self, group: asyncio.TaskGroup) -> None:
        self.air = Air()
        self.clock = VirtualClock(START)
        self.session = ClientSession(3, 1)
        self.commands: list[Command] = []
        self.link = ClassicLink(
            self.session,
            self.clock,
            UnixTimeline(START),
            on_command=self.commands.append,
            create_task=group.create_task,
        )

    def measure(self, stamp_ns: int, *, prism: int = 1, status: Status = Status.OK) -> PolarMeasurement:
        """Make a measurement."""
        return PolarMeasurement(
            station=3,
            prism=prism,
            sequence=0,
            stamp_ns=stamp_ns,
            received_ns=stamp_ns,
            horizontal_angle_rad=0.5,
            zenith_angle_rad=1.6,
            slope_distance_m=42.123456789,
            status=status,
            host_time_ns=stamp_ns,
        )

    async def say(self, payload: bytes) -> None:
        """Send a request."""
        packet = Packet(
            payload=payload,
            rssi_dbm=-80.5,
            snr_db=9.25,
            received_at_ns=self.clock.monotonic_ns(),
            stamp_sigma_ns=1,
        )
        self.air.arriving.put_nowait(packet)
        await asyncio.sleep(0.001)

    async def ask(self, payload: bytes) -> Reply | None:
        """Send a request and return the reply."""
        await self.say(payload)
        return await self.answer()

    async def answer(self) -> Reply | None:
        """Return what has been sent; None where nothing was."""
        await asyncio.sleep(0.001)
        return decode_reply(self.air.sent.get_nowait()) if self.air.sent.qsize() else None

    async def poll(self) -> MeasurementMessage:
        """Ask for data, of a station that has been synchronised."""
        await self.ask(b"e3")
        reply = await self.ask(b"t3")
        assert isinstance(reply, MeasurementMessage)
        return reply


@asynccontextmanager
async def client() -> AsyncGenerator[Client]:
    """Run a link on a radio."""
    async with asyncio.TaskGroup() as group:
        made = Client(group)
        talking = group.create_task(made.link.run(made.air))
        yield made
        talking.cancel()


async def test_the_master_gets_the_newest_again_and_again() -> None:
    """Bit for bit the raw values, and the host's stamp."""
    async with client() as made:
        made.link.offer(made.measure(START))
        made.link.offer(made.measure(START + 400 * MS))
        for _ in range(2):
            assert await made.poll() == MeasurementMessage(
                station=3,
                status=0,
                zenith_angle_rad=1.6,
                horizontal_angle_rad=0.5,
                slope_distance_m=42.123456789,
                time_ns=START + 400 * MS,
            )


@pytest.mark.parametrize(
    ("verdict", "raw"),
    [
        (Status.OK, 0),
        (Status.LOW_ACCURACY, 0),
        (Status.TILT, 1),
        (Status.WRONG_DISTANCE, 2),
        (Status.NO_TARGET, 3),
        (Status.ERROR, 3),
        (Status.ANGLE_ONLY, 4),
    ],
)
async def test_every_status_reaches_the_master(verdict: Status, raw: int) -> None:
    """Seven verdicts become five numbers on the air."""
    async with client() as made:
        made.link.offer(made.measure(START, status=verdict))
        message = await made.poll()
    assert (message.status, message.time_ns) == (raw, START)


async def test_what_the_disk_held_up_is_not_offered_as_another_prism() -> None:
    """After a change of prism a late line of the old one is journalled, and that is all."""
    async with client() as made:
        late = made.measure(START)
        await made.say(b"n32")
        assert made.commands == [TrackCommand(2)]
        made.session.apply(TrackCommand(2))
        made.link.respond(TrackCommand(2), ok=True)
        assert await made.answer() == Acknowledgement("n", ok=True)
        made.link.offer(late)
        assert (await made.poll()).time_ns == 0
        made.link.offer(made.measure(START + MS, prism=2))
        assert (await made.poll()).time_ns == START + MS
        made.session.apply(DirectCommand())
        made.link.offer(made.measure(START + 2 * MS, prism=2))
        assert (await made.poll()).time_ns == START + MS


@pytest.mark.parametrize(("sigma_ns", "stamp_ms"), [(MS, -40), (29 * MS, 0)])
async def test_a_ping_that_was_found_without_its_interrupt_is_not_stamped_too_early(
    sigma_ns: int, stamp_ms: int
) -> None:
    """The driver's guess may lie 50 ms before the packet's end; the master's bounds rest on stamps that are never early."""
    async with client() as made:
        found_ns = made.clock.monotonic_ns()
        made.air.arriving.put_nowait(
            Packet(
                payload=b"e3",
                rssi_dbm=-80.0,
                snr_db=9.0,
                received_at_ns=found_ns - 40 * MS,
                stamp_sigma_ns=sigma_ns,
            )
        )
        assert await made.answer() is not None
        assert await made.ask(b"s3") == TimeReply(START + found_ns + stamp_ms * MS)


async def test_a_shot_is_answered_whatever_becomes_of_it() -> None:
    """In direct mode `t` is an order for one single measurement; its answer carries it, or says that there is none."""
    async with client() as made:
        await made.say(b"d3")
        made.link.respond(DirectCommand(), ok=True)
        assert await made.answer() == Acknowledgement("d", ok=True)
        await made.say(b"t3")
        assert made.commands == [DirectCommand(), MeasureCommand()]
        made.link.respond_single(
            TargetRecord(
                station=3,
                stamp_ns=START + MS,
                horizontal_angle_rad=0.5,
                zenith_angle_rad=1.6,
                slope_distance_m=7.5,
                status=Status.OK,
                raw_status=0,
                instrument_time_ns=None,
            )
        )
        message = await made.answer()
        assert isinstance(message, MeasurementMessage)
        assert (message.status, message.time_ns, message.slope_distance_m) == (0, START + MS, 7.5)
        await made.say(b"t3")
        made.link.respond_single(None)
        failed = await made.answer()
        assert isinstance(failed, MeasurementMessage)
        assert failed.status == 3


async def test_what_the_master_cannot_order_is_not_answered() -> None:
    """There is no search in this protocol."""
    async with client() as made:
        made.link.respond(SearchCommand(), ok=True)
        assert await made.answer() is None


async def test_an_answer_that_nobody_waits_for_is_not_sent() -> None:
    """After twenty seconds the master asks others; nor does a radio that fails stop the client."""
    async with client() as made:
        await made.say(b"d3")
        await asyncio.sleep(21.0)
        made.link.respond(DirectCommand(), ok=True)
        assert await made.answer() is None
        await made.say(b"n3")
        made.air.broken = True
        made.link.respond(TrackCommand(None), ok=True)
        assert await made.answer() is None


async def test_the_status_tells_of_the_master() -> None:
    """Of packets for this station only; what the protocol does not have is null."""
    async with client() as made:
        assert made.link.status().master_received_ns is None
        await made.say(b"t2")
        assert made.link.status().master_received_ns is None
        await made.say(b"t3")
        status = made.link.status()
        assert status.master_received_ns is not None
        assert abs(status.master_received_ns - START) < 10 * MS
        assert (status.protocol, status.rssi_dbm, status.snr_db) == ("classic", -80.5, 9.25)
        assert (status.joined, status.queued, status.authenticated) == (None, None, None)
