"""Supervision of the radio."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from structlog.testing import capture_logs

from tsgt.errors import RadioError, RadioSettingsError, StreamError, TsgtError
from tsgt.radio.supervisor import supervise_radio
from tsgt.simulation.kernel import VirtualClock

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from tsgt.radio import Radio

CLOCK = VirtualClock(0)


class Attempts:
    """Opens a fake radio or raises the next error; records the times."""

    def __init__(self, *errors: TsgtError | None) -> None:
        self.errors = list(errors)
        self.opened_s: list[float] = []
        self.closed = 0

    @asynccontextmanager
    async def open(self) -> AsyncGenerator[Radio]:
        """Open, or raise the next error."""
        self.opened_s.append(CLOCK.monotonic_ns() / 1e9)
        if self.errors and (error := self.errors.pop(0)) is not None:
            raise error
        try:
            yield None  # type: ignore[misc]  # nobody touches it
        finally:
            self.closed += 1


async def run(attempts: Attempts, use_s: float, error: Exception | None, for_s: float) -> None:
    """Supervise the radio for a while; each use ends with the error after its time."""

    async def use(_radio: Radio) -> None:
        await asyncio.sleep(use_s)
        if error is not None:
            raise error

    with pytest.raises(TimeoutError):
        async with asyncio.timeout(for_s):
            await supervise_radio(attempts.open, use, CLOCK)


async def test_retry_delay_doubles_while_the_radio_is_missing() -> None:
    """The delay doubles from 0.1 s to 5 s; the error is logged once."""
    attempts = Attempts(*[RadioError("no chip")] * 10)
    with capture_logs() as logs:
        await run(attempts, 1e6, None, 60.0)
    pauses = [round(b - a, 3) for a, b in zip(attempts.opened_s, attempts.opened_s[1:], strict=False)]
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0, 5.0]
    assert [entry["event"] for entry in logs] == ["radio_lost", "radio_opened"]


@pytest.mark.parametrize("error", [RadioError("hung"), StreamError("no air")])
async def test_radio_that_fails_in_use_is_reopened(error: TsgtError) -> None:
    """After a working period the first delay is short again."""
    attempts = Attempts()
    await run(attempts, 10.0, error, 35.0)
    assert [round(at_s, 3) for at_s in attempts.opened_s] == [0.0, 10.1, 20.2, 30.3]
    assert attempts.closed == 4


async def test_changed_error_is_logged() -> None:
    """The second of two different errors in a row is logged too."""
    attempts = Attempts(RadioError("no chip"), RadioError("no chip"), RadioError("pin taken"))
    with capture_logs() as logs:
        await run(attempts, 1e6, None, 10.0)
    assert [entry["error"] for entry in logs if entry["event"] == "radio_lost"] == ["no chip", "pin taken"]


async def test_settings_error_ends_the_supervision() -> None:
    """A retry cannot make 20 dBm allowed."""
    with pytest.raises(RadioSettingsError):
        await supervise_radio(Attempts(RadioSettingsError("20 dBm")).open, _never, CLOCK)


async def test_failure_during_cancellation_cancels() -> None:
    """The radio's error replaces the cancellation, which must not be lost."""

    async def use(_radio: Radio) -> None:
        try:
            await asyncio.sleep(1e6)
        except asyncio.CancelledError:
            raise RadioError("gone") from None

    task = asyncio.create_task(supervise_radio(Attempts().open, use, CLOCK))
    await asyncio.sleep(1.0)
    task.cancel()
    done, _ = await asyncio.wait([task], timeout=60.0)
    task.cancel()
    assert done
    assert task.cancelled()


async def _never(_radio: Radio) -> None:
    raise AssertionError
