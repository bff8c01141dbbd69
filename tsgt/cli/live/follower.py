"""Follows the stream of a daemon across its restarts."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import TYPE_CHECKING

from tsgt.cli.live.line_reader import check_version, connect

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from tsgt.cli.live.line_reader import LineReader

CONNECT_TIMEOUT_S = 0.5

RETRY_INTERVAL_S = 1.0


class StreamFollower:
    """Connects to the first of some sockets that is served, and again when the stream ends.

    ``problem``: why there is no connection; empty while there is one.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths
        self._connection = ExitStack()
        self._reader: LineReader | None = None
        self._retry_s = 0.0
        self.problem = "not connected yet"

    def lines(self, until_s: float) -> Iterator[bytes]:
        """Yield the lines that arrive before a deadline on the monotonic clock in s, and wait for it.

        Raises StreamError for a stream of another protocol version.
        """
        while (now_s := time.monotonic()) < until_s:
            reader = self._reader
            if reader is None:
                if now_s < self._retry_s:
                    time.sleep(min(self._retry_s, until_s) - now_s)
                else:
                    self._connect()
                continue
            try:
                line = reader.line(until_s)
            except TimeoutError:
                return
            except (OSError, ValueError) as error:
                self._disconnect(f"the connection is lost: {error}")
                continue
            if line:
                check_version(line)
                yield line
            else:
                self._disconnect("the stream has ended")

    def close(self) -> None:
        """Disconnect."""
        self._connection.close()

    def _connect(self) -> None:
        problems = []
        for path in self._paths:
            try:
                self._reader = self._connection.enter_context(connect(path, CONNECT_TIMEOUT_S))
            except OSError as error:
                problems.append(f"{path}: {error.strerror or error}")
            else:
                self.problem = ""
                return
        self._disconnect("; ".join(problems))

    def _disconnect(self, problem: str) -> None:
        self._connection.close()
        self._reader = None
        self.problem = problem
        self._retry_s = time.monotonic() + RETRY_INTERVAL_S
