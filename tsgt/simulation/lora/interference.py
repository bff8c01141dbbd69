"""Interference between LoRa signals: how much stronger than its interferers a signal must be.

Within one spreading factor the stronger signal captures the receiver (co-channel rejection, SX1276 data sheet).
Different spreading factors are nearly orthogonal: Croce et al. 2018, "Impact of LoRa imperfect orthogonality", as
used by FLoRa.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.radio.planning import REQUIRED_SNR_DB

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.simulation.lora.frames import Modulation

CAPTURE_THRESHOLD_DB = 6.0
"""A signal captures the receiver when it is stronger than the sum of its like interferers by this much."""

CO_CHANNEL_BANDWIDTHS = 0.25
"""Signals whose carriers differ by at most this fraction of the bandwidth are on the same channel."""

# Wanted signal's spreading factor by row, interferer's by column, 7 to 12; the diagonal is the capture.
_REJECTION_DB = (
    (CAPTURE_THRESHOLD_DB, -8, -9, -9, -9, -9),
    (-11, CAPTURE_THRESHOLD_DB, -11, -12, -13, -13),
    (-15, -13, CAPTURE_THRESHOLD_DB, -13, -14, -15),
    (-19, -18, -17, CAPTURE_THRESHOLD_DB, -17, -18),
    (-22, -22, -21, -20, CAPTURE_THRESHOLD_DB, -20),
    (-25, -25, -25, -24, -23, CAPTURE_THRESHOLD_DB),
)

# Rounding must not decide about a signal that is stronger by exactly what is needed.
_ROUNDING = 1 + 1e-9


def required_sir_db(wanted: Modulation, interferer: Modulation) -> float | None:
    """Return the signal-to-interference ratio that the wanted signal needs; None: the spectra do not overlap.

    An interferer with another bandwidth, inverted IQ or an offset carrier acts as noise.
    """
    separation_hz = abs(wanted.frequency_hz - interferer.frequency_hz)
    if separation_hz >= (wanted.bandwidth_hz + interferer.bandwidth_hz) / 2:
        return None
    same_chirps = (
        wanted.bandwidth_hz == interferer.bandwidth_hz and wanted.inverted_iq == interferer.inverted_iq
    )
    if not same_chirps or separation_hz > CO_CHANNEL_BANDWIDTHS * wanted.bandwidth_hz:
        return REQUIRED_SNR_DB[wanted.spreading_factor]
    if wanted.spreading_factor == interferer.spreading_factor:
        return CAPTURE_THRESHOLD_DB
    if min(wanted.spreading_factor, interferer.spreading_factor) < 7:
        return REQUIRED_SNR_DB[wanted.spreading_factor]  # the table has no SF6
    return _REJECTION_DB[wanted.spreading_factor - 7][interferer.spreading_factor - 7]


def is_above_interference(
    signal_mw: float, needed_mw: Sequence[tuple[float, int, int]], from_ns: int
) -> bool:
    """Whether a signal is above the sum of its interferers throughout a section that starts at ``from_ns``.

    ``needed_mw`` has, for each interferer that overlaps the section, its power times the required ratio, its start and its
    end. The sum can only increase at the start of the section or of an interferer.
    """
    instants = [from_ns, *(start_ns for _, start_ns, _ in needed_mw if start_ns > from_ns)]
    worst_mw = max(
        sum(mw for mw, start_ns, end_ns in needed_mw if start_ns <= instant_ns < end_ns)
        for instant_ns in instants
    )
    return worst_mw <= signal_mw * _ROUNDING
