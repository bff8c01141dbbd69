"""Time on air of a LoRa packet, in integers (SX1276 data sheet 4.1.1.6 and 4.1.1.7).

A coding rate is given by its denominator, 5 to 8. Results are exact at 31.25, 62.5, 125, 250 and 500 kHz, where a symbol
lasts a whole number of nanoseconds; at the other nominal bandwidths they are rounded half up.
"""

from __future__ import annotations

# Within a longer symbol the crystals' drift matters, hence the low data rate optimisation.
_MAX_SYMBOL_MS = 16

SYNC_QUARTER_SYMBOLS = 17
"""Quarter symbols after the programmed preamble: 2 symbols of sync word and 2.25 of start of frame delimiter."""

HEADER_SYMBOLS = 8  # symbols of the header and the start of the payload, always at rate 4/8

TX_DONE_NS = 67_000
"""From the end of a packet on the air to TxDone of its sender, measured by Semtech for basicmac."""

# From the same measurements, at 125 and 500 kHz; accurate to a tenth of a symbol, and constant for each chip.
_RX_DONE_SYMBOLS = {7: 0.74, 8: 0.74, 9: 0.76, 10: 0.80, 11: 0.81, 12: 0.90}


def symbol_time_ns(spreading_factor: int, bandwidth_hz: int) -> int:
    """Return the duration of one symbol, 2^SF / BW."""
    return _divide_half_up((1 << spreading_factor) * 1_000_000_000, bandwidth_hz)


def rx_done_ns(spreading_factor: int, bandwidth_hz: int) -> int:
    """Return the time from the end of a packet on the air to RxDone of its receiver; SF 7 to 12."""
    return round(_RX_DONE_SYMBOLS[spreading_factor] * symbol_time_ns(spreading_factor, bandwidth_hz))


def low_data_rate_required(spreading_factor: int, bandwidth_hz: int) -> bool:
    """Whether a symbol exceeds 16 ms, so that the low data rate optimisation must be on."""
    return (1 << spreading_factor) * 1000 > _MAX_SYMBOL_MS * bandwidth_hz


def payload_symbols(
    payload_bytes: int,
    *,
    spreading_factor: int,
    coding_rate: int,
    explicit_header: bool = True,
    crc: bool = True,
    low_data_rate: bool = False,
) -> int:
    """Count the symbols after the preamble: header, payload and CRC.

    Parameters
    ----------
    payload_bytes
        1 to 255.
    spreading_factor
        6 to 12.
    coding_rate
        Denominator, 5 to 8.
    explicit_header
        The packet states its own length, coding rate and CRC flag.
    crc
        Two bytes of CRC follow the payload.
    low_data_rate
        The low data rate optimisation is on: two bits fewer per symbol.
    """
    bits = 8 * payload_bytes - 4 * spreading_factor + 28 + 16 * crc - 20 * (not explicit_header)
    bits_per_block = 4 * (spreading_factor - 2 * low_data_rate)
    blocks = max(-(-bits // bits_per_block), 0)
    return HEADER_SYMBOLS + blocks * coding_rate


def airtime_us(
    payload_bytes: int,
    *,
    spreading_factor: int,
    bandwidth_hz: int,
    coding_rate: int,
    preamble_symbols: int = 8,
    explicit_header: bool = True,
    crc: bool = True,
    low_data_rate: bool | None = None,
) -> int:
    """Return the time from the first symbol of the preamble to the end of the packet; see :func:`payload_symbols`.

    ``preamble_symbols``: value of the preamble register; 4.25 symbols more are sent. ``low_data_rate``: the low data
    rate optimisation; None follows :func:`low_data_rate_required`.
    """
    if low_data_rate is None:
        low_data_rate = low_data_rate_required(spreading_factor, bandwidth_hz)
    symbols = payload_symbols(
        payload_bytes,
        spreading_factor=spreading_factor,
        coding_rate=coding_rate,
        explicit_header=explicit_header,
        crc=crc,
        low_data_rate=low_data_rate,
    )
    quarter_symbols = 4 * (preamble_symbols + symbols) + SYNC_QUARTER_SYMBOLS
    return _divide_half_up((quarter_symbols << spreading_factor) * 1_000_000, 4 * bandwidth_hz)


def bit_rate_Bps(spreading_factor: int, bandwidth_hz: int, coding_rate: int) -> float:  # noqa: N802 (unit)
    """Return the nominal payload rate SF * 4/CR * BW / 2^SF in bytes/s, without preamble, header, optimisation."""
    return spreading_factor * 4 * bandwidth_hz / ((coding_rate << spreading_factor) * 8)


def _divide_half_up(numerator: int, denominator: int) -> int:
    return (2 * numerator + denominator) // (2 * denominator)
