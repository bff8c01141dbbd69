"""Supervision of the radio in a daemon that runs unattended for days."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.errors import RadioError, RadioSettingsError, StreamError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from tsgt.clock import Clock
    from tsgt.radio.base import Radio, RadioOpener

INITIAL_RETRY_DELAY_NS = 100_000_000
MAX_RETRY_DELAY_NS = 5_000_000_000

log = structlog.get_logger()


async def supervise_radio(
    open_radio: RadioOpener, use: Callable[[Radio], Awaitable[None]], clock: Clock
) -> NoReturn:
    """Open the radio and await ``use(radio)``, for ever; after an error or its return, reopen the radio.

    The delay after an error grows from 0.1 s to 5 s, until the radio has worked for longer than that. Only a changed
    error is logged, so that a missing radio does not fill the log. Raises RadioSettingsError if the radio will never
    accept the settings.
    """
    delay_ns = INITIAL_RETRY_DELAY_NS
    logged = ""
    while True:
        started_ns = clock.monotonic_ns()
        try:
            async with open_radio() as radio:
                log.info("radio_opened")
                await use(radio)
        except RadioSettingsError:
            raise
        except (RadioError, StreamError) as error:
            if (task := asyncio.current_task()) is not None and task.cancelling():
                # The radio failed at the moment of the cancellation, and its error replaced the CancelledError.
                raise asyncio.CancelledError from None
            if clock.monotonic_ns() - started_ns > MAX_RETRY_DELAY_NS:
                delay_ns, logged = INITIAL_RETRY_DELAY_NS, ""
            if str(error) != logged:
                logged = str(error)
                log.error("radio_lost", error=logged)  # noqa: TRY400 (the message is complete)
            await clock.sleep_until(clock.monotonic_ns() + delay_ns)
            delay_ns = min(2 * delay_ns, MAX_RETRY_DELAY_NS)
