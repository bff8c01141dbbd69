from __future__ import annotations

from dataclasses import replace

import pytest
from harness.hardware.radios import PAPER

from tsgt.radio import BANDWIDTHS_HZ, LoRaSettings
from tsgt.radio.sx127x import Mode, Register
from tsgt.radio.sx127x.register_io import frf, op_mode, packet_strength, receive_frf, register_values


def values(settings: LoRaSettings) -> dict[Register, int]:
    """Return the written values by address; each register once."""
    written = register_values(settings)
    assert len({register.address for register in written}) == len(written)
    return {register.address: register.value for register in written}


@pytest.mark.parametrize(
    ("frequency_hz", "expected"),
    [
        (434_000_000, "6c8000"),
        (868_100_000, "d90666"),
        (869_525_000, "d9619a"),
        (905_000_000, "e24000"),
        (915_000_000, "e4c000"),
        (923_300_000, "e6d333"),
    ],
)
def test_frequency_is_rounded_to_the_nearest_step(frequency_hz: int, expected: str) -> None:
    """RegFrf is that of the fact sheet; 869.525 MHz distinguishes rounding from truncation."""
    assert frf(frequency_hz).hex() == expected


def test_paper_settings_give_the_known_registers() -> None:
    """SF 9, 250 kHz, 4/6 with CRC are the bytes that the authors' nodes write, where both write them."""
    written = values(PAPER)
    assert written[Register.MODEM_CONFIG_1] == 0x84
    assert written[Register.MODEM_CONFIG_2] == 0x94
    assert written[Register.MODEM_CONFIG_3] == 0x04
    assert written[Register.SYNC_WORD] == 0x34
    assert (written[Register.PREAMBLE_MSB], written[Register.PREAMBLE_LSB]) == (0, 8)


@pytest.mark.parametrize(
    ("power_dbm", "pa_config", "pa_dac", "ocp"),
    [
        (2, 0xF0, 0x84, 0x2B),
        (14, 0xFC, 0x84, 0x2B),
        (17, 0xFF, 0x84, 0x2B),
        (20, 0xFF, 0x87, 0x31),
    ],
)
def test_power_sets_amplifier_and_current_limit_together(
    power_dbm: int, pa_config: int, pa_dac: int, ocp: int
) -> None:
    """PA_BOOST from 2 to 17 dBm with 100 mA and the default PaDac; 20 dBm with 140 mA and PaDac 0x87."""
    written = values(replace(PAPER, power_dbm=power_dbm))
    assert written[Register.PA_CONFIG] == pa_config
    assert written[Register.PA_DAC] == pa_dac
    assert written[Register.OCP] == ocp


@pytest.mark.parametrize(
    ("spreading_factor", "bandwidth_hz", "on"),
    [
        (11, 125_000, True),
        (10, 125_000, False),
        (12, 250_000, True),
        (11, 250_000, False),
        (12, 500_000, False),
    ],
)
def test_low_data_rate_follows_the_rule(spreading_factor: int, bandwidth_hz: int, on: bool) -> None:  # noqa: FBT001
    """The optimisation is on for symbols above 16 ms."""
    settings = replace(PAPER, spreading_factor=spreading_factor, bandwidth_hz=bandwidth_hz)
    assert values(settings)[Register.MODEM_CONFIG_3] == (0x0C if on else 0x04)


@pytest.mark.parametrize("on", [False, True])
def test_low_data_rate_can_be_set_against_the_rule(on: bool) -> None:  # noqa: FBT001 (a parameter)
    """The authors' nodes have it on at SF 11 and 250 kHz, other drivers never."""
    settings = replace(PAPER, spreading_factor=11, low_data_rate=on)
    assert values(settings)[Register.MODEM_CONFIG_3] == (0x0C if on else 0x04)


@pytest.mark.parametrize(
    ("inverted_iq", "invert_iq", "invert_iq_2"), [(False, 0x27, 0x1D), (True, 0x66, 0x19)]
)
def test_iq_is_inverted_both_ways(inverted_iq: bool, invert_iq: int, invert_iq_2: int) -> None:  # noqa: FBT001
    """Inverted IQ applies to sending and receiving, with its second register."""
    written = values(replace(PAPER, inverted_iq=inverted_iq))
    assert written[Register.INVERT_IQ] == invert_iq
    assert written[Register.INVERT_IQ_2] == invert_iq_2


@pytest.mark.parametrize(
    ("frequency_hz", "bandwidth_hz", "expected"),
    [
        (905_000_000, 500_000, (0x02, 0x64)),
        (434_000_000, 500_000, (0x02, 0x7F)),
        (169_000_000, 500_000, (0x03, None)),
        (905_000_000, 250_000, (0x03, None)),
    ],
)
def test_errata_2_1_sensitivity_at_500_khz(
    frequency_hz: int, bandwidth_hz: int, expected: tuple[int, int | None]
) -> None:
    """The two registers for 500 kHz have the value of their band, and keep their reset value elsewhere."""
    written = values(replace(PAPER, frequency_hz=frequency_hz, bandwidth_hz=bandwidth_hz))
    assert (written[Register.HIGH_BW_OPTIMIZE_1], written.get(Register.HIGH_BW_OPTIMIZE_2)) == expected


@pytest.mark.parametrize(
    ("bandwidth_hz", "reg_2f", "offset_hz"),
    [
        (7_800, 0x48, 7_810),
        (10_400, 0x44, 10_420),
        (15_600, 0x44, 15_620),
        (20_800, 0x44, 20_830),
        (31_250, 0x44, 31_250),
        (41_700, 0x44, 41_670),
        (62_500, 0x40, 0),
        (125_000, 0x40, 0),
        (250_000, 0x40, 0),
    ],
)
def test_errata_2_3_spurious_reception(bandwidth_hz: int, reg_2f: int, offset_hz: int) -> None:
    """Below 500 kHz the automatic IF is off; a narrow receiver is tuned higher, its sender is not."""
    settings = replace(PAPER, bandwidth_hz=bandwidth_hz)
    written = values(settings)
    assert written[Register.DETECT_OPTIMIZE] == 0x43
    assert (written[Register.REG_2F], written[Register.REG_30]) == (reg_2f, 0x00)
    assert receive_frf(settings) == frf(PAPER.frequency_hz + offset_hz)
    assert bytes(written[Register(Register.FRF_MSB + i)] for i in range(3)) == frf(PAPER.frequency_hz)


def test_errata_2_3_does_not_apply_at_500_khz() -> None:
    """The automatic IF stays on and its registers at their reset values."""
    settings = replace(PAPER, bandwidth_hz=500_000)
    written = values(settings)
    assert written[Register.DETECT_OPTIMIZE] == 0xC3
    assert Register.REG_2F not in written
    assert receive_frf(settings) == frf(PAPER.frequency_hz)


def test_bandwidth_codes_count_up() -> None:
    """The ten bandwidths have the codes 0 to 9."""
    codes = [
        values(replace(PAPER, bandwidth_hz=bandwidth_hz))[Register.MODEM_CONFIG_1] >> 4
        for bandwidth_hz in BANDWIDTHS_HZ
    ]
    assert codes == list(range(10))


@pytest.mark.parametrize(("frequency_hz", "expected"), [(434_000_000, 0x8D), (905_000_000, 0x85)])
def test_op_mode_depends_on_the_port(frequency_hz: int, expected: int) -> None:
    """The low-frequency bit is set on the LF port only."""
    assert op_mode(replace(PAPER, frequency_hz=frequency_hz), Mode.RXCONTINUOUS) == expected


@pytest.mark.parametrize(
    ("pkt_rssi", "pkt_snr", "frequency_hz", "rssi_dbm", "snr_db"),
    [
        (90, 40, 905_000_000, -157 + 96, 10.0),
        (90, 0, 905_000_000, -157 + 96, 0.0),
        (45, 0xEC, 905_000_000, -157 + 45 - 5, -5.0),
        (45, 0xEC, 434_000_000, -164 + 45 - 5, -5.0),
        (0, 0x80, 905_000_000, -157 - 32, -32.0),
    ],
)
def test_packet_strength(
    pkt_rssi: int, pkt_snr: int, frequency_hz: int, rssi_dbm: float, snr_db: float
) -> None:
    """RSSI and SNR follow the data sheet on both ports, above and below the noise."""
    strength = packet_strength(pkt_rssi, pkt_snr, frequency_hz=frequency_hz)
    assert strength == pytest.approx((rssi_dbm, snr_db))
