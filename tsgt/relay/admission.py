"""Sans-I/O: limits on who may try to connect, so that clients without the key cost the relay and its readers little.

A key of 256 bits cannot be guessed; the limits are for processor time, memory, file descriptors and the log.
"""

from __future__ import annotations

import ipaddress
from collections import OrderedDict

MAX_READERS = 64

MAX_PENDING = 64
"""Connections that have not shown the key; for a further one the oldest is closed, so that slow ones keep nobody out."""

MAX_PENDING_OF_ADDRESS = 8

ATTEMPTS = 10
"""Connections that an address may open at once, and wrong keys that it may show; then one each :data:`REFILL_NS`."""

REFILL_NS = 1_000_000_000

WRONG_KEY_COST = 5.0

MAX_ADDRESSES = 4096


class Admission:
    """Counts attempts of each address; an IPv6 network of 64 bits counts as one."""

    def __init__(self) -> None:
        self._spent: OrderedDict[str, tuple[float, int]] = OrderedDict()

    def admits(self, address: str, now_ns: int) -> bool:
        """Whether an address may connect now, which counts as an attempt."""
        return self._spend(address, 1.0, now_ns)

    def wrong_key(self, address: str, now_ns: int) -> None:
        """Count a wrong key."""
        self._spend(address, WRONG_KEY_COST, now_ns)

    def right_key(self, address: str) -> None:
        """Forget the attempts of an address that has the key."""
        self._spent.pop(_network(address), None)

    def _spend(self, address: str, cost: float, now_ns: int) -> bool:
        network = _network(address)
        spent, at_ns = self._spent.pop(network, (0.0, now_ns))
        spent = max(0.0, spent - (now_ns - at_ns) / REFILL_NS)
        admitted = spent + 1.0 <= ATTEMPTS
        self._spent[network] = (min(spent + cost, 3.0 * ATTEMPTS) if admitted else spent, now_ns)
        if len(self._spent) > MAX_ADDRESSES:
            self._spent.popitem(last=False)
        return admitted


def _network(address: str) -> str:
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv6Address):
        if parsed.ipv4_mapped is not None:
            return str(parsed.ipv4_mapped)
        return str(ipaddress.ip_network((parsed, 64), strict=False))
    return address
