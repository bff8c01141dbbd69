"""Defects planted by somebody who had read the user documentation only: thirty, each of which a user would act on.

python benchmarks/run.py planted_defects --from benchmarks/missions/independent_defects.py
"""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING

from harness.missions import defects_independent as d

from missions.planted_defects import Defect, silent_station
from tsgt.simulation.faults import FaultKind as F
from tsgt.simulation.mission import MASTER, station_name

if TYPE_CHECKING:
    from tsgt.simulation.mission import Mission


async def full_disk(mission: Mission) -> None:
    """Let the master's disk take nothing for ten seconds."""
    await mission.sleep_until(20.0)
    mission.computers[MASTER].disk.fail_writes(errno.ENOSPC, 20 * 10**9, 30 * 10**9)
    await mission.sleep_until(30.0)
    mission.computers[MASTER].disk.write_error = None
    await mission.sleep_until(45.0)


async def killed_client(mission: Mission) -> None:
    """Kill the client of station 2 twice, the second time without radio contact."""
    await mission.sleep_until(20.0)
    await mission.crash(station_name(2), down_s=2.0)
    mission.air.link.set_attenuation(MASTER, station_name(2), 300.0)
    await mission.sleep_until(32.0)
    await mission.crash(station_name(2), down_s=2.0)
    mission.air.link.set_attenuation(MASTER, station_name(2), 0.0)


# What a user would see comes after the colon.
DEFECTS = {
    # Client
    "numbers-again": Defect(
        "a restarted client numbers from 0 again: two measurements with one number, one of them lost",
        d.number_from_zero_again,
        script=killed_client,
    ),
    "acknowledged-ahead": Defect(
        "a journal's acknowledgement is 40 ahead: a restarted client never delivers those",
        d.journal_too_many_acknowledged,
        script=killed_client,
    ),
    "queued": Defect(
        "`tsgt status` of a station always shows 0 queued: it is switched off with its backlog",
        d.change_client_status(queued=0),
        script=silent_station,
    ),
    "journal-ok": Defect(
        "`tsgt status` of a station shows a good journal on a full disk: nothing is journalled, nobody knows",
        d.change_client_status(journal_ok=True, journal_waiting=0),
        test="unit/station/test_daemon.py::test_full_disk_stops_neither_instrument_nor_radio",
    ),
    # Radio
    "times": Defect(
        "classic sends times in whole 10 ms: poses of a moving robot are up to 15 mm off",
        d.truncate_times,
        protocol="classic",
        duration_s=30,
    ),
    "direction": Defect(
        "directions to search in are in the frame of station 1: other stations search where no robot is",
        d.direct_in_wrong_frame,
        test="unit/master/test_reacquisition_hints.py::test_prism_is_within_the_spread_in_the_reference_scenario",
    ),
    "battery": Defect(
        "a battery is shown with 30 points more than it has: the instrument dies unannounced",
        d.report_full_batteries,
        duration_s=30,
    ),
    # Status and events of the master
    "outstanding": Defect(
        "the master's status shows nothing outstanding: the operator packs up before the backlog has arrived",
        d.change_station_status(d.hide_outstanding),
        script=silent_station,
    ),
    "offset-neighbour": Defect(
        "the status shows each station the clock offset of the next one",
        d.show_neighbours_offset,
        protocol="classic",
        duration_s=30,
    ),
    "drain": Defect(
        "the drain rate has the wrong sign: a growing backlog seems to end in a minute",
        d.change_station_status(d.reverse_drain),
        script=silent_station,
        duration_s=75,
    ),
    "bound": Defect(
        "the bound of the newest stamp is a thousandth of what it is",
        d.change_station_status(d.bound_in_microseconds),
        duration_s=30,
    ),
    "lost-name": Defect(
        "the event of a lost station names the next one: the operator walks to the wrong tripod",
        d.name_next_station,
        script=silent_station,
    ),
    "recovered": Defect(
        "a lost station that responds again is no event: the alarm never ends",
        d.omit_recovered_station,
        script=silent_station,
    ),
    "disk-recovered": Defect(
        "a full disk that has space again is no event: the alarm never ends",
        d.omit_recovered_disk,
        script=full_disk,
    ),
    # Estimation
    "w-first": Defect("quaternions are w, x, y, z", d.change_batch(d.put_w_first), duration_s=30),
    "blocks": Defect(
        "the covariance has rotation before position", d.change_batch(d.swap_covariance_blocks), duration_s=30
    ),
    "axes": Defect(
        "the covariance is about the robot's axes: a filter weighs roll and pitch in each other's place",
        d.change_batch(d.covariance_about_robot_axes),
        duration_s=30,
    ),
    "angular-velocity": Defect(
        "the angular velocity is in the frame of the poses: roll rate and pitch rate are mixed",
        d.change_batch(d.angular_velocity_in_world),
    ),
    "constant-twice": Defect("the prism constant is added twice: 10 mm", d.add_constant_twice, duration_s=30),
    "outage": Defect(
        "poses are valid over outages of up to 20 s: decimetres off, and a robot drives by them",
        d.interpolate_over_outages,
        (F.PRISM_LOSS,),
        duration_s=100,
    ),
    "delayed": Defect(
        "smoothed poses at a delay are stamped one epoch late: 7 cm in a map",
        d.change_batch(d.stamp_delayed_late),
        estimator="continuous",
    ),
    "degraded": Defect(
        "no pose is degraded: the controller does not slow down",
        d.change_batch(d.forget_degradation),
        (F.PRISM_LOSS,),
        estimator="continuous",
        duration_s=100,
    ),
    "shares": Defect(
        "poses name the wrong station of each prism", d.change_batch(d.name_other_stations), duration_s=30
    ),
    # IMU
    "jump": Defect(
        "`jump_m` and `jump_rad` are always 0: a controller takes each correction for motion",
        d.change_batch(d.no_jumps),
        estimator="continuous",
        imu="industrial",
    ),
    "imu-used": Defect(
        "poses always say that they rest on the IMU, also when it is silent or not confirmed",
        d.change_batch(d.imu_always_used),
        estimator="continuous",
        imu="industrial",
    ),
    "bias": Defect(
        "the status shows the gyro's bias in degrees per second: the IMU seems to be broken",
        d.report_bias_in_degrees,
        estimator="continuous",
        imu="industrial",
    ),
    # Recording and stream
    "status-lines": Defect(
        "the recording has no statuses: nobody finds out later what went wrong",
        d.record_no_status,
        duration_s=30,
    ),
    "beacons": Defect(
        "beacons are recorded with the number of the next: a journal is merged a frame late",
        d.record_next_beacon,
        duration_s=30,
    ),
    "frames": Defect(
        "`setup` has the stations' rotations inverted: sight lines and maps are wrong",
        d.invert_frames_in_setup,
        duration_s=30,
    ),
    "late-setup": Defect(
        "a reader that connects later gets no `setup`: it knows neither frames nor limits",
        d.send_no_setup_to_late_readers,
        (F.VANISHING_READER,),
        duration_s=100,
    ),
}
