"""The result of a check."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Outcome(StrEnum):
    """Outcome of a check."""

    OK = "ok"
    NOTE = "note"  # Passed, with something that the operator should know
    FAILED = "failed"
    SKIPPED = "skipped"  # Not possible here and now


class Finding(NamedTuple):
    """Result of one check; ``detail`` is a line for the operator, with what to do after a colon or semicolon."""

    name: str
    outcome: Outcome
    detail: str

    @property
    def ok(self) -> bool | None:
        """Whether the check passed; None if it was skipped."""
        return None if self.outcome is Outcome.SKIPPED else self.outcome is not Outcome.FAILED


def ok(name: str, detail: str) -> Finding:
    """Return a passed check."""
    return Finding(name, Outcome.OK, detail)


def note(name: str, detail: str) -> Finding:
    """Return a passed check with a note."""
    return Finding(name, Outcome.NOTE, detail)


def failed(name: str, detail: str) -> Finding:
    """Return a failed check."""
    return Finding(name, Outcome.FAILED, detail)


def skipped(name: str, detail: str) -> Finding:
    """Return a skipped check."""
    return Finding(name, Outcome.SKIPPED, detail)
