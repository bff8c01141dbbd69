"""The relay's connection to the master, with connections that the test makes and without waiting."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import AsyncMock, Mock

from structlog.testing import capture_logs

from tsgt.relay.program import BACK_OFF_S, SourceReader

if TYPE_CHECKING:
    import pytest


def connections(monkeypatch: pytest.MonkeyPatch, *data: bytes) -> tuple[list[float], list[str]]:
    """Connect to a master that sends each connection this and closes it; return the waits after them, and the log."""
    waits: list[float] = []
    remaining = list(data)

    async def connect(_path: str, **_: int) -> tuple[asyncio.StreamReader, Mock]:
        reader = asyncio.StreamReader()
        reader.feed_data(remaining.pop(0))
        reader.feed_eof()
        return reader, Mock(wait_closed=AsyncMock())

    async def sleep(delay_s: float) -> None:
        waits.append(delay_s)
        if not remaining:
            raise asyncio.CancelledError

    async def main() -> None:
        with suppress(asyncio.CancelledError):
            await SourceReader(Path("s"), Mock()).run()

    with monkeypatch.context() as patch, capture_logs() as logs:
        patch.setattr(asyncio, "open_unix_connection", connect)
        patch.setattr(asyncio, "sleep", sleep)
        asyncio.run(main())
    return waits, [entry["event"] for entry in logs]


def test_master_that_refuses_the_relay_is_asked_ever_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """It accepts the connection and closes it without a line; the log says so once."""
    waits, events = connections(monkeypatch, *6 * [b""])
    assert waits == [0.1, 0.2, 0.4, 0.8, 1.6, BACK_OFF_S[1]]
    assert events == ["relay_source_missing"]


def test_back_off_begins_anew_after_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the next refusal is logged again."""
    waits, events = connections(monkeypatch, b"", b"", b'{"type":"hello"}\n', b"")
    assert waits == [0.1, 0.2, 0.1, 0.2]
    assert events == [
        "relay_source_missing",
        "relay_source_connected",
        "relay_source_lost",
        "relay_source_missing",
    ]
