"""Driver of the SX1276/77/78/79 (RFM95 to RFM98) on asyncio.

Three rules keep it out of trouble:

- The flags in the chip say *what* happened, an edge of DIO0 only says *when*. An edge without its flag is stale and
  ignored; a flag without its edge is found by polling, and its packet carries a wide stamp.
- Whatever touches several registers runs without an ``await`` or under one lock, so that transmissions, settings and
  recovery never interleave.
- A chip that does anything unexpected is reset and set up from the beginning. There is no second way back.
"""

from __future__ import annotations

import asyncio
import math
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.errors import RadioError, RadioSettingsError, RadioTimeoutError
from tsgt.radio.airtime import airtime_us
from tsgt.radio.base import MAX_PAYLOAD_BYTES, LoRaSettings, Packet, Transmitted
from tsgt.radio.sx127x.chip import Chip

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.radio.sx127x.hal import Edge, Hal

log = structlog.get_logger()

PREPARATION_NS = 3_000_000
"""How long before its instant a transmission is prepared and reception ends: the longest payload over a slow bus."""
TX_POLL_NS = 5_000_000
"""From the end of a packet, and again and again, until its TxDone is looked for without an edge."""
TX_TIMEOUT_NS = 50_000_000
"""From the end of a packet until its transmission has failed."""
TX_LOST_EDGE_SIGMA_NS = 1_000_000
"""One sigma of the end of a transmission that was computed from its start: what lies between stamp and antenna."""
WATCH_INTERVAL_NS = 100_000_000
"""How often the chip is checked while it receives."""
RETRY_NS = (100_000_000, 5_000_000_000)
"""Shortest and longest pause between attempts to set up a chip that does not answer."""
QUEUE_PACKETS = 64
"""How many packets wait for :meth:`SX127x.receive`; the oldest goes first."""


class State(Enum):
    """What the driver takes the chip to be doing."""

    DOWN = "down"
    RECEIVING = "receiving"
    TRANSMITTING = "transmitting"


@dataclass(slots=True)
class RadioStatistics:
    """What happened since the start.

    Attributes
    ----------
    transmitted, received
        Packets that went out, and packets that were good.
    crc_errors, no_crc
        Packets that were dropped because their CRC was wrong, or missing where the settings ask for one.
    lost_edges
        Interrupts that never came or could not be reported.
    tx_timeouts
        Transmissions whose end was never reported.
    resets
        Times that the chip was reset because of a fault.
    queue_overflows
        Packets that were dropped because nobody took them.
    """

    transmitted: int = 0
    received: int = 0
    crc_errors: int = 0
    no_crc: int = 0
    lost_edges: int = 0
    tx_timeouts: int = 0
    resets: int = 0
    queue_overflows: int = 0


class SX127x:
    """A LoRa radio (:class:`~tsgt.radio.base.Radio`) on an SX1276, 77, 78 or 79, sending from PA_BOOST.

    Parameters
    ----------
    hal
        Bus and pins; the driver closes it.
    clock
        Time; the one that the edges of the HAL are stamped with.
    allow_20_dbm
        Accept settings with 20 dBm, which the chip bears for 1 % of the time only (section 5.4.3).
    """

    def __init__(self, hal: Hal, clock: Clock, *, allow_20_dbm: bool = False) -> None:
        self._hal = hal
        self._clock = clock
        self._allow_20_dbm = allow_20_dbm
        self._lock = asyncio.Lock()
        self._packets: asyncio.Queue[Packet] = asyncio.Queue(QUEUE_PACKETS)
        self._watcher: asyncio.Task[NoReturn] | None = None
        self._settings: LoRaSettings
        self._chip: Chip
        self._state = State.DOWN
        self._problem = "it has not been started"
        self._retry_ns = RETRY_NS[0]
        self._shortest_packet_ns = 0
        self._flags_clear_at_ns = 0
        self._tx_started_at_ns = 0
        self._tx_edge: asyncio.Future[Edge] | None = None
        self.statistics = RadioStatistics()

    @property
    def state(self) -> State:
        """What the chip is doing at this moment."""
        return self._state

    async def start(self, settings: LoRaSettings) -> None:
        """Reset and set up the chip, and receive from then on.

        Raises
        ------
        RadioNotFoundError
            No SX1276/77/78/79 answers.
        RadioSettingsError
            20 dBm without ``allow_20_dbm``.
        RadioError
            A register does not keep its value.
        """
        await self.configure(settings)
        self._hal.on_dio0(self._on_edge)
        self._watcher = asyncio.create_task(self._watch(), name="sx127x-watch")

    async def configure(self, settings: LoRaSettings) -> None:
        """Reset the chip and set it up anew; a packet that is being received is lost. See :meth:`start`."""
        if settings.power_dbm == 20 and not self._allow_20_dbm:
            raise RadioSettingsError(
                "power_dbm 20 harms the radio above 1 % duty cycle: use 17, or allow 20 dBm explicitly"
            )
        async with self._lock:
            self._settings = settings
            self._chip = Chip(self._hal, self._clock, settings)
            self._shortest_packet_ns = self._airtime_ns(1)
            try:
                await self._set_up()
            except RadioError as error:
                self._problem = str(error)
                raise

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmitted:
        """Send one packet; see :meth:`tsgt.radio.base.Radio.transmit`."""
        if not 1 <= len(payload) <= MAX_PAYLOAD_BYTES:
            raise RadioSettingsError(f"a payload has 1 to {MAX_PAYLOAD_BYTES} bytes, got {len(payload)}")
        if at_ns is not None:
            await self._clock.sleep_until(at_ns - PREPARATION_NS)
        async with self._lock:
            if self._state is State.DOWN:
                raise RadioError(f"nothing was sent, the radio is down: {self._problem}")
            try:
                await self._prepare(payload)
                if at_ns is not None:
                    await self._clock.sleep_until(at_ns)
                transmitted = await self._send(self._airtime_ns(len(payload)))
            except RadioError as error:
                self._fail(str(error))
                raise
            finally:
                self._receive_again()
            if transmitted is None:
                self.statistics.tx_timeouts += 1
                self._fail(f"no TxDone {TX_TIMEOUT_NS // 1_000_000} ms after the end of a packet")
                await self._recover()
                raise RadioTimeoutError(
                    f"the radio did not report the end of a packet of {len(payload)} bytes and was reset: "
                    "check its supply, which must bear 120 mA"
                )
            self.statistics.transmitted += 1
            return transmitted

    async def receive(self) -> Packet:
        """Return the oldest packet that waits, or the next one to arrive."""
        return await self._packets.get()

    async def close(self) -> None:
        """Put the chip to sleep and let go of bus and pins; waits for the end of a running transmission."""
        if self._watcher is not None:
            self._watcher.cancel()
            await asyncio.wait([self._watcher])
        async with self._lock:
            if self._state is not State.DOWN:
                self._state = State.DOWN
                self._problem = "it has been closed"
                with suppress(RadioError):  # it is let go anyway
                    self._chip.sleep()
            self._hal.close()

    async def _set_up(self) -> None:
        """Take the chip from whatever state it is in to reception; on an error it stays DOWN."""
        self._state = State.DOWN
        await self._chip.set_up()
        self._flags_clear_at_ns = self._clock.monotonic_ns()
        self._retry_ns = RETRY_NS[0]
        self._state = State.RECEIVING

    # --- Transmission -----------------------------------------------------------------------------------------

    async def _prepare(self, payload: bytes) -> None:
        self._chip.enter_standby()
        # A packet may have ended just before; its edge is on its way and its bytes are still in the FIFO.
        await self._let_edges_in()
        self._collect(None)
        self._state = State.TRANSMITTING
        self._chip.load(payload)

    async def _send(self, airtime_ns: int) -> Transmitted | None:
        """Start the prepared packet and wait for its end; None if that is not reported."""
        self._tx_edge = asyncio.get_running_loop().create_future()
        self._tx_started_at_ns = started_at_ns = self._clock.monotonic_ns()
        self._chip.send()
        due_ns = started_at_ns + airtime_ns
        for poll_at_ns in range(due_ns + TX_POLL_NS, due_ns + TX_TIMEOUT_NS + 1, TX_POLL_NS):
            timeout_s = max(0, poll_at_ns - self._clock.monotonic_ns()) / 1e9
            await asyncio.wait([self._tx_edge], timeout=timeout_s)
            if self._tx_edge.done():
                edge = self._tx_edge.result()
                return Transmitted(
                    started_at_ns=started_at_ns,
                    done_at_ns=edge.at_ns,
                    stamp_sigma_ns=self._hal.stamp_sigma_ns,
                )
            if self._chip.packet_sent():
                self._count_lost_edges(1)
                return Transmitted(
                    started_at_ns=started_at_ns, done_at_ns=due_ns, stamp_sigma_ns=TX_LOST_EDGE_SIGMA_NS
                )
        return None

    def _end_transmission(self, edge: Edge) -> None:
        ended = self._tx_edge
        if ended is None or ended.done() or edge.at_ns < self._tx_started_at_ns:
            return
        if self._chip.packet_sent():
            ended.set_result(edge)

    def _receive_again(self) -> None:
        """Enter reception after a transmission, whatever became of it, unless the chip waits for a reset."""
        if self._state is State.DOWN:
            return
        try:
            self._flags_clear_at_ns = self._clock.monotonic_ns()
            self._chip.enter_reception()
        except RadioError as error:
            self._fail(str(error))
        else:
            self._state = State.RECEIVING

    # --- Reception --------------------------------------------------------------------------------------------

    def _on_edge(self, edge: Edge) -> None:
        if edge.lost:
            self._count_lost_edges(edge.lost)
        try:
            if self._state is State.RECEIVING:
                self._collect(edge)
            elif self._state is State.TRANSMITTING:
                self._end_transmission(edge)
        except RadioError as error:
            self._fail(str(error))

    def _collect(self, edge: Edge | None) -> None:
        """Take the packet that waits in the chip, if there is one."""
        now_ns = self._clock.monotonic_ns()
        arrival = self._chip.take_packet()
        if arrival is None:
            return
        stamp_ns, stamp_sigma_ns = self._stamp(edge, now_ns)
        self._flags_clear_at_ns = now_ns
        if edge is None:
            self._count_lost_edges(1)
        if arrival.crc_wrong:
            self.statistics.crc_errors += 1
        elif self._settings.crc and not arrival.has_crc:
            self.statistics.no_crc += 1
        else:
            self._deliver(
                Packet(
                    payload=arrival.payload,
                    rssi_dbm=arrival.rssi_dbm,
                    snr_db=arrival.snr_db,
                    received_at_ns=stamp_ns,
                    stamp_sigma_ns=stamp_sigma_ns,
                )
            )

    def _stamp(self, edge: Edge | None, now_ns: int) -> tuple[int, int]:
        """Tell when the packet ended that was in the chip now, and one sigma of it, in ns."""
        if edge is not None and now_ns - edge.at_ns < self._shortest_packet_ns:
            return edge.at_ns, self._hal.stamp_sigma_ns
        # Since an older edge another packet may have replaced the first, without one of its own.
        earliest_ns = self._flags_clear_at_ns if edge is None else edge.at_ns
        return (earliest_ns + now_ns) // 2, round((now_ns - earliest_ns) / math.sqrt(12))

    def _deliver(self, packet: Packet) -> None:
        self.statistics.received += 1
        if self._packets.full():
            self._packets.get_nowait()
            self.statistics.queue_overflows += 1
            log.warning("radio_queue_overflow", dropped=self.statistics.queue_overflows)
        self._packets.put_nowait(packet)

    # --- Watching over the chip -------------------------------------------------------------------------------

    async def _watch(self) -> NoReturn:
        while True:
            await self._pause(self._retry_ns if self._state is State.DOWN else WATCH_INTERVAL_NS)
            async with self._lock:
                if self._state is State.DOWN:
                    await self._recover()
                    continue
                try:
                    await self._check()
                except RadioError as error:
                    self._fail(str(error))
                    await self._recover()

    async def _check(self) -> None:
        self._chip.check_reception()
        looked_at_ns = self._clock.monotonic_ns()
        if self._chip.packet_waits():
            await self._let_edges_in()
            self._collect(None)
        else:
            self._flags_clear_at_ns = looked_at_ns

    def _fail(self, problem: str) -> None:
        """Take the chip as lost until it has been set up again."""
        if self._state is not State.DOWN:
            log.warning("radio_fault", problem=problem)
        self._state = State.DOWN
        self._problem = problem

    async def _recover(self) -> None:
        """Reset the chip and set it up again, once; the watch does so again if it fails."""
        self.statistics.resets += 1
        try:
            await self._set_up()
        except RadioError as error:
            if self._retry_ns == RETRY_NS[0]:
                log.error("radio_unreachable", error=str(error))  # noqa: TRY400 (the message says it all)
            self._problem = str(error)
            self._retry_ns = min(2 * self._retry_ns, RETRY_NS[1])
        else:
            log.info("radio_recovered", resets=self.statistics.resets)

    # --- Small things -----------------------------------------------------------------------------------------

    def _count_lost_edges(self, count: int) -> None:
        self.statistics.lost_edges += count
        log.warning("radio_edge_lost", lost=count, state=self._state.value)

    async def _let_edges_in(self) -> None:
        """Let the event loop hand over the edges that have been seen: one round to poll, one to call back."""
        await asyncio.sleep(0)
        await asyncio.sleep(0)

    def _airtime_ns(self, payload_bytes: int) -> int:
        settings = self._settings
        return 1000 * airtime_us(
            payload_bytes,
            spreading_factor=settings.spreading_factor,
            bandwidth_hz=settings.bandwidth_hz,
            coding_rate=settings.coding_rate,
            preamble_symbols=settings.preamble_symbols,
            crc=settings.crc,
            low_data_rate=settings.low_data_rate,
        )

    async def _pause(self, duration_ns: int) -> None:
        await self._clock.sleep_until(self._clock.monotonic_ns() + duration_ns)
