"""When the samples of an IMU arrive at the program that reads it: polls of the USB host, its scheduler, and its stalls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

POLL_S: Final = 0.000125
"""Microframe in which a high-speed USB device is asked. A full-speed one is asked each millisecond, and the earliest arrival
then wanders by that, as the two clocks beat."""

WAKE_UP_S: Final = 0.00015
"""Mean time until the reading program runs; exponential. An assumption."""

STALLS_HZ: Final = 2 / 60
"""Mean rate at which the reading program is kept from running. An assumption."""

STALL_S: Final = (0.005, 0.040)
"""Duration of a stall, uniform; what has arrived meanwhile is read in one burst."""


def draw_arrivals(earliest_s: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """Return the arrival of each sample, (N,), not before its earliest instant, in order; all in s."""
    phase_s = generator.uniform(0.0, POLL_S)
    polled_s = phase_s + np.ceil((earliest_s - phase_s) / POLL_S) * POLL_S
    arrival_s = polled_s + generator.exponential(WAKE_UP_S, len(earliest_s))
    if len(earliest_s):
        first_s, last_s = earliest_s[0], earliest_s[-1]
        count = generator.poisson(STALLS_HZ * (last_s - first_s))
        start_s = generator.uniform(first_s, last_s, count)
        for from_s, length_s in zip(start_s, generator.uniform(*STALL_S, count), strict=True):
            arrival_s = hold_back(arrival_s, from_s, from_s + length_s)
    return np.maximum.accumulate(arrival_s)


def hold_back(arrival_s: NDArray[np.float64], from_s: float, until_s: float) -> NDArray[np.float64]:
    """Delay what arrives in an interval to its end."""
    return np.where((arrival_s >= from_s) & (arrival_s < until_s), until_s, arrival_s)
