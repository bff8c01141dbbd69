"""The processes of the page: a live one and a replay."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tsgt.service import notify_systemd
from tsgt.web.live import LiveMessages
from tsgt.web.mission import MissionState
from tsgt.web.recorded import index_of
from tsgt.web.replay import ReplayMessages
from tsgt.web.server import Page, serve
from tsgt.web.source import ArrivalClock, follow

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.web.foxglove import FoxgloveServer
    from tsgt.web.server import Settings


async def run_live(
    path: Path,
    settings: Settings,
    clock: Clock,
    opened: Callable[[str], None],
    foxglove: Callable[[MissionState, Clock], FoxgloveServer] | None = None,
) -> None:
    """Serve the mission on a stream socket until cancelled; raises what :func:`serve` raises.

    ``foxglove``: makes what serves it to Foxglove apps as well.
    """
    state = MissionState(path.name)
    arrival_clock = ArrivalClock()
    apps = foxglove(state, arrival_clock) if foxglove is not None else None
    messages = LiveMessages(state, arrival_clock, apps.view if apps is not None else None)
    page = Page(settings, messages, clock, apps)
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(follow(path, apps or state, arrival_clock))
        tasks.create_task(messages.run())
        tasks.create_task(notify_systemd(lambda: f"{page.readers} readers", clock))
        tasks.create_task(serve(page, opened))


async def run_replay(path: Path, settings: Settings, clock: Clock, opened: Callable[[str], None]) -> None:
    """Serve a recording until cancelled; raises RecordingError, and what :func:`serve` raises."""
    index = await asyncio.to_thread(index_of, path)
    await serve(Page(settings, ReplayMessages(index, clock), clock), opened)
