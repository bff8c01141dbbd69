"""A radio that is opened again and again: what a daemon needs that runs unattended for days."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.errors import RadioError, RadioSettingsError, StreamError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from tsgt.clock import Clock
    from tsgt.radio.base import OpenRadio, Radio

FIRST_PAUSE_NS = 100_000_000
MAX_PAUSE_NS = 5_000_000_000

log = structlog.get_logger()


async def keep_radio(
    open_radio: OpenRadio, use: Callable[[Radio], Awaitable[None]], clock: Clock
) -> NoReturn:
    """Open the radio and use it, for ever; after an error close it, pause, and open it again.

    The pause grows from 0.1 s to 5 s, until the radio has worked for longer than that. The error is logged when it
    is another one than the last, so that a radio that is missing does not fill the log.

    Parameters
    ----------
    open_radio
        See :data:`~tsgt.radio.base.OpenRadio`.
    use
        What is done with it. When it returns, it is called again, with a radio that was opened anew.
    clock
        Sets the pace.

    Raises
    ------
    RadioSettingsError
        The radio is asked for something that it cannot do, and never will.
    """
    pause_ns = FIRST_PAUSE_NS
    logged = ""
    while True:
        began_ns = clock.monotonic_ns()
        try:
            async with open_radio() as radio:
                log.info("radio_opened")
                await use(radio)
        except RadioSettingsError:
            raise
        except (RadioError, StreamError) as error:
            if (task := asyncio.current_task()) is not None and task.cancelling():
                # Told to stop in the very moment in which the radio failed: the error took the place of the order.
                raise asyncio.CancelledError from None
            if clock.monotonic_ns() - began_ns > MAX_PAUSE_NS:
                pause_ns, logged = FIRST_PAUSE_NS, ""
            if str(error) != logged:
                logged = str(error)
                log.error("radio_lost", error=logged)  # noqa: TRY400 (the message says it all)
            await clock.sleep_until(clock.monotonic_ns() + pause_ns)
            pause_ns = min(2 * pause_ns, MAX_PAUSE_NS)
