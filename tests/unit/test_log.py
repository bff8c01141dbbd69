from __future__ import annotations

import errno
import io
import json
import sys

import pytest
import structlog

from tsgt.log import configure_logging


class Terminal(io.StringIO):
    """A stderr that says it is a terminal."""

    def isatty(self) -> bool:
        """Say so."""
        return True


def test_entries_are_json_lines_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """With level and UTC time."""
    configure_logging()
    structlog.get_logger().warning("reader_lost_lines", count=3)
    captured = capsys.readouterr()
    entry = json.loads(captured.err)
    assert entry.pop("timestamp").endswith("Z")
    assert entry == {"event": "reader_lost_lines", "level": "warning", "count": 3}
    assert captured.out == ""


def test_bound_context_is_in_every_entry(capsys: pytest.CaptureFixture[str]) -> None:
    """Bound context is in every entry."""
    configure_logging()
    with structlog.contextvars.bound_contextvars(station_id=2):
        structlog.get_logger().info("something")
    assert json.loads(capsys.readouterr().err)["station_id"] == 2


def test_exception_stays_on_its_line(capsys: pytest.CaptureFixture[str]) -> None:
    """A traceback is part of the JSON object, not lines of its own."""
    configure_logging()
    try:
        raise ValueError("broken")
    except ValueError:
        structlog.get_logger().exception("failed")
    (line,) = capsys.readouterr().err.splitlines()
    assert json.loads(line)["exception"][0]["exc_value"] == "broken"


def test_entries_are_text_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A person at a terminal gets a readable line."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    configure_logging()
    structlog.get_logger().info("stream_opened", path="/run/x")
    assert "stream_opened" in terminal.getvalue()
    assert not terminal.getvalue().startswith("{")


def test_level_drops_what_is_below(capsys: pytest.CaptureFixture[str]) -> None:
    """Entries below the level do not appear."""
    configure_logging("warning")
    structlog.get_logger().info("unimportant")
    structlog.get_logger().error("important")
    (line,) = capsys.readouterr().err.splitlines()
    assert json.loads(line)["event"] == "important"


class Unwritable(io.StringIO):
    """A stderr on a full disk, or behind a pipe that is gone."""

    def write(self, _text: str) -> int:
        """Fail."""
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("stderr", [Unwritable(), None], ids=["full disk", "closed"])
def test_failed_log_write_is_ignored(stderr: io.StringIO | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Failed log write is ignored."""
    monkeypatch.setattr(sys, "stderr", stderr)
    configure_logging()
    structlog.get_logger().error("something_happened")
