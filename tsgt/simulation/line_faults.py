"""What can go wrong with an answer on its way through a cable."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum

GARBAGE = b"\x00\xff\x1a%R1\x81,7"
"""Bytes that are no answer, though they begin like one."""


class LineFault(StrEnum):
    """A fault of one answer."""

    NONE = "none"
    """It comes as it is."""
    CUT = "cut"
    """Its second half does not come."""
    GARBAGE = "garbage"
    """Bytes that nobody sent come right before it."""
    SPOILT = "spoilt"
    """Bytes in its middle are others."""
    LATE = "late"
    """It comes long after."""
    DUPLICATED = "duplicated"
    """It comes twice."""
    TORN = "torn"
    """Its second half comes a while after the first."""
    DIGIT = "digit"
    """One of its digits is another one; without a checksum nobody can see that."""
    SILENCE = "silence"
    """It does not come."""


@dataclass(slots=True)
class LineFaults:
    """The faults of a line, all of which can be changed at any time.

    Attributes
    ----------
    script
        The next answers' faults, in order; answers after that have none.
    late_s
        How much later a late answer comes.
    torn_s
        How long the second half of a torn one takes.
    deaf
        Whether nothing reaches the instrument.
    mute
        Whether nothing comes back from it.
    """

    script: deque[LineFault] = field(default_factory=deque)
    late_s: float = 4.0
    torn_s: float = 0.3
    deaf: bool = False
    mute: bool = False

    def apply(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return what comes of an answer: parts, each with the ns after which it is sent."""
        if self.mute:
            return []
        fault = self.script.popleft() if self.script else LineFault.NONE
        half = len(data) // 2
        match fault:
            case LineFault.CUT:
                return [(0, data[:half])]
            case LineFault.GARBAGE:
                return [(0, GARBAGE + data)]
            case LineFault.SPOILT:
                return [(0, data[:half] + b"\x80\xfe" + data[half + 2 :])]
            case LineFault.LATE:
                return [(round(self.late_s * 1e9), data)]
            case LineFault.DUPLICATED:
                return [(0, data), (0, data)]
            case LineFault.TORN:
                return [(0, data[:half]), (round(self.torn_s * 1e9), data[half:])]
            case LineFault.DIGIT:
                return [(0, _other_digit(data))]
            case LineFault.SILENCE:
                return []
            case LineFault.NONE:
                return [(0, data)]


def _other_digit(data: bytes) -> bytes:
    """Return an answer with another digit somewhere; where, hangs on the answer."""
    digits = [i for i in range(len(data)) if data[i : i + 1].isdigit()]
    if not digits:
        return data
    at = digits[sum(data) % len(digits)]
    return data[:at] + (b"1" if data[at : at + 1] != b"1" else b"7") + data[at + 1 :]
