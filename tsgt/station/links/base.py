"""The seam between a station's client and the protocol that it speaks over the radio."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn, Protocol

if TYPE_CHECKING:
    from tsgt.model import PolarMeasurement
    from tsgt.radio import DirectOrder, Radio, SearchOrder, TrackOrder
    from tsgt.recording.journal import TargetRecord
    from tsgt.station.status import LinkStatus


class Link(Protocol):
    """Answers the master. It hands out one order at a time, and is told what became of it."""

    def offer(self, measurement: PolarMeasurement) -> None:
        """Take a measurement of a tracked prism, which has been journalled."""
        ...

    def executed(self, order: TrackOrder | SearchOrder | DirectOrder, *, ok: bool) -> None:
        """Answer an order that has been carried out, or has failed."""
        ...

    def shot(self, target: TargetRecord | None) -> None:
        """Answer an order for a single measurement, which has been journalled; None: it has failed."""
        ...

    async def talk(self, radio: Radio) -> NoReturn:
        """Answer the master over this radio, until it fails.

        Raises
        ------
        RadioError
            It has failed.
        """
        ...

    def status(self) -> LinkStatus:
        """Say how it goes."""
        ...
