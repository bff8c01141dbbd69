from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.hardware.radios import MS, PAPER, Bench, bench, make_side, running_timeline
from structlog.testing import capture_logs

from tsgt.errors import RadioError, RadioNotFoundError, RadioTimeoutError
from tsgt.radio.sx127x import Edge, Register, SX127x
from tsgt.radio.sx127x.driver import MAX_RETRY_DELAY_NS, State
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.lora import Air, LinkModel

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from tsgt.radio.sx127x import EdgeCallback


def new_air() -> Air:
    """Make an air on the running test's time."""
    return Air(running_timeline(), np.random.default_rng(0), LinkModel())


async def wait_ms(b: Bench, duration_ms: float) -> None:
    """Wait in virtual time."""
    await b.clock.sleep_until(b.clock.monotonic_ns() + round(duration_ms * MS))


async def assert_both_ways(b: Bench) -> None:
    """Packets pass in both directions."""
    for sender, receiver in ((b.here, b.there), (b.there, b.here)):
        await sender.radio.transmit(b"still there")
        async with asyncio.timeout(1):
            assert (await receiver.radio.receive()).payload == b"still there"


class FixedRegisters:
    """A chip of which only some registers answer, always the same."""

    stamp_sigma_ns = 0

    def __init__(self, **values: int) -> None:
        self._values = {Register[name]: value for name, value in values.items()}

    def transfer(self, data: bytes) -> bytes:
        """Answer with the fixed values."""
        return bytes([0, *(self._values.get(Register(data[0] & 0x7F), 0) for _ in data[1:])])

    def set_reset(self, *, low: bool) -> None:
        """Stay as it is."""

    def dio0(self) -> bool:
        """Low."""
        return False

    def on_dio0(self, callback: EdgeCallback) -> None:
        """Never call back."""

    def close(self) -> None:
        """Do nothing."""


# --- Start --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [False, True])
async def test_missing_chip_fails_the_start(level: bool) -> None:  # noqa: FBT001 (a parameter)
    """A bus without a response, 0x00 or 0xFF, ends the start with what to check."""
    side = make_side(new_air(), "here")
    side.chip.disconnect_bus(level)
    with pytest.raises(RadioNotFoundError, match=r"wiring, the NSS pin .* overlay"):
        await side.radio.start(PAPER)
    await side.radio.close()


async def test_sx1272_is_rejected_by_name() -> None:
    """The predecessor, whose registers differ, is recognised and named."""
    radio = SX127x(FixedRegisters(VERSION=0x22), VirtualClock(0))
    with pytest.raises(RadioNotFoundError, match="SX1272"):
        await radio.start(PAPER)


async def test_unknown_version_is_rejected() -> None:
    """Any other version is reported as read."""
    radio = SX127x(FixedRegisters(VERSION=0x40), VirtualClock(0))
    with pytest.raises(RadioNotFoundError, match="0x40"):
        await radio.start(PAPER)


@pytest.mark.parametrize("version", [0x11, 0x13])
async def test_undocumented_versions_are_accepted_and_logged(version: int) -> None:
    """Versions of some RFM9x modules are accepted with a log event."""
    radio = SX127x(FixedRegisters(VERSION=version), VirtualClock(0))
    with capture_logs() as logs, pytest.raises(RadioError, match="OP_MODE"):
        await radio.start(PAPER)
    assert logs == [{"event": "radio_version_unusual", "log_level": "info", "version": version}]


async def test_register_mismatch_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the register, the written and the read value."""
    side = make_side(new_air(), "here")
    transfer = side.chip.transfer

    def stuck(data: bytes) -> bytes:
        if data[0] == 0x80 | Register.SYNC_WORD:
            data = bytes([data[0], data[1] & 0xFE])
        return transfer(data)

    monkeypatch.setattr(side.chip, "transfer", stuck)
    with pytest.raises(RadioError, match=r"SYNC_WORD \(0x39\) reads 0x34 where 0x35 was written"):
        await side.radio.start(replace(PAPER, sync_word=0x35))
    await side.radio.close()


# --- Lost edges ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("counted", [False, True])
async def test_packet_without_edge_is_found_by_polling(counted: bool) -> None:  # noqa: FBT001 (a parameter)
    """A packet whose edge is lost is found within 100 ms, and its sigma covers the true time."""
    async with bench() as b:
        await wait_ms(b, 1000)
        b.there.hal.drop_edges(1, counted=counted)
        sent = await b.here.radio.transmit(b"hello")
        packet = await b.there.radio.receive()
        truth_ns = sent.done_at_ns + 0.76 * 2_048_000 - 67_000
        assert b.clock.monotonic_ns() - truth_ns <= 101 * MS
        assert abs(packet.received_at_ns - truth_ns) <= 1.8 * packet.stamp_sigma_ns
        assert packet.stamp_sigma_ns <= 30 * MS
        assert b.there.radio.statistics.lost_edges == 1
        await assert_both_ways(b)


async def test_disconnected_dio0_degrades_timestamps_only() -> None:
    """Without any edges packets still arrive, each is counted, and no sigma exceeds the polling interval."""
    async with bench() as b:
        b.here.hal.drop_edges(1000, counted=False)
        b.there.hal.drop_edges(1000, counted=False)
        for _ in range(10):
            await b.here.radio.transmit(b"hello")
            assert (await b.there.radio.receive()).stamp_sigma_ns <= 30 * MS
        assert b.here.radio.statistics.lost_edges == b.there.radio.statistics.lost_edges == 10
        assert b.here.radio.statistics.tx_timeouts == 0


async def test_pending_edge_is_not_lost() -> None:
    """A check of the chip between an interrupt and its handling waits for the edge."""
    async with bench() as b:
        await b.there.radio.transmit(b"hello")
        b.timeline.advance(2 * MS)  # RxDone, while the event loop does other things
        await b.here.radio._check()
        assert (await b.here.radio.receive()).stamp_sigma_ns == b.here.hal.stamp_sigma_ns
        assert b.here.radio.statistics.lost_edges == 0


async def test_transmission_without_edge_is_found_by_polling() -> None:
    """A TxDone without edge is found a few ms later; its timestamp is computed, with a larger sigma."""
    async with bench() as b:
        b.here.hal.drop_edges(1, counted=False)
        sent = await b.here.radio.transmit(bytes(34))
        assert b.clock.monotonic_ns() - sent.done_at_ns <= 6 * MS
        true_done_ns = sent.started_at_ns + 139_776_000 + 247_000
        assert abs(sent.done_at_ns - true_done_ns) <= sent.stamp_sigma_ns
        assert b.here.radio.statistics.lost_edges == 1
        assert b.here.radio.statistics.transmitted == 1


async def test_edge_of_a_transmission_is_taken_before_the_poll(monkeypatch: pytest.MonkeyPatch) -> None:
    """When the event loop was busy at the end of a packet, its timestamp is the edge's, not a computed one."""
    async with bench() as b:
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await wait_ms(b, 50)
        edges: list[Edge] = []
        deliver = b.here.radio._on_edge
        b.here.hal.on_dio0(edges.append)
        monkeypatch.setattr(b.here.radio, "_process_pending_edges", delivering(edges, deliver))
        assert (await sending).stamp_sigma_ns == b.here.hal.stamp_sigma_ns
        assert b.here.radio.statistics.lost_edges == 0


def delivering(edges: list[Edge], deliver: Callable[[Edge], None]) -> Callable[[], Awaitable[None]]:
    """Hold edges back until pending ones are asked for."""

    async def process() -> None:
        while edges:
            deliver(edges.pop(0))

    return process


async def test_edges_that_the_kernel_dropped_are_counted() -> None:
    """Edges that the HAL reports as lost appear in the statistics and in the log."""
    async with bench() as b:
        with capture_logs() as logs:
            b.here.radio._on_edge(Edge(0, lost=3))
        assert b.here.radio.statistics.lost_edges == 3
        assert logs == [{"event": "radio_edge_lost", "log_level": "warning", "lost": 3, "state": "receiving"}]


async def test_stale_edge_is_ignored() -> None:
    """An edge without its flag changes nothing in any state."""
    async with bench() as b:
        b.here.radio._on_edge(Edge(b.clock.monotonic_ns()))
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await wait_ms(b, 50)
        b.here.radio._on_edge(Edge(b.clock.monotonic_ns()))
        sent = await sending
        assert sent.done_at_ns - sent.started_at_ns > 139 * MS
        assert b.here.radio.statistics.received == 0


async def test_stale_edge_does_not_timestamp_a_transmission() -> None:
    """An edge from before a transmission, delivered after its end, is not taken for its TxDone."""
    async with bench() as b:
        b.here.hal.drop_edges(1, counted=False)
        start_ns = b.clock.monotonic_ns()
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await wait_ms(b, 141)
        assert b.here.chip.dio(0)
        b.here.radio._on_edge(Edge(start_ns - 1))
        assert (await sending).done_at_ns > start_ns


async def test_late_edge_gives_a_large_sigma() -> None:
    """When a host was away for longer than a packet, a second one may stand in the place of the first.

    Its stamp must then not claim the first one's edge.
    """
    async with bench() as b:
        b.there.hal.drop_edges(1, counted=False)
        async with b.there.radio._lock:  # the watch is part of the host that is away
            first = await b.here.radio.transmit(b"first")
            sent = await b.here.radio.transmit(b"second")
            await wait_ms(b, 5)
            b.there.radio._on_edge(Edge(first.done_at_ns + 1_490_000))
        packet = await b.there.radio.receive()
        truth_ns = sent.done_at_ns + 0.76 * 2_048_000 - 67_000
        assert packet.payload == b"second"
        assert packet.stamp_sigma_ns > 10 * MS
        assert abs(packet.received_at_ns - truth_ns) <= 1.8 * packet.stamp_sigma_ns


# --- Faults of the chip -------------------------------------------------------------------------------------------


async def test_transmission_without_tx_done_resets_the_chip() -> None:
    """The call fails 50 ms after the packet's end; the radio is reset and works again at once."""
    async with bench() as b:
        b.here.chip.drop_tx_done()
        start_ns = b.clock.monotonic_ns()
        with capture_logs() as logs, pytest.raises(RadioTimeoutError, match="34 bytes"):
            await b.here.radio.transmit(bytes(34))
        assert b.clock.monotonic_ns() - start_ns <= (140 + 50 + 20) * MS
        assert b.here.radio.statistics.tx_timeouts == 1
        assert b.here.radio.statistics.resets == 1
        assert [entry["event"] for entry in logs] == ["radio_fault", "radio_recovered"]
        await b.there.radio.receive()
        await assert_both_ways(b)


async def test_radio_timeout_is_a_timeout_error() -> None:
    """Callers can catch the built-in TimeoutError."""
    assert issubclass(RadioTimeoutError, TimeoutError)


async def test_chip_that_resets_itself_is_set_up_again() -> None:
    """After a supply dip the radio works again within 100 ms and the time of a reset."""
    async with bench() as b:
        b.here.chip.power_on_reset()
        await wait_ms(b, 120)
        assert b.here.radio.statistics.resets == 1
        await assert_both_ways(b)


async def test_chip_that_resets_itself_while_sending_is_set_up_again() -> None:
    """A reset during a transmission fails that call and none after it."""
    async with bench() as b:
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await wait_ms(b, 50)
        b.here.chip.power_on_reset()
        with pytest.raises(RadioTimeoutError):
            await sending
        await assert_both_ways(b)


async def test_chip_that_hangs_while_receiving_is_reset() -> None:
    """A chip with frozen registers reads correctly; the write check detects it."""
    async with bench() as b:
        b.here.chip.hang()
        await wait_ms(b, 120)
        assert b.here.radio.statistics.resets == 1
        await assert_both_ways(b)


async def test_chip_that_hangs_while_sending_is_reset() -> None:
    """A chip that freezes in TX fails that call and none after it."""
    async with bench() as b:
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await wait_ms(b, 50)
        b.here.chip.hang()
        with pytest.raises(RadioTimeoutError):
            await sending
        await assert_both_ways(b)


async def test_chip_that_hangs_with_a_packet_is_reset() -> None:
    """A packet that cannot be removed from the chip is a fault, not a stream of packets."""
    async with bench() as b:
        b.there.hal.drop_edges(1, counted=False)
        await b.here.radio.transmit(b"hello")
        await wait_ms(b, 2)
        assert b.there.chip.dio(0)
        b.there.chip.hang()
        await wait_ms(b, 120)
        assert b.there.radio.statistics.received == 0
        assert b.there.radio.statistics.resets == 1
        await assert_both_ways(b)


async def test_changed_sync_word_is_detected() -> None:
    """A chip that kept its mode but not its settings is set up again."""
    async with bench() as b:
        b.here.chip.transfer(bytes([0x80 | Register.SYNC_WORD, 0x12]))
        await wait_ms(b, 120)
        assert b.here.radio.statistics.resets == 1
        await assert_both_ways(b)


async def test_missing_chip_delivers_no_packets() -> None:
    """An open line reads as all flags set, which is no packet with a CRC error."""
    async with bench() as b:
        b.here.chip.disconnect_bus(level=True)
        b.here.radio._on_edge(Edge(b.clock.monotonic_ns()))
        with pytest.raises(RadioError):
            await b.here.radio.transmit(b"hello")
        assert b.here.radio.statistics.crc_errors == b.here.radio.statistics.received == 0


@pytest.mark.parametrize("level", [False, True])
async def test_radio_recovers_with_the_bus(level: bool) -> None:  # noqa: FBT001 (a parameter)
    """While the bus is lost, sending fails with the reason; the radio recovers with the bus."""
    async with bench() as b:
        with capture_logs() as logs:
            b.here.chip.disconnect_bus(level)
            await wait_ms(b, 60_000)
            with pytest.raises(RadioError, match="the radio is down: no radio responds"):
                await b.here.radio.transmit(b"hello")
            b.here.chip.reconnect_bus()
            await wait_ms(b, MAX_RETRY_DELAY_NS / MS + 100)
        assert [entry["event"] for entry in logs] == ["radio_fault", "radio_unreachable", "radio_recovered"]
        assert b.here.radio.statistics.resets < 30
        assert b.here.radio.statistics.received == 0
        await assert_both_ways(b)


@pytest.mark.parametrize("level", [False, True])
async def test_radio_recovers_from_a_bus_lost_while_sending(level: bool) -> None:  # noqa: FBT001 (a parameter)
    """A bus lost during a transmission fails that call; the radio recovers with the bus."""
    async with bench() as b:
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await wait_ms(b, 50)
        b.here.chip.disconnect_bus(level)
        with pytest.raises(RadioTimeoutError):
            await sending
        assert b.here.radio.state is State.DOWN
        b.here.chip.reconnect_bus()
        await wait_ms(b, 500)
        await b.there.radio.receive()
        await assert_both_ways(b)


async def test_radio_recovers_from_bus_errors() -> None:
    """An operating system error of the bus, in an interrupt or in the supervision, ends neither."""
    async with bench() as b:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(b.there.chip, "transfer", failing_transfer)
            await b.here.radio.transmit(b"hello")
            await wait_ms(b, 1000)
            with pytest.raises(RadioError, match="transfer failed"):
                await b.there.radio.transmit(b"hello")
        await wait_ms(b, MAX_RETRY_DELAY_NS / MS)
        await assert_both_ways(b)


def failing_transfer(_data: bytes) -> bytes:
    """Fail as the bus of a Pi would."""
    raise RadioError("/dev/spidev0.0: transfer failed")


async def test_radio_that_stays_down_ends_the_wait_for_a_packet() -> None:
    """Who only receives is told, and can open bus and pins again."""
    async with bench() as b:
        receiving = asyncio.create_task(b.here.radio.receive())
        b.here.chip.disconnect_bus(level=True)
        await wait_ms(b, 3_000)
        assert not receiving.done()
        await wait_ms(b, 10_000)
        assert receiving.done()
        with pytest.raises(RadioError, match="no radio responds"):
            await receiving
        b.here.chip.reconnect_bus()
        await wait_ms(b, MAX_RETRY_DELAY_NS / MS + 100)
        await assert_both_ways(b)


async def test_failed_change_of_settings_is_retried() -> None:
    """Settings that the chip does not accept become effective when it responds again."""
    async with bench() as b:
        b.here.chip.disconnect_bus(level=True)
        faster = replace(PAPER, spreading_factor=7)
        with pytest.raises(RadioNotFoundError):
            await b.here.radio.configure(faster)
        b.here.chip.reconnect_bus()
        await wait_ms(b, 500)
        await b.there.radio.configure(faster)
        await assert_both_ways(b)


async def test_cancelled_recovery_is_continued_by_the_supervision() -> None:
    """A call that is cancelled during a reset leaves the recovery to the background."""
    async with bench() as b:
        b.here.chip.drop_tx_done()
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        while b.here.radio.state is not State.DOWN:
            await wait_ms(b, 1)
        sending.cancel()
        await asyncio.wait([sending])
        await wait_ms(b, 500)
        await b.there.radio.receive()
        await assert_both_ways(b)
