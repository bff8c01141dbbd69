"""LoRaRF on a simulated chip, against our driver."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from harness.hardware.lab import SIZES, lab, payload
from harness.hardware.peripherals import RaspberryPi, import_driver

from tsgt.radio import LoRaSettings

if TYPE_CHECKING:
    from harness.hardware.lab import Lab

POLLING, WITH_DIO0 = -1, 4
RESET_PIN = 17

MODEMS = [(7, 125_000, 5), (9, 250_000, 6), (8, 500_000, 8), (10, 500_000, 7)]
modems = pytest.mark.parametrize(("spreading_factor", "bandwidth_hz", "coding_rate"), MODEMS)
sizes = pytest.mark.parametrize("size", SIZES)
pins = pytest.mark.parametrize("irq", [POLLING, WITH_DIO0], ids=["polling", "dio0"])


@sizes
@modems
async def test_lorarf_receives_our_packets(
    spreading_factor: int, bandwidth_hz: int, coding_rate: int, size: int
) -> None:
    """Our packets arrive."""
    async with lab(_settings(spreading_factor, bandwidth_hz, coding_rate)) as bench:
        lora = await bench.program.run(lambda: _lorarf(bench, spreading_factor, bandwidth_hz, coding_rate))
        receiving = asyncio.create_task(bench.program.run(lambda: _receive(lora)))
        await asyncio.sleep(0.1)
        await bench.radio.transmit(payload(size))
        assert await receiving == payload(size)
        assert lora.status() == lora.STATUS_RX_DONE


@sizes
@modems
async def test_we_receive_lorarfs_packets(
    spreading_factor: int, bandwidth_hz: int, coding_rate: int, size: int
) -> None:
    """That driver's packets arrive, at the power that it sets."""
    async with lab(_settings(spreading_factor, bandwidth_hz, coding_rate)) as bench:
        lora = await bench.program.run(lambda: _lorarf(bench, spreading_factor, bandwidth_hz, coding_rate))
        await bench.program.run(lambda: _send(lora, payload(size)))
        packet = await bench.radio.receive()
        assert packet.payload == payload(size)
        assert packet.rssi_dbm == pytest.approx(17 - 80, abs=1)


@pins
async def test_lorarf_transmits_consecutive_packets(irq: int) -> None:
    """Its transmit buffer starts where the last access ended, and wraps; polling and the interrupt pin both work."""
    async with lab(_settings(7, 125_000, 5)) as bench:
        lora = await bench.program.run(lambda: _lorarf(bench, 7, 125_000, 5, irq=irq))
        for size in (100, 120, 90):
            await bench.program.run(lambda size=size: _send(lora, payload(size)))  # type: ignore[misc]
            assert (await bench.radio.receive()).payload == payload(size)


@pins
async def test_lorarf_receives_consecutive_packets(irq: int) -> None:
    """It receives continuously, reading each packet from its FIFO address."""
    async with lab(_settings(7, 125_000, 5)) as bench:

        def receive(count: int) -> list[bytes]:
            lora = _lorarf(bench, 7, 125_000, 5, irq=irq)
            lora.request(lora.RX_CONTINUOUS)
            packets = []
            for _ in range(count):
                lora.wait()
                packets.append(lora.get(lora.available()))
                lora.status()
            return packets

        receiving = asyncio.create_task(bench.program.run(lambda: receive(5)))
        await asyncio.sleep(0.1)
        for size in (100, 120, 90, 1, 200):
            await bench.radio.transmit(payload(size))
            await asyncio.sleep(0.1)
        assert await receiving == [payload(size) for size in (100, 120, 90, 1, 200)]


async def test_lorarf_times_out() -> None:
    """Its single reception ends with RxTimeout after the set time."""
    async with lab(_settings(7, 125_000, 5)) as bench:
        lora = await bench.program.run(lambda: _lorarf(bench, 7, 125_000, 5))

        def receive() -> int:
            lora.request(500)
            lora.wait()
            return int(lora.status())

        before = asyncio.get_running_loop().time()
        assert await bench.program.run(receive) == lora.STATUS_RX_TIMEOUT
        assert asyncio.get_running_loop().time() - before == pytest.approx(0.5, abs=0.01)


async def test_packets_without_crc_are_dropped() -> None:
    """That driver sends without CRC by default; ours drops packets without CRC."""
    async with lab(_settings(7, 125_000, 5)) as bench:
        lora = await bench.program.run(lambda: _lorarf(bench, 7, 125_000, 5))
        await bench.program.run(lambda: lora.setCrcEnable(crcType=False))
        await bench.program.run(lambda: _send(lora, payload(34)))
        await asyncio.sleep(0.1)
        assert (bench.radio.statistics.received, bench.radio.statistics.no_crc) == (0, 1)


async def test_inverted_iq() -> None:
    """Packets pass with inverted IQ on both sides, not on one side only."""
    settings = _settings(7, 125_000, 5, inverted_iq=True)
    async with lab(settings) as bench:
        lora = await bench.program.run(lambda: _lorarf(bench, 7, 125_000, 5))
        await bench.program.run(lambda: _send(lora, b"normal"))
        await bench.program.run(lambda: lora.writeRegister(lora.REG_INVERTIQ, 0x66))
        await bench.program.run(lambda: _send(lora, b"inverted"))
        assert (await bench.radio.receive()).payload == b"inverted"
        assert bench.radio.statistics.received == 1


def _settings(
    spreading_factor: int, bandwidth_hz: int, coding_rate: int, *, inverted_iq: bool = False
) -> LoRaSettings:
    return LoRaSettings(
        frequency_hz=868_100_000,
        spreading_factor=spreading_factor,
        bandwidth_hz=bandwidth_hz,
        coding_rate=coding_rate,
        preamble_symbols=12,
        sync_word=0x34,
        inverted_iq=inverted_iq,
    )


def _lorarf(
    bench: Lab, spreading_factor: int, bandwidth_hz: int, coding_rate: int, *, irq: int = POLLING
) -> Any:
    """Make and set up a copy of LoRaRF's module on the peer's chip; the module holds one radio."""
    pi = RaspberryPi(bench.program, bench.chip, reset_pin=RESET_PIN, dio0_pin=WITH_DIO0)
    driver: Any = import_driver("LoRaRF.SX127x", pi.modules())
    driver.time = bench.program
    lora = driver.SX127x()
    assert lora.begin(0, 0, RESET_PIN, irq)
    lora.setFrequency(868_100_000)
    lora.setLoRaModulation(spreading_factor, bandwidth_hz, coding_rate)
    lora.setLoRaPacket(lora.HEADER_EXPLICIT, 12, 255, crcType=True)
    lora.setSyncWord(0x34)
    return lora


def _send(lora: Any, data: bytes) -> None:
    lora.beginPacket()
    lora.put(data)
    assert lora.endPacket()
    assert lora.wait(5)


def _receive(lora: Any) -> bytes:
    assert lora.request()
    assert lora.wait(10)
    return bytes(lora.get(lora.available()))
