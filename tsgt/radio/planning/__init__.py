"""What a channel carries and what a region allows: link budget, capacity, regulations. Sans-I/O.

In: modem settings, number and rate of the stations, loss, region, antenna gain. Out: predicted update rate, age and duty
cycle of either protocol; preset power; violated limits with what would comply.
"""

from tsgt.radio.planning.capacity import CycleEstimate, TrafficLoad, classic_cycle, superframe_cycle
from tsgt.radio.planning.link_budget import (
    NOISE_FIGURE_DB,
    REQUIRED_SNR_DB,
    noise_dbm,
    path_loss_db,
    sensitivity_dbm,
)
from tsgt.radio.planning.regulations import (
    DIPOLE_DBI,
    MIN_POWER_DBM,
    REGIONS,
    ChannelUse,
    preset_power_dbm,
    violations,
)

__all__ = [
    "DIPOLE_DBI",
    "MIN_POWER_DBM",
    "NOISE_FIGURE_DB",
    "REGIONS",
    "REQUIRED_SNR_DB",
    "ChannelUse",
    "CycleEstimate",
    "TrafficLoad",
    "classic_cycle",
    "noise_dbm",
    "path_loss_db",
    "preset_power_dbm",
    "sensitivity_dbm",
    "superframe_cycle",
    "violations",
]
