"""TODO face."""

from tsgt.simulation.mission.computer import MASTER
from tsgt.simulation.mission.disk import FULL, READ_ONLY
from tsgt.simulation.mission.mission import DRAIN_S, Mission, instrument_config, scenario_link, station_name
from tsgt.simulation.mission.run_log import Measured, Run, Session, StationWitness, ValidPoses

__all__ = [
    "DRAIN_S",
    "FULL",
    "MASTER",
    "READ_ONLY",
    "Measured",
    "Mission",
    "Run",
    "Session",
    "StationWitness",
    "ValidPoses",
    "instrument_config",
    "scenario_link",
    "station_name",
]
