"""Selects lines of the stream by kind, time and rate. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass

from tsgt.recording import decode

KINDS = ("pose", "smoothed", "measurement", "status", "event", "clock", "setup", "hello")
"""What can be selected: types of lines, with poses in two, and the rarer types with the one that they belong to."""

_KIND_OF = {"point": "measurement", "beacon": "clock"}

_NOT_OF_A_TIME = ("hello", "setup")
"""What is in force, however old its stamp."""


@dataclass(frozen=True, slots=True)
class _Line:
    """What the selection depends on."""

    type: str
    stamp_ns: int = 0
    kind: str = ""
    delay_s: float | None = None


class StreamFilter:
    """Selects lines.

    Parameters
    ----------
    kinds
        Some of :data:`KINDS`; empty: all lines, also of unknown types.
    rate_hz
        Poses per second of each series, by their stamps; None: all.
    since_ns
        Lines with an earlier stamp are rejected.
    """

    def __init__(
        self, kinds: frozenset[str] = frozenset(), rate_hz: float | None = None, since_ns: int = 0
    ) -> None:
        self._kinds = kinds
        self._rate_hz = rate_hz
        self._since_ns = since_ns
        self._last: dict[tuple[str, float | None], int] = {}

    @property
    def accepts_all(self) -> bool:
        """Whether every line is selected, also one that cannot be read."""
        return not self._kinds and self._rate_hz is None and not self._since_ns

    def accepts(self, data: bytes) -> bool:
        """Whether a line is selected; raises ValueError if it cannot be read."""
        line = decode(_Line, data)
        kind = _KIND_OF.get(line.type, line.type)
        if line.type == "pose" and line.kind == "smoothed":
            kind = "smoothed"
        if self._kinds and kind not in self._kinds:
            return False
        if line.stamp_ns < self._since_ns and line.type not in _NOT_OF_A_TIME:
            return False
        return line.type != "pose" or self._rate_hz is None or self._is_next(line, self._rate_hz)

    def _is_next(self, line: _Line, rate_hz: float) -> bool:
        """Whether a pose is the first of its series in its interval of time."""
        series = (line.kind, line.delay_s)
        interval = line.stamp_ns // round(1e9 / rate_hz)
        if self._last.get(series) == interval:
            return False
        self._last[series] = interval
        return True
