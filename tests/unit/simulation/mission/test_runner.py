"""Whole missions on virtual time, crashes and restarts included."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.missions.missions import QUICK, SUPERFRAME, linear_drive, run_mission

from tsgt.cli.simulate.figures import figures, frame_ms, outage_figures, station_figures
from tsgt.cli.simulate.poses import estimator_figures
from tsgt.config import ClassicMasterConfig
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.mission.authors_node import AuthorsTiming
from tsgt.simulation.options import Outage, Restart
from tsgt.simulation.scenario_files import find_scenario, with_stations

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.config import ScenarioConfig
    from tsgt.simulation.mission import Mission
    from tsgt.simulation.options import StationSoftware


@pytest.mark.slow
def test_classic_mission(tmp_path: Path) -> None:
    """Three stations deliver above 1.3 Hz each, timestamps are good to 0.3 ms, poses to centimetres."""
    run = run_mission(tmp_path, duration_s=60.0)
    assert check_invariants(run) == []
    for figure in station_figures(run).values():
        assert figure.measured == pytest.approx(141, abs=2)  # 2.5 Hz, but for the time that connecting takes
        assert figure.rate_hz > 1.3
        assert figure.duplicates == 0
        assert figure.time_error_us[2] < 300
    poses = estimator_figures(run)["linear"]
    assert poses.valid_poses > 600
    assert poses.against_truth.centroid.position_rms_mm < 40
    assert poses.against_truth.orientation_rms_deg < 2


@pytest.mark.parametrize(
    ("station_software", "min_hz", "max_hz"), [("ours", 1.5, 1.72), ("authors", 1.3, 1.6)]
)
@pytest.mark.slow
def test_rates_with_the_papers_settings(
    tmp_path: Path, station_software: StationSoftware, min_hz: float, max_hz: float
) -> None:
    """Airtime limits three stations to 1.72 Hz each; the paper measured about 1.4 Hz."""
    scenario = linear_drive()
    run = run_mission(
        tmp_path,
        scenario,
        duration_s=120.0,
        station_software=station_software,
        protocol=ClassicMasterConfig(kind="classic"),
    )
    for figure in station_figures(run).values():
        assert min_hz <= figure.rate_hz <= max_hz


@pytest.mark.slow
def test_same_seed_gives_the_same_stream(tmp_path: Path) -> None:
    """Another seed gives another stream."""
    one, same, other = (
        run_mission(tmp_path / name, duration_s=10.0, seed=seed)
        for name, seed in (("one", 3), ("same", 3), ("other", 4))
    )
    assert json.dumps(figures(one)) == json.dumps(figures(same))
    assert one.master_logs[0].line_hashes == same.master_logs[0].line_hashes
    assert one.master_logs[0].line_hashes != other.master_logs[0].line_hashes


@pytest.mark.slow
def test_clock_offsets_and_drifts_are_estimated(tmp_path: Path) -> None:
    """Stations drift by plus and minus the given ppm, and are years behind."""
    run = run_mission(tmp_path, duration_s=40.0, drift_ppm=50.0)
    assert check_invariants(run) == []
    last = {clock.station: clock for clock in run.master_logs[0].clocks}
    drifts = [last[station].frequency_ppm for station in (1, 2, 3)]
    assert drifts == pytest.approx([50.0, -50.0, 50.0], abs=10.0)
    assert all(clock.offset_ns < -(10**15) for clock in last.values())


@pytest.mark.slow
def test_authors_node(tmp_path: Path) -> None:
    """Stations with the authors' software are slower, with timestamp errors of a millisecond or two.

    The master subtracts their mean ping delay: half a polling interval and seven transfers.
    """
    run = run_mission(tmp_path, linear_drive(), duration_s=40.0, station_software="authors")
    assert check_invariants(run) == []
    samples = [sample for clock in run.master_logs[0].clocks for sample in clock.samples]
    timing = AuthorsTiming()
    (delay_ns,) = {sample.forward_ns - sample.back_ns for sample in samples}
    assert delay_ns == pytest.approx(timing.poll_interval_ns / 2 + 7 * timing.transfer_ns, abs=50_000)
    for figure in station_figures(run).values():
        assert 1.2 < figure.rate_hz < 1.65
        assert figure.time_error_us[2] < 3000
    assert estimator_figures(run)["linear"].valid_poses > 300


@pytest.mark.slow
def test_packet_loss_only_costs_measurements(tmp_path: Path) -> None:
    """With a tenth of all packets lost, fewer measurements arrive, all of them correct."""
    scenario = find_scenario("dynamic")
    lossy = scenario.model_copy(update={"radio": scenario.radio.model_copy(update={"loss_probability": 0.1})})
    run = run_mission(tmp_path, lossy, duration_s=40.0)
    assert check_invariants(run) == []
    for figure in station_figures(run).values():
        assert 15 < figure.delivered < 50


@pytest.mark.slow
def test_occluded_prisms_give_no_poses(tmp_path: Path) -> None:
    """An occlusion is delivered as a status.

    Until an instrument has detected the loss, it reports angles only.
    """
    run = run_mission(tmp_path, find_scenario("snowmobile"), duration_s=60.0, seed=1)
    assert check_invariants(run) == []
    statuses = {measurement.status for measurement in run.master_logs[0].measurements}
    assert {"ok", "no_target"} <= statuses <= {"ok", "no_target", "angle_only"}


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.slow
def test_fewer_or_more_stations_than_prisms(tmp_path: Path, count: int) -> None:
    """Two stations measure but give no pose; five share three prisms."""
    run = run_mission(tmp_path, with_stations(find_scenario("dynamic"), count), duration_s=20.0)
    assert check_invariants(run) == []
    assert list(station_figures(run)) == list(range(1, count + 1))
    assert all(figure.delivered > 5 for figure in station_figures(run).values())
    assert (estimator_figures(run)["linear"].valid_poses > 0) == (count >= 3)


@pytest.mark.slow
def test_client_restart(tmp_path: Path) -> None:
    """The other stations continue; the station and the poses recover."""

    async def crash(mission: Mission) -> None:
        await mission.sleep_until(15.0)
        await mission.stop("station2")
        await mission.sleep_until(20.0)
        mission.start_station(2)

    run = run_mission(tmp_path, duration_s=45.0, script=crash)
    assert check_invariants(run) == []
    stamps = {
        station: np.array(
            [
                (m.stamp_ns - run.start_ns) / 1e9
                for m in run.master_logs[0].measurements
                if m.station == station
            ]
        )
        for station in (1, 2, 3)
    }
    assert not np.any((stamps[2] > 15.5) & (stamps[2] < 20.0))
    assert np.sum(stamps[2] > 30.0) > 15
    assert np.sum((stamps[1] > 15.0) & (stamps[1] < 20.0)) > 3
    poses_s = (run.master_logs[0].valid_poses().stamp_ns - run.start_ns) / 1e9
    assert np.sum(poses_s > 30.0) > 150
    assert len(run.station_logs[2].journals) == 2


@pytest.mark.parametrize("down_s", [2.2, 8.0, 15.0])
@pytest.mark.parametrize("at_s", [0.85, 2.3, 15.45])
@pytest.mark.slow
def test_clock_without_battery_stops_during_downtime(tmp_path: Path, at_s: float, down_s: float) -> None:
    """Timestamps stay correct, also when the downtime interrupts a synchronisation."""

    async def reboot(mission: Mission) -> None:
        await mission.sleep_until(at_s)
        await mission.stop("station1")
        mission.computers["station1"].clock.step(-round(down_s * 1e9))
        await mission.sleep_until(at_s + down_s)
        mission.start_station(1)

    run = run_mission(tmp_path, duration_s=35.0, script=reboot)
    assert check_invariants(run) == []
    late = [
        m for m in run.master_logs[0].measurements if m.station == 1 and m.stamp_ns > run.end_ns - 5 * 10**9
    ]
    assert len(late) > 4


@pytest.mark.slow
def test_master_restart(tmp_path: Path) -> None:
    """The second master has its own recording, resynchronises all clocks, and poses recover."""

    async def crash(mission: Mission) -> None:
        await mission.sleep_until(15.0)
        await mission.stop("master")
        await mission.sleep_until(17.0)
        mission.start_master()

    run = run_mission(tmp_path, duration_s=45.0, script=crash)
    assert check_invariants(run) == []
    first, second = run.master_logs
    assert first.recording() != second.recording()
    assert {clock.station for clock in second.clocks} == {1, 2, 3}
    assert len(second.valid_poses().stamp_ns) > 150


@pytest.mark.slow
def test_outage(tmp_path: Path) -> None:
    """During the outage nothing arrives from its station, and more from the others."""
    run = run_mission(tmp_path, duration_s=40.0, outages=(Outage((2,), 15.0, 10.0),))
    assert check_invariants(run) == []
    received_s = {
        station: np.array(
            [
                (m.received_ns - run.start_ns) / 1e9
                for m in run.master_logs[0].measurements
                if m.station == station
            ]
        )
        for station in (1, 2, 3)
    }
    assert not np.any((received_s[2] > 15.5) & (received_s[2] < 25.0))
    assert np.sum(received_s[2] > 27.0) > 15
    assert np.sum((received_s[1] > 15.0) & (received_s[1] < 25.0)) > 5
    (outage,) = outage_figures(run)
    assert np.isnan(outage.drained_s)  # what was measured meanwhile is lost over this protocol
    assert 0 < outage.live_age_ms < 1000


@pytest.mark.slow
def test_outage_with_a_fractional_nanosecond_ends(tmp_path: Path) -> None:
    """Rounding of instants does not prolong it."""
    outage = Outage((2,), 2.1, 0.2)
    assert round(outage.end_s * 1e9) / 1e9 < outage.end_s
    run = run_mission(tmp_path, duration_s=20.0, outages=(outage,))
    received_s = [
        (m.received_ns - run.start_ns) / 1e9 for m in run.master_logs[0].measurements if m.station == 2
    ]
    assert max(received_s) > 15.0


@pytest.mark.slow
def test_requested_restarts(tmp_path: Path) -> None:
    """A client and the master are down for two seconds."""
    run = run_mission(tmp_path, duration_s=40.0, restarts=(Restart(1, 15.0), Restart(None, 20.0)))
    assert check_invariants(run) == []
    assert [len(station_log.journals) for station_log in run.station_logs.values()] == [2, 1, 1]
    assert [len(station_log.statuses) for station_log in run.station_logs.values()] == [2, 1, 1]
    assert len(run.master_logs) == 2
    made_s = np.array(sorted(run.station_logs[1].true_times_ns.values())) / 1e9
    assert not np.any((made_s > 15.0) & (made_s < 17.0))
    assert np.sum(made_s > 17.0) > 50


@pytest.mark.slow
def test_interference_over_classic(tmp_path: Path) -> None:
    """Interference costs measurements, but changes neither them nor what is measured."""
    alone, disturbed = (
        run_mission(tmp_path / name, duration_s=40.0, interference_rate_hz=per_s)
        for name, per_s in (("alone", 0.0), ("disturbed", 0.5))
    )
    assert check_invariants(disturbed) == []
    for one, other in zip(station_figures(alone).values(), station_figures(disturbed).values(), strict=True):
        assert one.measured == other.measured
        assert 0.5 * one.delivered < other.delivered < one.delivered


@pytest.mark.slow
def test_timestamp_jitter_and_drift_ramp(tmp_path: Path) -> None:
    """Timestamp errors grow with the jitter and stay within the bounds.

    The first synchronisation takes a second, so that 20 us of jitter leave the frequency uncertain until the second one.
    """
    run = run_mission(tmp_path, duration_s=60.0, stamp_jitter_us=20.0, drift_ramp_ppm_per_min=1.0)
    assert check_invariants(run) == []
    for figure in station_figures(run).values():
        assert 5 < figure.time_error_us[0] < 1500


@pytest.mark.slow
def test_unix_clock_step_has_no_effect_on_a_running_client(tmp_path: Path) -> None:
    """The client fixes its time at its start."""

    async def step(mission: Mission) -> None:
        await mission.sleep_until(15.0)
        mission.computers["station1"].clock.step(3_600_000_000_000)

    run = run_mission(tmp_path, duration_s=30.0, script=step)
    assert check_invariants(run) == []
    assert not any(clock.restarted for clock in run.master_logs[0].clocks[3:])


@pytest.mark.slow
def test_paper_filter_lags(tmp_path: Path) -> None:
    """With the paper's filter and 50 ppm the timestamp errors are large, but within its bound."""
    paper = QUICK.model_copy(update={"clock_filter": "paper", "resync_interval_s": 20.0})
    run = run_mission(
        tmp_path,
        linear_drive(),
        duration_s=120.0,
        drift_ppm=50.0,
        protocol=paper,
    )
    assert check_invariants(run) == []
    for figure in station_figures(run).values():
        assert figure.time_error_us[2] > 2000


# --- The protocol superframe ----------------------------------------------------------------------------------------


def _lossy(loss: float) -> ScenarioConfig:
    scenario = find_scenario("dynamic")
    return scenario.model_copy(update={"radio": scenario.radio.model_copy(update={"loss_probability": loss})})


@pytest.mark.slow
def test_superframe_delivers_everything(tmp_path: Path) -> None:
    """Three stations deliver all measurements once and promptly, and the poses are better."""
    run = run_mission(tmp_path, duration_s=60.0, protocol=SUPERFRAME)
    assert check_invariants(run) == []
    for figure in station_figures(run).values():
        assert figure.delivered == figure.measured == pytest.approx(141, abs=2)
        assert figure.rate_hz == pytest.approx(2.5, abs=0.06)
        assert figure.duplicates == 0
        assert figure.age_ms[0] < 350  # of which the instrument takes 20 to 60 ms, and the line some
        assert figure.within_2s > 0.99
        assert figure.time_error_us[2] < 100
    poses = estimator_figures(run)
    assert poses["linear"].valid_poses > 1100
    assert poses["linear"].against_truth.centroid.position_rms_mm < 20
    assert poses["continuous"].against_truth.centroid.position_rms_mm < 3
    assert 350 < frame_ms(run) < 450


@pytest.mark.slow
def test_same_seed_gives_the_same_superframe_stream(tmp_path: Path) -> None:
    """Nonces and keys included."""
    one, same, other = (
        run_mission(tmp_path / name, _lossy(0.1), duration_s=10.0, seed=seed, protocol=SUPERFRAME)
        for name, seed in (("one", 3), ("same", 3), ("other", 4))
    )
    assert json.dumps(figures(one)) == json.dumps(figures(same))
    assert one.master_logs[0].line_hashes == same.master_logs[0].line_hashes
    assert one.master_logs[0].line_hashes != other.master_logs[0].line_hashes


@pytest.mark.parametrize("authenticated", [True, False])
@pytest.mark.slow
def test_outage_over_superframe(tmp_path: Path, *, authenticated: bool) -> None:
    """With a tenth of all packets lost, everything arrives afterwards, live measurements first."""
    run = run_mission(
        tmp_path,
        _lossy(0.1),
        duration_s=70.0,
        protocol=SUPERFRAME,
        outages=(Outage((1, 2, 3), 20.0, 20.0),),
        authenticated=authenticated,
    )
    assert check_invariants(run) == []
    for figure in station_figures(run).values():
        assert figure.delivered == figure.measured
    (outage,) = outage_figures(run)
    assert 1 < outage.drained_s < 20
    assert outage.live_age_ms < 1000
    assert outage.time_error_us[2] < 200


@pytest.mark.slow
def test_restarts_over_superframe(tmp_path: Path) -> None:
    """No measurement is lost when clients or the master restart, and all bounds hold."""
    run = run_mission(
        tmp_path,
        _lossy(0.1),
        duration_s=70.0,
        protocol=SUPERFRAME,
        drift_ppm=50.0,
        stamp_jitter_us=20.0,
        restarts=(Restart(1, 15.0), Restart(2, 15.2), Restart(None, 30.0), Restart(1, 30.5)),
        outages=(Outage((3,), 25.0, 10.0),),
    )
    assert check_invariants(run) == []
    assert [len(station_log.journals) for station_log in run.station_logs.values()] == [3, 2, 1]
    for figure in station_figures(run).values():
        assert figure.delivered == figure.measured


@pytest.mark.slow
def test_reboot_over_superframe(tmp_path: Path) -> None:
    """The clock restarts; journalled measurements from before arrive with valid bounds."""

    async def reboot(mission: Mission) -> None:
        await mission.reboot(1, at_s=30.0, off_s=10.0)

    run = run_mission(
        tmp_path,
        duration_s=70.0,
        protocol=SUPERFRAME,
        drift_ppm=50.0,
        script=reboot,
        outages=(Outage((1,), 22.0, 10.0),),
    )
    assert check_invariants(run) == []
    station = station_figures(run)[1]
    # Twice three and a half seconds go into connecting.
    assert station.delivered == station.measured == pytest.approx(2.5 * (60 - 7), abs=2)


@pytest.mark.slow
def test_replay_attack_over_superframe(tmp_path: Path) -> None:
    """Noise and replayed packets cost some packets and change nothing."""
    run = run_mission(tmp_path, duration_s=60.0, protocol=SUPERFRAME, interference_rate_hz=1.0)
    assert check_invariants(run) == []
    for figure in station_figures(run).values():
        assert figure.delivered >= figure.measured - 1
        assert figure.duplicates == 0


@pytest.mark.slow
def test_many_stations(tmp_path: Path) -> None:
    """Twelve stations share the channel, and each delivers its measurements."""
    run = run_mission(
        tmp_path, with_stations(find_scenario("dynamic"), 12), duration_s=30.0, protocol=SUPERFRAME
    )
    assert check_invariants(run) == []
    for figure in station_figures(run).values():
        assert figure.delivered >= figure.measured - 2  # frames last 2.5 s, and the drain 5 s
