"""What the relay costs with several readers: processor, memory, and the delay that it adds.

tsgt demo --socket /tmp/poses.sock --duration 120 &
python benchmarks/run.py relay_readers /tmp/poses.sock [--readers 5] [--seconds 60] [--tls]

The delay is from the arrival of a predicted pose on the master's socket to its arrival through the relay, both in this
process, so it contains the delays of this process, too.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import AsyncExitStack, suppress
from pathlib import Path

from tsgt.client import AsyncStream
from tsgt.radio.key_file import write_key

PORT = 27790
CERTIFICATE = (
    "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=relay"
)


async def arrivals(stream: AsyncStream, seconds: float) -> dict[int, float]:
    """Return when each predicted pose arrived."""
    found: dict[int, float] = {}
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            async for pose in stream.poses("predicted", include_invalid=True):
                found[pose.stamp_ns] = time.monotonic()
    return found


async def measure(source: str, path: Path, key: Path, readers: int, seconds: float) -> list[float]:
    """Return the added delays in ms."""
    async with AsyncExitStack() as stack:
        direct = await stack.enter_async_context(AsyncStream(path))
        relayed = [await stack.enter_async_context(AsyncStream(source, key=key)) for _ in range(readers)]
        first, *others = await asyncio.gather(*(arrivals(stream, seconds) for stream in (direct, *relayed)))
    return sorted(
        (other[stamp] - at) * 1e3 for other in others for stamp, at in first.items() if stamp in other
    )


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("socket", type=Path, help="socket of a running master or demo")
    parser.add_argument("--readers", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--tls", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_key(folder / "key")
        files = ("-keyout", str(folder / "key.pem"), "-out", str(folder / "certificate.pem"))
        subprocess.run([*CERTIFICATE.split(), *files], check=True, capture_output=True)
        tls = ["--certificate", str(folder / "certificate.pem"), "--private-key", str(folder / "key.pem")]
        command = [
            sys.executable, "-m", "tsgt", "relay", "--socket", str(options.socket), "--key", str(folder / "key"),
            "--listen", f"127.0.0.1:{PORT}", *(tls if options.tls else []),
        ]  # fmt: skip
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as relay:
            try:
                wait_for(PORT)
                before = processor_s(relay.pid)
                source = f"relay{'s' if options.tls else ''}://127.0.0.1:{PORT}"
                delays = asyncio.run(
                    measure(source, options.socket, folder / "key", options.readers, options.seconds)
                )
                used_s = processor_s(relay.pid) - before
                status = Path(f"/proc/{relay.pid}/status").read_text()
            finally:
                relay.terminate()
    memory = re.search(r"VmRSS:\s+(\d+)", status)
    assert memory is not None  # noqa: S101 (the kernel writes it)
    print(
        f"poses                {len(delays)} to {options.readers} readers{' over TLS' if options.tls else ''}"
    )
    print(f"processor            {100 * used_s / options.seconds:.2f} % of a core")
    print(f"memory               {int(memory[1]) / 1024:.0f} MB")
    print(
        f"added delay          median {delays[len(delays) // 2]:.2f} ms, p99 {delays[len(delays) * 99 // 100]:.2f} ms"
    )


def wait_for(port: int) -> None:
    """Return when the relay listens."""
    while True:
        with suppress(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port)):
            return
        time.sleep(0.1)


def processor_s(process: int) -> float:
    """Return the processor time of a process in s."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
