"""Registers of an SX127x: settings as register values, access over the bus, and signal strength from register values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.errors import RadioError
from tsgt.radio.airtime import low_data_rate_required
from tsgt.radio.base import BANDWIDTHS_HZ, MAX_PAYLOAD_BYTES, LoRaSettings
from tsgt.radio.sx127x import registers as reg
from tsgt.radio.sx127x.registers import Register

if TYPE_CHECKING:
    from tsgt.radio.sx127x.hal import Hal

FRF = (Register.FRF_MSB, Register.FRF_MID, Register.FRF_LSB)

# Errata 2.3: register 0x2F, and the offset above the carrier to which a narrow receiver is tuned.
_REG_2F = {7_800: 0x48, 10_400: 0x44, 15_600: 0x44, 20_800: 0x44, 31_250: 0x44, 41_700: 0x44}
_REG_2F_WIDE = 0x40
_RX_OFFSET_HZ = {7_800: 7_810, 10_400: 10_420, 15_600: 15_620, 20_800: 20_830, 31_250: 31_250, 41_700: 41_670}

# Errata 2.1: carrier range and register 0x3A for 500 kHz.
_HIGH_BW_BANDS = ((862_000_000, 1_020_000_000, 0x64), (410_000_000, 525_000_000, 0x7F))


@dataclass(frozen=True, slots=True)
class RegisterValue:
    """A register and its value; ``mask`` has the bits that must read back, as the chip drives the others itself."""

    address: Register
    value: int
    mask: int = 0xFF


def op_mode(settings: LoRaSettings, mode: reg.Mode) -> int:
    """Return RegOpMode for a LoRa mode, with the low-frequency bit for the LF port."""
    low = reg.LOW_FREQUENCY_MODE_ON if settings.frequency_hz < reg.MIN_HF_HZ else 0
    return reg.LONG_RANGE_MODE | low | mode


def frf(frequency_hz: int) -> bytes:
    """Return RegFrf, most significant byte first, for the nearest of its steps of 61.035 Hz (section 4.1.4)."""
    return (((frequency_hz << reg.FRF_BITS) + reg.F_XOSC_HZ // 2) // reg.F_XOSC_HZ).to_bytes(3, "big")


def receive_frf(settings: LoRaSettings) -> bytes:
    """Return RegFrf for reception, which is above the carrier for bandwidths below 62.5 kHz (errata 2.3)."""
    return frf(settings.frequency_hz + _RX_OFFSET_HZ.get(settings.bandwidth_hz, 0))


def register_values(settings: LoRaSettings) -> tuple[RegisterValue, ...]:
    """Return the values of all registers for reception and transmission, in the order of writing, after a reset.

    RegOpMode and the payload length of each packet are excluded, as are registers that errata leave at the reset value.
    """
    values = [
        *map(RegisterValue, FRF, frf(settings.frequency_hz)),
        RegisterValue(Register.PA_RAMP, reg.PA_RAMP_40_US),
        *_power(settings.power_dbm),
        # The AGC sets the gain.
        RegisterValue(Register.LNA, reg.LNA_GAIN_G1 | reg.LNA_BOOST_HF, 0xFF & ~reg.LNA_GAIN_MASK),
        RegisterValue(Register.FIFO_TX_BASE_ADDR, 0x00),  # one packet at a time may use the whole FIFO
        RegisterValue(Register.FIFO_RX_BASE_ADDR, 0x00),
        RegisterValue(Register.IRQ_FLAGS_MASK, 0x00),
        *_modem(settings),
        RegisterValue(Register.MAX_PAYLOAD_LENGTH, MAX_PAYLOAD_BYTES),
        RegisterValue(Register.HOP_PERIOD, 0x00),
        RegisterValue(Register.PPM_CORRECTION, 0x00),
        RegisterValue(Register.SYNC_WORD, settings.sync_word),
        RegisterValue(Register.DIO_MAPPING_1, reg.DIO0_RX_DONE),
        RegisterValue(Register.DIO_MAPPING_2, 0x00),
    ]
    return tuple(values)


def _power(power_dbm: int) -> tuple[RegisterValue, ...]:
    """Return the three registers of the PA_BOOST pin (section 5.4)."""
    if power_dbm == 20:
        pa_dac, min_dbm, ocp_trim = reg.PA_DAC_20_DBM, 5, reg.OCP_TRIM_140_MA
    else:
        pa_dac, min_dbm, ocp_trim = reg.PA_DAC_DEFAULT, 2, reg.OCP_TRIM_100_MA
    return (
        RegisterValue(Register.OCP, reg.OCP_ON | ocp_trim),
        RegisterValue(Register.PA_DAC, pa_dac),
        RegisterValue(Register.PA_CONFIG, reg.PA_SELECT_BOOST | reg.MAX_POWER_MASK | (power_dbm - min_dbm)),
    )


def _modem(settings: LoRaSettings) -> list[RegisterValue]:
    bandwidth_hz = settings.bandwidth_hz
    low_data_rate = settings.low_data_rate
    if low_data_rate is None:
        low_data_rate = low_data_rate_required(settings.spreading_factor, bandwidth_hz)
    wide = bandwidth_hz == 500_000
    detect = reg.DETECT_OPTIMIZE_RESERVED | reg.DETECT_OPTIMIZE_SF7_TO_SF12
    invert_iq = reg.INVERT_IQ_NORMAL
    if settings.inverted_iq:
        invert_iq = (invert_iq | reg.INVERT_IQ_RX) & ~reg.INVERT_IQ_TX_OFF
    values = [
        RegisterValue(
            Register.MODEM_CONFIG_1,
            BANDWIDTHS_HZ.index(bandwidth_hz) << reg.BW_SHIFT
            | (settings.coding_rate - 4) << reg.CODING_RATE_SHIFT,
        ),
        RegisterValue(
            Register.MODEM_CONFIG_2,
            settings.spreading_factor << reg.SPREADING_FACTOR_SHIFT | reg.RX_PAYLOAD_CRC_ON * settings.crc,
        ),
        RegisterValue(Register.MODEM_CONFIG_3, reg.AGC_AUTO_ON | reg.LOW_DATA_RATE_OPTIMIZE * low_data_rate),
        RegisterValue(Register.PREAMBLE_MSB, settings.preamble_symbols >> 8),
        RegisterValue(Register.PREAMBLE_LSB, settings.preamble_symbols & 0xFF),
        RegisterValue(Register.DETECTION_THRESHOLD, reg.DETECTION_THRESHOLD_SF7_TO_SF12),
        RegisterValue(Register.INVERT_IQ, invert_iq),
        RegisterValue(
            Register.INVERT_IQ_2, reg.INVERT_IQ_2_INVERTED if settings.inverted_iq else reg.INVERT_IQ_2_NORMAL
        ),
        RegisterValue(Register.DETECT_OPTIMIZE, detect | reg.AUTOMATIC_IF_ON if wide else detect),
    ]
    if not wide:
        values.append(RegisterValue(Register.REG_2F, _REG_2F.get(bandwidth_hz, _REG_2F_WIDE)))
        values.append(RegisterValue(Register.REG_30, 0x00))
    return values + _high_bandwidth(settings.frequency_hz, wide=wide)


def _high_bandwidth(frequency_hz: int, *, wide: bool) -> list[RegisterValue]:
    for min_hz, max_hz, optimum in _HIGH_BW_BANDS:
        if wide and min_hz <= frequency_hz <= max_hz:
            return [
                RegisterValue(Register.HIGH_BW_OPTIMIZE_1, 0x02),
                RegisterValue(Register.HIGH_BW_OPTIMIZE_2, optimum),
            ]
    return [RegisterValue(Register.HIGH_BW_OPTIMIZE_1, 0x03)]


def packet_strength(pkt_rssi: int, pkt_snr: int, *, frequency_hz: int) -> tuple[float, float]:
    """Return RSSI in dBm and SNR in dB from their registers (section 5.5.5); offsets depend on the port, LF or HF."""
    offset_dbm = reg.RSSI_OFFSET_LF_DBM if frequency_hz < reg.MIN_HF_HZ else reg.RSSI_OFFSET_HF_DBM
    snr_db = (pkt_snr - 256 if pkt_snr > 127 else pkt_snr) / 4
    # Below the noise the RSSI is that of the noise; the signal is lower by the SNR.
    rssi_dbm = offset_dbm + pkt_rssi * 16 / 15 if snr_db >= 0 else offset_dbm + pkt_rssi + snr_db
    return rssi_dbm, snr_db


class RegisterAccess:
    """Register access, one chip-select window per call (section 2.2); raises RadioError when the bus fails."""

    def __init__(self, hal: Hal) -> None:
        self._hal = hal

    def read(self, address: int) -> int:
        """Read one register."""
        return self._hal.transfer(bytes((address, 0)))[1]

    def read_burst(self, address: int, count: int) -> bytes:
        """Read consecutive registers, or bytes of the FIFO, whose address does not increment."""
        return self._hal.transfer(bytes([address]) + bytes(count))[1:]

    def write(self, address: int, *values: int) -> None:
        """Write consecutive registers."""
        self._hal.transfer(bytes((reg.WRITE | address, *values)))

    def write_burst(self, address: int, data: bytes) -> None:
        """Write consecutive registers, or bytes of the FIFO."""
        self._hal.transfer(bytes([reg.WRITE | address]) + data)

    def write_verified(self, register: RegisterValue) -> None:
        """Write a register and read it back. Raises RadioError if it reads back differently."""
        self.write(register.address, register.value)
        self.verify(register)

    def verify(self, register: RegisterValue) -> None:
        """Check that a register reads back as written. Raises RadioError if it reads back differently."""
        actual = self.read(register.address)
        if (actual ^ register.value) & register.mask:
            raise RadioError(
                f"{register.address.name} (0x{register.address:02X}) reads 0x{actual:02X} where 0x{register.value:02X} was written: check the wiring, "
                "a lower spi_hz and the supply"
            )
