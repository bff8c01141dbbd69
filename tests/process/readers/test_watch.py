"""``tsgt status --watch`` and ``tsgt listen`` on a real terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import socket
import struct
import subprocess
import sys
import termios
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from harness.files.records import EVENT, HELLO, POSE, STATUS, measurement
from harness.missions.processes import TIMEOUT_S

from tsgt.model import Status
from tsgt.recording import StationStatus, encode_line

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

COLUMNS, ROWS = 40, 30
STATION = StationStatus(
    id=1, measurements=5, usable=5, age_s=0.2, status=Status.OK, last_heard_s=0.1, answering=True
)
LINES = [
    encode_line(record)
    for record in (
        replace(STATUS, stations=(STATION,)),
        measurement(0),
        replace(POSE, kind="predicted", quality="good"),
    )
]


class Terminal:
    """A terminal with a program on it."""

    def __init__(self, *arguments: object) -> None:
        self._fd, other = pty.openpty()
        fcntl.ioctl(other, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        command = [sys.executable, "-m", "tsgt", *map(str, arguments)]
        environment = os.environ | {"TERM": "xterm-256color"}
        environment.pop("COLUMNS", None)
        self.process = subprocess.Popen(
            command,
            stdin=other,
            stdout=other,
            stderr=other,
            env=environment,
            start_new_session=True,
        )
        os.close(other)
        self.written = b""

    def read(self) -> str:
        """Return what is written within a short time, without control sequences."""
        new = b""
        until_s = time.monotonic() + 0.3
        while (left_s := until_s - time.monotonic()) > 0 and select.select([self._fd], [], [], left_s)[0]:
            try:
                new += os.read(self._fd, 65536)
            except OSError:  # the program has ended
                break
        self.written += new
        text = re.sub(r"\x1b\[[0-9;]*H", "\n", new.decode(errors="replace"))
        return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)

    def read_until(self, text: str) -> str:
        """Read until a text is written; return what was read."""
        until_s = time.monotonic() + TIMEOUT_S
        read = ""
        while text not in read:
            ended = self.process.poll() is not None
            read += self.read()
            assert text in read or not (ended or time.monotonic() > until_s), self.written[-2000:]
        return read

    def end(self) -> tuple[int, str]:
        """Read until the program ends; return its exit code and what was read."""
        until_s = time.monotonic() + TIMEOUT_S
        part = ""
        while self.process.poll() is None:
            part += self.read()
            assert time.monotonic() < until_s, self.written[-2000:]
        assert self.process.returncode is not None
        return self.process.returncode, part + self.read()

    def close(self) -> None:
        """End the program and the terminal."""
        self.process.kill()
        self.process.wait()
        os.close(self._fd)


@contextmanager
def terminal(*arguments: object) -> Iterator[Terminal]:
    """Run a program on a terminal, and kill it at the end."""
    opened = Terminal(*arguments)
    try:
        yield opened
    finally:
        opened.close()


@contextmanager
def master(path: Path) -> Iterator[None]:
    """Serve a stream to one reader at a time, until the end of the block."""
    ended = threading.Event()

    def serve() -> None:
        while not ended.is_set():
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            with connection:
                connection.sendall(encode_line(HELLO) + b"\n" + encode_line(EVENT) + b"\n")
                while not ended.wait(0.1):
                    try:
                        connection.sendall(b"".join(line + b"\n" for line in LINES))
                    except OSError:
                        break

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        listener.settimeout(0.1)
        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
    path.unlink()


def test_watch_survives_the_master_and_ends_cleanly(tmp_path: Path) -> None:
    """It says when the master is gone, connects again, and leaves the terminal as it was; no line is too wide."""
    path = tmp_path / "s"
    with terminal("status", "--watch", "--socket", path) as screen:
        screen.read_until("NO CONNECTION")
        with master(path):
            shown = screen.read_until("GOOD")
            shown += screen.read_until("STATION 1  TRACKING")
        screen.read_until("NO CONNECTION")
        with master(path):
            shown += screen.read_until("GOOD")
            screen.process.send_signal(signal.SIGINT)  # as Ctrl-C
            assert screen.end()[0] == 0
    assert "lines_lost: lost 7 lines" in shown
    assert max(map(len, re.split(r"[\r\n]+", shown))) <= COLUMNS
    end = screen.written[-200:]
    assert b"\x1b[?1049l" in end  # the screen before
    assert b"\x1b[?25h" in end  # the cursor


def test_listen_shows_the_newest_lines_until_the_end(tmp_path: Path) -> None:
    """SIGTERM also leaves the terminal as it was; the end of the stream is success."""
    path = tmp_path / "s"
    with terminal("listen", "--socket", path) as screen:
        code, text = screen.end()
        assert code == 1  # no stream
        assert "start tsgt-master" in text
    with master(path):
        with terminal("listen", "--socket", path, "--kind", "pose,measurement") as first:
            screen_text = first.read_until("STATION 1  prism 1")
            assert "PREDICTED  VALID" in screen_text
            assert "lines_lost" not in screen_text
            first.process.send_signal(signal.SIGTERM)
            assert first.end()[0] == 0
        assert b"\x1b[?1049l" in first.written[-200:]
        last = Terminal("listen", "--socket", path)
        last.read_until("lines_lost")
    code, text = last.end()
    last.close()
    assert code == 0
    assert "the stream has ended" in text
