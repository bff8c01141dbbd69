"""Orders as beacons of the superframe say them, and back."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tsgt.radio.messages import OrderPart, Towards
from tsgt.radio.orders import Direction, DirectOrder, MeasureOrder, SearchOrder, TrackOrder

if TYPE_CHECKING:
    from tsgt.radio.orders import Order

NARROWEST_RAD = math.radians(0.25)
WIDEST_CODE = 15

_FULL_CIRCLE = 1 << 16
_ROUNDING_RAD = math.hypot(0.5, 0.5) * math.tau / _FULL_CIRCLE


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
        Number of the prism, 1 to 16, that a :class:`~tsgt.radio.orders.TrackOrder` without a prism means.
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
    return round(angle_rad / math.tau * _FULL_CIRCLE) % _FULL_CIRCLE


def _angle_rad(code: int) -> float:
    return code * math.tau / _FULL_CIRCLE
