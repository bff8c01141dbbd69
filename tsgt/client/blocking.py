"""The plain face: iterators that wait, and a look at the newest pose that does not."""

from __future__ import annotations

import select
from typing import TYPE_CHECKING, Self

from tsgt.client.records import Event, Pose, Record
from tsgt.client.stream import LIVE, StreamBase

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.client.pump import WaitFor


class Stream(StreamBase):
    """The stream of poses, read by plain code; a context manager, for one thread.

    It reads only while one of its methods is called.

    Parameters
    ----------
    source
        The master's UNIX socket, ``relay://HOST[:PORT]``, or with TLS ``relays://HOST[:PORT]``.
    key
        Of a relay: file with the key, or the key.
    reconnect
        Whether to connect again, for ever, when the connection is lost or there is none yet. Otherwise iterators end with
        the stream, and a failure raises StreamError.
    resume
        Whether to ask a relay for the lines that were missed while there was no connection.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; iterators end."""
        self._pump.close()

    def __iter__(self) -> Iterator[Record]:
        """Iterate over all records, in the order in which the master made them.

        Raises StreamError for another protocol, or a wrong key at the first connection.
        """
        with self._queue() as queue:
            while True:
                while queue:
                    yield queue.take()
                if self._pump.ended:
                    return
                self._take(self._pump.step())
                if not queue:
                    self._wait(self._pump.wait_for())

    def poses(
        self, series: str = LIVE, *, max_age_s: float | None = None, include_invalid: bool = False
    ) -> Iterator[Pose]:
        """Iterate over valid poses that are not stale.

        ``series``: "live", "predicted", "interpolated", "smoothed" or with its delay "smoothed_1s". ``max_age_s``: age
        from which a pose is stale; None: by its kind, see :func:`default_max_age_s`.
        """
        for record in self:
            pose = self._hands_out(record, series, max_age_s, include_invalid=include_invalid)
            if pose is not None:
                yield pose

    def events(self) -> Iterator[Event]:
        """Iterate over events."""
        return (record for record in self if isinstance(record, Event))

    def latest(
        self, series: str = LIVE, *, max_age_s: float | None = None, include_invalid: bool = False
    ) -> Pose | None:
        """Read what has arrived, without waiting, and return the newest pose; None if it is stale, invalid or missing."""
        self._take(self._pump.step())
        while self._pump.more:
            self._take(self._pump.step())
        return self._newest_pose(series, max_age_s, include_invalid=include_invalid)

    def _wait(self, wait: WaitFor) -> None:
        poller = select.poll()
        if wait.descriptor is not None:
            poller.register(wait.descriptor, select.POLLOUT if wait.write else select.POLLIN)
        timeout_ms = None
        if wait.until_ns is not None:
            timeout_ms = max(0, wait.until_ns - self._now_ns()) / 1e6 + 1
        poller.poll(timeout_ms)
