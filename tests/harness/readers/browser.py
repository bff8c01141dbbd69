"""A real headless Chromium, driven by the DevTools protocol over its WebSocket."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import re
import shutil
import signal
import tempfile
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import aiohttp

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

START_TIMEOUT_S = 60.0
CALL_TIMEOUT_S = 60.0
POLL_S = 0.05
PAGE_REPLACED = -32000
"""Code of the protocol's error when a page is replaced by the next one while it evaluates an expression."""

_OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-extensions", "--disable-sync",
    "--disable-background-timer-throttling", "--disable-renderer-backgrounding", "--mute-audio",
    "--hide-scrollbars", "--remote-debugging-port=0", "--remote-allow-origins=*",
)  # fmt: skip


class PageReplacedError(Exception):
    """The browser went to another page during a call."""


class Tab:
    """One page of the browser."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self._calls = 0
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self.problems: list[str] = []
        """Exceptions and errors that the page has logged, as a violated Content-Security-Policy."""
        self._reader = asyncio.create_task(self._read())

    async def close(self) -> None:
        """End the conversation."""
        self._reader.cancel()
        await asyncio.gather(self._reader, return_exceptions=True)
        await self._socket.close()

    async def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol."""
        self._calls += 1
        answer = self._answers[self._calls] = asyncio.get_running_loop().create_future()
        await self._socket.send_str(json.dumps({"id": self._calls, "method": method, "params": params}))
        async with asyncio.timeout(CALL_TIMEOUT_S):
            reply = await answer
        if reply.get("error", {}).get("code") == PAGE_REPLACED:
            raise PageReplacedError(reply)
        assert "error" not in reply, reply
        result: dict[str, Any] = reply["result"]
        return result

    async def open(self, url: str, width: int, height: int, first: str = "") -> Self:
        """Open an address in a window of this size; ``first``: a script that runs before those of the page."""
        for domain in ("Page", "Runtime", "Log"):
            await self.call(f"{domain}.enable")
        await self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        if first:
            await self.call("Page.addScriptToEvaluateOnNewDocument", source=first)
        await self.call("Page.navigate", url=url)
        return self

    async def run(self, script: str) -> Any:
        """Return the value of an expression in the page."""
        result = await self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    async def wait(self, script: str, timeout_s: float) -> float:
        """Wait until an expression is true, in this page or the next; return how long that took, in s."""
        loop = asyncio.get_running_loop()
        start_s = loop.time()
        while not await self._is_true(script):
            text = "document.body && document.body.innerText.slice(0, 400)"
            assert loop.time() - start_s < timeout_s, (
                f"not within {timeout_s} s: {script}: {await self.run(text)}"
            )
            await asyncio.sleep(POLL_S)
        return loop.time() - start_s

    async def _is_true(self, script: str) -> bool:
        with suppress(PageReplacedError):
            return bool(await self.run(script))
        return False

    async def screenshot(self) -> bytes:
        """Return what the window shows as a PNG."""
        result = await self.call("Page.captureScreenshot", format="png")
        return base64.b64decode(result["data"])

    async def _read(self) -> None:
        async for message in self._socket:
            content = json.loads(message.data)
            if "id" in content:
                self._answers.pop(content["id"]).set_result(content)
            elif content["method"] == "Runtime.exceptionThrown":
                self.problems.append(json.dumps(content["params"]["exceptionDetails"])[:500])
            elif content["method"] == "Log.entryAdded" and content["params"]["entry"]["level"] == "error":
                self.problems.append(content["params"]["entry"]["text"])


class Browser:
    """A running browser."""

    def __init__(self, session: aiohttp.ClientSession, port: str, process: int) -> None:
        self._session = session
        self._url = f"http://127.0.0.1:{port}"
        self._process = process

    def freeze(self) -> None:
        """Stop all its processes, as a computer does that sleeps."""
        os.killpg(self._process, signal.SIGSTOP)

    def thaw(self) -> None:
        """Let them go on."""
        os.killpg(self._process, signal.SIGCONT)

    @asynccontextmanager
    async def tab(
        self, url: str, width: int = 1280, height: int = 800, first: str = ""
    ) -> AsyncIterator[Tab]:
        """Open a page of its own."""
        async with self._session.put(f"{self._url}/json/new?about:blank") as response:
            target = json.loads(await response.text())
        tab = Tab(await self._session.ws_connect(target["webSocketDebuggerUrl"], max_msg_size=0))
        try:
            yield await tab.open(url, width, height, first)
        finally:
            await tab.close()
            async with self._session.get(f"{self._url}/json/close/{target['id']}"):
                pass


@asynccontextmanager
async def browser() -> AsyncIterator[Browser]:
    """Start a browser with an empty profile, and end it."""
    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory(prefix="tsgt-browser-", ignore_cleanup_errors=True) as profile:
        process = await asyncio.create_subprocess_exec(
            CHROMIUM,
            *_OPTIONS,
            f"--user-data-dir={profile}",
            "about:blank",
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            port = await _port(Path(profile) / "DevToolsActivePort")
            async with aiohttp.ClientSession() as session:
                yield Browser(session, port, process.pid)
        finally:
            with suppress(ProcessLookupError):
                process.terminate()
            await process.wait()


async def _port(file: Path) -> str:
    async with asyncio.timeout(START_TIMEOUT_S):
        while True:
            if found := _number(file):
                return found
            await asyncio.sleep(POLL_S)


def _number(file: Path) -> str:
    found = re.match(r"(\d+)\n", file.read_text()) if file.exists() else None
    return found[1] if found is not None else ""
