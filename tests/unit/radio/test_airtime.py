from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsgt.radio import airtime_us, bit_rate_Bps, low_data_rate_required, payload_symbols, symbol_time_ns

if TYPE_CHECKING:
    from collections.abc import Iterator

FACTS = Path(__file__).parents[4] / "shared" / "facts" / "radio.md"
BANDWIDTHS_HZ = (125_000, 250_000, 500_000)


class Modem(TypedDict):
    """Settings that every property is tried with."""

    spreading_factor: int
    bandwidth_hz: int
    coding_rate: int


modems: st.SearchStrategy[Modem] = st.builds(
    Modem,
    spreading_factor=st.integers(7, 12),
    bandwidth_hz=st.sampled_from(BANDWIDTHS_HZ),
    coding_rate=st.integers(5, 8),
)


class Row(NamedTuple):
    """One value of a table: settings, and the time on air that belongs to them."""

    preamble_symbols: int
    bandwidth_hz: int
    spreading_factor: int
    coding_rate: int
    payload_bytes: int
    airtime_us: int


# Worked by hand from the data sheet's formula.
ROWS = [
    Row(8, 250_000, 9, 6, 2, 53_760),
    Row(8, 250_000, 9, 6, 8, 66_048),
    Row(8, 250_000, 9, 6, 9, 78_336),
    Row(8, 250_000, 9, 6, 34, 139_776),
    Row(6, 250_000, 9, 6, 34, 135_680),
    Row(8, 250_000, 9, 6, 255, 741_888),
    Row(8, 250_000, 8, 6, 34, 76_032),
    Row(8, 125_000, 7, 5, 2, 30_976),
    Row(8, 125_000, 11, 6, 34, 1_118_208),
    Row(8, 125_000, 12, 8, 2, 925_696),
    Row(8, 250_000, 12, 5, 20, 659_456),
    Row(6, 500_000, 10, 7, 8, 66_048),
    Row(6, 500_000, 12, 8, 34, 542_720),
]


@pytest.mark.parametrize("row", ROWS)
def test_airtime_of_worked_examples(row: Row) -> None:
    """The airtime is the data sheet's, to the microsecond."""
    assert _computed(row) == row.airtime_us


def test_airtime_matches_every_published_table() -> None:
    """Every value of the fact sheet's tables is met to the microsecond."""
    if not FACTS.is_file():
        pytest.skip(f"the fact sheet is not at {FACTS}")
    rows = list(_published(FACTS.read_text(encoding="utf-8")))
    assert len({(row.spreading_factor, row.bandwidth_hz, row.coding_rate) for row in rows}) == 6 * 3 * 4
    assert [row for row in rows if _computed(row) != row.airtime_us] == []


@pytest.mark.parametrize(
    ("spreading_factor", "bandwidth_hz", "expected"),
    [
        (10, 125_000, False),
        (11, 125_000, True),
        (12, 125_000, True),
        (11, 250_000, False),
        (12, 250_000, True),
        (12, 500_000, False),
        (8, 15_600, True),
    ],
)
def test_low_data_rate_is_required_above_16_ms(
    spreading_factor: int, bandwidth_hz: int, *, expected: bool
) -> None:
    """The low data rate optimisation is required where a symbol lasts longer than 16 ms."""
    assert low_data_rate_required(spreading_factor, bandwidth_hz) is expected


def test_low_data_rate_can_be_forced() -> None:
    """A sender with the optimisation against the rule (SF 11 at 250 kHz) sends longer packets."""
    assert airtime_us(34, spreading_factor=11, bandwidth_hz=250_000, coding_rate=6) == 509_952
    assert (
        airtime_us(34, spreading_factor=11, bandwidth_hz=250_000, coding_rate=6, low_data_rate=True)
        == 559_104
    )


def test_spreading_factor_6_has_the_same_preamble() -> None:
    """The preamble has 4.25 extra symbols at SF 6 too, unlike on later chips."""
    # ceil((80 - 24 + 28 + 16 - 20) / 24) = 4 blocks of 5 symbols, 8 + 20 + 12.25 symbols of 0.512 ms
    assert airtime_us(
        10, spreading_factor=6, bandwidth_hz=125_000, coding_rate=5, explicit_header=False
    ) == round(40.25 * 512)


def test_symbols_without_header_and_crc() -> None:
    """Omitting header and CRC saves 36 bits."""
    with_both = payload_symbols(34, spreading_factor=9, coding_rate=6)
    without = payload_symbols(34, spreading_factor=9, coding_rate=6, explicit_header=False, crc=False)
    assert (with_both, without) == (56, 50)


def test_the_shortest_packet_has_eight_symbols() -> None:
    """A payload that fits into the first block adds no symbols."""
    assert payload_symbols(1, spreading_factor=12, coding_rate=8, explicit_header=False, crc=False) == 8


def test_symbol_time_of_odd_bandwidths_is_rounded() -> None:
    """At 7.8 kHz a symbol is not a whole number of nanoseconds: 128 / 7800 s."""
    assert symbol_time_ns(7, 7_800) == 16_410_256


def test_bit_rate_of_the_paper() -> None:
    """SF 9, 250 kHz and 4/6 carry the paper's 366 bytes per second."""
    assert bit_rate_Bps(9, 250_000, 6) == 366.2109375


@given(payload_bytes=st.integers(1, 254), modem=modems)
def test_airtime_increases_with_the_payload(payload_bytes: int, modem: Modem) -> None:
    """One more byte costs nothing or one block of as many symbols as the coding rate's denominator."""
    step_us = airtime_us(payload_bytes + 1, **modem) - airtime_us(payload_bytes, **modem)
    block_ns = modem["coding_rate"] * symbol_time_ns(modem["spreading_factor"], modem["bandwidth_hz"])
    assert step_us * 1000 in (0, block_ns)


@given(payload_bytes=st.integers(1, 255), preamble=st.integers(6, 60_000), modem=modems)
def test_preamble_symbol_costs_one_symbol(payload_bytes: int, preamble: int, modem: Modem) -> None:
    """Another symbol of preamble lasts one symbol."""
    more_us = airtime_us(payload_bytes, **modem, preamble_symbols=preamble + 1)
    less_us = airtime_us(payload_bytes, **modem, preamble_symbols=preamble)
    symbol_ns = symbol_time_ns(modem["spreading_factor"], modem["bandwidth_hz"])
    # Times are whole microseconds, and so is every symbol at these bandwidths.
    assert (more_us - less_us) * 1000 == symbol_ns


def _computed(row: Row) -> int:
    return airtime_us(
        row.payload_bytes,
        spreading_factor=row.spreading_factor,
        bandwidth_hz=row.bandwidth_hz,
        coding_rate=row.coding_rate,
        preamble_symbols=row.preamble_symbols,
    )


def _published(text: str) -> Iterator[Row]:
    """Every value of section 5: the two detailed tables and the large ones."""
    detailed, tables = text.partition("### 5.2")[2].partition("## 6.")[0].split("### 5.3")
    for spreading_factor, part in zip((9, 8), detailed.split("**SF8"), strict=True):
        for cells in _cells(part):
            # The last columns are times on air: preamble 8, and at SF 9 preamble 6 too.
            times = cells[4:] if spreading_factor == 9 else cells[2:]
            for preamble_symbols, time_ms in zip((8, 6), times, strict=False):
                yield Row(
                    preamble_symbols, 250_000, spreading_factor, 6, int(cells[0]), _microseconds(time_ms)
                )
    for table in re.split(r"\*\*Preamble (?=\d)", tables)[1:]:
        preamble_symbols, bandwidth_khz = map(int, re.findall(r"^(\d+), BW (\d+) kHz", table)[0])
        payloads = [int(size) for size in re.findall(r"(\d+) B \|", table)]
        for cells in _cells(table):
            for payload_bytes, time_ms in zip(payloads, cells[4:], strict=True):
                yield Row(
                    preamble_symbols,
                    bandwidth_khz * 1000,
                    int(cells[0]),
                    int(cells[3].removeprefix("4/")),
                    payload_bytes,
                    _microseconds(time_ms),
                )


def _cells(table: str) -> Iterator[list[str]]:
    for line in table.splitlines():
        if re.match(r"\| \d", line):
            yield [cell.strip(" *") for cell in line.strip("|").split("|")]


def _microseconds(time_ms: str) -> int:
    whole, fraction = time_ms.split(".")
    return int(whole) * 1000 + int(fraction)
