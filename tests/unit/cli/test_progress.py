"""Progress of long computations on a terminal."""

from __future__ import annotations

import io
import sys
from typing import TYPE_CHECKING

from tsgt.cli.progress import progress

if TYPE_CHECKING:
    import pytest


class Terminal(io.StringIO):
    """A stream that claims to be a terminal."""

    def isatty(self) -> bool:
        """Return True."""
        return True


def test_progress_names_the_first_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the first share is known, the label is that of the first phase."""
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


def test_no_progress_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A log file gets no bar."""
    printed = io.StringIO()
    monkeypatch.setattr(sys, "stderr", printed)
    with progress("fitting", first="tuning") as on_progress:
        assert on_progress is None
    assert printed.getvalue() == ""
