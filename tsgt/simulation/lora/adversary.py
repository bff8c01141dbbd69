"""Somebody else on the same channel, who means no good: noise, and what the mission's radios have said, again."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    import numpy as np

    from tsgt.clock import Clock
    from tsgt.radio import OpenRadio, Radio

LONGEST_NOISE_BYTES = 40
_REMEMBERED = 64


class ForeignRadio:
    """Sends at random times: random bytes, or a packet that it has heard, whole, cut short or with a bit turned over.

    Parameters
    ----------
    clock
        Time.
    rng
        What is sent, and when.
    per_s
        Packets per second, on average.

    Attributes
    ----------
    sent
        How many it has sent.
    """

    def __init__(self, clock: Clock, rng: np.random.Generator, per_s: float) -> None:
        self._clock = clock
        self._rng = rng
        self._per_s = per_s
        self._heard: deque[bytes] = deque(maxlen=_REMEMBERED)
        self.sent = 0

    async def run(self, open_radio: OpenRadio) -> None:
        """Listen and send until cancelled."""
        async with open_radio() as radio:
            await self.use(radio)

    async def use(self, radio: Radio) -> None:
        """Listen and send with a radio that is open, until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._listen(radio))
            group.create_task(self._send(radio))

    async def _listen(self, radio: Radio) -> NoReturn:
        while True:
            self._heard.append((await radio.receive()).payload)

    async def _send(self, radio: Radio) -> NoReturn:
        while True:
            wait_ns = round(1e9 * self._rng.exponential(1 / self._per_s))
            await self._clock.sleep_until(self._clock.monotonic_ns() + wait_ns)
            await radio.transmit(self.packet())
            self.sent += 1

    def packet(self) -> bytes:
        """Return the next packet that it would send."""
        kind = self._rng.integers(4)
        if kind == 0 or not self._heard:
            return self._rng.bytes(int(self._rng.integers(1, LONGEST_NOISE_BYTES + 1)))
        # The newest as often as any other: it is the one that has a chance.
        newest = self._rng.random() < 0.5
        payload = self._heard[-1 if newest else int(self._rng.integers(len(self._heard)))]
        if kind == 1:
            return payload
        if kind == 2:
            return payload[: int(self._rng.integers(1, len(payload) + 1))]
        bit = int(self._rng.integers(8 * len(payload)))
        return bytes(byte ^ (1 << bit % 8) * (index == bit // 8) for index, byte in enumerate(payload))
