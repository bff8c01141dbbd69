"""Commands for single measurements to the stations, in either protocol, while no master runs."""

from __future__ import annotations

import asyncio
import secrets
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from tsgt.clock import UnixTimeline
from tsgt.master.classic import Transport
from tsgt.master.superframe import FrameLoop, superframe_timing
from tsgt.model import Status
from tsgt.radio import DirectCommand, MeasureCommand, TrackCommand
from tsgt.radio.classic import (
    CommandMessage,
    CommandTransaction,
    LinkTiming,
    SingleMeasurementPoll,
    status_of,
)
from tsgt.radio.superframe import SuperframeMaster
from tsgt.radio.superframe.wire import Authenticator, angle_rad, distance_m

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Mapping, Sequence

    from tsgt.clock import Clock
    from tsgt.config import ClassicMasterConfig, SuperframeMasterConfig
    from tsgt.radio import Command, LoRaSettings, Packet, Radio, Transmission
    from tsgt.radio.superframe import ReceivedReply

COMMAND_TIMEOUT_S = 10.0
"""A change of mode takes some instruments seconds."""

ATTEMPTS = 3
"""Attempts with a station that does not respond; with the superframe, factor on the timeout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandResponse:
    """Response of a station; the raw single measurement if the command was to measure, with a distance of 0 for none."""

    ok: bool
    status: Status = Status.ERROR
    horizontal_angle_rad: float = 0.0
    zenith_angle_rad: float = 0.0
    slope_distance_m: float = 0.0


class CommandSender(Protocol):
    """Sends commands to stations, one after the other."""

    async def send(self, station: int, command: Command) -> CommandResponse | None:
        """Send a command; return the response, None without one. Raises RadioError if the master's radio fails."""
        ...


class ClassicCommandSender:
    """Sends commands in the protocol classic; the only user of the radio."""

    def __init__(
        self, radio: Radio, clock: Clock, protocol: ClassicMasterConfig, settings: LoRaSettings
    ) -> None:
        self._timing = LinkTiming(settings, round(protocol.reply_timeout_ms * 1e6))
        self._transport = Transport(radio, clock, UnixTimeline.fixed_now(clock), self._timing)

    async def send(self, station: int, command: Command) -> CommandResponse | None:
        """See :meth:`CommandSender.send`."""
        match command:
            case TrackCommand(prism):
                return await self._command(CommandMessage("n", station, prism))
            case DirectCommand():
                return await self._command(CommandMessage("d", station))
            case MeasureCommand():
                return await self._measure(station)
            case _:
                raise ValueError(f"the protocol classic has no {command}")

    async def _command(self, message: CommandMessage) -> CommandResponse | None:
        for _ in range(ATTEMPTS):
            transaction = CommandTransaction(message.station, message, round(1e9 * COMMAND_TIMEOUT_S))
            await self._transport.run(transaction)
            if transaction.ok is not None:
                return CommandResponse(ok=transaction.ok)
        return None

    async def _measure(self, station: int) -> CommandResponse | None:
        transaction = SingleMeasurementPoll(station, self._timing)
        await self._transport.run(transaction)
        if transaction.message is None:
            return None
        return CommandResponse(
            ok=True,
            status=status_of(transaction.message),
            horizontal_angle_rad=transaction.message.horizontal_angle_rad,
            zenith_angle_rad=transaction.message.zenith_angle_rad,
            slope_distance_m=transaction.message.slope_distance_m,
        )


@asynccontextmanager
async def superframe_command_sender(
    radio: Radio,
    clock: Clock,
    prisms: Mapping[int, int],
    protocol: SuperframeMasterConfig,
    settings: LoRaSettings,
    key: bytes | None,
) -> AsyncGenerator[CommandSender]:
    """Run TDMA frames that carry commands.

    Measurements in the frames are not acknowledged: they are for a master.

    Parameters
    ----------
    prisms
        By station: the prism that it tracks.
    key
        Key of the mission; None: unauthenticated.
    """
    master = SuperframeMaster(
        prisms,
        superframe_timing(protocol, settings),
        Authenticator(key),
        secrets.randbits,
        clock.monotonic_ns(),
        records=False,
    )
    observer = _ResponseObserver()
    frames = asyncio.create_task(FrameLoop(radio, clock, master, observer).run())
    try:
        yield _SuperframeCommandSender(master, observer, frames)
    finally:
        frames.cancel()
        await asyncio.wait([frames])


class _ResponseObserver:
    """Waits for one response at a time and ignores all other link events."""

    def __init__(self) -> None:
        self._station = 0
        self._response: asyncio.Future[CommandResponse] | None = None

    def expect(self, station: int) -> asyncio.Future[CommandResponse]:
        self._station = station
        self._response = asyncio.get_running_loop().create_future()
        return self._response

    async def ready(self) -> None:
        pass

    def composing(self) -> None:
        pass

    def beacon_sent(self, sent: Transmission) -> None:
        pass

    def received(self, reply: ReceivedReply, packet: Packet) -> None:  # noqa: ARG002 (the interface)
        if self._response is None or self._response.done() or reply.station != self._station:
            return
        if (measured := reply.single_measurement) is not None:
            response = CommandResponse(
                ok=True,
                status=measured.status,
                horizontal_angle_rad=angle_rad(measured.horizontal),
                zenith_angle_rad=angle_rad(measured.zenith),
                slope_distance_m=distance_m(measured.distance, far=False) or 0.0,
            )
            self._response.set_result(response)
        elif reply.response is not None:
            self._response.set_result(CommandResponse(ok=reply.response.ok))

    def not_received(self, stations: Sequence[int]) -> None:
        pass


class _SuperframeCommandSender:
    def __init__(
        self, master: SuperframeMaster, observer: _ResponseObserver, frames: asyncio.Task[None]
    ) -> None:
        self._master = master
        self._observer = observer
        self._frames = frames

    async def send(self, station: int, command: Command) -> CommandResponse | None:
        self._master.station(station).submit(command)
        response = self._observer.expect(station)
        either: list[asyncio.Future[Any]] = [response, self._frames]
        await asyncio.wait(either, timeout=ATTEMPTS * COMMAND_TIMEOUT_S, return_when=asyncio.FIRST_COMPLETED)
        if self._frames.done():
            self._frames.result()
        return response.result() if response.done() else None
