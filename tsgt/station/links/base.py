"""The interface between a station's client and its radio protocol."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn, Protocol

if TYPE_CHECKING:
    from tsgt.model import PolarMeasurement
    from tsgt.radio import DirectCommand, Radio, SearchCommand, TrackCommand
    from tsgt.recording.journal import TargetRecord
    from tsgt.station.status import LinkStatus


class Link(Protocol):
    """Replies to the master. It hands out one command at a time and is given its result."""

    def offer(self, measurement: PolarMeasurement) -> None:
        """Take a journalled measurement of a tracked prism for delivery."""

    def respond(self, command: TrackCommand | SearchCommand | DirectCommand, *, ok: bool) -> None:
        """Respond to a command that was executed or has failed."""

    def respond_single(self, target: TargetRecord | None) -> None:
        """Respond with a journalled single measurement; None: it has failed."""

    async def run(self, radio: Radio) -> NoReturn:
        """Reply to the master over this radio until the radio fails, which raises RadioError."""

    def status(self) -> LinkStatus:
        """Return the link's current status."""
