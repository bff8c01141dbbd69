"""What the simulated SX1276 holds: its two register pages as after a reset, and the FIFO."""

from __future__ import annotations

from tsgt.radio.sx127x import Register

FIFO_BYTES = 256
FIFO_PATTERN = 0xA5
"""Fills the FIFO in SLEEP, where the real content is undefined, so that nobody relies on it."""

FIRST_PAGED = 0x0D
FIRST_AFTER_PAGED = 0x40
"""Registers from the first to before the second exist on an FSK page and on a LoRa page."""

REG_IMAGE_CAL = 0x3B
"""RegImageCal of the FSK page: bit 6 starts a calibration, bit 5 tells that it runs."""

REGISTERS = 0x80
"""How many addresses there are."""

# Data sheet table 41 and section 6.4; those that it calls reserved are as drivers have found them
# (facts/radio.md 2.1, 2.2).
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
"""Registers of the LoRa page and common ones that ignore writes."""


class ChipMemory:
    """Registers and FIFO.

    Attributes
    ----------
    lora
        Registers by address: the common ones and the LoRa page.
    fsk
        Registers by address, of which the FSK page is used.
    fifo
        256 bytes, for sending and receiving alike.
    frf
        The carrier in force, in steps of the synthesizer: RegFrf as it was when its last byte was written.
    """

    def __init__(self) -> None:
        self.lora = bytearray(REGISTERS)
        self.fsk = bytearray(REGISTERS)
        self.fifo = bytearray(FIFO_BYTES)
        self.frf = 0
        self.reset()

    def reset(self) -> None:
        """Set everything as it is after power-on; the FIFO keeps what chance left in it."""
        self.lora[:] = bytes(REGISTERS)
        self.fsk[:] = bytes(REGISTERS)
        for address, value in (_COMMON_RESET | _LORA_RESET).items():
            self.lora[address] = value
        for address, value in _FSK_RESET.items():
            self.fsk[address] = value
        self.latch_frf()

    def latch_frf(self) -> None:
        """Put the three bytes of RegFrf in force."""
        self.frf = int.from_bytes(self.lora[Register.FRF_MSB : Register.FRF_LSB + 1], "big")

    def sleep(self) -> None:
        """Lose what the chip loses in SLEEP: the FIFO and the counts of headers and packets."""
        self.fifo[:] = bytes([FIFO_PATTERN]) * FIFO_BYTES
        self.lora[Register.RX_HEADER_CNT_VALUE_MSB : Register.RX_PACKET_CNT_VALUE_LSB + 1] = bytes(4)

    def count(self, msb: int) -> None:
        """Add one to a 16-bit counter, which wraps."""
        value = int.from_bytes(self.lora[msb : msb + 2], "big") + 1
        self.lora[msb : msb + 2] = (value & 0xFFFF).to_bytes(2, "big")

    def read_fifo(self, start: int, length: int) -> bytes:
        """Copy bytes out of the FIFO, whose addresses wrap."""
        end = start + length
        return bytes(self.fifo[start:end] if end <= FIFO_BYTES else (self.fifo + self.fifo)[start:end])

    def write_fifo(self, start: int, data: bytes) -> int:
        """Copy bytes into the FIFO and return the address after the last."""
        end = start + len(data)
        if end <= FIFO_BYTES:
            self.fifo[start:end] = data
        else:
            for address, byte in enumerate(data, start):
                self.fifo[address % FIFO_BYTES] = byte
        return end % FIFO_BYTES
