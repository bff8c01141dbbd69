"""Run in the guest: carries out what the host asks for over a virtio serial port, one JSON line each way."""

from __future__ import annotations

import base64
import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

PORT = "/dev/virtio-ports/agent"


def run(command: str, timeout_s: float) -> dict[str, Any]:
    """Run a shell command with its children; after the timeout (guest time) all of them are killed, code 124."""
    process = subprocess.Popen(  # noqa: S602 (a test machine's shell)
        command,
        shell=True,
        executable="/bin/bash",
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        cwd="/root",
    )
    try:
        out, _ = process.communicate(timeout=timeout_s)
        code = process.returncode
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, _ = process.communicate()
        code = 124
    return {"code": code, "out": base64.b64encode(out).decode()}


def carry_out(request: dict[str, Any]) -> dict[str, Any]:
    """Run a command, write a file, or read one."""
    if "put" in request:
        path = Path(request["put"])
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(request["data"]))
        path.chmod(request["mode"])
        return {"code": 0, "out": ""}
    if "get" in request:
        return {"code": 0, "out": base64.b64encode(Path(request["get"]).read_bytes()).decode()}
    return run(request["run"], request["timeout_s"])


def main() -> None:
    """Serve for ever."""
    port = os.open(PORT, os.O_RDWR)
    pending = b""
    while True:
        data = os.read(port, 65536)
        if not data:  # no host is connected
            signal.sigtimedwait([], 0.1)
            continue
        *lines, pending = (pending + data).split(b"\n")
        for line in lines:
            request = json.loads(line)
            try:
                result = carry_out(request)
            except OSError as error:
                result = {"code": 1, "out": base64.b64encode(str(error).encode()).decode()}
            answer = json.dumps({"id": request["id"], **result}).encode() + b"\n"
            while answer:
                answer = answer[os.write(port, answer) :]


if __name__ == "__main__":
    main()
