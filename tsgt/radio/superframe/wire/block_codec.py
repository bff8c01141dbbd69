"""Measurement blocks as bit fields.

Linear predictive coding: the newest measurement of a block is sent in full, each older one as its residual from a linear
extrapolation of the two before it, in the narrowest of four field widths that holds it; the last one holds any number.
The widths were fitted to tracks of real and simulated robots at 10 to 500 m and up to 2 m/s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tsgt.errors import MessageError
from tsgt.model import Status
from tsgt.radio.superframe.wire.messages import (
    TIME_BITS,
    WIDE_TIME_BITS,
    EncodedMeasurement,
    MeasurementBlock,
)

if TYPE_CHECKING:
    from tsgt.radio.superframe.wire.bits import BitReader, BitWriter

SEQUENCE_BITS = 8
WIDE_SEQUENCE_BITS = 32
VALUE_BITS = 24  # of an angle and of a distance; distance 0: none

NOMINAL_STEP = 25_000
"""Predicted first time step, in units of 16 us: 0.4 s, the usual period of a tracking total station."""

TIME_WIDTHS = (8, 12, 18, WIDE_TIME_BITS)  # field widths of residuals in bits, two's complement, as below
HORIZONTAL_WIDTHS = (7, 13, 17, VALUE_BITS)
ZENITH_WIDTHS = (7, 11, 14, VALUE_BITS)
DISTANCE_WIDTHS = (8, 11, 14, VALUE_BITS)

_QUALITY_BITS = 4
_COUNT_BITS = 4
_PRISM_BITS = 4
_STATUS_BITS = 3
_WIDTH_INDEX_BITS = 2

_WIDTHS = ((SEQUENCE_BITS, TIME_BITS), (WIDE_SEQUENCE_BITS, WIDE_TIME_BITS))
"""Of sequence number and time, narrow and wide."""

_STATUSES = tuple(Status)
_STATUS_CODES = {status: code for code, status in enumerate(_STATUSES)}


class _Step(NamedTuple):
    """Difference from a measurement to the next older one; ``numbers`` counts the sequence number backwards."""

    numbers: int
    time: int
    horizontal: int
    zenith: int
    distance: int

    def predicted(self, change: int, time: int) -> int:
        """Extrapolate a change of this step linearly to the time of the next one."""
        return change * time // self.time if self.time else 0

    def predicted_time(self, numbers: int) -> int:
        """Extrapolate the time step to a difference of sequence numbers."""
        return self.time // self.numbers * numbers


_INITIAL_STEP = _Step(1, -NOMINAL_STEP, 0, 0, 0)


def put_status(writer: BitWriter, status: Status) -> None:
    """Append a status."""
    writer.put(_STATUS_CODES[status], _STATUS_BITS)


def take_status(reader: BitReader) -> Status:
    """Return the next status; raise MessageError if its code is not assigned."""
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


def put_newest(writer: BitWriter, measurement: EncodedMeasurement, *, wide: bool) -> None:
    """Append a measurement in full."""
    sequence_bits, time_bits = _WIDTHS[wide]
    writer.put(measurement.sequence % (1 << sequence_bits), sequence_bits)
    writer.put(measurement.time % (1 << time_bits), time_bits)
    put_status(writer, measurement.status)
    put_values(writer, measurement.horizontal, measurement.zenith, measurement.distance)


def take_newest(reader: BitReader, *, wide: bool) -> EncodedMeasurement:
    """Return the next measurement in full."""
    sequence_bits, time_bits = _WIDTHS[wide]
    sequence, time = reader.take(sequence_bits), reader.take(time_bits)
    return EncodedMeasurement(sequence, time, take_status(reader), *take_values(reader))


def put_block(writer: BitWriter, block: MeasurementBlock) -> None:
    """Append a block; raise MessageError unless it has 1 to 16 measurements, newest first, that fit their fields."""
    writer.put(block.quality, _QUALITY_BITS)
    flags = (block.beacon_relative, block.wide, block.far, block.prism is not None)
    writer.put(any(flags), 1)
    if any(flags):
        for flag in flags:
            writer.put(flag, 1)
        if block.prism is not None:
            writer.put(block.prism - 1, _PRISM_BITS)
    writer.put(len(block.measurements) - 1, _COUNT_BITS)
    newer = block.measurements[0]
    put_newest(writer, newer, wide=block.wide)
    step = _INITIAL_STEP
    for older in block.measurements[1:]:
        step = _put_older(writer, newer, older, step)
        newer = older


def take_block(reader: BitReader) -> MeasurementBlock:
    """Return the next block; raise MessageError if the bits are none."""
    quality = reader.take(_QUALITY_BITS)
    beacon_relative = wide = far = has_prism = False
    if reader.take(1):
        beacon_relative, wide, far, has_prism = (bool(reader.take(1)) for _ in range(4))
    prism = reader.take(_PRISM_BITS) + 1 if has_prism else None
    older_count = reader.take(_COUNT_BITS)
    measurements = [take_newest(reader, wide=wide)]
    step = _INITIAL_STEP
    for _ in range(older_count):
        older, step = _take_older(reader, measurements[-1], step)
        measurements.append(older)
    return MeasurementBlock(
        measurements=tuple(measurements),
        beacon_relative=beacon_relative,
        quality=quality,
        wide=wide,
        prism=prism,
        far=far,
    )


def _put_older(
    writer: BitWriter, newer: EncodedMeasurement, older: EncodedMeasurement, before: _Step
) -> _Step:
    numbers = newer.sequence - older.sequence
    if numbers < 1:
        raise MessageError(f"measurement {older.sequence} cannot follow {newer.sequence} in a block")
    irregular = numbers > 1 or older.status is not newer.status
    writer.put(irregular, 1)
    if irregular:
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
        raise MessageError(f"measurements {older.sequence} and {newer.sequence} of a block are days apart")
    if (older.horizontal | older.zenith | (older.distance or 0)) >> VALUE_BITS:
        raise MessageError(
            f"measurement {older.sequence} has a value that does not fit into {VALUE_BITS} bits"
        )
    _put_residual(writer, step.time - before.predicted_time(numbers), TIME_WIDTHS)
    for change, change_before, widths in (
        (step.horizontal, before.horizontal, HORIZONTAL_WIDTHS),
        (step.zenith, before.zenith, ZENITH_WIDTHS),
        (step.distance, before.distance, DISTANCE_WIDTHS),
    ):
        _put_residual(writer, change - before.predicted(change_before, step.time), widths)
    return step


def _take_older(
    reader: BitReader, newer: EncodedMeasurement, before: _Step
) -> tuple[EncodedMeasurement, _Step]:
    numbers, status = 1, newer.status
    if reader.take(1):
        status = take_status(reader)
        numbers = _take_count(reader)
    time = _signed(_take_residual(reader, TIME_WIDTHS) + before.predicted_time(numbers), WIDE_TIME_BITS)
    horizontal, zenith, distance = (
        _take_residual(reader, widths) + before.predicted(change_before, time)
        for change_before, widths in (
            (before.horizontal, HORIZONTAL_WIDTHS),
            (before.zenith, ZENITH_WIDTHS),
            (before.distance, DISTANCE_WIDTHS),
        )
    )
    older = EncodedMeasurement(
        newer.sequence - numbers,
        newer.time + time,
        status,
        (newer.horizontal + horizontal) % (1 << VALUE_BITS),
        (newer.zenith + zenith) % (1 << VALUE_BITS),
        ((newer.distance or 0) + distance) % (1 << VALUE_BITS) or None,
    )
    changes = (_signed(change, VALUE_BITS) for change in (horizontal, zenith, distance))
    return older, _Step(numbers, time, *changes)


def _put_count(writer: BitWriter, count: int) -> None:
    """Append a number from 1 on in Elias gamma code."""
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
    """Append a number modulo the last width: index of the width, then the number in two's complement."""
    residual = _signed(residual, widths[-1])
    for index, width in enumerate(widths):
        half = 1 << width - 1
        if -half <= residual < half:
            writer.put(index << width | residual & (1 << width) - 1, _WIDTH_INDEX_BITS + width)
            return


def _take_residual(reader: BitReader, widths: tuple[int, ...]) -> int:
    width = widths[reader.take(_WIDTH_INDEX_BITS)]
    return _signed(reader.take(width), width)


def _signed(number: int, bits: int) -> int:
    """Return the number modulo 2^bits, from -2^(bits-1) on."""
    half = 1 << bits - 1
    return (number + half) % (1 << bits) - half
