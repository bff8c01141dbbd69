"""What people can ask of a running client over its status socket, and what it answers: one JSON line each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tsgt.config.client import PressureHpa, TemperatureC  # noqa: TC001 (pydantic looks them up when the program runs)
from tsgt.recording.journal import InstrumentRecord  # noqa: TC001 (likewise)


@dataclass(frozen=True, slots=True, kw_only=True)
class AtmosphereRequest:
    """The instrument is to correct distances for this air from now on.

    Attributes
    ----------
    type
        Always ``atmosphere``.
    temperature_c, pressure_hpa
        As in :class:`~tsgt.station.instrument.Atmosphere`.
    """

    type: Literal["atmosphere"] = "atmosphere"
    temperature_c: TemperatureC
    pressure_hpa: PressureHpa


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What became of a request.

    Attributes
    ----------
    type
        Always ``answer``.
    problem
        Why it was not done, or not yet; empty when it was.
    settings
        What is known of the instrument and of its settings now, as read back from it; null where nothing is.
    """

    type: Literal["answer"] = "answer"
    problem: str = ""
    settings: InstrumentRecord | None = None
