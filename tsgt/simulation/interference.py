"""How much stronger than what disturbs it a LoRa signal must be (facts: co-channel rejection, SX1276 data sheet).

Within one spreading factor the stronger signal captures the receiver. Different spreading factors are nearly
orthogonal: Croce et al. 2018, "Impact of LoRa imperfect orthogonality", as used by FLoRa.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.radio.link_budget import REQUIRED_SNR_DB

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.simulation.frames import Modulation

CAPTURE_DB = 6.0
"""A signal survives others of its own kind when it is stronger than their sum by this much."""

SAME_CHANNEL_BANDWIDTHS = 0.25
"""Carriers that differ by at most so many bandwidths demodulate each other."""

# Wanted signal's spreading factor by row, interferer's by column, 7 to 12; the diagonal is the capture.
_REJECTION_DB = (
    (CAPTURE_DB, -8, -9, -9, -9, -9),
    (-11, CAPTURE_DB, -11, -12, -13, -13),
    (-15, -13, CAPTURE_DB, -13, -14, -15),
    (-19, -18, -17, CAPTURE_DB, -17, -18),
    (-22, -22, -21, -20, CAPTURE_DB, -20),
    (-25, -25, -25, -24, -23, CAPTURE_DB),
)

# Rounding must not decide about a signal that is stronger by exactly what is needed.
_ROUNDING = 1 + 1e-9


def needed_ratio_db(wanted: Modulation, interferer: Modulation) -> float | None:
    """Ratio of signal to interferer that the wanted signal needs; None: they do not meet in the spectrum.

    Chirps that are no copies of the wanted ones (other bandwidth, inverted, beside the channel) act as noise.
    """
    apart_hz = abs(wanted.frequency_hz - interferer.frequency_hz)
    if apart_hz >= (wanted.bandwidth_hz + interferer.bandwidth_hz) / 2:
        return None
    alike = wanted.bandwidth_hz == interferer.bandwidth_hz and wanted.inverted_iq == interferer.inverted_iq
    if not alike or apart_hz > SAME_CHANNEL_BANDWIDTHS * wanted.bandwidth_hz:
        return REQUIRED_SNR_DB[wanted.spreading_factor]
    if wanted.spreading_factor == interferer.spreading_factor:
        return CAPTURE_DB
    if min(wanted.spreading_factor, interferer.spreading_factor) < 7:
        return REQUIRED_SNR_DB[wanted.spreading_factor]  # the table has no SF6
    return _REJECTION_DB[wanted.spreading_factor - 7][interferer.spreading_factor - 7]


def survives(signal_mw: float, needed_mw: Sequence[tuple[float, int, int]], from_ns: int) -> bool:
    """Whether a signal stands above the sum of its interferers at every instant of a section.

    Parameters
    ----------
    signal_mw
        Power of the wanted signal.
    needed_mw
        For each interferer that overlaps the section: the power that it alone calls for (its own power times the
        ratio needed), when it starts and when it ends.
    from_ns
        Start of the section; the sum can only grow there and where an interferer starts.
    """
    instants = [from_ns, *(start_ns for _, start_ns, _ in needed_mw if start_ns > from_ns)]
    worst_mw = max(
        sum(mw for mw, start_ns, end_ns in needed_mw if start_ns <= instant_ns < end_ns)
        for instant_ns in instants
    )
    return worst_mw <= signal_mw * _ROUNDING
