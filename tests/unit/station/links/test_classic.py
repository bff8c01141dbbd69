"""The classic link: which measurement is offered, and the responses to commands."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from harness.hardware.radios import MS

from tsgt.clock import SuspensionWatch, UnixTimeline
from tsgt.errors import ComputerSuspendedError, RadioError
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
    """A radio connected to the test."""

    def __init__(self) -> None:
        self.arriving: asyncio.Queue[Packet] = asyncio.Queue()
        self.sent: asyncio.Queue[bytes] = asyncio.Queue()
        self.broken = False

    async def configure(self, settings: LoRaSettings) -> None:
        """Do nothing."""

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmission:
        """Queue the packet for the test."""
        if self.broken:
            raise RadioError("it is broken")
        self.sent.put_nowait(payload)
        return Transmission(started_at_ns=at_ns or 0, done_at_ns=at_ns or 0, stamp_sigma_ns=1)

    async def receive(self) -> Packet:
        """Return the test's next packet."""
        return await self.arriving.get()

    async def close(self) -> None:
        """Do nothing."""


class Client:
    """A link with its session, and the commands received."""

    def __init__(self, group: asyncio.TaskGroup) -> None:
        self.air = Air()
        self.clock = VirtualClock(START)
        self.session = ClientSession(3, 1)
        self.suspended_ns = 0
        self.commands: list[Command] = []
        self.link = ClassicLink(
            self.session,
            self.clock,
            SuspensionWatch(lambda: self.suspended_ns),
            UnixTimeline(START),
            on_command=self.commands.append,
            create_task=group.create_task,
        )

    def measure(self, stamp_ns: int, *, prism: int = 1, status: Status = Status.OK) -> PolarMeasurement:
        """Return a measurement."""
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

    async def send(self, payload: bytes) -> None:
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
        await self.send(payload)
        return await self.reply()

    async def reply(self) -> Reply | None:
        """Return the next reply; None without one."""
        await asyncio.sleep(0.001)
        return decode_reply(self.air.sent.get_nowait()) if self.air.sent.qsize() else None

    async def poll(self) -> MeasurementMessage:
        """Ping and poll a measurement."""
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


async def test_newest_measurement_is_repeated() -> None:
    """Raw values bit for bit, and the host's timestamp."""
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
    ("status", "raw"),
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
async def test_every_status_is_encoded(status: Status, raw: int) -> None:
    """Seven statuses become five codes on the air."""
    async with client() as made:
        made.link.offer(made.measure(START, status=status))
        message = await made.poll()
    assert (message.status, message.time_ns) == (raw, START)


async def test_no_reply_after_a_suspension() -> None:
    """The request would be later by the suspension than the measurement on the same clock."""
    with pytest.RaisesGroup(ComputerSuspendedError):
        async with client() as made:
            made.link.offer(made.measure(START))
            made.suspended_ns = 2_000_000_000
            await made.send(b"e3")
            pytest.fail("it goes on")
    assert made.air.sent.empty()


async def test_delayed_measurement_of_old_prism_is_not_offered() -> None:
    """It is journalled only."""
    async with client() as made:
        late = made.measure(START)
        await made.send(b"n32")
        assert made.commands == [TrackCommand(2)]
        made.session.apply(TrackCommand(2))
        made.link.respond(TrackCommand(2), ok=True)
        assert await made.reply() == Acknowledgement("n", ok=True)
        made.link.offer(late)
        assert (await made.poll()).time_ns == 0
        made.link.offer(made.measure(START + MS, prism=2))
        assert (await made.poll()).time_ns == START + MS
        made.session.apply(DirectCommand())
        made.link.offer(made.measure(START + 2 * MS, prism=2))
        assert (await made.poll()).time_ns == START + MS


@pytest.mark.parametrize(("sigma_ns", "stamp_ms"), [(MS, -40), (29 * MS, 0)])
async def test_ping_without_interrupt_is_not_timestamped_early(sigma_ns: int, stamp_ms: int) -> None:
    """The driver's estimate may precede the packet's end by 50 ms; the master's bounds require timestamps that are never early."""
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
        assert await made.reply() is not None
        assert await made.ask(b"s3") == TimeReply(START + found_ns + stamp_ms * MS)


async def test_single_measurement_always_gets_a_response() -> None:
    """In direct mode `t` requests a single measurement; the response has it, or an error status."""
    async with client() as made:
        await made.send(b"d3")
        made.link.respond(DirectCommand(), ok=True)
        assert await made.reply() == Acknowledgement("d", ok=True)
        await made.send(b"t3")
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
        message = await made.reply()
        assert isinstance(message, MeasurementMessage)
        assert (message.status, message.time_ns, message.slope_distance_m) == (0, START + MS, 7.5)
        await made.send(b"t3")
        made.link.respond_single(None)
        failed = await made.reply()
        assert isinstance(failed, MeasurementMessage)
        assert failed.status == 3


async def test_search_result_is_not_sent() -> None:
    """There is no search in this protocol."""
    async with client() as made:
        made.link.respond(SearchCommand(), ok=True)
        assert await made.reply() is None


async def test_expired_response_is_not_sent() -> None:
    """After twenty seconds the master polls others. A failing radio does not stop the client either."""
    async with client() as made:
        await made.send(b"d3")
        await asyncio.sleep(21.0)
        made.link.respond(DirectCommand(), ok=True)
        assert await made.reply() is None
        await made.send(b"n3")
        made.air.broken = True
        made.link.respond(TrackCommand(None), ok=True)
        assert await made.reply() is None


async def test_status_reports_packets_for_this_station() -> None:
    """Fields that the protocol lacks are null."""
    async with client() as made:
        assert made.link.status().master_received_ns is None
        await made.send(b"t2")
        assert made.link.status().master_received_ns is None
        await made.send(b"t3")
        status = made.link.status()
        assert status.master_received_ns is not None
        assert abs(status.master_received_ns - START) < 10 * MS
        assert (status.protocol, status.rssi_dbm, status.snr_db) == ("classic", -80.5, 9.25)
        assert (status.joined, status.queued, status.authenticated) == (None, None, None)
