"""What the commands of the desk share: what is shown while a computation runs."""

from __future__ import annotations

import io
import sys
from typing import TYPE_CHECKING

from tsgt.cli.recordings import progress

if TYPE_CHECKING:
    import pytest


class Terminal(io.StringIO):
    """A place where somebody looks."""

    def isatty(self) -> bool:
        """Say so."""
        return True


def test_what_has_no_share_yet_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bar that stands still says what it waits for, and then what it measures."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress("fitting", first="tuning") as on_progress:
        assert on_progress is not None
        before = terminal.getvalue()
        on_progress(0.5)
    assert "tuning" in before
    assert "fitting" not in before
    assert "fitting" in terminal.getvalue().removeprefix(before)
    assert "50%" in terminal.getvalue()


def test_nothing_is_shown_where_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A log file gets no bar."""
    printed = io.StringIO()
    monkeypatch.setattr(sys, "stderr", printed)
    with progress("fitting", first="tuning") as on_progress:
        assert on_progress is None
    assert printed.getvalue() == ""
