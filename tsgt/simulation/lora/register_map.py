"""Conversion between SX1276 registers and physical quantities.

Frequencies and bandwidths in Hz, powers in dBm at the module's antenna connector.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

from tsgt.radio import BANDWIDTHS_HZ, low_data_rate_required, symbol_time_ns
from tsgt.radio.sx127x import Register
from tsgt.radio.sx127x import registers as reg
from tsgt.simulation.lora.frames import Modulation

if TYPE_CHECKING:
    from tsgt.simulation.lora.chip_memory import ChipMemory

MIN_PREAMBLE_SYMBOLS = 6

# Errata 2.3: with automatic IF off and 0x2F set for it, a narrow receiver is tuned one bandwidth below its carrier.
_NARROW_RX_OFFSET_HZ = {
    (7_800, 0x48): 7_810,
    (10_400, 0x44): 10_420,
    (15_600, 0x44): 15_620,
    (20_800, 0x44): 20_830,
    (31_250, 0x44): 31_250,
    (41_700, 0x44): 41_670,
}

# RegPktSnrValue is signed, in quarters of a dB; real ones saturate.
_MIN_SNR_QUARTERS = -128
_MAX_SNR_QUARTERS = 56

# RFM95 and Dragino HAT connect PA_BOOST only; the leakage from RFO is an estimate.
_RFO_LEAK_DB = -40.0


@dataclass(frozen=True, slots=True)
class ModemSettings:
    """Decoded registers of the LoRa page.

    Attributes
    ----------
    sending, receiving
        Modulations of transmitter and receiver; they differ in IQ and, at narrow bandwidths, in frequency.
    payload_bytes, max_payload_bytes
        RegPayloadLength and RegMaxPayloadLength.
    """

    sending: Modulation
    receiving: Modulation
    symbol_ns: int
    coding_rate: int  # denominator, 5 to 8
    crc: bool  # rxPayloadCrcOn, which applies to transmission as well
    preamble_symbols: int  # as programmed
    payload_bytes: int
    max_payload_bytes: int
    timeout_symbols: int  # preamble timeout of RXSINGLE
    continuous: bool  # txContinuousMode


def modem_settings(memory: ChipMemory) -> tuple[ModemSettings | None, tuple[str, ...]]:
    """Decode the settings; None: the modem cannot work with them. Second item: violations of the data sheet."""
    page = memory.lora
    return _modem_settings(
        memory.frf,
        bytes(page[Register.MODEM_CONFIG_1 : Register.HOP_PERIOD + 1]),
        page[Register.MODEM_CONFIG_3],
        bytes(page[Register.REG_2F : Register.SYNC_WORD + 1]),
    )


@lru_cache(maxsize=1024)
def _modem_settings(
    frf: int, settings: bytes, config_3: int, detection: bytes
) -> tuple[ModemSettings | None, tuple[str, ...]]:
    """Decode registers 0x1D to 0x24, 0x26, and 0x2F to 0x39; cached, because drivers use few combinations."""
    config_1, config_2, timeout_lsb, preamble_msb, preamble_lsb, payload, max_payload, hop_period = settings
    problems = []
    bandwidth_code = config_1 >> reg.BW_SHIFT
    coding_rate = 4 + (config_1 >> reg.CODING_RATE_SHIFT & 7)
    explicit = not config_1 & reg.IMPLICIT_HEADER_MODE_ON
    spreading_factor = config_2 >> reg.SPREADING_FACTOR_SHIFT
    low_data_rate = bool(config_3 & reg.LOW_DATA_RATE_OPTIMIZE)
    preamble = preamble_msb << 8 | preamble_lsb
    if hop_period:
        problems.append("frequency hopping is not simulated")
    if preamble < MIN_PREAMBLE_SYMBOLS:
        problems.append(f"a preamble of {preamble} symbols; the shortest is {MIN_PREAMBLE_SYMBOLS}")
    if payload == 0:
        problems.append("PayloadLength 0")
    if bandwidth_code >= len(BANDWIDTHS_HZ) or not 5 <= coding_rate <= 8 or not 6 <= spreading_factor <= 12:
        problems.append("undefined bandwidth, coding rate or spreading factor")
        return None, tuple(problems)
    bandwidth_hz = BANDWIDTHS_HZ[bandwidth_code]
    if low_data_rate != low_data_rate_required(spreading_factor, bandwidth_hz):
        problems.append(
            f"LowDataRateOptimize {'on' if low_data_rate else 'off'} at SF{spreading_factor}, {bandwidth_hz} Hz"
        )
    optimize = detection[Register.DETECT_OPTIMIZE - Register.REG_2F]
    threshold = detection[Register.DETECTION_THRESHOLD - Register.REG_2F]
    if spreading_factor == 6 and explicit:
        problems.append("SF6 with explicit header")
        return None, tuple(problems)
    if (optimize & 7, threshold) != ((5, 0x0C) if spreading_factor == 6 else (3, 0x0A)):
        problems.append(
            f"DetectOptimize {optimize:#04x} and DetectionThreshold {threshold:#04x} at SF{spreading_factor}"
        )
        return None, tuple(problems)

    frequency_hz = frf * reg.F_XOSC_HZ / 2**reg.FRF_BITS
    offset_hz = 0
    if not optimize & reg.AUTOMATIC_IF_ON:
        offset_hz = _NARROW_RX_OFFSET_HZ.get((bandwidth_hz, detection[0]), 0)
    invert = detection[Register.INVERT_IQ - Register.REG_2F]

    def modulation(frequency_hz: float, *, inverted_iq: bool) -> Modulation:
        return Modulation(
            frequency_hz=frequency_hz,
            spreading_factor=spreading_factor,
            bandwidth_hz=bandwidth_hz,
            inverted_iq=inverted_iq,
            sync_word=detection[Register.SYNC_WORD - Register.REG_2F],
            explicit_header=explicit,
            low_data_rate=low_data_rate,
        )

    return ModemSettings(
        sending=modulation(frequency_hz, inverted_iq=not invert & reg.INVERT_IQ_TX_OFF),
        receiving=modulation(frequency_hz - offset_hz, inverted_iq=bool(invert & reg.INVERT_IQ_RX)),
        symbol_ns=symbol_time_ns(spreading_factor, bandwidth_hz),
        coding_rate=coding_rate,
        crc=bool(config_2 & reg.RX_PAYLOAD_CRC_ON),
        preamble_symbols=preamble,
        payload_bytes=max(1, payload),
        max_payload_bytes=max_payload,
        timeout_symbols=(config_2 & reg.SYMB_TIMEOUT_MSB_MASK) << 8 | timeout_lsb,
        continuous=bool(config_2 & reg.TX_CONTINUOUS_MODE),
    ), tuple(problems)


def output_power_dbm(pa_config: int, pa_dac: int) -> float:
    """Return the transmitter's power (data sheet 5.4.2, 5.4.3)."""
    output_power = pa_config & reg.OUTPUT_POWER_MASK
    if pa_config & reg.PA_SELECT_BOOST:
        return (5.0 if pa_dac & 7 == reg.PA_DAC_20_DBM & 7 else 2.0) + output_power
    highest_dbm = 10.8 + 0.6 * ((pa_config & reg.MAX_POWER_MASK) >> 4)
    return highest_dbm - (15 - output_power) + _RFO_LEAK_DB


def rssi_register(rssi_dbm: float, frequency_hz: float) -> int:
    """Return RegRssiValue for a power on the channel (data sheet 5.5.5)."""
    return _clamp(round(rssi_dbm - _rssi_offset_dbm(frequency_hz)), 0, 255)


def packet_strength_registers(rssi_dbm: float, snr_db: float, frequency_hz: float) -> tuple[int, int]:
    """Return RegPktSnrValue and RegPktRssiValue (inverse of data sheet 5.5.5)."""
    quarters = _clamp(round(4 * snr_db), _MIN_SNR_QUARTERS, _MAX_SNR_QUARTERS)
    above_offset_db = rssi_dbm - _rssi_offset_dbm(frequency_hz)
    strength = above_offset_db - quarters / 4 if quarters < 0 else above_offset_db * 15 / 16
    return quarters & 0xFF, _clamp(round(strength), 0, 255)


def frequency_error_registers(error_hz: float, bandwidth_hz: float) -> bytes:
    """Return RegFei, 20-bit signed in three bytes (data sheet 4.1.5); positive: the sender is above the receiver."""
    steps = round(error_hz * reg.F_XOSC_HZ / 2**24 * 500_000 / bandwidth_hz)
    return (_clamp(steps, -(2**19), 2**19 - 1) & 0xFFFFF).to_bytes(3, "big")


def _rssi_offset_dbm(frequency_hz: float) -> int:
    return reg.RSSI_OFFSET_HF_DBM if frequency_hz >= reg.MIN_HF_HZ else reg.RSSI_OFFSET_LF_DBM


def _clamp(value: int, low: int, high: int) -> int:
    return max(low, min(high, value))
