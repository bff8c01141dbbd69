"""What a station had measured and the radio had not carried, put into the recording from its journal afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tsgt.model import PolarMeasurement  # noqa: TC001 (pydantic looks it up when the program runs)


@dataclass(frozen=True, slots=True, kw_only=True)
class MergedRecord:
    """A measurement that came from a station's journal, after the recording had ended.

    It was not on the stream, so a replay passes over it; whoever processes the recording uses it like any other.

    Attributes
    ----------
    type
        Always ``merged``.
    journal
        Name of the file that it came from.
    measurement
        As the journal has it, with its number in the journal, but for its times: ``stamp_ns`` is on the master's Unix
        clock, and ``received_ns`` is the same, for the master never had it.
    """

    type: Literal["merged"] = "merged"
    journal: str
    measurement: PolarMeasurement
