"""Logging to stderr: coloured lines on a terminal, JSON lines otherwise.

A log entry is a stable event name with keys (units in the names); docs/reference/log-events.md lists them.
"""

from __future__ import annotations

import logging
import sys
from contextlib import suppress
from typing import Literal

import structlog

Level = Literal["debug", "info", "warning", "error", "critical"]


def configure_logging(level: Level = "info") -> None:
    """Set up structlog for the whole process; entries below ``level`` are dropped."""
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
    """Writes entries to stderr and ignores failures.

    A daemon must not end because its log is on a full disk, or its terminal or pipe was closed.
    """

    def msg(self, message: str) -> None:
        """Write one entry to the present ``sys.stderr``, which may have been redirected."""
        if sys.stderr is not None:
            with suppress(OSError):
                sys.stderr.write(message + "\n")
                sys.stderr.flush()

    debug = info = warning = error = critical = exception = msg
