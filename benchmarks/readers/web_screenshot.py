"""The figure of the operator's page in README and guide: a recording on the page, in a real Chromium.

tsgt simulate dynamic --duration 180 --seed 1 --output R.jsonl
python benchmarks/run.py web_screenshot R.jsonl docs/how-to/figures/web.png --at 100
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from pathlib import Path

from harness.readers.browser import CHROMIUM, browser

from tsgt.clock import SystemClock
from tsgt.web.recorded import index_of
from tsgt.web.replay import ReplayMessages
from tsgt.web.server import Page, Settings, serve

SETTLE_S = 3.0


def main() -> None:
    """Write the figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--at", type=float, default=100.0, help="second of the recording")
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=800)
    options = parser.parse_args()
    if CHROMIUM is None:
        sys.exit("chromium is not installed: apt install chromium")
    image = asyncio.run(photograph(options.recording, options.at, (options.width, options.height)))
    options.output.write_bytes(image)
    print(f"{options.output}: {len(image) / 1e3:.0f} kB")


async def photograph(recording: Path, at_s: float, size: tuple[int, int]) -> bytes:
    """Return what the page shows of a recording, as PNG."""
    clock = SystemClock()
    page = Page(
        Settings(address="127.0.0.1", port=0, access=None), ReplayMessages(index_of(recording), clock), clock
    )
    url: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(serve(page, url.set_result))
    try:
        async with browser() as window, window.tab(await url, *size) as tab:
            bar = "document.getElementById('at')"
            await tab.wait(f"{bar}?.max > 1", 30)
            await tab.run(f"{bar}.value = {at_s}; {bar}.dispatchEvent(new Event('input'))")
            await tab.wait(f"{bar}.value >= {at_s}", 30)
            await asyncio.sleep(SETTLE_S)
            await tab.run("document.getElementById('fit').click()")
            await asyncio.sleep(0.5)
            return await tab.screenshot()
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


if __name__ == "__main__":
    sys.exit("run it by its name: python benchmarks/run.py web_screenshot")
