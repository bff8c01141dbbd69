"""What a check found: one line."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Outcome(StrEnum):
    """How a check ended."""

    OK = "ok"
    NOTE = "note"
    """It works; a person should know this nevertheless."""
    FAILED = "failed"
    SKIPPED = "skipped"
    """It cannot be made here and now."""


class Finding(NamedTuple):
    """What one check found.

    Attributes
    ----------
    name
        Of the check, as programs read it.
    outcome
        How it ended.
    detail
        For people: what was found, and after a colon or semicolon what to do or to type.
    """

    name: str
    outcome: Outcome
    detail: str

    @property
    def ok(self) -> bool | None:
        """Whether all is well; None where that is not known."""
        return None if self.outcome is Outcome.SKIPPED else self.outcome is not Outcome.FAILED


def ok(name: str, detail: str) -> Finding:
    """Return that all is well."""
    return Finding(name, Outcome.OK, detail)


def note(name: str, detail: str) -> Finding:
    """Return that it works, and that there is something to know."""
    return Finding(name, Outcome.NOTE, detail)


def failed(name: str, detail: str) -> Finding:
    """Return that a person has to do something."""
    return Finding(name, Outcome.FAILED, detail)


def skipped(name: str, detail: str) -> Finding:
    """Return that it cannot be told here and now."""
    return Finding(name, Outcome.SKIPPED, detail)
