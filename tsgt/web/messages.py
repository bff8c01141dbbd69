"""The messages to the page: a view of the state with what is new in its histories. Sans-I/O."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tsgt.web.mission.state import Cursors, MissionState


def message(
    state: MissionState, view: dict[str, Any], cursors: Cursors | None, sent_s: float, **more: Any
) -> dict[str, Any]:
    """Return a message.

    Parameters
    ----------
    cursors
        What the reader has already; None: a new reader, which gets everything.
    sent_s
        Time on a clock that is never set: the page sees from it whether messages are late.
    """
    first = cursors is None
    now = state.cursors()
    since = now._replace(trail=0, residuals=0, events=0, setup=-1) if cursors is None else cursors
    content: dict[str, Any] = {
        "first": first,
        "sent_s": round(sent_s, 3),
        "view": view,
        "trail": state.trail.since(since.trail),
        "residuals": state.residuals.since(since.residuals),
        "events": state.events.since(since.events),
        **more,
    }
    if since.setup != now.setup:
        content["setup"] = state.setup_view()
    return content


def encode(content: dict[str, Any]) -> bytes:
    """Return a message as one line of JSON."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
