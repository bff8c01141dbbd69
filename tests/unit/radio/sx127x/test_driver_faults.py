from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.radios import MS, PAPER, Bench, bench, make_side, running_timeline
from structlog.testing import capture_logs

from tsgt.errors import RadioError, RadioNotFoundError, RadioTimeoutError
from tsgt.radio.sx127x import Edge, Register, SX127x
from tsgt.radio.sx127x.driver import MAX_RETRY_DELAY_NS, State
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.lora import Air, LinkModel

if TYPE_CHECKING:
    from tsgt.radio.sx127x import EdgeCallback


def new_air() -> Air:
    """Make an air on the running test's time."""
    return Air(running_timeline(), np.random.default_rng(0), LinkModel())


async def wait_ms(b: Bench, duration_ms: float) -> None:
    """Let so much time pass."""
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
async def test_missing_chip_is_named_at_the_start(level: bool) -> None:  # noqa: FBT001 (a parameter)
    """A bus on which nothing answers, 0x00 or 0xFF, ends the start with what to check."""
    side = make_side(new_air(), "here")
    side.chip.disconnect_bus(level)
    with pytest.raises(RadioNotFoundError, match=r"wiring, the NSS pin .* overlay"):
        await side.radio.start(PAPER)
    await side.radio.close()


async def test_sx1272_is_refused_by_name() -> None:
    """The chip's predecessor, whose registers differ, is recognised and named."""
    radio = SX127x(FixedRegisters(VERSION=0x22), VirtualClock(0))
    with pytest.raises(RadioNotFoundError, match="SX1272"):
        await radio.start(PAPER)


async def test_unknown_version_is_refused() -> None:
    """Any other version is reported as it reads."""
    radio = SX127x(FixedRegisters(VERSION=0x40), VirtualClock(0))
    with pytest.raises(RadioNotFoundError, match="0x40"):
        await radio.start(PAPER)


@pytest.mark.parametrize("version", [0x11, 0x13])
async def test_odd_versions_are_accepted_and_logged(version: int) -> None:
    """Versions that some RFM9x modules have pass, with an entry in the log."""
    radio = SX127x(FixedRegisters(VERSION=version), VirtualClock(0))
    with capture_logs() as logs, pytest.raises(RadioError, match="OP_MODE"):
        await radio.start(PAPER)
    assert logs == [{"event": "radio_version_unusual", "log_level": "info", "version": version}]


async def test_register_that_does_not_keep_its_value_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mismatch on reading back says which register, what it should hold and what it holds."""
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
async def test_packet_without_edge_is_found(counted: bool) -> None:  # noqa: FBT001 (a parameter)
    """A packet whose edge is lost is found within 100 ms, and its stamp covers what really happened."""
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


async def test_dio0_that_is_not_connected_costs_only_time_stamps() -> None:
    """Without any edges packets still pass, each is counted, and no stamp is worse than the polling."""
    async with bench() as b:
        b.here.hal.drop_edges(1000, counted=False)
        b.there.hal.drop_edges(1000, counted=False)
        for _ in range(10):
            await b.here.radio.transmit(b"hello")
            assert (await b.there.radio.receive()).stamp_sigma_ns <= 30 * MS
        assert b.here.radio.statistics.lost_edges == b.there.radio.statistics.lost_edges == 10
        assert b.here.radio.statistics.tx_timeouts == 0


async def test_edge_that_is_on_its_way_is_not_taken_as_lost() -> None:
    """A check of the chip between an interrupt and its handling waits for the edge."""
    async with bench() as b:
        await b.there.radio.transmit(b"hello")
        b.timeline.advance(2 * MS)  # RxDone, while the event loop does other things
        await b.here.radio._check()
        assert (await b.here.radio.receive()).stamp_sigma_ns == b.here.hal.stamp_sigma_ns
        assert b.here.radio.statistics.lost_edges == 0


async def test_lost_edge_of_a_transmission_is_noticed() -> None:
    """A TxDone without edge is found a few ms later; its stamp is computed and says that it is less certain."""
    async with bench() as b:
        b.here.hal.drop_edges(1, counted=False)
        sent = await b.here.radio.transmit(bytes(34))
        assert b.clock.monotonic_ns() - sent.done_at_ns <= 6 * MS
        true_done_ns = sent.started_at_ns + 139_776_000 + 247_000
        assert abs(sent.done_at_ns - true_done_ns) <= sent.stamp_sigma_ns
        assert b.here.radio.statistics.lost_edges == 1
        assert b.here.radio.statistics.transmitted == 1


async def test_edges_that_the_kernel_dropped_are_counted() -> None:
    """What the HAL reports as lost shows in the statistics and in the log."""
    async with bench() as b:
        with capture_logs() as logs:
            b.here.radio._on_edge(Edge(0, lost=3))
        assert b.here.radio.statistics.lost_edges == 3
        assert logs == [{"event": "radio_edge_lost", "log_level": "warning", "lost": 3, "state": "receiving"}]


async def test_stale_edge_is_ignored() -> None:
    """An edge without its flag, in whatever state, changes nothing."""
    async with bench() as b:
        b.here.radio._on_edge(Edge(b.clock.monotonic_ns()))
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await wait_ms(b, 50)
        b.here.radio._on_edge(Edge(b.clock.monotonic_ns()))
        sent = await sending
        assert sent.done_at_ns - sent.started_at_ns > 139 * MS
        assert b.here.radio.statistics.received == 0


async def test_stale_edge_does_not_stamp_the_end_of_a_transmission() -> None:
    """An edge from before a transmission, handed over after its end, is not taken for its TxDone."""
    async with bench() as b:
        b.here.hal.drop_edges(1, counted=False)
        start_ns = b.clock.monotonic_ns()
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await wait_ms(b, 141)
        assert b.here.chip.dio(0)
        b.here.radio._on_edge(Edge(start_ns - 1))
        assert (await sending).done_at_ns > start_ns


async def test_edge_that_is_handled_too_late_gives_a_wide_stamp() -> None:
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


async def test_transmission_that_does_not_end_resets_the_chip() -> None:
    """Without TxDone the call fails 50 ms after the packet's end; the radio is reset and works again at once."""
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
    """Callers that know nothing of radios can catch the built-in TimeoutError."""
    assert issubclass(RadioTimeoutError, TimeoutError)


async def test_chip_that_resets_itself_is_set_up_again() -> None:
    """After a dip of the supply the radio works again within 100 ms and the time of a reset."""
    async with bench() as b:
        b.here.chip.power_on_reset()
        await wait_ms(b, 120)
        assert b.here.radio.statistics.resets == 1
        await assert_both_ways(b)


async def test_chip_that_resets_itself_while_sending_is_set_up_again() -> None:
    """A reset in the middle of a transmission fails that call and none after it."""
    async with bench() as b:
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await wait_ms(b, 50)
        b.here.chip.power_on_reset()
        with pytest.raises(RadioTimeoutError):
            await sending
        await assert_both_ways(b)


async def test_chip_that_hangs_while_receiving_is_reset() -> None:
    """A chip whose registers are frozen looks well to a reader; it is found out and reset all the same."""
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
    """A packet that cannot be taken off the chip is a fault, not a stream of packets."""
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


async def test_changed_sync_word_is_noticed() -> None:
    """A chip that has kept its mode but not its settings is set up again."""
    async with bench() as b:
        b.here.chip.transfer(bytes([0x80 | Register.SYNC_WORD, 0x12]))
        await wait_ms(b, 120)
        assert b.here.radio.statistics.resets == 1
        await assert_both_ways(b)


async def test_missing_chip_delivers_no_packets() -> None:
    """All flags set is what an open line reads as, not a packet with a wrong CRC."""
    async with bench() as b:
        b.here.chip.disconnect_bus(level=True)
        b.here.radio._on_edge(Edge(b.clock.monotonic_ns()))
        with pytest.raises(RadioError):
            await b.here.radio.transmit(b"hello")
        assert b.here.radio.statistics.crc_errors == b.here.radio.statistics.received == 0


@pytest.mark.parametrize("level", [False, True])
async def test_lost_bus_is_survived(level: bool) -> None:  # noqa: FBT001 (a parameter)
    """While nothing answers, sending fails with the reason; when the bus is back, so is the radio."""
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
async def test_bus_lost_while_sending_is_survived(level: bool) -> None:  # noqa: FBT001 (a parameter)
    """A bus that goes in the middle of a transmission fails that call; the radio comes back with the bus."""
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


async def test_bus_that_fails_is_survived() -> None:
    """An error of the operating system on the bus, in an interrupt as in the watch, ends nothing."""
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


async def test_failed_change_of_settings_is_tried_again() -> None:
    """Settings that a chip does not take when asked come into force when it answers again."""
    async with bench() as b:
        b.here.chip.disconnect_bus(level=True)
        faster = replace(PAPER, spreading_factor=7)
        with pytest.raises(RadioNotFoundError):
            await b.here.radio.configure(faster)
        b.here.chip.reconnect_bus()
        await wait_ms(b, 500)
        await b.there.radio.configure(faster)
        await assert_both_ways(b)


async def test_cancelled_recovery_is_taken_up_by_the_watch() -> None:
    """A call that is cancelled while it resets the chip leaves the rest to the background."""
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
