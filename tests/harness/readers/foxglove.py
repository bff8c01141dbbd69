"""A Foxglove app: a WebSocket client that speaks its protocol, and decodes messages with the schemas that it is given."""

from __future__ import annotations

import asyncio
import base64
import json
import struct
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import aiohttp
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.json_format import MessageToDict
from google.protobuf.message_factory import GetMessages

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

SUBPROTOCOL = "foxglove.sdk.v1"
TIMEOUT_S = 30.0


class App:
    """A connected app.

    ``information``, ``channels``: what the server has said of itself and offers, by topic.
    """

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.information: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.times_ns: list[int] = []
        self._decoders: dict[str, Callable[[bytes], dict[str, Any]]] = {}

    async def greeted(self) -> None:
        """Wait for the server's first two messages."""
        self.information = json.loads(await self.socket.receive_str(timeout=TIMEOUT_S))
        offer = json.loads(await self.socket.receive_str(timeout=TIMEOUT_S))
        assert offer["op"] == "advertise"
        self.channels = {each["topic"]: each for each in offer["channels"]}
        self._decoders = {topic: _decoder(channel) for topic, channel in self.channels.items()}

    async def subscribe(self, *topics: str) -> None:
        """Subscribe to topics; the number of a subscription is 100 more than that of its channel."""
        wishes = [
            {"id": 100 + self.channels[topic]["id"], "channelId": self.channels[topic]["id"]}
            for topic in topics
        ]
        await self.socket.send_json({"op": "subscribe", "subscriptions": wishes})

    async def message(self) -> tuple[str, int, dict[str, Any]]:
        """Return topic, time and content of the next message."""
        by_number = {100 + channel["id"]: topic for topic, channel in self.channels.items()}
        while True:
            data = await self.socket.receive_bytes(timeout=TIMEOUT_S)
            if data[0] == 2:
                self.times_ns.append(struct.unpack("<Q", data[1:])[0])
                continue
            opcode, number, stamp_ns = struct.unpack("<BIQ", data[:13])
            assert opcode == 1
            topic = by_number[number]
            return topic, stamp_ns, self._decoders[topic](data[13:])

    async def until(
        self, wanted: Callable[[str, dict[str, Any]], bool], timeout_s: float = TIMEOUT_S
    ) -> dict[str, Any]:
        """Return the content of the first message that is wanted; pass over the others."""
        async with asyncio.timeout(timeout_s):
            while True:
                topic, _, content = await self.message()
                if wanted(topic, content):
                    return content


def _decoder(channel: dict[str, Any]) -> Callable[[bytes], dict[str, Any]]:
    if channel["encoding"] == "json":
        assert channel["schemaEncoding"] == "jsonschema"
        assert json.loads(channel["schema"])["type"] == "object"
        return json.loads
    assert channel["encoding"] == channel["schemaEncoding"] == "protobuf"
    files = FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file
    kind = GetMessages(files)[channel["schemaName"]]
    return lambda data: MessageToDict(
        kind.FromString(data), preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )


@asynccontextmanager
async def app(url: str, subprotocol: str = SUBPROTOCOL, **headers: str) -> AsyncIterator[App]:
    """Connect an app, like the desktop's unless headers say otherwise; raises aiohttp.WSServerHandshakeError if it is refused."""
    headers = {name: text for name, text in {"Origin": "file://", **headers}.items() if text}
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(url, protocols=(subprotocol,), headers=headers, max_msg_size=0) as socket,
    ):
        connected = App(socket)
        await connected.greeted()
        yield connected
