"""What a channel carries and what a region allows: link budget, capacity, regulations. Sans-I/O.

In: modem settings, number and rate of the stations, loss, region, antenna gain. Out: predicted update rate, age and duty
cycle of either protocol; preset power; violated limits and a use that complies.
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
    CHANNELS,
    DIPOLE_DBI,
    MIN_POWER_DBM,
    REGIONS,
    Channel,
    ChannelUse,
    chip_violation,
    compliant_use,
    duty_cycle_limit,
    power_limit_dbm,
    preset_power_dbm,
    violations,
)

__all__ = [
    "CHANNELS",
    "DIPOLE_DBI",
    "MIN_POWER_DBM",
    "NOISE_FIGURE_DB",
    "REGIONS",
    "REQUIRED_SNR_DB",
    "Channel",
    "ChannelUse",
    "CycleEstimate",
    "TrafficLoad",
    "chip_violation",
    "classic_cycle",
    "compliant_use",
    "duty_cycle_limit",
    "noise_dbm",
    "path_loss_db",
    "power_limit_dbm",
    "preset_power_dbm",
    "sensitivity_dbm",
    "superframe_cycle",
    "violations",
]
