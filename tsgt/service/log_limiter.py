"""A limit on warnings that could otherwise be logged with every packet or line."""

from __future__ import annotations

LOG_INTERVAL_NS = 60_000_000_000


class LogLimiter:
    """Allows each event to be logged once a minute."""

    def __init__(self) -> None:
        self._logged_ns: dict[str, int] = {}

    def allows(self, event: str, now_ns: int) -> bool:
        """Whether to log an event now; the caller then logs it."""
        if now_ns - self._logged_ns.get(event, -LOG_INTERVAL_NS) < LOG_INTERVAL_NS:
            return False
        self._logged_ns[event] = now_ns
        return True
