"""Registers of the SX1276/77/78/79 in LoRa mode: addresses, then bit fields.

Names and section numbers are those of the data sheet, Rev. 4 (March 2015); "errata" is Semtech's errata note for
the chip. A register without a name is called by its address.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag


class Register(IntEnum):
    """Addresses; 0x0D to 0x3F are the LoRa page."""

    # Common to FSK and LoRa mode (section 6.1, table 41)
    FIFO = 0x00
    OP_MODE = 0x01
    FRF_MSB = 0x06
    FRF_MID = 0x07
    FRF_LSB = 0x08  # writing it applies all three
    PA_CONFIG = 0x09
    PA_RAMP = 0x0A
    OCP = 0x0B
    LNA = 0x0C
    DIO_MAPPING_1 = 0x40
    DIO_MAPPING_2 = 0x41
    VERSION = 0x42
    PLL_HOP = 0x44
    TCXO = 0x4B
    PA_DAC = 0x4D

    # The LoRa page (section 6.4)
    FIFO_ADDR_PTR = 0x0D
    FIFO_TX_BASE_ADDR = 0x0E
    FIFO_RX_BASE_ADDR = 0x0F
    FIFO_RX_CURRENT_ADDR = 0x10
    IRQ_FLAGS_MASK = 0x11
    IRQ_FLAGS = 0x12
    RX_NB_BYTES = 0x13
    RX_HEADER_CNT_VALUE_MSB = 0x14
    RX_HEADER_CNT_VALUE_LSB = 0x15
    RX_PACKET_CNT_VALUE_MSB = 0x16
    RX_PACKET_CNT_VALUE_LSB = 0x17
    MODEM_STAT = 0x18
    PKT_SNR_VALUE = 0x19  # signed, in quarters of a dB
    PKT_RSSI_VALUE = 0x1A
    RSSI_VALUE = 0x1B
    HOP_CHANNEL = 0x1C
    MODEM_CONFIG_1 = 0x1D
    MODEM_CONFIG_2 = 0x1E
    SYMB_TIMEOUT_LSB = 0x1F
    PREAMBLE_MSB = 0x20
    PREAMBLE_LSB = 0x21
    PAYLOAD_LENGTH = 0x22
    MAX_PAYLOAD_LENGTH = 0x23
    HOP_PERIOD = 0x24
    FIFO_RX_BYTE_ADDR = 0x25
    MODEM_CONFIG_3 = 0x26
    PPM_CORRECTION = 0x27
    FEI_MSB = 0x28
    FEI_MID = 0x29
    FEI_LSB = 0x2A
    RSSI_WIDEBAND = 0x2C
    REG_2F = 0x2F  # intermediate frequency, errata 2.3; sources disagree on which half is which
    REG_30 = 0x30
    DETECT_OPTIMIZE = 0x31
    INVERT_IQ = 0x33
    HIGH_BW_OPTIMIZE_1 = 0x36  # errata 2.1
    DETECTION_THRESHOLD = 0x37
    SYNC_WORD = 0x39
    HIGH_BW_OPTIMIZE_2 = 0x3A  # errata 2.1
    INVERT_IQ_2 = 0x3B


# --- SPI (section 2.2) ----------------------------------------------------------------------------------------

WRITE = 0x80  # bit 7 of the address byte

# --- RegOpMode (section 4.1.6) --------------------------------------------------------------------------------

LONG_RANGE_MODE = 0x80
ACCESS_SHARED_REG = 0x40
LOW_FREQUENCY_MODE_ON = 0x08
MODE_MASK = 0x07


class Mode(IntEnum):
    """Bits 2-0 of RegOpMode in LoRa mode (table 16)."""

    SLEEP = 0
    STDBY = 1
    FSTX = 2
    TX = 3
    FSRX = 4
    RXCONTINUOUS = 5
    RXSINGLE = 6
    CAD = 7


# --- RegFrf (section 4.1.4): the carrier is Frf * F_XOSC / 2^19 -----------------------------------------------

F_XOSC_HZ = 32_000_000
FRF_BITS = 19

# --- RegPaConfig, RegPaRamp, RegOcp, RegPaDac (section 5.4) ---------------------------------------------------

PA_SELECT_BOOST = 0x80
MAX_POWER_MASK = 0x70
OUTPUT_POWER_MASK = 0x0F
PA_RAMP_40_US = 0x09
OCP_ON = 0x20
OCP_TRIM_100_MA = 11
OCP_TRIM_140_MA = 17
PA_DAC_DEFAULT = 0x84
PA_DAC_20_DBM = 0x87

# --- RegLna (section 5.5.3) -----------------------------------------------------------------------------------

LNA_GAIN_G1 = 0x20
LNA_GAIN_MASK = 0xE0
LNA_BOOST_HF = 0x03

# --- RegDioMapping1 (table 18) --------------------------------------------------------------------------------

DIO0_RX_DONE = 0x00
DIO0_TX_DONE = 0x40
DIO0_CAD_DONE = 0x80

# --- RegVersion (section 6.4) ---------------------------------------------------------------------------------

VERSION_SX1276 = 0x12
VERSIONS_LIKE_SX1276 = frozenset({0x11, 0x13})  # not in the data sheet; read from RFM95 modules and clones
VERSION_SX1272 = 0x22

# --- RegIrqFlags, RegIrqFlagsMask (section 6.4) ---------------------------------------------------------------


class Irq(IntFlag):
    """Bits of RegIrqFlags; writing a one clears the bit."""

    RX_TIMEOUT = 0x80
    RX_DONE = 0x40
    PAYLOAD_CRC_ERROR = 0x20
    VALID_HEADER = 0x10
    TX_DONE = 0x08
    CAD_DONE = 0x04
    FHSS_CHANGE_CHANNEL = 0x02
    CAD_DETECTED = 0x01


ALL_IRQ_FLAGS = 0xFF

# --- RegModemStat (section 6.4) -------------------------------------------------------------------------------

RX_CODING_RATE_SHIFT = 5
MODEM_CLEAR = 0x10
HEADER_INFO_VALID = 0x08
RX_ON_GOING = 0x04
SIGNAL_SYNCHRONIZED = 0x02
SIGNAL_DETECTED = 0x01

# --- RegHopChannel (section 6.4) ------------------------------------------------------------------------------

CRC_ON_PAYLOAD = 0x40

# --- RegModemConfig1, 2, 3 (section 6.4) ----------------------------------------------------------------------

BW_SHIFT = 4
CODING_RATE_SHIFT = 1
IMPLICIT_HEADER_MODE_ON = 0x01

SPREADING_FACTOR_SHIFT = 4
TX_CONTINUOUS_MODE = 0x08
RX_PAYLOAD_CRC_ON = 0x04
SYMB_TIMEOUT_MSB_MASK = 0x03

LOW_DATA_RATE_OPTIMIZE = 0x08
AGC_AUTO_ON = 0x04

# --- RegDetectOptimize, RegDetectionThreshold (section 4.1.1.2; bit 7: errata 2.3) ----------------------------

AUTOMATIC_IF_ON = 0x80
DETECT_OPTIMIZE_RESERVED = 0x40  # bits 6-3 as after a reset
DETECT_OPTIMIZE_SF7_TO_SF12 = 0x03
DETECTION_THRESHOLD_SF7_TO_SF12 = 0x0A

# --- RegInvertIQ, RegInvertIQ2 (section 6.4) ------------------------------------------------------------------

INVERT_IQ_RX = 0x40
INVERT_IQ_TX_OFF = 0x01  # set: sent chirps are not inverted
INVERT_IQ_NORMAL = 0x27
INVERT_IQ_2_NORMAL = 0x1D
INVERT_IQ_2_INVERTED = 0x19

# --- Packet strength (section 5.5.5) --------------------------------------------------------------------------

RSSI_OFFSET_HF_DBM = -157
RSSI_OFFSET_LF_DBM = -164
MIN_HF_HZ = 525_000_000  # carriers from here on use the HF port
