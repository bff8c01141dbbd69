"""The operator's page on real loopback, with a stream or a recording behind it."""

from __future__ import annotations

import asyncio
import functools
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ParamSpec

import aiohttp
from harness.files.records import POSE, SETUP, START, STATUS

from tsgt.clock import SystemClock
from tsgt.model import Status
from tsgt.recording import (
    HelloRecord,
    PoseRecord,
    SetupRecord,
    StationShare,
    StationStatus,
    StatusRecord,
    encode_line,
)
from tsgt.web.live import LiveMessages
from tsgt.web.mission.state import MissionState
from tsgt.web.server import Page, Settings, serve

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine

    from tsgt.web.access import Access
    from tsgt.web.foxglove import FoxgloveServer

P = ParamSpec("P")

HELLO = encode_line(HelloRecord())
SETUP_LINE = encode_line(SETUP)


def station(number: int, **changes: Any) -> StationStatus:
    """Return the status of a station that tracks."""
    tracking = StationStatus(
        id=number, measurements=100, usable=100, age_s=0.3, status=Status.OK, prism=number, locked=True, answering=True,
        last_heard_s=0.1, rate_hz=2.5, loss=0.0, rssi_dbm=-60.0, snr_db=9.0, stamp_bound_ns=150_000, joined=True, outstanding=0,
    )  # fmt: skip
    return replace(tracking, **changes)


def status(at_s: float, *stations: StationStatus, **changes: Any) -> StatusRecord:
    """Return a status record of three stations that track, or of these."""
    return replace(
        STATUS,
        stamp_ns=START + round(at_s * 1e9),
        stations=stations or tuple(station(number) for number in (1, 2, 3)),
        protocol="superframe",
        authenticated=True,
        **changes,
    )


def pose(at_s: float, **changes: Any) -> PoseRecord:
    """Return a valid predicted pose."""
    shares = tuple(
        StationShare(id=number, prism=number, age_s=0.2 + number / 10, residual_m=number / 1e3, reason="")
        for number in (1, 2, 3)
    )
    valid = replace(
        POSE, stamp_ns=START + round(at_s * 1e9), estimator="continuous", kind="predicted", quality="good", stations=shares,
        position_m=(10.0, 10.0, 0.0),
    )  # fmt: skip
    return replace(valid, **changes)


def mission(setup: SetupRecord = SETUP) -> MissionState:
    """Return a state that is connected to a stream, at the time 0."""
    state = MissionState("poses.sock")
    state.connected(0.0)
    state.line(HELLO, 0.0)
    state.line(encode_line(setup), 0.0)
    return state


def feed(state: MissionState, *records: StatusRecord | PoseRecord | Any, now_s: float) -> None:
    """Pass records on at a time."""
    for record in records:
        state.line(encode_line(record), now_s)


def in_real_time(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, None]:
    """Run a coroutine test on real sockets, which virtual time has not."""

    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        asyncio.run(test(*args, **kwargs))

    return run


@asynccontextmanager
async def served(
    state: MissionState,
    access: Access | None = None,
    foxglove: FoxgloveServer | None = None,
    **settings: Any,
) -> AsyncIterator[str]:
    """Serve the page of a state on a free port of loopback, also to Foxglove apps if so; give its address."""
    clock = SystemClock()
    messages = LiveMessages(state, clock, foxglove.view if foxglove is not None else None)
    url: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    page = Page(Settings(address="127.0.0.1", port=0, access=access, **settings), messages, clock, foxglove)
    tasks = [asyncio.create_task(messages.run()), asyncio.create_task(serve(page, url.set_result))]
    try:
        yield await url
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@asynccontextmanager
async def client() -> AsyncIterator[aiohttp.ClientSession]:
    """Return a client without cookies of earlier ones."""
    jar = aiohttp.CookieJar(unsafe=True)  # also of addresses without a name
    async with aiohttp.ClientSession(cookie_jar=jar, auto_decompress=False) as session:
        yield session
