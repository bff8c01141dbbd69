"""TODO face."""

from tsgt.radio.planning.capacity import Cycle, Load, classic_cycle, superframe_cycle
from tsgt.radio.planning.link_budget import (
    NOISE_FIGURE_DB,
    REQUIRED_SNR_DB,
    noise_dbm,
    path_loss_db,
    sensitivity_dbm,
)
from tsgt.radio.planning.regulations import DIPOLE_DBI, LOWEST_DBM, REGIONS, Use, exceeded, preset_power_dbm

__all__ = [
    "DIPOLE_DBI",
    "LOWEST_DBM",
    "NOISE_FIGURE_DB",
    "REGIONS",
    "REQUIRED_SNR_DB",
    "Cycle",
    "Load",
    "Use",
    "classic_cycle",
    "exceeded",
    "noise_dbm",
    "path_loss_db",
    "preset_power_dbm",
    "sensitivity_dbm",
    "superframe_cycle",
]
