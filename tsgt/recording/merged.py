"""Measurements that were merged into a recording from a station's journal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tsgt.model import PolarMeasurement  # noqa: TC001 (pydantic evaluates annotations at run time)


@dataclass(frozen=True, slots=True, kw_only=True)
class MergedRecord:
    """A measurement from a station's journal, added after the recording had ended.

    It was not on the stream, so a replay ignores it; post-processing uses it like any other.
    """

    type: Literal["merged"] = "merged"
    journal: str
    """Name of the file that it came from."""
    measurement: PolarMeasurement
    """As in the journal, with its number there, except for its times: ``stamp_ns`` is on the master's Unix clock, and
    ``received_ns`` is the same, as the master never received it."""
