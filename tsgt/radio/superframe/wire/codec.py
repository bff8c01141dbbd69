"""Beacons and replies of the superframe as bytes, without their code.

A message has one form in bytes only. What would be encoded in another way is refused, so that no bit of a packet is
without meaning.

Orders as beacons of the superframe say them, and back.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tsgt.errors import MessageError
from tsgt.radio.commands import Direction, DirectOrder, MeasureOrder, SearchOrder, TrackOrder
from tsgt.radio.superframe.wire.authentication import CODE_BYTES
from tsgt.radio.superframe.wire.bits import BitReader, BitWriter
from tsgt.radio.superframe.wire.block_codec import (
    VALUE_BITS,
    put_newest,
    put_run,
    put_status,
    put_values,
    take_newest,
    take_run,
    take_status,
    take_values,
)
from tsgt.radio.superframe.wire.messages import (
    MOST_STATIONS,
    SINGLE_QUALITY,
    TURN_ROUND_BITS,
    VERSION,
    AnswerPart,
    Beacon,
    Confirmation,
    Introduction,
    OrderPart,
    Reply,
    Run,
    SessionPart,
    ShotPart,
    SlotOrder,
    StatePart,
    StationEntry,
    Towards,
)

if TYPE_CHECKING:
    from tsgt.radio.commands import Order

_VERSION_BITS = 2
_BEACON_BYTES = 5
_PADDING_BITS = 8

_SINGLE, _RUNS, _EXTENDED = range(3)
_END, _SESSION, _CONFIRMATION, _ORDER = range(4)
_ORDERS = 5
_TRACK, _SEARCH_TOWARDS = 0, 4

_FULL_CIRCLE = 1 << VALUE_BITS
_LONGEST = (1 << VALUE_BITS) - 1
_NEAR_UNITS_PER_M = 10_000
_FAR_UNITS_PER_M = 1_000


def encode_beacon(beacon: Beacon) -> bytes:
    """Return the content of a beacon, without code.

    Raises
    ------
    MessageError
        A number does not go into its field.
    """
    stations = len(beacon.stations)
    if not 1 <= stations <= MOST_STATIONS:
        raise MessageError(f"a beacon speaks to 1 to {MOST_STATIONS} stations, got {stations}")
    extended = beacon.session is not None or bool(beacon.confirmations) or bool(beacon.orders)
    writer = BitWriter()
    writer.put(VERSION, _VERSION_BITS)
    writer.put(beacon.frame, 8)
    writer.put(extended, 1)
    writer.put(beacon.sent, 16)
    writer.put(beacon.cumulative, 8)
    writer.put(beacon.order.reverse, 1)
    writer.put(beacon.order.first, 4)
    if extended:
        writer.put(stations - 1, 4)
    for entry in beacon.stations:
        writer.put(entry.history, 4)
        writer.put(entry.grant, 4)
    if extended:
        _put_items(writer, beacon)
    return writer.to_bytes()


def decode_beacon(content: bytes) -> Beacon:
    """Return the beacon with this content.

    Raises
    ------
    MessageError
        It is none that :func:`encode_beacon` would return.
    """
    reader = BitReader(content)
    _take_version(reader)
    frame = reader.take(8)
    extended = reader.take(1)
    sent, cumulative = reader.take(16), reader.take(8)
    reverse, first = bool(reader.take(1)), reader.take(4)
    stations = reader.take(4) + 1 if extended else len(content) - _BEACON_BYTES
    entries = tuple(StationEntry(reader.take(4), reader.take(4)) for _ in range(stations))
    session: SessionPart | None = None
    confirmations: list[Confirmation] = []
    orders: list[OrderPart] = []
    while extended and (item := reader.take(2)) != _END:
        if item == _SESSION:
            session = SessionPart(
                nonce=reader.take(48),
                counter_high=reader.take(16),
                sent_high=reader.take(24),
                guard=reader.take(8),
                turn_round=reader.take(8),
            )
        elif item == _CONFIRMATION:
            confirmations.append(Confirmation(reader.take(4) + 1, reader.take(32)))
        else:
            orders.append(_take_order(reader))
    beacon = Beacon(
        frame=frame,
        sent=sent,
        cumulative=cumulative,
        order=SlotOrder(first, reverse),
        stations=entries,
        session=session,
        confirmations=tuple(confirmations),
        orders=tuple(orders),
    )
    _refuse_other_forms(encode_beacon(beacon), content)
    return beacon


def encode_reply(reply: Reply) -> bytes:
    """Return the content of a reply, without code, in the shortest form that holds it.

    A single plain measurement of a quality better than :data:`SINGLE_QUALITY` comes back with that one.

    Raises
    ------
    MessageError
        A number does not go into its field, or a run is none.
    """
    writer = BitWriter()
    writer.put(VERSION, _VERSION_BITS)
    parts = (reply.introduction, reply.state, reply.turn_round_us, reply.answer, reply.shot)
    extended = any(part is not None for part in parts)
    if not extended and len(reply.runs) == 1 and _is_single(reply.runs[0]):
        writer.put(_SINGLE, 2)
        put_newest(writer, reply.runs[0].sightings[0], wide=False)
        return writer.to_bytes()
    writer.put(_EXTENDED if extended else _RUNS, 2)
    if extended:
        for part in parts:
            writer.put(part is not None, 1)
        _put_parts(writer, reply)
    for run in reply.runs:
        put_run(writer, run)
    return writer.to_bytes()


def decode_reply(content: bytes) -> Reply:
    """Return the reply with this content.

    Raises
    ------
    MessageError
        It is none that :func:`encode_reply` would return.
    """
    reader = BitReader(content)
    _take_version(reader)
    form = reader.take(2)
    if form == _SINGLE:
        reply = Reply(runs=(Run(sightings=(take_newest(reader, wide=False),)),))
    elif form == _RUNS:
        reply = Reply(runs=_take_runs(reader))
    elif form == _EXTENDED:
        reply = _take_extended(reader)
    else:
        raise MessageError(f"there is no reply of form {form}")
    _refuse_other_forms(encode_reply(reply), content)
    return reply


def reply_bytes(reply: Reply) -> int:
    """Return how long a reply is on the air, code and all, in bytes."""
    return len(encode_reply(reply)) + CODE_BYTES


def angle_code(angle_rad: float) -> int:
    """Return an angle as it goes over the air: in 2 pi / 2^24, 0 to 2^24 - 1."""
    return round(angle_rad / math.tau * _FULL_CIRCLE) % _FULL_CIRCLE


def angle_rad(code: int) -> float:
    """Return an angle in rad, from 0 to below 2 pi."""
    return code * math.tau / _FULL_CIRCLE


def is_far(distance_m: float | None) -> bool:
    """Whether a slope distance needs a far run: from 1677.7 m on."""
    return distance_m is not None and round(distance_m * _NEAR_UNITS_PER_M) > _LONGEST


def distance_code(distance_m: float | None, *, far: bool) -> int | None:
    """Return a slope distance as it goes over the air: in 0.1 mm, or 1 mm in a far run.

    None where there is none, or none that fits: nothing below one unit and, near, nothing for which :func:`is_far`
    holds, far, nothing above 16.7 km.
    """
    if distance_m is None:
        return None
    code = round(distance_m * (_FAR_UNITS_PER_M if far else _NEAR_UNITS_PER_M))
    return code if 0 < code <= _LONGEST else None


def distance_m(code: int | None, *, far: bool) -> float | None:
    """Return a slope distance in m."""
    return None if code is None else code / (_FAR_UNITS_PER_M if far else _NEAR_UNITS_PER_M)


def _take_version(reader: BitReader) -> None:
    version = reader.take(_VERSION_BITS)
    if version != VERSION:
        raise MessageError(f"the message has version {version} of the protocol, expected {VERSION}")


def _refuse_other_forms(canonical: bytes, content: bytes) -> None:
    """Refuse padding that is not zero, items in another order, numbers in a wider field than they need, and so on."""
    if canonical != content:
        raise MessageError("the message is not in the form in which it would be sent")


def _put_items(writer: BitWriter, beacon: Beacon) -> None:
    session = beacon.session
    if session is not None:
        writer.put(_SESSION, 2)
        writer.put(session.nonce, 48)
        writer.put(session.counter_high, 16)
        writer.put(session.sent_high if beacon.sent else 0, 24)
        writer.put(session.guard, 8)
        writer.put(session.turn_round, 8)
    for confirmation in beacon.confirmations:
        writer.put(_CONFIRMATION, 2)
        _put_station(writer, confirmation.station, beacon)
        writer.put(confirmation.nonce, 32)
    for order in beacon.orders:
        _refuse_no_order(order)
        writer.put(_ORDER, 2)
        _put_station(writer, order.station, beacon)
        writer.put(order.ticket, 4)
        writer.put(order.order, 4)
        writer.put(order.argument, 4)
        if order.towards is not None:
            writer.put(order.towards.horizontal, 16)
            writer.put(order.towards.zenith, 16)
    writer.put(_END, 2)


def _refuse_no_order(part: OrderPart) -> None:
    argued = part.argument and part.order not in (_TRACK, _SEARCH_TOWARDS)
    directed = part.towards is not None
    if part.order >= _ORDERS or argued or directed != (part.order == _SEARCH_TOWARDS):
        kind = "a direction" if directed else "no direction"
        raise MessageError(f"there is no order {part.order} with argument {part.argument} and {kind}")


def _take_order(reader: BitReader) -> OrderPart:
    station, ticket, order, argument = reader.take(4) + 1, reader.take(4), reader.take(4), reader.take(4)
    towards = Towards(reader.take(16), reader.take(16)) if order == _SEARCH_TOWARDS else None
    return OrderPart(station, ticket, order, argument, towards)


def _put_station(writer: BitWriter, station: int, beacon: Beacon) -> None:
    if not 1 <= station <= len(beacon.stations):
        raise MessageError(f"a beacon to {len(beacon.stations)} stations says something to station {station}")
    writer.put(station - 1, 4)


def _is_single(run: Run) -> bool:
    plain = not (run.direct or run.wide or run.far or run.prism is not None)
    return plain and len(run.sightings) == 1 and run.quality <= SINGLE_QUALITY


def _put_parts(writer: BitWriter, reply: Reply) -> None:
    introduction, state, answer, shot = reply.introduction, reply.state, reply.answer, reply.shot
    if introduction is not None:
        writer.put(introduction.nonce, 32)
        writer.put(introduction.lineage, 16)
        writer.put(introduction.run_start, 32)
        writer.put(introduction.oldest, 32)
    if state is not None:
        writer.put(state.prism - 1, 4)
        writer.put(state.direct, 1)
        writer.put(state.connected, 1)
        writer.put(state.late, 8)
        writer.put(state.doubted, 4)
        writer.put(-state.rssi_dbm, 7)
    if reply.turn_round_us is not None:
        writer.put(reply.turn_round_us, TURN_ROUND_BITS)
    if answer is not None:
        writer.put(answer.ticket, 4)
        writer.put(answer.ok, 1)
    if shot is not None:
        writer.put(shot.ticket, 4)
        put_status(writer, shot.status)
        put_values(writer, shot.horizontal, shot.zenith, shot.distance)


def _take_extended(reader: BitReader) -> Reply:
    introduced, stated, timed, answered, shot = (reader.take(1) for _ in range(5))
    # The parts are read in the order in which they stand here.
    return Reply(
        introduction=_take_introduction(reader) if introduced else None,
        state=_take_state(reader) if stated else None,
        turn_round_us=reader.take(TURN_ROUND_BITS) if timed else None,
        answer=AnswerPart(reader.take(4), bool(reader.take(1))) if answered else None,
        shot=_take_shot(reader) if shot else None,
        runs=_take_runs(reader),
    )


def _take_introduction(reader: BitReader) -> Introduction:
    return Introduction(
        nonce=reader.take(32),
        lineage=reader.take(16),
        run_start=reader.take(32),
        oldest=reader.take(32),
    )


def _take_state(reader: BitReader) -> StatePart:
    return StatePart(
        prism=reader.take(4) + 1,
        direct=bool(reader.take(1)),
        connected=bool(reader.take(1)),
        late=reader.take(8),
        doubted=reader.take(4),
        rssi_dbm=-reader.take(7),
    )


def _take_shot(reader: BitReader) -> ShotPart:
    return ShotPart(reader.take(4), take_status(reader), *take_values(reader))


def _take_runs(reader: BitReader) -> tuple[Run, ...]:
    """Take runs until less than a byte is left, which no run fits into."""
    runs = []
    while reader.remaining >= _PADDING_BITS:
        runs.append(take_run(reader))
    return tuple(runs)


NARROWEST_RAD = math.radians(0.25)
WIDEST_CODE = 15

_COMMAND_CIRCLE = 1 << 16
_ROUNDING_RAD = math.hypot(0.5, 0.5) * math.tau / _COMMAND_CIRCLE


def spread_rad(code: int) -> float:
    """Return how wide a search of this code, 0 to 15, is to every side, in rad: 0.25 degrees, doubled every two steps."""
    return NARROWEST_RAD * math.exp2(code / 2)


def order_part(station: int, ticket: int, order: Order, tracked: int) -> OrderPart:
    """Return an order as a beacon says it.

    Parameters
    ----------
    station
        Number of the station, 1 to 16.
    ticket
        4 bits.
    order
        What it is to do. A direction is rounded and its spread made wider, so that it covers at least what it did; but
        not beyond the widest that can be said, 45 degrees.
    tracked
        Number of the prism, 1 to 16, that a :class:`~tsgt.radio.commands.TrackOrder` without a prism means.
    """
    match order:
        case TrackOrder(prism):
            return OrderPart(station, ticket, 0, (prism or tracked) - 1)
        case SearchOrder(towards):
            if towards is None:
                return OrderPart(station, ticket, 1)
            spread = _spread_code(towards.spread_rad + _ROUNDING_RAD)
            angles = _angle_code(towards.horizontal_angle_rad), _angle_code(towards.zenith_angle_rad)
            return OrderPart(station, ticket, 4, spread, Towards(*angles))
        case DirectOrder():
            return OrderPart(station, ticket, 2)
        case MeasureOrder():
            return OrderPart(station, ticket, 3)


def order_of(part: OrderPart) -> Order:
    """Return the order that a beacon says."""
    if part.towards is not None:
        return SearchOrder(
            Direction(
                horizontal_angle_rad=_angle_rad(part.towards.horizontal),
                zenith_angle_rad=_angle_rad(part.towards.zenith),
                spread_rad=spread_rad(part.argument),
            )
        )
    match part.order:
        case 0:
            return TrackOrder(part.argument + 1)
        case 1:
            return SearchOrder()
        case 2:
            return DirectOrder()
        case _:  # the message codec lets no other through
            return MeasureOrder()


def _spread_code(spread_rad: float) -> int:
    steps = math.ceil(2 * math.log2(max(spread_rad, NARROWEST_RAD) / NARROWEST_RAD))
    return min(steps, WIDEST_CODE)


def _angle_code(angle_rad: float) -> int:
    return round(angle_rad / math.tau * _COMMAND_CIRCLE) % _COMMAND_CIRCLE


def _angle_rad(code: int) -> float:
    return code * math.tau / _COMMAND_CIRCLE
