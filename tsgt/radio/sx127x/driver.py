"""Driver of the SX1276/77/78/79 (RFM95 to RFM98) on asyncio.

The flags in the chip state *what* happened, an edge of DIO0 only *when*: without its flag it is ignored; a flag without its
edge is found by polling, and its timestamp has a large sigma. Access to several registers runs without an ``await`` or
under one lock. A chip that does anything unexpected is reset and set up from the beginning: there is no other recovery. When that
fails for seconds, who receives gets the error, to open bus and pins again.
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
from tsgt.radio.base import MAX_PAYLOAD_BYTES, LoRaSettings, Packet, Transmission
from tsgt.radio.sx127x.chip import Chip

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.radio.sx127x.hal import Edge, Hal

log = structlog.get_logger()

PREPARATION_NS = 3_000_000
"""Time before its start at which a transmission is prepared and reception ends: the longest payload over a slow bus."""
TX_POLL_NS = 5_000_000  # interval at which TxDone is polled after the end of a packet, without an edge
TX_TIMEOUT_NS = 50_000_000  # timeout from the end of a packet to its TxDone
TX_LOST_EDGE_SIGMA_NS = 1_000_000
"""One sigma of an end of transmission that is computed from the timestamp of its start."""
CHECK_INTERVAL_NS = 100_000_000  # interval of the checks of a receiving chip
INITIAL_RETRY_DELAY_NS = 100_000_000
MAX_RETRY_DELAY_NS = 5_000_000_000
"""Delay between attempts to set up a chip that does not respond; it doubles after each."""
QUEUE_CAPACITY = 64  # packets queued for :meth:`SX127x.receive`; an overflow drops the oldest


class State(Enum):
    """State of the chip."""

    DOWN = "down"
    RECEIVING = "receiving"
    TRANSMITTING = "transmitting"


@dataclass(slots=True)
class RadioStatistics:
    """Counters since the start.

    Attributes
    ----------
    crc_errors, no_crc
        Packets dropped because their CRC was wrong, or missing though the settings require one.
    lost_edges
        Interrupts that were missed or could not be reported.
    queue_overflows
        Packets dropped from a full queue.
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
        The driver closes it.
    clock
        The clock of the HAL's edges.
    allow_20_dbm
        Accept 20 dBm, which the chip allows at 1 % duty cycle only (section 5.4.3).
    """

    def __init__(self, hal: Hal, clock: Clock, *, allow_20_dbm: bool = False) -> None:
        self._hal = hal
        self._clock = clock
        self._allow_20_dbm = allow_20_dbm
        self._lock = asyncio.Lock()
        self._packets: asyncio.Queue[Packet | RadioError] = asyncio.Queue(QUEUE_CAPACITY)
        self._supervisor: asyncio.Task[NoReturn] | None = None
        self._settings: LoRaSettings
        self._chip: Chip
        self._state = State.DOWN
        self._problem = "not started"
        self._retry_delay_ns = INITIAL_RETRY_DELAY_NS
        self._min_packet_ns = 0
        self._flags_clear_at_ns = 0
        self._tx_started_at_ns = 0
        self._tx_edge: asyncio.Future[Edge] | None = None
        self.statistics = RadioStatistics()

    @property
    def state(self) -> State:
        """State of the chip."""
        return self._state

    async def start(self, settings: LoRaSettings) -> None:
        """Reset and set up the chip, and start receiving.

        Raises
        ------
        RadioNotFoundError
            No SX1276/77/78/79 responds.
        RadioSettingsError
            20 dBm without ``allow_20_dbm``.
        RadioError
            A register does not read back as written.
        """
        await self.configure(settings)
        self._hal.on_dio0(self._on_edge)
        self._supervisor = asyncio.create_task(self._supervise(), name="sx127x-supervisor")

    async def configure(self, settings: LoRaSettings) -> None:
        """Reset the chip and set it up again; a packet that is being received is lost. See :meth:`start`."""
        if settings.power_dbm == 20 and not self._allow_20_dbm:
            raise RadioSettingsError(
                "power_dbm 20 harms the radio above 1 % duty cycle: use 17, or allow 20 dBm explicitly"
            )
        async with self._lock:
            self._settings = settings
            self._chip = Chip(self._hal, self._clock, settings)
            self._min_packet_ns = settings.airtime_ns(1)
            try:
                await self._set_up()
            except RadioError as error:
                self._problem = str(error)
                raise

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmission:
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
                transmitted = await self._send(self._settings.airtime_ns(len(payload)))
            except RadioError as error:
                self._fail(str(error))
                raise
            finally:
                self._resume_reception()
            if transmitted is None:
                self.statistics.tx_timeouts += 1
                self._fail(f"no TxDone within {TX_TIMEOUT_NS // 1_000_000} ms after the end of a packet")
                await self._recover()
                raise RadioTimeoutError(
                    f"the radio did not report the end of a packet of {len(payload)} bytes and was reset: "
                    "check its supply, which must deliver 120 mA"
                )
            self.statistics.transmitted += 1
            return transmitted

    async def receive(self) -> Packet:
        """See :meth:`tsgt.radio.base.Radio.receive`; raises RadioError once the chip cannot be set up again for long."""
        while True:
            received = await self._packets.get()
            if isinstance(received, Packet):
                return received
            if self._state is State.DOWN:
                raise received

    async def close(self) -> None:
        """Put the chip to sleep and release bus and pins, after the end of a running transmission.

        Cancelled, it releases them at once: they can be opened again.
        """
        try:
            if self._supervisor is not None:
                self._supervisor.cancel()
                await asyncio.wait([self._supervisor])
            async with self._lock:
                if self._state is not State.DOWN:
                    with suppress(RadioError):  # it is released anyway
                        self._chip.sleep()
        finally:
            if self._state is not State.DOWN:
                self._state = State.DOWN
                self._problem = "closed"
            self._hal.close()

    async def _set_up(self) -> None:
        """Take the chip from any state to reception; on an error it stays DOWN."""
        self._state = State.DOWN
        await self._chip.set_up()
        self._flags_clear_at_ns = self._clock.monotonic_ns()
        self._retry_delay_ns = INITIAL_RETRY_DELAY_NS
        self._state = State.RECEIVING

    # --- Transmission -----------------------------------------------------------------------------------------

    async def _prepare(self, payload: bytes) -> None:
        self._chip.enter_standby()
        # A packet may have ended just before: its edge is pending, and its bytes are still in the FIFO.
        await self._process_pending_edges()
        self._collect(None)
        self._state = State.TRANSMITTING
        self._chip.load(payload)

    async def _send(self, airtime_ns: int) -> Transmission | None:
        """Send the loaded packet and wait for its end; None if it is not reported."""
        self._tx_edge = asyncio.get_running_loop().create_future()
        self._tx_started_at_ns = started_at_ns = self._clock.monotonic_ns()
        self._chip.send()
        due_ns = started_at_ns + airtime_ns
        for poll_at_ns in range(due_ns + TX_POLL_NS, due_ns + TX_TIMEOUT_NS + 1, TX_POLL_NS):
            timeout_s = max(0, poll_at_ns - self._clock.monotonic_ns()) / 1e9
            await asyncio.wait([self._tx_edge], timeout=timeout_s)
            if not self._tx_edge.done():  # After the event loop did other things, the edge may be pending.
                await self._process_pending_edges()
            if self._tx_edge.done():
                edge = self._tx_edge.result()
                return Transmission(
                    started_at_ns=started_at_ns,
                    done_at_ns=edge.at_ns,
                    stamp_sigma_ns=self._hal.stamp_sigma_ns,
                )
            if self._chip.packet_sent():
                self._count_lost_edges(1)
                return Transmission(
                    started_at_ns=started_at_ns, done_at_ns=due_ns, stamp_sigma_ns=TX_LOST_EDGE_SIGMA_NS
                )
        return None

    def _end_transmission(self, edge: Edge) -> None:
        ended = self._tx_edge
        if ended is None or ended.done() or edge.at_ns < self._tx_started_at_ns:
            return
        if self._chip.packet_sent():
            ended.set_result(edge)

    def _resume_reception(self) -> None:
        """Enter reception after a transmission, successful or not, unless the chip is DOWN."""
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
        """Read the packet in the chip, if there is one."""
        now_ns = self._clock.monotonic_ns()
        raw = self._chip.read_packet()
        if raw is None:
            return
        stamp_ns, stamp_sigma_ns = self._timestamp(edge, now_ns)
        self._flags_clear_at_ns = now_ns
        if edge is None:
            self._count_lost_edges(1)
        if raw.crc_error:
            self.statistics.crc_errors += 1
        elif self._settings.crc and not raw.has_crc:
            self.statistics.no_crc += 1
        else:
            self._deliver(
                Packet(
                    payload=raw.payload,
                    rssi_dbm=raw.rssi_dbm,
                    snr_db=raw.snr_db,
                    received_at_ns=stamp_ns,
                    stamp_sigma_ns=stamp_sigma_ns,
                )
            )

    def _timestamp(self, edge: Edge | None, now_ns: int) -> tuple[int, int]:
        """Return the end of the packet in the chip, and one sigma of it."""
        if edge is not None and now_ns - edge.at_ns < self._min_packet_ns:
            return edge.at_ns, self._hal.stamp_sigma_ns
        # After an older edge, another packet without an edge may have replaced the first.
        earliest_ns = self._flags_clear_at_ns if edge is None else edge.at_ns
        return (earliest_ns + now_ns) // 2, round((now_ns - earliest_ns) / math.sqrt(12))

    def _deliver(self, packet: Packet) -> None:
        self.statistics.received += 1
        self._queue(packet)

    def _queue(self, received: Packet | RadioError) -> None:
        if self._packets.full():
            self._packets.get_nowait()
            self.statistics.queue_overflows += 1
            log.warning("radio_queue_overflow", dropped=self.statistics.queue_overflows)
        self._packets.put_nowait(received)

    # --- Supervision ------------------------------------------------------------------------------------------

    async def _supervise(self) -> NoReturn:
        while True:
            await self._pause(self._retry_delay_ns if self._state is State.DOWN else CHECK_INTERVAL_NS)
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
        checked_at_ns = self._clock.monotonic_ns()
        if self._chip.packet_received():
            await self._process_pending_edges()
            self._collect(None)
        else:
            self._flags_clear_at_ns = checked_at_ns

    def _fail(self, problem: str) -> None:
        """Mark the chip as DOWN until it is set up again."""
        if self._state is not State.DOWN:
            log.warning("radio_fault", problem=problem)
        self._state = State.DOWN
        self._problem = problem

    async def _recover(self) -> None:
        """Reset and set up the chip once; the supervision retries after a failure."""
        self.statistics.resets += 1
        try:
            await self._set_up()
        except RadioError as error:
            if self._retry_delay_ns == INITIAL_RETRY_DELAY_NS:
                log.error("radio_unreachable", error=str(error))  # noqa: TRY400 (the message is complete)
            self._problem = str(error)
            longer_ns = min(2 * self._retry_delay_ns, MAX_RETRY_DELAY_NS)
            if self._retry_delay_ns < longer_ns == MAX_RETRY_DELAY_NS:
                # Bus or pins may be what fails: who receives opens them again.
                self._queue(error)
            self._retry_delay_ns = longer_ns
        else:
            log.info("radio_recovered", resets=self.statistics.resets)

    # --- Helpers ----------------------------------------------------------------------------------------------

    def _count_lost_edges(self, count: int) -> None:
        self.statistics.lost_edges += count
        log.warning("radio_edge_lost", lost=count, state=self._state.value)

    async def _process_pending_edges(self) -> None:
        """Let the event loop deliver detected edges: one iteration to poll, one for the callbacks."""
        await asyncio.sleep(0)
        await asyncio.sleep(0)

    async def _pause(self, duration_ns: int) -> None:
        await self._clock.sleep_until(self._clock.monotonic_ns() + duration_ns)
