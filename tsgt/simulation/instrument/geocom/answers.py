"""What the procedures of a simulated total station have in common."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

Value = float | int | str | bytes
"""A real number, a whole one or a truth value, a string, a byte."""


class Offered(NamedTuple):
    """A distance that an answer has carried.

    Attributes
    ----------
    instrument_ms
        Its stamp: ms since the instrument was switched on.
    true_ns
        When it was taken, on the timeline.
    horizontal_angle_rad, zenith_angle_rad, distance_m
        As given.
    prism
        Of which prism; None of a target.
    code
        With which code.
    """

    instrument_ms: int
    true_ns: int
    horizontal_angle_rad: float
    zenith_angle_rad: float
    distance_m: float
    prism: int | None
    code: int


@dataclass(frozen=True, slots=True)
class Answer:
    """What a procedure answers.

    Attributes
    ----------
    code
        What came of it.
    values
        After the code.
    com_code
        Whether it was understood at all.
    offered
        The distance among the values.
    """

    code: int = 0
    values: tuple[Value, ...] = ()
    com_code: int = 0
    offered: Offered | None = None


OK = Answer()

Job = Generator[int, None, Answer]
"""Work that takes time: it gives the true time in ns at which it wants to go on, and ends with its answer."""

Run = Callable[..., Answer | Job]
"""Gets the total station and the parameters."""

Procedures = Mapping[int, tuple[str, Run]]
"""By number: a letter for each parameter (d real, i whole, s string, b byte), and what is done."""


def values(*given: Value) -> Answer:
    """Answer with values, all in order."""
    return Answer(values=given)
