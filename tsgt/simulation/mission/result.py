"""The result of a simulated mission: the logs of its daemons, with the ground truth."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from tsgt.estimation import transform_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tsgt.model import Matrix4, Parameters
    from tsgt.simulation.faults.catalogue import FaultKind
    from tsgt.simulation.imu import SimulatedImuRun
    from tsgt.simulation.mission.master_log import MasterLog
    from tsgt.simulation.mission.station_log import StationLog
    from tsgt.simulation.options import Outage
    from tsgt.simulation.wheel_odometry import OdometrySamples
    from tsgt.simulation.world import Rollover, World

START_UNIX_NS = 1_800_000_000_000_000_000
"""Unix time at the start of each simulated mission, on the master's clock: 15 January 2027."""


class StationMove(NamedTuple):
    """From an instant on, in s from the start, a station has another true frame."""

    station: int
    from_s: float
    T_station1_station: Matrix4


class Slew(NamedTuple):
    """NTP has changed the frequency of a station's clock for some time; times in s from the start."""

    station: int
    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True)
class MissionResult:
    """A completed mission."""

    parameters: Parameters  # setup as known to the first master: the exact truth at the start
    world: World  # ground truth; times count from the start of the mission
    duration_s: float  # duration of the measurements, drain excluded
    master_logs: list[MasterLog]  # one per start of the master
    station_logs: dict[int, StationLog]
    airtime_s: float  # total airtime of all radios
    superframe: bool
    outages: tuple[Outage, ...] = ()
    faults: Counter[FaultKind] = field(default_factory=Counter)  # number of faults by kind
    slews: tuple[Slew, ...] = ()  # of the stations' clocks by NTP
    moves: tuple[StationMove, ...] = ()  # of the stations, in their order
    rollovers: tuple[Rollover, ...] = ()  # of the robot
    knocks_s: tuple[float, ...] = ()  # when the IMU was knocked, in s from the start
    faults_end_s: float | None = None  # end of the faults in s from the start; None: no faults
    rate_hz: dict[int, float] = field(default_factory=dict)  # measurement rate by station number
    oversized_collections: tuple[str, ...] = ()  # collections of the daemons that exceeded their bounds
    imu: SimulatedImuRun | None = None  # samples and truth of the robot's IMU
    odometry: OdometrySamples | None = None  # samples of its wheel odometry
    start_ns: ClassVar[int] = START_UNIX_NS  # unix time of the start on the master's clock, in ns

    @property
    def end_ns(self) -> int:
        """Unix time of the end on the master's clock, in ns; the drain follows."""
        return self.start_ns + round(self.duration_s * 1e9)

    def in_force(self, master_log: MasterLog) -> MissionResult:
        """Return the mission with the parameters with which a master was started."""
        return replace(self, parameters=master_log.parameters or self.parameters)

    def true_poses(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the true poses of the reference point, (N, 4, 4), at N instants in s from the start."""
        return self.world.pose_at(times_s) @ transform_of(self.parameters.reference_point)
