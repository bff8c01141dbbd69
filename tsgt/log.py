"""Logs on stderr: coloured lines for a person at a terminal, JSON lines for everything else.

A log entry is a stable event name with keys (units in the names), never a sentence with numbers in it; the
names are listed in docs/reference/log-events.md.
"""

from __future__ import annotations

import logging
import sys
from typing import Literal

import structlog

Level = Literal["debug", "info", "warning", "error"]


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
    if sys.stderr.isatty():
        renderers = [structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)]
    else:
        renderers = [structlog.processors.dict_tracebacks, structlog.processors.JSONRenderer()]
    structlog.configure(
        processors=[*shared, *renderers],
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()]),
        # Looked up at each entry: whoever redirects stderr later (a test, a daemon) is followed.
        logger_factory=lambda *_: structlog.WriteLogger(sys.stderr),
    )
