"""Link budget: path loss, noise, and the sensitivity of a receiver (SX1276 data sheet, Rev 4)."""

from __future__ import annotations

import math

REQUIRED_SNR_DB = {6: -5.0, 7: -7.5, 8: -10.0, 9: -12.5, 10: -15.0, 11: -17.5, 12: -20.0}
"""SNR that the demodulator needs, by spreading factor."""

NOISE_FIGURE_DB = 6.5  # of the chip's receiver; reproduces the data sheet's sensitivity to 1 dB

_THERMAL_NOISE_DBM_PER_HZ = -174.0
_LIGHT_MPS = 299_792_458


def noise_dbm(bandwidth_hz: float, noise_figure_db: float) -> float:
    """Return the noise power of a receiver in its bandwidth."""
    return _THERMAL_NOISE_DBM_PER_HZ + 10 * math.log10(bandwidth_hz) + noise_figure_db


def sensitivity_dbm(spreading_factor: int, bandwidth_hz: int) -> float:
    """Return the power above which a receiver decodes nearly all packets."""
    return noise_dbm(bandwidth_hz, NOISE_FIGURE_DB) + REQUIRED_SNR_DB[spreading_factor]


def path_loss_db(distance_m: float, frequency_hz: float, exponent: float) -> float:
    """Return the loss between two antennas without gain (log-distance model: Friis to one metre, then the exponent).

    ``distance_m``: less than one metre counts as one metre. ``exponent``: 2 in free space, 2.7 to 3.5 over ground and
    through trees.
    """
    # A chip whose carrier was never set sends at 0 Hz.
    first_metre_db = 20 * math.log10(4 * math.pi * max(frequency_hz, 1.0) / _LIGHT_MPS)
    return first_metre_db + 10 * exponent * math.log10(max(1.0, distance_m))
