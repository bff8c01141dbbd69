"""``tsgt web --foxglove`` as a process, with apps that speak the protocol."""

from __future__ import annotations

import asyncio
import re
import sys
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from harness.files.records import EVENT
from harness.missions.scripted_mission import scripted_mission
from harness.readers.web import in_real_time

from tsgt.recording import encode_line

pytest.importorskip("foxglove", reason="the extra foxglove is not installed (pip install 'tsgt[foxglove]')")

from harness.readers.foxglove import app

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

START_S = 30.0
FOLLOWS_S = 2.0


@asynccontextmanager
async def web(path: Path) -> AsyncIterator[str]:
    """Start the program; give the address that it prints for the app."""
    arguments = [sys.executable, "-m", "tsgt", "web", "--port", "0", "--socket", str(path), "--foxglove"]
    process = await asyncio.create_subprocess_exec(*arguments, stderr=asyncio.subprocess.PIPE)
    assert process.stderr is not None
    try:
        async with asyncio.timeout(START_S):
            while not (
                found := re.match(rb"open in Foxglove: (\S+)", line := await process.stderr.readline())
            ):
                assert line, "tsgt web has ended"
        drain = asyncio.create_task(process.stderr.read())
        yield found[1].decode()
        drain.cancel()
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


@in_real_time
async def test_app_follows_a_mission(tmp_path: Path) -> None:
    """A valid pose, an invalid one, an event, and the end of the master, each within two seconds."""
    path = tmp_path / "poses.sock"
    async with scripted_mission(path) as mission, web(path) as url, app(url) as one:
        await one.subscribe(*one.channels)
        await one.until(
            lambda topic, content: topic == "/tsgt/mission" and content["verdict"]["words"] == "GOOD"
        )
        found = await one.until(lambda topic, _: topic == "/tsgt/pose", FOLLOWS_S)
        x, y = (
            found["pose"]["position"][name] - centre
            for name, centre in zip("xy", mission.centre_m, strict=True)
        )
        assert (x * x + y * y) ** 0.5 == pytest.approx(5.0)
        mission.server.publish(encode_line(EVENT))
        await one.until(
            lambda topic, content: topic == "/tsgt/events" and content["message"] == EVENT.message, FOLLOWS_S
        )
        mission.pose = {"valid": False, "reason": "outage", "quality": "invalid"}
        await one.until(no_pose, FOLLOWS_S)
        for _ in range(50):
            assert (await one.message())[0] != "/tsgt/pose"
        mission.pose = {}
        await one.until(lambda topic, _: topic == "/tsgt/pose", FOLLOWS_S)
        mission.hung = True
        await one.until(no_pose, FOLLOWS_S)
        await one.until(
            lambda topic, content: (
                topic == "/tsgt/mission" and content["verdict"]["words"] == "STREAM STOPPED"
            ),
            FOLLOWS_S,
        )
        assert one.times_ns == sorted(one.times_ns)


def no_pose(topic: str, content: dict[str, Any]) -> bool:
    """Return whether a message says that there is no valid pose."""
    return topic == "/tsgt/mission" and not content["pose_valid"]
