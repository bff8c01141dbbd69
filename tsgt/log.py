"""Logs on stderr: coloured lines for a person at a terminal, JSON lines for everything else.

A log entry is a stable event name with keys (units in the names), never a sentence with numbers in it; the
names are listed in docs/reference/log-events.md.
"""

from __future__ import annotations

import logging
import sys
from contextlib import suppress
from typing import Literal

import structlog

Level = Literal["debug", "info", "warning", "error", "critical"]


def configure_logging(level: Level = "info") -> None:
    """Set up structlog for the whole process.

    Parameters
    ----------
    level
        Entries below this are dropped.
    """
    shared: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    renderers: list[structlog.typing.Processor]
    if sys.stderr is not None and sys.stderr.isatty():
        renderers = [structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)]
    else:
        renderers = [structlog.processors.dict_tracebacks, structlog.processors.JSONRenderer()]
    structlog.configure(
        processors=[*shared, *renderers],
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()]),
        logger_factory=lambda *_: _StderrLogger(),
    )


class _StderrLogger:
    """Writes entries to stderr, and goes on without where that fails.

    A daemon must not end because its log is on a full disk, or behind a terminal or a pipe that is gone.
    """

    def msg(self, message: str) -> None:
        """Write one entry. Stderr is looked up each time: whoever redirects it later (a test) is followed."""
        if sys.stderr is not None:
            with suppress(OSError):
                sys.stderr.write(message + "\n")
                sys.stderr.flush()

    debug = info = warning = error = critical = exception = msg
