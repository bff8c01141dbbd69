"""How runs of measurements are packed into bits.

The newest measurement of a run stands in full. Of each older one there is only how far it is from where the two before
it lead: a straight line in time. A robot that keeps its speed costs little more than the noise of the instrument. Such
a residual takes a field of one of four widths, of which the last holds any number.

The widths fit tracks of real robots and of simulated ones, at 10 to 500 m and up to 2 m/s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tsgt.errors import MessageError
from tsgt.model import Status
from tsgt.radio.superframe.wire.messages import TIME_BITS, WIDE_TIME_BITS, Run, Sighting

if TYPE_CHECKING:
    from tsgt.radio.superframe.wire.bits import BitReader, BitWriter

SEQUENCE_BITS = 8
WIDE_SEQUENCE_BITS = 32
VALUE_BITS = 24
"""Of an angle and of a distance; 0 is no distance."""

NOMINAL_STEP = 25_000
"""Where the first step back in time is expected, in units of 16 us: 0.4 s, as usual for a total station that tracks."""

TIME_WIDTHS = (8, 12, 18, WIDE_TIME_BITS)
HORIZONTAL_WIDTHS = (7, 13, 17, VALUE_BITS)
ZENITH_WIDTHS = (7, 11, 14, VALUE_BITS)
DISTANCE_WIDTHS = (8, 11, 14, VALUE_BITS)
"""Of residuals, in bits, in two's complement."""

_QUALITY_BITS = 4
_COUNT_BITS = 4
_PRISM_BITS = 4
_STATUS_BITS = 3
_CHOICE_BITS = 2

_STATUSES = tuple(Status)
_STATUS_CODES = {status: code for code, status in enumerate(_STATUSES)}


class _Step(NamedTuple):
    """From a measurement of a run to the next older one: sequence number back, the rest as it changes."""

    numbers: int
    time: int
    horizontal: int
    zenith: int
    distance: int


_FIRST = _Step(1, -NOMINAL_STEP, 0, 0, 0)
"""As if before the first step."""


def put_status(writer: BitWriter, status: Status) -> None:
    """Append a verdict."""
    writer.put(_STATUS_CODES[status], _STATUS_BITS)


def take_status(reader: BitReader) -> Status:
    """Return the next verdict.

    Raises
    ------
    MessageError
        There is none with this number.
    """
    code = reader.take(_STATUS_BITS)
    if code >= len(_STATUSES):
        raise MessageError(f"there is no status {code}")
    return _STATUSES[code]


def put_values(writer: BitWriter, horizontal: int, zenith: int, distance: int | None) -> None:
    """Append two angles and a distance in full."""
    writer.put(horizontal, VALUE_BITS)
    writer.put(zenith, VALUE_BITS)
    writer.put(distance or 0, VALUE_BITS)


def take_values(reader: BitReader) -> tuple[int, int, int | None]:
    """Return the next two angles and distance."""
    return reader.take(VALUE_BITS), reader.take(VALUE_BITS), reader.take(VALUE_BITS) or None


def put_newest(writer: BitWriter, sighting: Sighting, *, wide: bool) -> None:
    """Append a measurement in full."""
    sequence_bits, time_bits = _widths(wide=wide)
    writer.put(sighting.sequence % (1 << sequence_bits), sequence_bits)
    writer.put(sighting.time % (1 << time_bits), time_bits)
    put_status(writer, sighting.status)
    put_values(writer, sighting.horizontal, sighting.zenith, sighting.distance)


def take_newest(reader: BitReader, *, wide: bool) -> Sighting:
    """Return the next measurement that stands in full."""
    sequence_bits, time_bits = _widths(wide=wide)
    sequence, time = reader.take(sequence_bits), reader.take(time_bits)
    return Sighting(sequence, time, take_status(reader), *take_values(reader))


def put_run(writer: BitWriter, run: Run) -> None:
    """Append a run.

    Raises
    ------
    MessageError
        It has no measurement or more than 16, they are not newest first, or a number does not go into its field.
    """
    writer.put(run.quality, _QUALITY_BITS)
    flags = (run.direct, run.wide, run.far, run.prism is not None)
    writer.put(any(flags), 1)
    if any(flags):
        for flag in flags:
            writer.put(flag, 1)
        if run.prism is not None:
            writer.put(run.prism - 1, _PRISM_BITS)
    writer.put(len(run.sightings) - 1, _COUNT_BITS)
    newer = run.sightings[0]
    put_newest(writer, newer, wide=run.wide)
    step = _FIRST
    for older in run.sightings[1:]:
        step = _put_older(writer, newer, older, step)
        newer = older


def take_run(reader: BitReader) -> Run:
    """Return the next run.

    Raises
    ------
    MessageError
        The bits are no run.
    """
    quality = reader.take(_QUALITY_BITS)
    direct = wide = far = named = False
    if reader.take(1):
        direct, wide, far, named = (bool(reader.take(1)) for _ in range(4))
    prism = reader.take(_PRISM_BITS) + 1 if named else None
    older_ones = reader.take(_COUNT_BITS)
    sightings = [take_newest(reader, wide=wide)]
    step = _FIRST
    for _ in range(older_ones):
        older, step = _take_older(reader, sightings[-1], step)
        sightings.append(older)
    return Run(sightings=tuple(sightings), direct=direct, quality=quality, wide=wide, prism=prism, far=far)


def _put_older(writer: BitWriter, newer: Sighting, older: Sighting, before: _Step) -> _Step:
    numbers = newer.sequence - older.sequence
    if numbers < 1:
        raise MessageError(f"measurement {older.sequence} cannot stand behind {newer.sequence} in a run")
    other = numbers > 1 or older.status is not newer.status
    writer.put(other, 1)
    if other:
        put_status(writer, older.status)
        _put_count(writer, numbers)
    step = _Step(
        numbers,
        older.time - newer.time,
        _signed(older.horizontal - newer.horizontal, VALUE_BITS),
        _signed(older.zenith - newer.zenith, VALUE_BITS),
        _signed((older.distance or 0) - (newer.distance or 0), VALUE_BITS),
    )
    if _signed(step.time, WIDE_TIME_BITS) != step.time:
        raise MessageError(f"measurement {older.sequence} is days away from {newer.sequence} in the same run")
    if (older.horizontal | older.zenith | (older.distance or 0)) >> VALUE_BITS:
        raise MessageError(
            f"measurement {older.sequence} has a value that does not fit into {VALUE_BITS} bits"
        )
    _put_residual(writer, step.time - before.time // before.numbers * numbers, TIME_WIDTHS)
    _put_residual(
        writer, step.horizontal - _expected(before.horizontal, before, step.time), HORIZONTAL_WIDTHS
    )
    _put_residual(writer, step.zenith - _expected(before.zenith, before, step.time), ZENITH_WIDTHS)
    _put_residual(writer, step.distance - _expected(before.distance, before, step.time), DISTANCE_WIDTHS)
    return step


def _take_older(reader: BitReader, newer: Sighting, before: _Step) -> tuple[Sighting, _Step]:
    numbers, status = 1, newer.status
    if reader.take(1):
        status = take_status(reader)
        numbers = _take_count(reader)
    time = _signed(
        _take_residual(reader, TIME_WIDTHS) + before.time // before.numbers * numbers, WIDE_TIME_BITS
    )
    horizontal = _take_residual(reader, HORIZONTAL_WIDTHS) + _expected(before.horizontal, before, time)
    zenith = _take_residual(reader, ZENITH_WIDTHS) + _expected(before.zenith, before, time)
    distance = _take_residual(reader, DISTANCE_WIDTHS) + _expected(before.distance, before, time)
    older = Sighting(
        newer.sequence - numbers,
        newer.time + time,
        status,
        (newer.horizontal + horizontal) % (1 << VALUE_BITS),
        (newer.zenith + zenith) % (1 << VALUE_BITS),
        ((newer.distance or 0) + distance) % (1 << VALUE_BITS) or None,
    )
    changes = (_signed(change, VALUE_BITS) for change in (horizontal, zenith, distance))
    return older, _Step(numbers, time, *changes)


def _expected(change: int, before: _Step, time: int) -> int:
    """Return how an angle or a distance changes in this time at the rate of the step before."""
    return change * time // before.time if before.time else 0


def _put_count(writer: BitWriter, count: int) -> None:
    """Append a number from 1 on: one zero less than it has bits, then itself."""
    bits = count.bit_length()
    if bits > WIDE_SEQUENCE_BITS:
        raise MessageError(f"{count} is too large a step of the sequence number")
    writer.put(0, bits - 1)
    writer.put(count, bits)


def _take_count(reader: BitReader) -> int:
    zeros = 0
    while not reader.take(1):
        zeros += 1
    return 1 << zeros | reader.take(zeros)


def _put_residual(writer: BitWriter, residual: int, widths: tuple[int, ...]) -> None:
    """Append a number, counted modulo the last width: which width, then itself."""
    residual = _signed(residual, widths[-1])
    for choice, width in enumerate(widths):
        if _signed(residual, width) == residual:
            writer.put(choice, _CHOICE_BITS)
            writer.put(residual % (1 << width), width)
            return


def _take_residual(reader: BitReader, widths: tuple[int, ...]) -> int:
    width = widths[reader.take(_CHOICE_BITS)]
    return _signed(reader.take(width), width)


def _signed(number: int, bits: int) -> int:
    """Return the number from -2^(bits-1) on that is the same modulo 2^bits."""
    half = 1 << bits - 1
    return (number + half) % (1 << bits) - half


def _widths(*, wide: bool) -> tuple[int, int]:
    return (WIDE_SEQUENCE_BITS, WIDE_TIME_BITS) if wide else (SEQUENCE_BITS, TIME_BITS)
