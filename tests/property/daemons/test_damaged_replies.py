"""Damaged replies of an instrument: no wrong reading, no hang, and normal operation afterwards."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from dataclasses import dataclass, field

import pytest
from harness.files.damage import Damage, damages, examples
from harness.instruments.leica import LeicaBench, leica_bench, leica_config
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from tsgt.errors import InstrumentError
from tsgt.model import Status
from tsgt.simulation.instrument.serial_line import LineFaults
from tsgt.simulation.kernel import run_virtual

HOSTILE_S = 20.0
BACK_S = 30.0
"""An instrument whose line has been bad is found again within this: all speeds are tried meanwhile."""


@dataclass(slots=True)
class DamagedReplies(LineFaults):
    """Damaged replies, and other bytes on the line, one after the other."""

    damages: deque[Damage | None] = field(default_factory=deque)
    replies: list[bytes] = field(default_factory=list)

    def apply(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return what arrives of a reply."""
        self.replies.append(data)
        damage = self.damages.popleft() if self.damages else None
        return [(0, data if damage is None else damage.to([data, *self.replies[-5:]]))]


async def read_until(day: LeicaBench, until_s: float) -> None:
    """Read, and reconnect after each error, as the client does; check the readings."""
    connected = False
    while day.now_s < until_s:
        try:
            async with asyncio.timeout(until_s - day.now_s):
                if not connected:
                    await day.begin()
                    connected = True
                while True:
                    reading = await day.instrument.read()
                    assert math.isfinite(reading.horizontal_angle_rad)
                    assert math.isfinite(reading.zenith_angle_rad)
                    assert reading.slope_distance_m is None or 0 < reading.slope_distance_m < math.inf
                    assert 0 <= reading.at_ns <= day.clock.monotonic_ns()
        except TimeoutError:
            break
        except InstrumentError as error:
            assert "\n" not in str(error)  # noqa: PT017 (any error will do, but it is one line)
            connected = False
            await day.instrument.close()
            await asyncio.sleep(0.3)


@examples(6)
@given(
    script=st.lists(st.none() | st.none() | damages, min_size=1, max_size=60),
    begun=st.booleans(),
    checksum=st.booleans(),
)
@pytest.mark.slow
def test_damaged_replies(
    script: list[Damage | None],
    begun: bool,  # noqa: FBT001 (given by hypothesis)
    checksum: bool,  # noqa: FBT001 (as above)
) -> None:
    """While it connects, sets up and tracks; with a checksum or without."""

    async def run() -> None:
        async with leica_bench(leica_config(checksum=checksum)) as day:
            if begun:
                await day.begin()
            day.line._wire.faults = DamagedReplies(damages=deque(script))
            await read_until(day, day.now_s + HOSTILE_S)
            day.line._wire.faults = LineFaults()
            await day.instrument.close()
            async with asyncio.timeout(BACK_S):
                await day.begin()
                await day.read_until(Status.OK, within_s=BACK_S)

    with capture_logs():
        run_virtual(run)
