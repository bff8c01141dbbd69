from __future__ import annotations

import asyncio
import itertools
from contextlib import suppress
from dataclasses import replace

import pytest
from harness.hardware.radios import MS, PAPER, bench, make_side
from structlog.testing import capture_logs

from tsgt.errors import RadioError, RadioSettingsError
from tsgt.radio import BANDWIDTHS_HZ, LoRaSettings, airtime_us
from tsgt.radio.sx127x import Register
from tsgt.radio.sx127x.driver import QUEUE_CAPACITY, State
from tsgt.radio.sx127x.register_io import FRF, receive_frf, register_values
from tsgt.simulation.lora.frames import Frame, Modulation


def frame(payload: bytes, start_ns: int, *, crc: bool = True, power_dbm: float = 14.0) -> Frame:
    """Make a frame as a radio with the paper's settings would send it."""
    modulation = Modulation(
        frequency_hz=PAPER.frequency_hz,
        spreading_factor=PAPER.spreading_factor,
        bandwidth_hz=PAPER.bandwidth_hz,
        inverted_iq=False,
        sync_word=PAPER.sync_word,
        explicit_header=True,
        low_data_rate=False,
    )
    return Frame(modulation, PAPER.coding_rate, crc, PAPER.preamble_symbols, payload, power_dbm, start_ns)


class Sender:
    """An antenna that receives nothing, for frames that the driver would not send."""

    def preamble_detected(self, at_ns: int) -> None:
        """Ignore it."""

    def header_received(self, at_ns: int, header: object) -> None:
        """Ignore it."""

    def frame_ended(self, at_ns: int, reception: object) -> None:
        """Ignore it."""


@pytest.mark.parametrize("size", [1, 2, 34, 255])
async def test_packets_arrive_in_both_directions(size: int) -> None:
    """Each radio receives what the other sends, at any length."""
    payload = bytes(i * 7 & 0xFF for i in range(size))
    async with bench() as b:
        await b.here.radio.transmit(payload)
        assert (await b.there.radio.receive()).payload == payload
        await b.there.radio.transmit(payload[::-1])
        assert (await b.here.radio.receive()).payload == payload[::-1]
        assert b.here.chip.warnings == b.there.chip.warnings == []


async def test_packet_has_its_signal_strength() -> None:
    """RSSI and SNR are those of the channel: 14 dBm less 80 dB, and an SNR that saturates above 14 dB."""
    async with bench() as b:
        await b.here.radio.transmit(b"hello")
        packet = await b.there.radio.receive()
    assert packet.rssi_dbm == pytest.approx(14 - 80, abs=0.6)
    assert packet.snr_db == 14


async def test_weak_packet_has_its_signal_strength() -> None:
    """Below the noise the SNR corrects the RSSI."""
    async with bench() as b:
        b.air.link.set_attenuation("here", "there", 14 - 80 + 119.5)
        await b.here.radio.transmit(b"hello")
        packet = await b.there.radio.receive()
    assert packet.snr_db == pytest.approx(-119.5 + 113.5, abs=0.3)
    assert packet.rssi_dbm == pytest.approx(-119.5, abs=0.6)


async def test_timestamps_are_those_of_the_edges() -> None:
    """TxDone is an airtime after the start plus start-up and 67 us, RxDone 0.76 symbols after the packet's end."""
    async with bench() as b:
        sent = await b.here.radio.transmit(bytes(34))
        packet = await b.there.radio.receive()
    startup_ns = 60_000 + 120_000
    assert sent.done_at_ns - sent.started_at_ns == pytest.approx(
        139_776_000 + startup_ns + 67_000, abs=20_000
    )
    assert packet.received_at_ns - sent.done_at_ns == pytest.approx(0.76 * 2_048_000 - 67_000, abs=30_000)
    assert sent.stamp_sigma_ns == packet.stamp_sigma_ns == b.here.hal.stamp_sigma_ns


@pytest.mark.parametrize("bandwidth_hz", BANDWIDTHS_HZ)
@pytest.mark.parametrize("frequency_hz", [434_000_000, 869_525_000])
async def test_every_bandwidth_works_on_both_ports(bandwidth_hz: int, frequency_hz: int) -> None:
    """At each bandwidth, on either port, a packet arrives: narrow receivers are tuned with an offset, senders are not."""
    settings = replace(PAPER, bandwidth_hz=bandwidth_hz, frequency_hz=frequency_hz, spreading_factor=7)
    async with bench(settings) as b:
        await b.here.radio.transmit(b"hello")
        assert (await b.there.radio.receive()).payload == b"hello"
        await b.there.radio.transmit(b"world")
        assert (await b.here.radio.receive()).payload == b"world"
        assert b.here.chip.warnings == []


@pytest.mark.parametrize(
    "settings",
    [
        replace(PAPER, spreading_factor=7),
        replace(PAPER, spreading_factor=12),
        replace(PAPER, spreading_factor=11, low_data_rate=True),
        replace(PAPER, coding_rate=8),
        replace(PAPER, preamble_symbols=300),
        replace(PAPER, sync_word=0x12),
        replace(PAPER, crc=False),
        replace(PAPER, inverted_iq=True),
        replace(PAPER, power_dbm=2),
    ],
)
async def test_every_setting_works(settings: LoRaSettings) -> None:
    """Two radios with the same settings receive each other, and one with the paper's receives neither."""
    async with bench(settings) as b:
        await b.here.radio.transmit(b"hello")
        assert (await b.there.radio.receive()).payload == b"hello"


@pytest.mark.parametrize(
    "other",
    [
        replace(PAPER, spreading_factor=8),
        replace(PAPER, bandwidth_hz=125_000),
        replace(PAPER, sync_word=0x12),
        replace(PAPER, inverted_iq=True),
        replace(PAPER, frequency_hz=906_000_000),
    ],
)
async def test_packets_with_other_settings_are_not_received(other: LoRaSettings) -> None:
    """A sender that differs in spreading factor, bandwidth, sync word, IQ or frequency is not received."""
    async with bench(PAPER, other) as b:
        await b.here.radio.transmit(b"hello")
        await b.clock.sleep_until(b.clock.monotonic_ns() + 1000 * MS)
        assert b.there.radio.statistics.received == 0


async def test_every_combination_is_accepted() -> None:
    """The chip accepts all combinations of the modem's settings without a data sheet violation, and receives."""
    combinations = itertools.product(BANDWIDTHS_HZ, range(7, 13), range(5, 9), (False, True))
    async with bench() as b:
        for bandwidth_hz, spreading_factor, coding_rate, flag in combinations:
            settings = replace(
                PAPER,
                bandwidth_hz=bandwidth_hz,
                spreading_factor=spreading_factor,
                coding_rate=coding_rate,
                crc=flag,
                inverted_iq=not flag,
            )
            await b.here.radio.configure(settings)
            assert bytes(map(b.here.register, FRF)) == receive_frf(settings)
            for register in register_values(settings):
                if register.address in FRF:
                    continue
                assert not (b.here.register(register.address) ^ register.value) & register.mask
        assert b.here.chip.warnings == []
        assert b.here.radio.state is State.RECEIVING


async def test_configure_changes_the_settings_of_a_running_radio() -> None:
    """After a change of settings on both sides packets arrive again, also from 500 kHz, which changes other registers."""
    async with bench(replace(PAPER, bandwidth_hz=500_000)) as b:
        await b.here.radio.configure(PAPER)
        await b.there.radio.configure(PAPER)
        await b.here.radio.transmit(b"hello")
        assert (await b.there.radio.receive()).payload == b"hello"
        assert b.here.register(Register.REG_2F) == 0x40


async def test_back_to_back_packets_wrap_in_the_fifo() -> None:
    """Thirty consecutive packets of 34 bytes arrive intact: 1020 bytes through a FIFO of 256."""
    async with bench() as b:
        payloads = [bytes([number]) * 34 for number in range(30)]
        for payload in payloads:
            await b.here.radio.transmit(payload)
        await b.clock.sleep_until(b.clock.monotonic_ns() + 10 * MS)
        received = [(await b.there.radio.receive()).payload for _ in payloads]
        assert received == payloads
        assert b.there.radio.statistics.lost_edges == 0


async def test_transmission_starts_at_its_instant() -> None:
    """A scheduled packet starts exactly at its instant, and its sender receives until shortly before."""
    async with bench() as b:
        at_ns = b.clock.monotonic_ns() + 500 * MS
        sending = asyncio.create_task(b.here.radio.transmit(b"hello", at_ns=at_ns))
        await b.there.radio.transmit(b"meanwhile")
        assert (await b.here.radio.receive()).payload == b"meanwhile"
        sent = await sending
    assert sent.started_at_ns == at_ns


async def test_past_instant_means_now() -> None:
    """A packet whose instant has passed starts at once, with the actual start in its record."""
    async with bench() as b:
        now_ns = b.clock.monotonic_ns()
        sent = await b.here.radio.transmit(b"hello", at_ns=now_ns - 10 * MS)
    assert sent.started_at_ns == now_ns


async def test_transmissions_of_several_tasks_queue_up() -> None:
    """Packets of concurrent tasks are sent one after the other, and all arrive."""
    async with bench() as b:
        await asyncio.gather(*(b.here.radio.transmit(bytes([number])) for number in range(5)))
        received = [(await b.there.radio.receive()).payload[0] for _ in range(5)]
    assert received == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("edge_is_lost", [False, True])
async def test_packet_that_ends_just_before_a_transmission_is_kept(edge_is_lost: bool) -> None:  # noqa: FBT001
    """A packet whose interrupt has not been handled yet when its receiver starts to send is received all the same.

    Its edge is waited for, so that it is counted as lost only if it is.
    """
    async with bench() as b:
        b.here.hal.drop_edges(int(edge_is_lost), counted=False)
        await b.there.radio.transmit(b"hello")
        b.timeline.advance(2 * MS)  # RxDone, while the event loop does other things
        await b.here.radio.transmit(b"answer")
        packet = await b.here.radio.receive()
        assert packet.payload == b"hello"
        assert (packet.stamp_sigma_ns > b.here.hal.stamp_sigma_ns) == edge_is_lost
        assert b.here.radio.statistics.lost_edges == edge_is_lost


async def test_cancelled_transmission_leaves_the_radio_receiving() -> None:
    """A transmission cancelled on the air is aborted, not received, and its sender receives again."""
    async with bench() as b:
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await b.clock.sleep_until(b.clock.monotonic_ns() + 50 * MS)
        sending.cancel()
        await asyncio.wait([sending])
        assert b.here.radio.state is State.RECEIVING
        await b.clock.sleep_until(b.clock.monotonic_ns() + 500 * MS)
        assert b.there.radio.statistics.received == 0
        await b.there.radio.transmit(b"hello")
        assert (await b.here.radio.receive()).payload == b"hello"


@pytest.mark.parametrize("delay_ms", [1, 496, 499])
async def test_transmission_cancelled_before_its_instant_leaves_the_radio_receiving(delay_ms: int) -> None:
    """A transmission cancelled before its instant, loaded or not, never starts."""
    async with bench() as b:
        now_ns = b.clock.monotonic_ns()
        sending = asyncio.create_task(b.here.radio.transmit(b"never", at_ns=now_ns + 500 * MS))
        await b.clock.sleep_until(now_ns + delay_ms * MS)
        sending.cancel()
        await asyncio.wait([sending])
        await b.there.radio.transmit(b"hello")
        assert (await b.here.radio.receive()).payload == b"hello"
        assert b.there.radio.statistics.received == 0


async def test_cancelled_reception_loses_no_packet() -> None:
    """A packet that arrives after a cancelled receive() is queued for the next one."""
    async with bench() as b:
        waiting = asyncio.create_task(b.there.radio.receive())
        await asyncio.sleep(0.1)
        waiting.cancel()
        await asyncio.wait([waiting])
        await b.here.radio.transmit(b"hello")
        assert (await b.there.radio.receive()).payload == b"hello"


async def test_full_queue_drops_the_oldest() -> None:
    """Without a receiver the newest packets are kept; the others are counted and logged."""
    async with bench(replace(PAPER, spreading_factor=7)) as b:
        with capture_logs() as logs:
            for number in range(QUEUE_CAPACITY + 2):
                await b.here.radio.transmit(bytes([number]))
            await b.clock.sleep_until(b.clock.monotonic_ns() + 10 * MS)
        assert (await b.there.radio.receive()).payload == bytes([2])
        assert b.there.radio.statistics.queue_overflows == 2
        assert [entry["event"] for entry in logs] == ["radio_queue_overflow"] * 2


async def test_packet_with_a_crc_error_is_dropped_and_counted() -> None:
    """A packet whose CRC is wrong, here from a collision in its payload, is not delivered."""
    async with bench() as b:
        sender = b.air.join(Sender(), "sender")
        start_ns = b.clock.monotonic_ns()
        sending = asyncio.create_task(b.here.radio.transmit(bytes(34)))
        await b.clock.sleep_until(start_ns + 90 * MS)
        sender.transmit(frame(b"noise", start_ns + 90 * MS))
        await sending
        await b.clock.sleep_until(start_ns + 500 * MS)
        assert b.there.radio.statistics.crc_errors == 1
        assert b.there.radio.statistics.received == 0
        await b.here.radio.transmit(b"hello")
        assert (await b.there.radio.receive()).payload == b"hello"


async def test_packet_without_crc_is_dropped_where_one_is_required() -> None:
    """A receiver that requires CRCs drops and counts packets without one."""
    async with bench(replace(PAPER, crc=False), PAPER) as b:
        await b.here.radio.transmit(b"hello")
        await b.clock.sleep_until(b.clock.monotonic_ns() + 100 * MS)
        assert b.there.radio.statistics.no_crc == 1
        assert b.there.radio.statistics.received == 0


async def test_packet_with_crc_is_received_where_none_is_required() -> None:
    """The header states whether a packet has a CRC."""
    async with bench(PAPER, replace(PAPER, crc=False)) as b:
        await b.here.radio.transmit(b"hello")
        assert (await b.there.radio.receive()).payload == b"hello"


@pytest.mark.parametrize("size", [0, 256])
async def test_payload_of_invalid_length_is_rejected(size: int) -> None:
    """An empty payload and one of 256 bytes are rejected before any register access."""
    async with bench() as b:
        with pytest.raises(RadioSettingsError, match=f"1 to 255 bytes, got {size}"):
            await b.here.radio.transmit(bytes(size))
        assert b.here.radio.state is State.RECEIVING


async def test_twenty_dbm_must_be_allowed() -> None:
    """20 dBm are rejected unless the driver allows them."""
    with pytest.raises(RadioSettingsError, match="1 % duty"):
        async with bench(replace(PAPER, power_dbm=20)):
            pass


async def test_twenty_dbm_arrive_6_db_stronger() -> None:
    """With 20 dBm a packet arrives 6 dB stronger than with 14, and going back restores the amplifier."""
    async with bench(replace(PAPER, power_dbm=20), allow_20_dbm=True) as b:
        await b.here.radio.transmit(b"hello")
        assert (await b.there.radio.receive()).rssi_dbm == pytest.approx(20 - 80, abs=0.6)
        await b.here.radio.configure(PAPER)
        assert b.here.register(Register.PA_DAC) == 0x84


async def test_transmission_before_the_start_fails() -> None:
    """The error states the reason."""
    async with bench() as b:
        side = make_side(b.air, "third")
        with pytest.raises(RadioError, match="down: not started"):
            await side.radio.transmit(b"hello")


async def test_closed_radio_is_asleep() -> None:
    """close() waits for a running transmission and then puts the chip to sleep."""
    async with bench() as b:
        sending = asyncio.create_task(b.here.radio.transmit(b"hello"))
        await asyncio.sleep(0.01)
        await b.here.radio.close()
        assert sending.done()
        assert b.here.register(Register.OP_MODE) == 0x80
        assert (await b.there.radio.receive()).payload == b"hello"
        with pytest.raises(RadioError, match="down: closed"):
            await b.here.radio.transmit(b"hello")


async def test_cancelled_close_releases_the_radio(monkeypatch: pytest.MonkeyPatch) -> None:
    """A close() that is cancelled while it waits for a transmission releases bus and pins all the same."""
    async with bench() as b:
        released: list[bool] = []
        monkeypatch.setattr(b.here.hal, "close", lambda: released.append(True))
        sending = asyncio.create_task(b.here.radio.transmit(b"hello"))
        await asyncio.sleep(0.01)
        closing = asyncio.create_task(b.here.radio.close())
        await asyncio.sleep(0.01)
        closing.cancel()
        await asyncio.wait([closing])
        assert released == [True]
        with suppress(RadioError):
            await sending
        with pytest.raises(RadioError, match="down: closed"):
            await b.here.radio.transmit(b"hello")


async def test_frame_helper_has_the_drivers_airtime() -> None:
    """The frames of these tests have the driver's airtime."""
    assert frame(bytes(34), 0).end_ns == 1000 * airtime_us(
        34, spreading_factor=9, bandwidth_hz=250_000, coding_rate=6
    )
