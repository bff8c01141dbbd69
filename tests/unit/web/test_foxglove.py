"""The stream for Foxglove apps, decoded with the schemas that they are given; and who gets it."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest
from harness.files.records import EVENT, SETUP
from harness.readers import foxglove_layout
from harness.readers.web import HELLO, in_real_time, pose, served, status
from structlog.testing import capture_logs

from tsgt.clock import SystemClock
from tsgt.recording import encode_line
from tsgt.web.access import ATTEMPTS_PER_ADDRESS, Access
from tsgt.web.mission.state import MissionState

pytest.importorskip("foxglove", reason="the extra foxglove is not installed (pip install 'tsgt[foxglove]')")

import aiohttp
from harness.readers.foxglove import SUBPROTOCOL, App, app

from tsgt.web.foxglove import Feed, FoxgloveServer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

CODE = "correct horse"
EVERYTHING = ("/tf", "/tsgt/pose", "/tsgt/scene", "/tsgt/events", "/tsgt/mission", "/tsgt/status")


class Mission:
    """A mission whose lines a test sends, and its apps."""

    def __init__(self) -> None:
        self.state = MissionState("poses.sock")
        self.apps = FoxgloveServer(self.state, SystemClock())
        self.url = ""

    def send(self, *records: Any) -> None:
        """Send lines of the stream, now."""
        for record in records:
            self.apps.line(encode_line(record), time.monotonic())


@asynccontextmanager
async def mission(access: Access | None = None) -> AsyncIterator[Mission]:
    """Serve a mission in which nothing happens by itself."""
    here = Mission()
    here.apps.connected(time.monotonic())
    here.apps.line(HELLO, time.monotonic())
    here.send(SETUP, status(0.0))
    async with served(here.state, access, here.apps) as url:
        here.url = f"{url}foxglove"
        yield here


async def subscribed(one: App, *topics: str) -> None:
    """Subscribe, and wait until the server knows."""
    await one.subscribe(*topics, "/tsgt/mission")
    await one.until(lambda topic, _: topic == "/tsgt/mission")


@pytest.mark.parametrize("subprotocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
@in_real_time
async def test_app_is_told_channels_and_time(subprotocol: str) -> None:
    """Of both generations of apps."""
    async with mission() as here, app(here.url, subprotocol) as one:
        assert one.socket.protocol == subprotocol
        assert one.information["op"] == "serverInfo"
        assert one.information["capabilities"] == ["time"]
        assert set(one.channels) == set(EVERYTHING)
        await subscribed(one)
        assert one.times_ns[0] >= status(0.0).stamp_ns


@in_real_time
async def test_valid_pose_arrives_with_frames_and_robot() -> None:
    """With every number."""
    async with mission() as here, app(here.url) as one:
        await subscribed(one, "/tsgt/pose", "/tf", "/tsgt/scene")
        sent = pose(0.1, position_m=(1.0, 2.0, 3.0), orientation_xyzw=(0.0, 0.0, 0.6, 0.8))
        here.send(sent)
        found = await one.until(lambda topic, _: topic == "/tsgt/pose")
        assert found["frame_id"] == "station1"
        assert found["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 3.0}
        assert found["pose"]["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}
        moving = await one.until(lambda topic, content: topic == "/tf" and len(content["transforms"]) == 1)
        assert moving["transforms"][0]["parent_frame_id"] == "station1"
        assert moving["transforms"][0]["child_frame_id"] == "robot"
        assert moving["transforms"][0]["translation"] == {"x": 1.0, "y": 2.0, "z": 3.0}
        robot = await one.until(lambda topic, content: topic == "/tsgt/scene" and shows(content, "robot"))
        (entity,) = robot["entities"]
        assert entity["lifetime"] == "1s"
        assert entity["arrows"][0]["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 3.0}
        assert len(entity["spheres"]) == 3


def shows(scene: dict[str, Any], name: str) -> bool:
    """Return whether a scene has something of this name."""
    return any(each["id"] == name for each in scene["entities"])


def removes(scene: dict[str, Any], name: str) -> bool:
    """Return whether a scene takes something of this name away."""
    return any(each["id"] == name for each in scene["deletions"])


@in_real_time
async def test_invalid_pose_is_no_pose() -> None:
    """No pose, no frame, the robot is taken away; the mission says why, and how old the pose is."""
    async with mission() as here, app(here.url) as one:
        await subscribed(one, "/tsgt/pose", "/tf", "/tsgt/scene")
        here.send(pose(0.1))
        await one.until(lambda topic, content: topic == "/tsgt/mission" and content["pose_valid"])
        here.send(pose(0.2, valid=False, reason="uncertain", quality="invalid", position_m=(77.0, 77.0, 0.0)))
        seen = []

        def taken(topic: str, content: dict[str, Any]) -> bool:
            seen.append((topic, json.dumps(content)))
            return topic == "/tsgt/mission" and not content["pose_valid"]

        found = await one.until(taken)
        assert found["verdict"]["words"] == "NO POSE"
        assert found["verdict"]["cause"]
        assert 0.0 <= found["pose_age_s"] < 5.0
        assert "/tsgt/pose" not in [topic for topic, _ in seen]
        assert not any("77.0" in content for topic, content in seen if topic in {"/tf", "/tsgt/scene"})
        assert any(
            topic == "/tsgt/scene" and removes(json.loads(content), "robot") for topic, content in seen
        )


def test_stale_pose_is_no_pose() -> None:
    """Although the last one was valid: the robot is taken away when none follows within a second."""
    state = MissionState("poses.sock")
    feed = Feed(state, lambda _: True)
    state.connected(0.0)
    for record in (SETUP, status(0.0), pose(0.0)):
        line = encode_line(record)
        state.line(line, 0.0)
        list(feed.line(line, 0.0))
    assert said(feed, state, 0.5)["pose_valid"]
    state.line(encode_line(status(1.1)), 1.1)
    stale = said(feed, state, 1.1)
    assert not stale["pose_valid"]
    assert stale["verdict"]["words"] == "NO POSE"


def test_pose_of_a_late_stream_is_no_pose() -> None:
    """Lines that arrive 10 s late are no live view, however valid their poses: the robot is taken away."""
    state = MissionState("poses.sock")
    feed = Feed(state, lambda _: True)
    state.connected(0.0)
    state.line(encode_line(SETUP), 0.0)

    def sent(at_s: float, now_s: float) -> list[str]:
        """Return the topics of the messages of a pose, after a status that is as old."""
        for record in (status(at_s), pose(at_s)):
            line = encode_line(record)
            state.line(line, now_s)
            messages = list(feed.line(line, now_s))
        return [each.topic for each in messages]

    assert sent(0.0, 0.0) == ["/tsgt/pose", "/tf", "/tsgt/scene"]
    assert sent(1.0, 11.0) == ["/tsgt/scene"]
    assert said(feed, state, 11.0)["verdict"]["words"] == "STREAM STOPPED"
    assert sent(12.0, 12.0) == ["/tsgt/pose", "/tf", "/tsgt/scene"]


def test_pose_that_leads_a_backlog_is_no_pose() -> None:
    """After a silence the delay is unknown until a status tells it: poses are live again behind one that is in time."""
    state = MissionState("poses.sock")
    feed = Feed(state, lambda _: True)
    state.connected(0.0)
    state.line(encode_line(SETUP), 0.0)

    def sent(record: Any, now_s: float) -> bool:
        """Return whether a line gives a pose."""
        line = encode_line(record)
        state.line(line, now_s)
        return "/tsgt/pose" in [each.topic for each in feed.line(line, now_s)]

    sent(status(0.0), 0.0)
    assert sent(pose(0.05), 0.05)
    assert not sent(pose(0.1), 8.0)
    assert not said(feed, state, 8.0)["pose_valid"]
    sent(status(1.0), 8.0)
    assert not sent(pose(1.05), 8.0)
    sent(status(8.0), 8.0)
    assert sent(pose(8.05), 8.05)


def test_last_known_position_is_not_shown_in_a_new_frame() -> None:
    """It was one of the old frame, as was the trail."""
    state = MissionState("poses.sock")
    feed = Feed(state, lambda _: True)
    state.connected(0.0)
    other = replace(
        SETUP, stations=tuple(replace(each, position_m=(9.0, 9.0, 0.0)) for each in SETUP.stations)
    )
    shown = []
    for setup in (SETUP, SETUP, other):
        for record in (setup, status(0.0), pose(0.0)) if setup is SETUP else (setup,):
            line = encode_line(record)
            state.line(line, 0.0)
            list(feed.line(line, 0.0))
        scenes = [each.data for each in feed.view(state.view(1.2), 1.2) if each.topic == "/tsgt/scene"]
        shown.append(any(b"last known position" in each for each in scenes))
    assert shown == [True, True, False]


def said(feed: Feed, state: MissionState, now_s: float) -> dict[str, Any]:
    """Return what the channel of the mission says."""
    messages = {each.topic: each.data for each in feed.view(state.view(now_s), now_s)}
    content: dict[str, Any] = json.loads(messages["/tsgt/mission"])
    return content


@in_real_time
async def test_set_up_events_and_status_arrive() -> None:
    """Frames by the names of an export, fences and stations in the scene, events as log, the status as on the stream."""
    async with mission() as here, app(here.url) as one:
        await subscribed(one, *EVERYTHING)
        frames = await one.until(lambda topic, content: topic == "/tf" and len(content["transforms"]) > 1)
        assert {each["child_frame_id"] for each in frames["transforms"]} == {
            "station2", "station3", "prism1", "prism2", "prism3",
        }  # fmt: skip
        around = await one.until(
            lambda topic, content: topic == "/tsgt/scene" and shows(content, "surroundings")
        )
        texts = [each["text"] for each in around["entities"][0]["texts"]]
        assert texts == ["1: tracking", "2: tracking", "3: tracking", "site: stay inside"]
        here.send(replace(EVENT, event="radio_failed", message="the radio\nfailed"), status(1.0))
        event = await one.until(lambda topic, _: topic == "/tsgt/events")
        assert (event["level"], event["name"], event["message"]) == (
            "ERROR",
            "radio_failed",
            "the radio failed",
        )
        found = await one.until(lambda topic, _: topic == "/tsgt/status")
        assert found == json.loads(encode_line(status(1.0)))


@in_real_time
async def test_layout_names_what_is_sent() -> None:
    """Every topic is a channel, and every path leads to a value in a message of a running mission."""
    async with mission() as here, app(here.url) as one:
        await subscribed(one)
        here.send(pose(0.0), pose(0.0, kind="smoothed"))
        found = await one.until(lambda topic, content: topic == "/tsgt/mission" and content["pose_valid"])
        for path in foxglove_layout.paths("live.json"):
            topic = foxglove_layout.topic_of(path)
            assert topic in one.channels
            if path != topic:
                assert topic == "/tsgt/mission"
                assert foxglove_layout.value_at(found, path.removeprefix(topic)) is not None, path


@pytest.mark.parametrize("origin", ["file://", "https://app.foxglove.dev"])
@in_real_time
async def test_foxglove_may_connect_on_loopback(origin: str) -> None:
    """Desktop and browser."""
    async with mission() as here, app(here.url, Origin=origin) as one:
        assert one.channels


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": ""},
        {"Origin": "https://app.foxglove.dev.evil.example"},
        {"Host": "evil.example"},
        {"subprotocol": "chat"},
    ],
)
@in_real_time
async def test_others_are_refused(headers: dict[str, str]) -> None:
    """A page of another site, no origin at all, a rebound name, another protocol."""
    async with mission() as here:
        with pytest.raises(aiohttp.WSServerHandshakeError):
            async with app(here.url, **headers):
                pass


@in_real_time
async def test_code_is_required_where_there_is_one() -> None:
    """In the address, from any origin; the page's limit on wrong ones is one for both."""
    async with mission(Access(CODE)) as here:
        async with app(f"{here.url}?code=correct%20horse", Origin="http://other.example") as one:
            assert one.channels
        for _ in range(ATTEMPTS_PER_ADDRESS):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refusal:
                async with app(f"{here.url}?code=wrong", Origin="file://"):
                    pass
            assert refusal.value.status == 403
        with pytest.raises(aiohttp.WSServerHandshakeError) as refusal:
            async with app(f"{here.url}?code=correct%20horse"):
                pass
        assert refusal.value.status == 429


@pytest.mark.parametrize(
    "request_",
    [
        "{",
        "[]",
        '{"op":"subscribe"}',
        '{"op":"subscribe","subscriptions":[{"id":1,"channelId":999}]}',
        '{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]}',
        '{"op":"subscribe","subscriptions":[{"id":"x","channelId":1}]}',
        '{"op":"unsubscribe","subscriptionIds":[[]]}',
        "[" * 10_000,
        "x" * 100_000,
    ],
)
@in_real_time
async def test_wrong_request_ends_the_connection(request_: str) -> None:
    """Of this app; the next one is served."""
    async with mission() as here:
        async with app(here.url) as one:
            await one.socket.send_str(request_)
            async with asyncio.timeout(10):
                while (await one.socket.receive()).type is aiohttp.WSMsgType.BINARY:
                    pass
            assert one.socket.closed
        async with app(here.url) as one:
            assert one.channels


@in_real_time
async def test_unsubscribed_topic_is_sent_no_more() -> None:
    """And requests for what is not offered are ignored."""
    async with mission() as here, app(here.url) as one:
        await subscribed(one, "/tsgt/status")
        number = 100 + one.channels["/tsgt/status"]["id"]
        await one.socket.send_json({"op": "getParameters", "parameterNames": []})
        await one.socket.send_json({"op": "unsubscribe", "subscriptionIds": [number]})
        await one.subscribe("/tsgt/events")
        await asyncio.sleep(0.3)
        here.send(status(1.0), EVENT)
        topics = []
        while "/tsgt/events" not in topics:
            topics.append((await one.message())[0])
        assert "/tsgt/status" not in topics


@in_real_time
async def test_stalled_app_costs_others_nothing() -> None:
    """Everything reaches the other one at once; the stalled one is disconnected."""
    async with mission() as here, app(here.url) as one:
        stalled = await stalling(here.url, one.channels["/tsgt/status"]["id"])
        await subscribed(one, "/tsgt/status")
        with capture_logs() as logs:
            async with asyncio.timeout(30):
                while not any(entry["event"] == "foxglove_app_stalled" for entry in logs):
                    here.send(status(1.0))
                    await one.until(lambda topic, _: topic == "/tsgt/status")
        here.send(status(2.0))
        await one.until(lambda topic, _: topic == "/tsgt/status")
        stalled.close()


async def stalling(url: str, channel: int) -> socket.socket:
    """Return an app that subscribes to a channel and then takes nothing."""
    host = urlsplit(url)
    request = json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel}]}).encode()
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.setblocking(False)
    loop = asyncio.get_running_loop()
    await loop.sock_connect(connection, (host.hostname, host.port))
    head = (
        f"GET {host.path} HTTP/1.1\r\nHost: {host.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
        f"Sec-WebSocket-Protocol: {SUBPROTOCOL}\r\nOrigin: file://\r\n\r\n"
    )
    masked = b"\x81\xfe" + len(request).to_bytes(2) + bytes(4) + request
    await loop.sock_sendall(connection, head.encode() + masked)
    return connection
