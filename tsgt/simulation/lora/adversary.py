"""A replay attacker on the mission's channel: sends noise, and captured packets whole, truncated or with a flipped bit."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    import numpy as np

    from tsgt.clock import Clock
    from tsgt.radio import Radio, RadioOpener

MAX_NOISE_BYTES = 40
_CAPTURE_CAPACITY = 64


class ReplayAttacker:
    """Sends random bytes or captured packets, whole, truncated or with one bit flipped, at random times of an average rate."""

    def __init__(self, clock: Clock, rng: np.random.Generator, rate_hz: float) -> None:
        self._clock = clock
        self._rng = rng
        self._rate_hz = rate_hz
        self._captured: deque[bytes] = deque(maxlen=_CAPTURE_CAPACITY)
        self.sent = 0  # number of packets sent

    async def run(self, open_radio: RadioOpener) -> None:
        """Open the radio, receive and send until cancelled."""
        async with open_radio() as radio:
            await self.attack(radio)

    async def attack(self, radio: Radio) -> None:
        """Receive and send with an open radio until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._listen(radio))
            group.create_task(self._send(radio))

    async def _listen(self, radio: Radio) -> NoReturn:
        while True:
            self._captured.append((await radio.receive()).payload)

    async def _send(self, radio: Radio) -> NoReturn:
        while True:
            wait_ns = round(1e9 * self._rng.exponential(1 / self._rate_hz))
            await self._clock.sleep_until(self._clock.monotonic_ns() + wait_ns)
            await radio.transmit(self.packet())
            self.sent += 1

    def packet(self) -> bytes:
        """Return the next packet to send."""
        kind = self._rng.integers(4)
        if kind == 0 or not self._captured:
            return self._rng.bytes(int(self._rng.integers(1, MAX_NOISE_BYTES + 1)))
        # The newest packet as often as all others: it has the best chance of being accepted.
        newest = self._rng.random() < 0.5
        payload = self._captured[-1 if newest else int(self._rng.integers(len(self._captured)))]
        if kind == 1:
            return payload
        if kind == 2:
            return payload[: int(self._rng.integers(1, len(payload) + 1))]
        bit = int(self._rng.integers(8 * len(payload)))
        return bytes(byte ^ (1 << bit % 8) * (index == bit // 8) for index, byte in enumerate(payload))
