"""A simulated mission: the real daemons on simulated computers, with everything around them simulated from one seed.

In: a scenario, options, a folder. Out: recordings, journals, and a :class:`MissionResult` with what the daemons did and
the ground truth. `Mission` also starts, stops, kills and reboots computers for scripts and fault injection.
"""

from tsgt.simulation.mission.computer import MASTER
from tsgt.simulation.mission.config_edits import MasterEdit
from tsgt.simulation.mission.daemon_configs import has_odometry, instrument_config, station_name
from tsgt.simulation.mission.master_log import MasterLog, ValidPoses
from tsgt.simulation.mission.mission import DRAIN_S, Mission
from tsgt.simulation.mission.result import MissionResult, Slew, StationMove
from tsgt.simulation.mission.setup_mistakes import SetupMistake
from tsgt.simulation.mission.station_log import JournalIndex, StationLog
from tsgt.simulation.mission.stream_listener import listen_to_stream

__all__ = [
    "DRAIN_S",
    "MASTER",
    "JournalIndex",
    "MasterEdit",
    "MasterLog",
    "Mission",
    "MissionResult",
    "SetupMistake",
    "Slew",
    "StationLog",
    "StationMove",
    "ValidPoses",
    "has_odometry",
    "instrument_config",
    "listen_to_stream",
    "station_name",
]
