"""The conversation with Foxglove apps: its WebSocket protocol, to read only. Each app has a queue of its own.

https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md; the subprotocol of newer apps, ``foxglove.sdk.v1``, is the same
for what is offered here: the server's information and time, channels, subscriptions and messages.
"""

from __future__ import annotations

import asyncio
import json
import struct
from collections import Counter
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import structlog
from aiohttp import WSMsgType, web

import tsgt
from tsgt.web.foxglove.channels import CHANNELS
from tsgt.web.foxglove.feed import Feed

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.clock import Clock
    from tsgt.web.foxglove.feed import Message
    from tsgt.web.mission import MissionState

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")

MAX_REQUEST_BYTES = 16_384
REQUEST_INTERVAL_S = 0.01
"""Requests of an app that sends more are read later."""

QUEUE_MESSAGES = 200
"""Of one app: some three seconds; one that takes nothing for longer is disconnected, and its app connects again."""

HEARTBEAT_S = 10.0
"""An app that answers none of the server's pings for half of this is disconnected as well."""

_MESSAGE, _TIME = 1, 2  # binary opcodes
_NUMBERS = range(2**32)

log = structlog.get_logger()


class _App:
    """One app: what it has subscribed to, and what waits for it."""

    def __init__(self, request: web.Request) -> None:
        self.request = request
        self.queue: asyncio.Queue[bytes] = asyncio.Queue(QUEUE_MESSAGES)
        self.subscriptions: dict[str, int] = {}
        """Its numbers of subscriptions, by topic."""

    def put(self, data: bytes) -> bool:
        """Queue a frame; False: it takes nothing, and is disconnected."""
        if self.queue.full():
            log.warning("foxglove_app_stalled", address=self.request.remote)
            self.abort()
            return False
        self.queue.put_nowait(data)
        return True

    def abort(self) -> None:
        """Break the connection off; what waits in buffers is thrown away."""
        if self.request.transport is not None:
            self.request.transport.abort()


class FoxgloveServer:
    """Serves one mission to apps; takes the lines of the stream for the page's state as well.

    Parameters
    ----------
    state
        The page's.
    clock
        For the age of what is sent.
    """

    def __init__(self, state: MissionState, clock: Clock) -> None:
        self._state = state
        self._clock = clock
        self._apps: set[_App] = set()
        self._subscribers: Counter[str] = Counter()
        self._feed = Feed(state, lambda topic: self._subscribers[topic] > 0)

    # --- in ---------------------------------------------------------------------------------------------------

    def connected(self, now_s: float) -> None:
        """Take note of a new connection to the stream."""
        self._state.connected(now_s)
        self._feed.connected()

    def disconnected(self, problem: str) -> None:
        """Take note that there is none."""
        self._state.disconnected(problem)

    def line(self, data: bytes, now_s: float) -> None:
        """Take a line of the stream; raises ValueError, as the state does."""
        self._state.line(data, now_s)
        self._publish(self._feed.line(data, now_s))

    def view(self, view: dict[str, Any], now_s: float) -> None:
        """Take a view of the page."""
        if not self._apps:
            return
        if (stamp_ns := self._feed.now_ns(now_s)) is not None:
            for app in list(self._apps):
                self._put(app, struct.pack("<BQ", _TIME, stamp_ns))
        self._publish(self._feed.view(view, now_s))

    def _publish(self, messages: Iterable[Message]) -> None:
        for topic, stamp_ns, data in messages:
            for app in list(self._apps):
                if (number := app.subscriptions.get(topic)) is not None:
                    self._put(app, struct.pack("<BIQ", _MESSAGE, number, stamp_ns) + data)

    def _put(self, app: _App, data: bytes) -> None:
        if not app.put(data):
            self._forget(app)

    def _forget(self, app: _App) -> None:
        self._apps.discard(app)
        self._subscribers -= Counter(app.subscriptions.keys())
        app.subscriptions.clear()

    # --- out --------------------------------------------------------------------------------------------------

    async def converse(self, request: web.Request) -> web.WebSocketResponse:
        """Serve one app until it leaves, stalls or breaks the protocol."""
        offered = request.headers.get("Sec-WebSocket-Protocol", "").replace(",", " ").split()
        if not set(SUBPROTOCOLS).intersection(offered):
            raise web.HTTPBadRequest
        socket = web.WebSocketResponse(
            protocols=SUBPROTOCOLS, max_msg_size=MAX_REQUEST_BYTES, heartbeat=HEARTBEAT_S, compress=False
        )
        await socket.prepare(request)
        app = _App(request)
        app.put(_text({"op": "serverInfo", "name": f"tsgt {tsgt.__version__}", "capabilities": ["time"]}))
        app.put(_text({"op": "advertise", "channels": [each.advertised for each in CHANNELS.values()]}))
        self._apps.add(app)
        sender = asyncio.create_task(self._send(socket, app))
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT or not self._request(app, message.data):
                    break
                await self._clock.sleep_until(self._clock.monotonic_ns() + round(REQUEST_INTERVAL_S * 1e9))
        finally:
            self._forget(app)
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)
            app.abort()
        return socket

    async def _send(self, socket: web.WebSocketResponse, app: _App) -> None:
        with suppress(ConnectionError):
            while True:
                data = await app.queue.get()
                await (socket.send_str(data.decode()) if data[:1] == b"{" else socket.send_bytes(data))

    def _request(self, app: _App, text: str) -> bool:
        """Follow a request; False: it is none, and the connection is closed. Requests that nothing offers are ignored."""
        try:
            content = json.loads(text)
            match content["op"]:
                case "subscribe":
                    topics = {each.id: each.topic for each in CHANNELS.values()}
                    for wish in content["subscriptions"]:
                        self._subscribe(app, topics[wish["channelId"]], wish["id"])
                case "unsubscribe":
                    numbers = set(content["subscriptionIds"])
                    for topic in [each for each, number in app.subscriptions.items() if number in numbers]:
                        del app.subscriptions[topic]
                        self._subscribers[topic] -= 1
        except (ValueError, KeyError, TypeError, RecursionError):
            return False
        return True

    def _subscribe(self, app: _App, topic: str, number: Any) -> None:
        if not isinstance(number, int) or number not in _NUMBERS:
            raise ValueError
        if topic not in app.subscriptions:
            self._subscribers[topic] += 1
        app.subscriptions[topic] = number


def _text(content: dict[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":")).encode()
