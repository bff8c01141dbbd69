"""Memory of a simulated SX1276: both register pages with their reset values, and the FIFO."""

from __future__ import annotations

from tsgt.radio.sx127x import Register

FIFO_BYTES = 256
FIFO_PATTERN = 0xA5
"""FIFO content in SLEEP, which is undefined on the real chip."""

FIRST_PAGED = 0x0D
FIRST_AFTER_PAGED = 0x40
"""Registers from FIRST_PAGED up to this one exist on an FSK page and on a LoRa page."""

REG_IMAGE_CAL = 0x3B
"""RegImageCal of the FSK page: bit 6 starts a calibration, bit 5 is set while it runs."""

REGISTERS = 0x80
"""Number of addresses."""

# Data sheet table 41 and section 6.4; reserved ones as found by drivers.
_COMMON_RESET = {
    Register.OP_MODE: 0x09,  # FSK, low-frequency registers, STDBY
    Register.FRF_MSB: 0x6C,  # 434 MHz
    Register.FRF_MID: 0x80,
    Register.FRF_LSB: 0x00,
    Register.PA_CONFIG: 0x4F,
    Register.PA_RAMP: 0x09,
    Register.OCP: 0x2B,
    Register.LNA: 0x20,
    Register.VERSION: 0x12,
    Register.PLL_HOP: 0x2D,
    Register.TCXO: 0x09,
    Register.PA_DAC: 0x84,
    0x70: 0xD0,  # RegPll
}
_LORA_RESET = {
    Register.FIFO_TX_BASE_ADDR: 0x80,
    Register.MODEM_STAT: 0x10,
    Register.MODEM_CONFIG_1: 0x72,
    Register.MODEM_CONFIG_2: 0x70,
    Register.SYMB_TIMEOUT_LSB: 0x64,
    Register.PREAMBLE_LSB: 0x08,
    Register.PAYLOAD_LENGTH: 0x01,
    Register.MAX_PAYLOAD_LENGTH: 0xFF,
    Register.REG_2F: 0x20,
    Register.DETECT_OPTIMIZE: 0xC3,
    Register.INVERT_IQ: 0x27,
    Register.HIGH_BW_OPTIMIZE_1: 0x03,
    Register.DETECTION_THRESHOLD: 0x0A,
    Register.SYNC_WORD: 0x12,
    Register.HIGH_BW_OPTIMIZE_2: 0x65,
    Register.INVERT_IQ_2: 0x1D,
}
_FSK_RESET = {0x24: 0x05, 0x39: 0xF5, REG_IMAGE_CAL: 0x82}

READ_ONLY = frozenset(
    {
        Register.FIFO_RX_CURRENT_ADDR,
        *range(Register.RX_NB_BYTES, Register.HOP_CHANNEL + 1),
        Register.FIFO_RX_BYTE_ADDR,
        *range(Register.FEI_MSB, Register.FEI_LSB + 1),
        Register.RSSI_WIDEBAND,
        Register.VERSION,
        0x5B,  # RegFormerTemp
    }
)
"""Registers of the LoRa page and common registers that ignore writes."""


class ChipMemory:
    """Registers and FIFO.

    Attributes
    ----------
    frf
        Carrier frequency in effect, in synthesizer steps: RegFrf when its last byte was written.
    """

    def __init__(self) -> None:
        self.lora = bytearray(REGISTERS)  # common registers and the LoRa page, by address
        self.fsk = bytearray(REGISTERS)  # by address; only the FSK page is used
        self.fifo = bytearray(FIFO_BYTES)
        self.frf = 0
        self.reset()

    def reset(self) -> None:
        """Set the power-on values; the FIFO keeps its content."""
        self.lora[:] = bytes(REGISTERS)
        self.fsk[:] = bytes(REGISTERS)
        for address, value in (_COMMON_RESET | _LORA_RESET).items():
            self.lora[address] = value
        for address, value in _FSK_RESET.items():
            self.fsk[address] = value
        self.latch_frf()

    def latch_frf(self) -> None:
        """Let the three bytes of RegFrf take effect."""
        self.frf = int.from_bytes(self.lora[Register.FRF_MSB : Register.FRF_LSB + 1], "big")

    def sleep(self) -> None:
        """Clear what SLEEP clears: the FIFO and the counters of headers and packets."""
        self.fifo[:] = bytes([FIFO_PATTERN]) * FIFO_BYTES
        self.lora[Register.RX_HEADER_CNT_VALUE_MSB : Register.RX_PACKET_CNT_VALUE_LSB + 1] = bytes(4)

    def count(self, msb: int) -> None:
        """Increment a 16-bit counter, which wraps."""
        value = int.from_bytes(self.lora[msb : msb + 2], "big") + 1
        self.lora[msb : msb + 2] = (value & 0xFFFF).to_bytes(2, "big")

    def read_fifo(self, start: int, length: int) -> bytes:
        """Read bytes from the FIFO; addresses wrap."""
        end = start + length
        return bytes(self.fifo[start:end] if end <= FIFO_BYTES else (self.fifo + self.fifo)[start:end])

    def write_fifo(self, start: int, data: bytes) -> int:
        """Write bytes to the FIFO; return the address after the last."""
        end = start + len(data)
        if end <= FIFO_BYTES:
            self.fifo[start:end] = data
        else:
            for address, byte in enumerate(data, start):
                self.fifo[address % FIFO_BYTES] = byte
        return end % FIFO_BYTES
