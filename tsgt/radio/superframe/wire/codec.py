"""Beacons and replies of the superframe as bytes, without their authentication code. Sans-I/O.

The encoding is canonical: a message has exactly one form, and decoding rejects every other one, so that no bit of a
packet is without meaning.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from tsgt.errors import MessageError
from tsgt.radio.commands import DirectCommand, Direction, MeasureCommand, SearchCommand, TrackCommand
from tsgt.radio.superframe.wire.authentication import CODE_BYTES
from tsgt.radio.superframe.wire.bits import BitReader, BitWriter
from tsgt.radio.superframe.wire.block_codec import (
    VALUE_BITS,
    put_block,
    put_newest,
    put_status,
    put_values,
    take_block,
    take_newest,
    take_status,
    take_values,
)
from tsgt.radio.superframe.wire.messages import (
    CONDITION_KIND_BITS,
    CONDITION_VALUE_BITS,
    MAX_STATIONS,
    SINGLE_QUALITY,
    TURNAROUND_BITS,
    VERSION,
    Beacon,
    CommandResponse,
    ConditionItem,
    EncodedCommand,
    EncodedDirection,
    JoinConfirmation,
    JoinRequest,
    MeasurementBlock,
    Reply,
    SessionInfo,
    SingleMeasurement,
    SlotOrder,
    StationEntry,
    StatusReport,
)

if TYPE_CHECKING:
    from tsgt.radio.commands import Command

_VERSION_BITS = 2
_BEACON_BYTES = 5
_PADDING_BITS = 8

_SINGLE, _BLOCKS, _EXTENDED = range(3)
_END, _SESSION, _CONFIRMATION, _COMMAND = range(4)
_TRACK, _SEARCH, _DIRECT, _MEASURE, _SEARCH_TOWARDS = _COMMAND_CODES = range(5)

_SESSION_FIELDS = {"nonce": 48, "counter_high": 16, "sent_high": 24, "guard": 8, "turnaround": 8}
_JOIN_FIELDS = {"nonce": 32, "stream_id": 16, "first_sequence": 32, "oldest": 32}
"""Fields of a message part in their order, with their widths in bits."""

_FULL_CIRCLE = 1 << VALUE_BITS
_COMMAND_CIRCLE = 1 << 16
_MAX_DISTANCE = (1 << VALUE_BITS) - 1
_NEAR_UNITS_PER_M = 10_000
_FAR_UNITS_PER_M = 1_000

MIN_SPREAD_RAD = math.radians(0.25)
MAX_SPREAD_CODE = 15
_ROUNDING_RAD = math.hypot(0.5, 0.5) * math.tau / _COMMAND_CIRCLE

# --- Beacons ----------------------------------------------------------------------------------------------------------


def encode_beacon(beacon: Beacon) -> bytes:
    """Return the content of a beacon; raise MessageError if a number does not fit its field."""
    stations = len(beacon.stations)
    if not 1 <= stations <= MAX_STATIONS:
        raise MessageError(f"a beacon addresses 1 to {MAX_STATIONS} stations, got {stations}")
    extended = beacon.session is not None or bool(beacon.confirmations) or bool(beacon.commands)
    writer = BitWriter()
    writer.put(VERSION, _VERSION_BITS)
    writer.put(beacon.frame, 8)
    writer.put(extended, 1)
    writer.put(beacon.sent, 16)
    writer.put(beacon.cumulative, 8)
    writer.put(beacon.slot_order.reverse, 1)
    writer.put(beacon.slot_order.first, 4)
    if extended:
        writer.put(stations - 1, 4)
    for entry in beacon.stations:
        writer.put(entry.ack_bitmap, 4)
        writer.put(entry.grant, 4)
    if extended:
        _put_items(writer, beacon)
    return writer.to_bytes()


def decode_beacon(content: bytes) -> Beacon:
    """Return the beacon with this content; raise MessageError if :func:`encode_beacon` returns it for none."""
    reader = BitReader(content)
    _take_version(reader)
    frame = reader.take(8)
    extended = reader.take(1)
    sent, cumulative = reader.take(16), reader.take(8)
    reverse, first = bool(reader.take(1)), reader.take(4)
    stations = reader.take(4) + 1 if extended else len(content) - _BEACON_BYTES
    entries = tuple(StationEntry(reader.take(4), reader.take(4)) for _ in range(stations))
    session: SessionInfo | None = None
    confirmations: list[JoinConfirmation] = []
    commands: list[EncodedCommand] = []
    while extended and (item := reader.take(2)) != _END:
        if item == _SESSION:
            session = SessionInfo(**_take_fields(reader, _SESSION_FIELDS))
        elif item == _CONFIRMATION:
            confirmations.append(JoinConfirmation(reader.take(4) + 1, reader.take(32)))
        else:
            commands.append(_take_command(reader))
    beacon = Beacon(
        frame=frame,
        sent=sent,
        cumulative=cumulative,
        slot_order=SlotOrder(first, reverse),
        stations=entries,
        session=session,
        confirmations=tuple(confirmations),
        commands=tuple(commands),
    )
    _require_canonical(encode_beacon(beacon), content)
    return beacon


def _put_items(writer: BitWriter, beacon: Beacon) -> None:
    if beacon.session is not None:
        writer.put(_SESSION, 2)
        sent = {} if beacon.sent else {"sent_high": 0}
        _put_fields(writer, beacon.session, _SESSION_FIELDS, **sent)
    addressed = [each.station for each in beacon.confirmations] + [each.station for each in beacon.commands]
    for station in addressed:
        if not 1 <= station <= len(beacon.stations):
            raise MessageError(f"a beacon to {len(beacon.stations)} stations addresses station {station}")
    for confirmation in beacon.confirmations:
        writer.put(_CONFIRMATION, 2)
        writer.put(confirmation.station - 1, 4)
        writer.put(confirmation.nonce, 32)
    for command in beacon.commands:
        _check_command(command)
        writer.put(_COMMAND, 2)
        writer.put(command.station - 1, 4)
        writer.put(command.command_id, 4)
        writer.put(command.code, 4)
        writer.put(command.argument, 4)
        if command.towards is not None:
            writer.put(command.towards.horizontal, 16)
            writer.put(command.towards.zenith, 16)
    writer.put(_END, 2)


def _check_command(command: EncodedCommand) -> None:
    has_argument = command.argument and command.code not in (_TRACK, _SEARCH_TOWARDS)
    has_direction = command.towards is not None
    if (
        command.code not in _COMMAND_CODES
        or has_argument
        or has_direction != (command.code == _SEARCH_TOWARDS)
    ):
        direction = "a direction" if has_direction else "no direction"
        raise MessageError(
            f"there is no command {command.code} with argument {command.argument} and {direction}"
        )


def _take_command(reader: BitReader) -> EncodedCommand:
    station, command_id, code, argument = reader.take(4) + 1, reader.take(4), reader.take(4), reader.take(4)
    towards = EncodedDirection(reader.take(16), reader.take(16)) if code == _SEARCH_TOWARDS else None
    return EncodedCommand(station, command_id, code, argument, towards)


# --- Replies ----------------------------------------------------------------------------------------------------------


def encode_reply(reply: Reply) -> bytes:
    """Return the content of a reply in its shortest form; raise MessageError if a number does not fit its field.

    A single plain measurement of a quality better than :data:`SINGLE_QUALITY` is decoded with that quality.
    """
    writer = BitWriter()
    writer.put(VERSION, _VERSION_BITS)
    parts = (
        reply.join_request,
        reply.status_report,
        reply.turnaround_us,
        reply.response,
        reply.single_measurement,
    )
    extended = any(part is not None for part in parts)
    if not extended and len(reply.blocks) == 1 and _is_single(reply.blocks[0]):
        writer.put(_SINGLE, 2)
        put_newest(writer, reply.blocks[0].measurements[0], wide=False)
        return writer.to_bytes()
    writer.put(_EXTENDED if extended else _BLOCKS, 2)
    if extended:
        for part in parts:
            writer.put(part is not None, 1)
        _put_parts(writer, reply)
    for block in reply.blocks:
        put_block(writer, block)
    return writer.to_bytes()


def decode_reply(content: bytes) -> Reply:
    """Return the reply with this content; raise MessageError if :func:`encode_reply` returns it for none."""
    reader = BitReader(content)
    _take_version(reader)
    form = reader.take(2)
    if form == _SINGLE:
        reply = Reply(blocks=(MeasurementBlock(measurements=(take_newest(reader, wide=False),)),))
    elif form == _BLOCKS:
        reply = Reply(blocks=_take_blocks(reader))
    elif form == _EXTENDED:
        reply = _take_extended(reader)
    else:
        raise MessageError(f"there is no reply of form {form}")
    _require_canonical(encode_reply(reply), content)
    return reply


def reply_bytes(reply: Reply) -> int:
    """Return the length of a reply in bytes, authentication code included."""
    return len(encode_reply(reply)) + CODE_BYTES


def _is_single(block: MeasurementBlock) -> bool:
    plain = not (block.beacon_relative or block.wide or block.far or block.prism is not None)
    return plain and len(block.measurements) == 1 and block.quality <= SINGLE_QUALITY


def _put_parts(writer: BitWriter, reply: Reply) -> None:
    report, response, single = reply.status_report, reply.response, reply.single_measurement
    if reply.join_request is not None:
        _put_fields(writer, reply.join_request, _JOIN_FIELDS)
    if report is not None:
        writer.put(report.prism - 1, 4)
        writer.put(report.direct, 1)
        writer.put(report.connected, 1)
        writer.put(report.missed_slots, 8)
        writer.put(report.rejected_beacons, 4)
        writer.put(-report.rssi_dbm, 7)
        writer.put(report.condition.kind, CONDITION_KIND_BITS)
        writer.put(report.condition.value, CONDITION_VALUE_BITS)
    if reply.turnaround_us is not None:
        writer.put(reply.turnaround_us, TURNAROUND_BITS)
    if response is not None:
        writer.put(response.command_id, 4)
        writer.put(response.ok, 1)
    if single is not None:
        writer.put(single.command_id, 4)
        put_status(writer, single.status)
        put_values(writer, single.horizontal, single.zenith, single.distance)


def _take_extended(reader: BitReader) -> Reply:
    joins, reports, has_turnaround, responds, has_single = (reader.take(1) for _ in range(5))
    # Keyword arguments are evaluated in this order, which is that of the fields.
    return Reply(
        join_request=JoinRequest(**_take_fields(reader, _JOIN_FIELDS)) if joins else None,
        status_report=(
            StatusReport(
                prism=reader.take(4) + 1,
                direct=bool(reader.take(1)),
                connected=bool(reader.take(1)),
                missed_slots=reader.take(8),
                rejected_beacons=reader.take(4),
                rssi_dbm=-reader.take(7),
                condition=ConditionItem(reader.take(CONDITION_KIND_BITS), reader.take(CONDITION_VALUE_BITS)),
            )
            if reports
            else None
        ),
        turnaround_us=reader.take(TURNAROUND_BITS) if has_turnaround else None,
        response=CommandResponse(reader.take(4), bool(reader.take(1))) if responds else None,
        single_measurement=(
            SingleMeasurement(reader.take(4), take_status(reader), *take_values(reader))
            if has_single
            else None
        ),
        blocks=_take_blocks(reader),
    )


def _take_blocks(reader: BitReader) -> tuple[MeasurementBlock, ...]:
    """Read blocks until less than a byte is left: only padding."""
    blocks = []
    while reader.remaining >= _PADDING_BITS:
        blocks.append(take_block(reader))
    return tuple(blocks)


# --- Commands ---------------------------------------------------------------------------------------------------------


def spread_rad(code: int) -> float:
    """Return the search half-width of a code 0 to 15, in rad: 0.25 degrees, doubled every two steps."""
    return MIN_SPREAD_RAD * math.exp2(code / 2)


def encode_command(station: int, command_id: int, command: Command, tracked: int) -> EncodedCommand:
    """Return a command as a beacon carries it; a track command without a prism means the one ``tracked``.

    The spread of a search direction is increased by the rounding of its angles, and limited to 45 degrees.
    """
    match command:
        case TrackCommand(prism):
            return EncodedCommand(station, command_id, _TRACK, (prism or tracked) - 1)
        case SearchCommand(towards):
            if towards is None:
                return EncodedCommand(station, command_id, _SEARCH)
            spread = _spread_code(towards.spread_rad + _ROUNDING_RAD)
            direction = EncodedDirection(
                _encode_angle(towards.horizontal_angle_rad, _COMMAND_CIRCLE),
                _encode_angle(towards.zenith_angle_rad, _COMMAND_CIRCLE),
            )
            return EncodedCommand(station, command_id, _SEARCH_TOWARDS, spread, direction)
        case DirectCommand():
            return EncodedCommand(station, command_id, _DIRECT)
        case MeasureCommand():
            return EncodedCommand(station, command_id, _MEASURE)


def decode_command(encoded: EncodedCommand) -> Command:
    """Return the command of a decoded beacon."""
    if encoded.towards is not None:
        return SearchCommand(
            Direction(
                horizontal_angle_rad=_decode_angle(encoded.towards.horizontal, _COMMAND_CIRCLE),
                zenith_angle_rad=_decode_angle(encoded.towards.zenith, _COMMAND_CIRCLE),
                spread_rad=spread_rad(encoded.argument),
            )
        )
    match encoded.code:
        case 0:
            return TrackCommand(encoded.argument + 1)
        case 1:
            return SearchCommand()
        case 2:
            return DirectCommand()
        case _:  # decode_beacon rejects codes above 4
            return MeasureCommand()


def _spread_code(spread_rad: float) -> int:
    steps = math.ceil(2 * math.log2(max(spread_rad, MIN_SPREAD_RAD) / MIN_SPREAD_RAD))
    return min(steps, MAX_SPREAD_CODE)


# --- Angles, distances, fields ----------------------------------------------------------------------------------------


def angle_code(angle_rad: float) -> int:
    """Return an angle in units of 2 pi / 2^24, 0 to 2^24 - 1."""
    return _encode_angle(angle_rad, _FULL_CIRCLE)


def angle_rad(code: int) -> float:
    """Return the angle of a code in rad, 0 <= angle < 2 pi."""
    return _decode_angle(code, _FULL_CIRCLE)


def is_far(distance_m: float | None) -> bool:
    """Whether a slope distance needs a far block: from 1677.7 m on."""
    return distance_m is not None and round(distance_m * _NEAR_UNITS_PER_M) > _MAX_DISTANCE


def distance_code(distance_m: float | None, *, far: bool) -> int | None:
    """Return a slope distance in units of 0.1 mm, or 1 mm in a far block.

    None without a distance, below one unit, and above 1677.7 m, or 16.7 km in a far block.
    """
    if distance_m is None:
        return None
    code = round(distance_m * (_FAR_UNITS_PER_M if far else _NEAR_UNITS_PER_M))
    return code if 0 < code <= _MAX_DISTANCE else None


def distance_m(code: int | None, *, far: bool) -> float | None:
    """Return the slope distance of a code in m."""
    return None if code is None else code / (_FAR_UNITS_PER_M if far else _NEAR_UNITS_PER_M)


def _encode_angle(angle_rad: float, circle: int) -> int:
    return round(angle_rad / math.tau * circle) % circle


def _decode_angle(code: int, circle: int) -> float:
    return code * math.tau / circle


def _put_fields(writer: BitWriter, part: object, widths: dict[str, int], **replaced: int) -> None:
    for name, width in widths.items():
        writer.put(replaced.get(name, getattr(part, name)), width)


def _take_fields(reader: BitReader, widths: dict[str, int]) -> dict[str, Any]:
    return {name: reader.take(width) for name, width in widths.items()}


def _take_version(reader: BitReader) -> None:
    version = reader.take(_VERSION_BITS)
    if version != VERSION:
        raise MessageError(f"the message has version {version} of the protocol, expected {VERSION}")


def _require_canonical(canonical: bytes, content: bytes) -> None:
    """Reject non-zero padding, items in another order, fields wider than necessary and the like."""
    if canonical != content:
        raise MessageError("the message is not in canonical form")
