"""The verdict on the mission: one word with its cause in one line, the worst of everything that is known. Sans-I/O.

A fourth word, NO CONNECTION, is the browser's own: it comes when this program falls silent.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

SILENCE_LIMIT_S = 1.5
"""A master sends a status each second, whatever happens."""

DELAY_LIMIT_S = 1.5
"""Lines that arrive later than this after their making, beyond what is usual, are no live view."""

POSE_AGE_LIMIT_S = 1.0
"""Between two live poses are 0.05 s; with the estimator linear they wait for the slowest station."""

HOLD_S = 1.0
"""A verdict becomes worse at once and better only after this time, so that one can read it."""


class Level(IntEnum):
    """The words of the verdict, the best first."""

    GOOD = 0
    CARE = 1
    NO_POSE = 2
    STREAM_STOPPED = 3

    @property
    def words(self) -> str:
        """Return the level as the page shows it."""
        return self.name.replace("_", " ")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that the operator has to know."""

    level: Level
    cause: str
    """One line, plain words."""
    urgent: bool = False
    """Whether to act at once although there are poses: a fence is crossed, the disk is full."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamFacts:
    """What is known of the stream itself."""

    connected: bool
    problem: str = ""
    """Why it is not connected."""
    silence_s: float = 0.0
    """Time without any line."""
    delay_s: float = 0.0
    """Delay of the newest line beyond the least one; infinite while it is unknown: after a silence, until a status comes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseFacts:
    """The newest live pose: predicted, or interpolated with the estimator linear."""

    age_s: float
    """Time since it arrived."""
    valid: bool
    explanation: str = ""
    """Why it is invalid, for people."""
    degradations: tuple[str, ...] = ()
    """What degrades it, for people, the worst first."""


GOOD = Finding(Level.GOOD, "all stations track, the pose is valid")


def stream_findings(stream: StreamFacts) -> list[Finding]:
    """Return what is wrong with the stream; while something is, nothing else is known of the present."""
    if not stream.connected:
        return [Finding(Level.STREAM_STOPPED, stream.problem)]
    if stream.silence_s > SILENCE_LIMIT_S:
        return [Finding(Level.STREAM_STOPPED, f"the master has sent nothing for {stream.silence_s:.0f} s")]
    if stream.delay_s > DELAY_LIMIT_S:
        late = f"{stream.delay_s:.0f} s late" if math.isfinite(stream.delay_s) else "late"
        return [Finding(Level.STREAM_STOPPED, f"the stream arrives {late}")]
    return []


def pose_findings(pose: PoseFacts | None, waiting_for: str) -> list[Finding]:
    """Return what is wrong with the live pose; ``waiting_for``: what is missing for the first one."""
    if pose is None:
        return [Finding(Level.NO_POSE, f"no pose yet: {waiting_for}")]
    if pose.age_s > POSE_AGE_LIMIT_S:
        return [Finding(Level.NO_POSE, f"no pose for {pose.age_s:.0f} s: {waiting_for}")]
    if not pose.valid:
        return [Finding(Level.NO_POSE, pose.explanation)]
    return [Finding(Level.CARE, text) for text in pose.degradations]


def judge(
    stream: StreamFacts, pose: PoseFacts | None, waiting_for: str, others: Sequence[Finding]
) -> list[Finding]:
    """Return everything that the operator has to know, the verdict first.

    Parameters
    ----------
    others
        What is known of stations, recording, disk, fences and IMU, in order of importance.
    """
    findings = stream_findings(stream)
    if findings:
        return findings
    findings = [*pose_findings(pose, waiting_for), *_without_repetition(others)]
    findings.sort(key=lambda finding: (-finding.level, not finding.urgent))
    return findings or [GOOD]


def _without_repetition(items: Sequence[Finding]) -> list[Finding]:
    """Return the findings without those whose text another one has as well."""
    once = list({each.cause: each for each in reversed(items)}.values())[::-1]
    return [each for each in once if not any(repeats(o.cause, each.cause) for o in once if o is not each)]


def repeats(text: str, cause: str) -> bool:
    """Return whether a text has a cause as a whole part of it, as in ``no pose for 2 s: CAUSE`` or ``CAUSE: 3 MB left``.

    A cause that another one only begins with is another cause: geofences may have names that begin alike.
    """
    return re.search(rf"(?:^|[:;] ){re.escape(cause)}(?:$|[:;])", text) is not None


class Hold:
    """Keeps a verdict for :data:`HOLD_S` before a better one replaces it."""

    def __init__(self) -> None:
        self._shown = GOOD
        self._confirmed_s = float("-inf")

    def update(self, verdict: Finding, now_s: float) -> Finding:
        """Take the verdict of now and return the one to show."""
        if verdict.level < self._shown.level and now_s - self._confirmed_s < HOLD_S:
            return self._shown
        self._shown = verdict
        self._confirmed_s = now_s
        return verdict
