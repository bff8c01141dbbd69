"""How orders for single measurements get to the stations, in either protocol, while no master runs."""

from __future__ import annotations

import asyncio
import secrets
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from tsgt.clock import UnixTimeline
from tsgt.master.classic import Collector
from tsgt.master.superframe import FrameLoop, superframe_timing
from tsgt.model import Status
from tsgt.radio import DirectOrder, MeasureOrder, TrackOrder
from tsgt.radio.classic import Command, Ordered, Shot, status_of
from tsgt.radio.classic.transactions import Timing
from tsgt.radio.superframe import SuperframeMaster
from tsgt.radio.superframe.wire import Authenticator, angle_rad, distance_m

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Mapping, Sequence

    from tsgt.clock import Clock
    from tsgt.config import ClassicMasterConfig, SuperframeMasterConfig
    from tsgt.radio import LoRaSettings, Order, Packet, Radio, Transmitted
    from tsgt.radio.superframe.reception import Heard

ORDER_TIMEOUT_S = 10.0
"""How long a change of mode may take; some instruments need seconds."""

ATTEMPTS = 3
"""How often an order is given to a station that does not answer; in frames, how many times as long it is waited for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What a station says to an order.

    Attributes
    ----------
    ok
        It has been carried out.
    status, horizontal_angle_rad, zenith_angle_rad, slope_distance_m
        Of the single measurement, raw; a distance of 0 is none.
    """

    ok: bool
    status: Status = Status.ERROR
    horizontal_angle_rad: float = 0.0
    zenith_angle_rad: float = 0.0
    slope_distance_m: float = 0.0


class Orders(Protocol):
    """Gives orders to stations, one after the other."""

    async def give(self, station: int, order: Order) -> Answer | None:
        """Give an order to track, to leave that, or to measure; return the answer, None where there is none.

        Raises
        ------
        RadioError
            The master's radio failed.
        """
        ...


class ClassicOrders:
    """Gives orders in the protocol classic.

    Parameters
    ----------
    radio
        Nobody else uses it.
    clock
        The radio's.
    protocol
        How long a station may take to answer.
    settings
        Of the modem.
    """

    def __init__(
        self, radio: Radio, clock: Clock, protocol: ClassicMasterConfig, settings: LoRaSettings
    ) -> None:
        self._timing = Timing.of(settings, round(protocol.reply_timeout_ms * 1e6))
        self._collector = Collector(radio, clock, UnixTimeline.fixed_now(clock), self._timing)

    async def give(self, station: int, order: Order) -> Answer | None:
        """See :class:`Orders`."""
        match order:
            case TrackOrder(prism):
                return await self._ordered(Command("n", station, prism))
            case DirectOrder():
                return await self._ordered(Command("d", station))
            case MeasureOrder():
                return await self._shot(station)
            case _:
                raise ValueError(f"the protocol classic has no {order}")

    async def _ordered(self, command: Command) -> Answer | None:
        for _ in range(ATTEMPTS):
            turn = Ordered(command.station, command, round(1e9 * ORDER_TIMEOUT_S))
            await self._collector.take(turn)
            if turn.ok is not None:
                return Answer(ok=turn.ok)
        return None

    async def _shot(self, station: int) -> Answer | None:
        turn = Shot(station, self._timing)
        await self._collector.take(turn)
        if turn.message is None:
            return None
        return Answer(
            ok=True,
            status=status_of(turn.message),
            horizontal_angle_rad=turn.message.horizontal_angle_rad,
            zenith_angle_rad=turn.message.zenith_angle_rad,
            slope_distance_m=turn.message.slope_distance_m,
        )


@asynccontextmanager
async def superframe_orders(
    radio: Radio,
    clock: Clock,
    prisms: Mapping[int, int],
    protocol: SuperframeMasterConfig,
    settings: LoRaSettings,
    key: bytes | None,
) -> AsyncGenerator[Orders]:
    """Run frames, in which orders can be given.

    Measurements that stations send in them are not acknowledged: a master will want them.

    Parameters
    ----------
    radio
        Nobody else uses it.
    clock
        The radio's.
    prisms
        By station: the prism that it tracks.
    protocol, settings
        As the configuration of the master says.
    key
        Of the mission; None: anybody can take part.
    """
    master = SuperframeMaster(
        prisms,
        superframe_timing(protocol, settings),
        Authenticator(key),
        secrets.randbits,
        clock.monotonic_ns(),
        records=False,
    )
    listener = _Listener()
    frames = asyncio.create_task(FrameLoop(radio, clock, master, listener).run())
    try:
        yield _SuperframeOrders(master, listener, frames)
    finally:
        frames.cancel()
        await asyncio.wait([frames])


class _Listener:
    """Waits for one answer at a time; the rest of what happens in frames is of no interest here."""

    def __init__(self) -> None:
        self._station = 0
        self._answer: asyncio.Future[Answer] | None = None

    def expect(self, station: int) -> asyncio.Future[Answer]:
        self._station = station
        self._answer = asyncio.get_running_loop().create_future()
        return self._answer

    async def ready(self) -> None:
        pass

    def composing(self) -> None:
        pass

    def beacon(self, sent: Transmitted) -> None:
        pass

    def heard(self, heard: Heard, packet: Packet) -> None:  # noqa: ARG002 (the interface)
        if self._answer is None or self._answer.done() or heard.station != self._station:
            return
        if (shot := heard.shot) is not None:
            answer = Answer(
                ok=True,
                status=shot.status,
                horizontal_angle_rad=angle_rad(shot.horizontal),
                zenith_angle_rad=angle_rad(shot.zenith),
                slope_distance_m=distance_m(shot.distance, far=False) or 0.0,
            )
            self._answer.set_result(answer)
        elif heard.answer is not None:
            self._answer.set_result(Answer(ok=heard.answer.ok))

    def silent(self, stations: Sequence[int]) -> None:
        pass


class _SuperframeOrders:
    def __init__(self, master: SuperframeMaster, listener: _Listener, frames: asyncio.Task[None]) -> None:
        self._master = master
        self._listener = listener
        self._frames = frames

    async def give(self, station: int, order: Order) -> Answer | None:
        self._master.order(station, order)
        answer = self._listener.expect(station)
        either: list[asyncio.Future[Any]] = [answer, self._frames]
        await asyncio.wait(either, timeout=ATTEMPTS * ORDER_TIMEOUT_S, return_when=asyncio.FIRST_COMPLETED)
        if self._frames.done():
            self._frames.result()
        return answer.result() if answer.done() else None
