"""``tsgt web`` as a process, and its page in a real browser."""

from __future__ import annotations

import asyncio
import re
import signal
import sys
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from harness.files.records import EVENT, HEADER, PARAMETERS
from harness.missions.scripted_mission import scripted_mission
from harness.readers.browser import CHROMIUM, Tab, browser
from harness.readers.web import in_real_time, pose, status

from tsgt.model import Status
from tsgt.recording import encode_line

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="chromium is not installed (apt install chromium)"
)

SIZES = ((1280, 800), (800, 1280), (390, 844))
FOLLOWS_S = 2.0
"""From a fault on the stream until the page shows it."""

START_S = 60.0
MEMORY_MB = 60.0

NOTHING = "\N{EN DASH}"

SILENT = {"last_heard_s": 7.0, "answering": False}

WELL: dict[str, Any] = {
    "stations": {1: {}, 2: {}, 3: {}}, "pose": {}, "free_bytes": 20_000_000_000, "centre_m": (14.0, 12.0), "hung": False,
}  # fmt: skip

FAULTS: list[tuple[dict[str, Any], str, str]] = [
    ({"stations": {1: {}, 2: SILENT, 3: {}}}, "CARE", "station 2: silent"),
    ({"stations": {1: {}, 2: {"status": Status.NO_TARGET}, 3: {}}}, "CARE", "station 2: no prism"),
    (
        {
            "stations": dict.fromkeys((1, 2, 3), SILENT),
            "pose": {"valid": False, "reason": "outage", "quality": "invalid"},
        },
        "NO POSE",
        "no station is received",
    ),
    ({"free_bytes": 12_000_000}, "CARE", "the disk is full: 12 MB left"),
    ({"centre_m": (80.0, 80.0)}, "CARE", "outside the geofence site"),
    ({"hung": True}, "STREAM STOPPED", "the master has sent nothing"),
]
"""What happens to the mission, and what the page then says."""


@asynccontextmanager
async def web(*options: str | Path, port: str = "0") -> AsyncIterator[tuple[asyncio.subprocess.Process, str]]:
    """Start the program; give process and address."""
    arguments = [sys.executable, "-m", "tsgt", "web", "--port", port, *map(str, options)]
    process = await asyncio.create_subprocess_exec(*arguments, stderr=asyncio.subprocess.PIPE)
    assert process.stderr is not None
    try:
        async with asyncio.timeout(START_S):
            while not (found := re.match(rb"the page is at (\S+)", line := await process.stderr.readline())):
                assert line, "tsgt web has ended"
        drain = asyncio.create_task(process.stderr.read())
        yield process, found[1].decode()
        drain.cancel()
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


def words_are(words: str, cause: str = "") -> str:
    """Return the expression that is true when the page shows this verdict."""
    return (
        f"document.getElementById('words')?.textContent === {words!r} && "
        f"document.getElementById('cause').textContent.includes({cause!r})"
    )


@needs_chromium
@in_real_time
async def test_page_follows_each_fault_within_two_seconds(tmp_path: Path) -> None:
    """At the sizes of a laptop, a tablet and a phone; and what it shows comes back by itself."""
    socket = tmp_path / "poses.sock"

    async with AsyncExitStack() as stack:
        window = await stack.enter_async_context(browser())
        _, url = await stack.enter_async_context(web("--socket", socket))
        tabs = [await stack.enter_async_context(window.tab(url, *size)) for size in SIZES]
        async with scripted_mission(socket) as mission:
            await shown(tabs, words_are("GOOD"), START_S)
            for changes, words, cause in FAULTS:
                vars(mission).update(changes)
                await shown(tabs, words_are(words, cause), FOLLOWS_S)
                vars(mission).update(WELL)
                await shown(tabs, words_are("GOOD"), 2 * FOLLOWS_S)
            mission.server.publish(encode_line(EVENT_WITH_SCRIPT))
            await shown(tabs, "document.getElementById('events').textContent.includes('<img')", FOLLOWS_S)
        # The master is gone.
        await shown(tabs, words_are("STREAM STOPPED", "the stream has ended"), FOLLOWS_S)
        for tab in tabs:
            assert await tab.run("document.querySelector('#f-sigma b').textContent") == NOTHING
            assert await tab.run("window.broken") is None
            assert await tab.run("document.documentElement.scrollWidth <= innerWidth")
            assert tab.problems == []


EVENT_WITH_SCRIPT = type(EVENT)(
    stamp_ns=EVENT.stamp_ns,
    event="<b>",
    message="<img src=x onerror='window.broken=1'><script>window.broken=1</script>",
)


async def shown(tabs: list[Tab], script: str, timeout_s: float) -> None:
    """Wait until all pages show something."""
    await asyncio.gather(*(tab.wait(script, timeout_s) for tab in tabs))


@needs_chromium
@in_real_time
async def test_page_without_its_server_is_no_green(tmp_path: Path) -> None:
    """Hung or killed: the browser's own clock tells; and the page connects to the next one by itself."""
    socket = tmp_path / "poses.sock"
    async with (
        browser() as window,
        scripted_mission(socket),
        web("--socket", socket) as (process, url),
        window.tab(url) as tab,
    ):
        await tab.wait(words_are("GOOD"), START_S)
        process.send_signal(signal.SIGSTOP)
        await tab.wait(words_are("NO CONNECTION"), FOLLOWS_S)
        process.send_signal(signal.SIGCONT)
        await tab.wait(words_are("GOOD"), 2 * FOLLOWS_S)
        process.kill()
        await tab.wait(words_are("NO CONNECTION"), FOLLOWS_S)
        assert await tab.run("document.querySelector('#f-sigma b').textContent") == NOTHING
        async with web("--socket", socket, port=url.rsplit(":", 1)[1].strip("/")):
            await tab.wait(words_are("GOOD"), START_S)


@needs_chromium
@in_real_time
async def test_code_and_keys_in_a_browser(tmp_path: Path) -> None:
    """The form sends the code as a browser does, with its origin; then keys steer map and colours."""
    code = tmp_path / "web.code"
    code.write_text("abcdefghjk23")
    code.chmod(0o600)
    async with (
        browser() as window,
        web("--socket", tmp_path / "none.sock", "--code-file", code) as (_, url),
        window.tab(url) as tab,
    ):
        field = "document.getElementById('code')"
        for given, then in (
            ("wrong code", "innerText.includes('Wrong code')"),
            ("abcdefghjk23", "dataset.replay === 'no'"),
        ):
            await tab.wait(f"{field} !== null", START_S)
            await tab.run(f"{field}.value = {given!r}; {field}.form.requestSubmit()")
            await tab.wait(f"document.body?.{then}", START_S)
        await tab.wait(words_are("STREAM STOPPED", "does tsgt-master run?"), START_S)
        assert await tab.run("document.cookie") == ""
        for key, state in (
            ("f", "document.getElementById('follow').ariaPressed === 'false'"),
            ("n", "document.getElementById('north').textContent === 'Heading up'"),
            ("t", "document.documentElement.dataset.theme === 'light'"),
            ("t", "document.documentElement.dataset.theme === 'dark'"),
        ):
            await tab.run(
                f"document.body.dispatchEvent(new KeyboardEvent('keydown', {{key: {key!r}, bubbles: true}}))"
            )
            assert await tab.run(state), key


@needs_chromium
@in_real_time
async def test_recording_with_its_time_bar(tmp_path: Path) -> None:
    """It plays; the bar seeks, the button pauses, and a paused replay is no lost connection."""
    records = [HEADER, PARAMETERS]
    for step in range(600):
        records += [pose(step / 10, position_m=(step / 20, 5.0, 0.0))] + (
            [status(step / 10)] if step % 10 == 0 else []
        )
    path = tmp_path / "drive.jsonl"
    path.write_bytes(b"".join(encode_line(record) + b"\n" for record in records))
    async with browser() as window, web("--replay", path) as (_, url), window.tab(url) as tab:
        await tab.wait(words_are("GOOD"), START_S)
        await tab.run(
            "let at = document.getElementById('at'); at.value = 40; at.dispatchEvent(new Event('input'))"
        )
        await tab.wait("document.getElementById('at-text').textContent.startsWith('0:41')", START_S)
        await tab.run("document.getElementById('play').click()")
        await tab.wait("document.getElementById('play').textContent === 'Play'", START_S)
        before = await tab.run("document.getElementById('at-text').textContent")
        await asyncio.sleep(FOLLOWS_S)
        assert await tab.run("document.getElementById('at-text').textContent") == before
        assert await tab.run(words_are("GOOD"))
        assert tab.problems == []


@in_real_time
async def test_program_is_small_and_ends_when_told(tmp_path: Path) -> None:
    """A mission's minute fits into 60 MB, without numpy; SIGTERM ends it at once, with exit code 0."""
    socket = tmp_path / "poses.sock"
    async with scripted_mission(socket), web("--socket", socket) as (process, url):
        reader, writer = await asyncio.open_connection("127.0.0.1", int(url.rsplit(":", 1)[1].strip("/")))
        writer.write(f"GET /stream HTTP/1.1\r\nHost: {url.split('/')[2]}\r\n\r\n".encode())
        for _ in range(10):
            assert await reader.readuntil(b"\n\n")
        maps = await asyncio.to_thread(read, f"/proc/{process.pid}/maps")
        found = re.search(r"VmHWM:\s+(\d+)", await asyncio.to_thread(read, f"/proc/{process.pid}/status"))
        assert found is not None
        peak_mb = int(found[1]) / 1024
        assert not re.search(r"numpy|scipy", maps)
        assert peak_mb < MEMORY_MB
        process.send_signal(signal.SIGTERM)
        async with asyncio.timeout(START_S):
            assert await process.wait() == 0
        writer.close()


def read(path: str) -> str:
    """Read a file."""
    return Path(path).read_text(encoding="utf-8")
