"""What both faces of the stream have: the newest records, queues for each iterator, and the rule for stale poses."""

from __future__ import annotations

from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tsgt.client.pump import Pump
from tsgt.client.records import Gap, Hello, Pose, Record, Setup, Status, monotonic_ns
from tsgt.client.source import DEFAULT_SOCKET, RelaySource, parse_source, read_key_file

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterator

    from tsgt.client.source import SocketSource

LIVE = "live"
"""Name of the poses that come first for each epoch: predicted, or with the estimator linear interpolated."""

MARGIN_S = 0.5
"""By how much a pose may be older than its kind is by nature, unless the caller says otherwise."""

INTERPOLATED_AGE_S = 3.0  # radio and the next measurement of each prism, with reserve
DEFAULT_LAG_S = 3.0  # of a stream without the record ``setup``
BATCH_S = 1.5  # final smoothed poses are sent some at a time

QUEUE_RECORDS = 2000
"""Of each iterator; when it is full, the oldest record is lost and a :class:`Gap` tells of it."""


def default_max_age_s(pose: Pose, lag_s: float | None = None) -> float:
    """Return the age in s from which a pose is stale, by its kind; ``lag_s``: of the set-up."""
    if pose.kind == "predicted":
        return MARGIN_S
    if pose.kind == "interpolated":
        return INTERPOLATED_AGE_S
    if pose.delay_s is not None:
        return pose.delay_s + MARGIN_S
    return (DEFAULT_LAG_S if lag_s is None else lag_s) + BATCH_S + MARGIN_S


class StreamBase:
    """The state of a stream as far as it has been read."""

    def __init__(
        self,
        source: str | os.PathLike[str] = DEFAULT_SOCKET,
        *,
        key: bytes | str | os.PathLike[str] | None = None,
        reconnect: bool = True,
        resume: bool = True,
        now_ns: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._source: SocketSource | RelaySource = parse_source(source)
        if key is not None and not isinstance(key, bytes):
            key = read_key_file(key)
        self._now_ns = now_ns
        self._pump = Pump(self._source, key, reconnect=reconnect, resume=resume, now_ns=now_ns)
        self._queues: list[_Queue] = []
        self._newest: dict[str, Pose] = {}
        self.hello: Hello | None = None
        """The greeting of the present session of the master; None before it."""
        self.setup: Setup | None = None
        """The set-up in force; None before it."""
        self.status: Status | None = None
        """The newest status; None before the first one."""
        self.stale_poses = 0
        """Poses that ``poses()`` did not hand out because they were too old."""
        self.gaps = 0
        """How often lines were missing."""

    @property
    def problem(self) -> str:
        """Why there is no connection, in one line; empty while there is one."""
        return self._pump.problem

    def _take(self, records: list[Record]) -> None:
        for record in records:
            if isinstance(record, Pose):
                self._newest[record.series] = record
            elif isinstance(record, Hello):
                self.hello = record
                self._newest.clear()
            elif isinstance(record, Setup):
                self.setup = record
            elif isinstance(record, Status):
                self.status = record
            elif isinstance(record, Gap):
                self.gaps += 1
            for queue in self._queues:
                queue.put(record)

    def _newest_pose(self, series: str, max_age_s: float | None, *, include_invalid: bool) -> Pose | None:
        names = ("predicted", "interpolated") if series == LIVE else (series,)
        for name in names:
            pose = self._newest.get(name)
            if pose is not None and self._passes(pose, max_age_s, include_invalid=include_invalid):
                return pose
        return None

    def _hands_out(
        self, record: Record, series: str, max_age_s: float | None, *, include_invalid: bool
    ) -> Pose | None:
        """Return the record if it is a pose of the series that is neither stale nor, unless wanted, invalid."""
        if not isinstance(record, Pose):
            return None
        if record.series != series and not (series == LIVE and record.kind in ("predicted", "interpolated")):
            return None
        if self._stale(record, max_age_s):
            self.stale_poses += 1
            return None
        return record if record.valid or include_invalid else None

    def _passes(self, pose: Pose, max_age_s: float | None, *, include_invalid: bool) -> bool:
        return not self._stale(pose, max_age_s) and (pose.valid or include_invalid)

    def _stale(self, pose: Pose, max_age_s: float | None) -> bool:
        lag_s = None if self.setup is None else self.setup.lag_s
        limit_s = default_max_age_s(pose, lag_s) if max_age_s is None else max_age_s
        return pose.age_s(self._now_ns()) > limit_s

    @contextmanager
    def _queue(self) -> Iterator[_Queue]:
        queue = _Queue()
        self._queues.append(queue)
        try:
            yield queue
        finally:
            self._queues.remove(queue)


class _Queue:
    """Records that an iterator has not taken yet."""

    def __init__(self) -> None:
        self._records: deque[Record] = deque()
        self._lost = 0

    def __bool__(self) -> bool:
        return bool(self._records)

    def put(self, record: Record) -> None:
        if len(self._records) >= QUEUE_RECORDS:
            self._records.popleft()
            self._lost += 1
        self._records.append(record)

    def take(self) -> Record:
        if self._lost:
            gap = Gap(lines=self._lost, reason="this program took its records too slowly")
            self._lost = 0
            return gap
        return self._records.popleft()
