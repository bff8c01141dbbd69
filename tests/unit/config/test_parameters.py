"""Conversion of configuration and set-up files to parameters."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from tsgt.config import (
    ClassicMasterConfig,
    MasterConfig,
    NoiseConfig,
    PipelineConfig,
    ScenarioConfig,
    load,
    noise,
    parameters,
    parameters_in_force,
    scenario_parameters,
)
from tsgt.config.parameters import pipeline_parameters
from tsgt.errors import ConfigError
from tsgt.model import TRACKING_NOISE, Parameters, PipelineParameters

EXAMPLES = Path(__file__).parents[3] / "configs"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Copy the example configurations."""
    for path in EXAMPLES.glob("*.toml"):
        shutil.copy(path, tmp_path)
    return tmp_path


def _parameters(folder: Path, *edits: tuple[str, str], file: str = "master") -> Parameters:
    path = folder / f"{file}.example.toml"
    text = path.read_text()
    for good, bad in edits:
        assert good in text
        text = text.replace(good, bad, 1)
    path.write_text(text)
    return parameters(load(folder / "master.example.toml", MasterConfig))


def test_units_become_si(folder: Path) -> None:
    """Millimetres, milliseconds, arcseconds and degrees become metres, nanoseconds and radians."""
    known = _parameters(
        folder,
        ("prism_constant_mm = 0.0 ", "prism_constant_mm = -34.4 "),
        ("latency_ms = 0.0", "latency_ms = 12.5"),
        ("atmospheric_ppm = 0.0", "atmospheric_ppm = 7.5"),
        ("angle_sigma_arcsec = 1.0", "angle_sigma_arcsec = 3600.0"),
        ("tilt_limit_deg = 90.0", "tilt_limit_deg = 180.0"),
        ("outage_limit_s = 1.0", "outage_limit_s = 0.75"),
        ("rate_hz = 20.0", "rate_hz = 8"),
    )
    station = known.stations[0]
    assert station.prism_constant_m == pytest.approx(-0.0344, abs=1e-15)
    assert station.latency_ns == 12_500_000
    assert station.atmospheric_ppm == 7.5
    assert station.noise.angle_sigma_rad == pytest.approx(math.radians(1.0), rel=1e-12)
    assert known.pipeline.tilt_limit_rad == math.pi
    assert known.pipeline.outage_limit_ns == 750_000_000
    assert known.pipeline.period_ns == 125_000_000


def test_set_up_files_are_read(folder: Path) -> None:
    """Frames and prism positions come from the set-up files."""
    known = _parameters(folder)
    assert known.stations[1].T_station1_station[0][3] == 2.0
    assert [prism.prism for prism in known.prisms] == [1, 2, 3]
    assert known.prisms[1].position_m == (0.4844, -0.1759, 1.4167)


def test_instrument_errors_and_covariance_are_read(folder: Path) -> None:
    """Units are converted; the scale replaces that of the configuration; the layout's sigmas join the covariance."""
    frames = folder / "station_frames.example.toml"
    errors = "[stations.3]\nvertical_index_mrad = 0.2\ncollimation_mrad = -0.1\nrange_scale_ppm = 4.0\n"
    table = '[covariance]\ncomponents = ["station3.z", "station9.x"]\nmatrix = [[4e-6, 1e-7], [1e-7, 1e-6]]\n'
    text = frames.read_text().replace("[stations.3]\n", errors)
    frames.write_text(f"{text}\n{table}".replace("station9", "station2"))
    layout = folder / "prism_layout.example.toml"
    layout.write_text(layout.read_text().replace("[prisms.2]\n", "[prisms.2]\nsigma_m = [0.0, 0.0, 0.001]\n"))
    known = _parameters(folder)
    station = known.stations[2]
    assert (station.vertical_index_rad, station.collimation_rad, station.atmospheric_ppm) == (
        2e-4,
        -1e-4,
        4.0,
    )
    assert known.stations[1].atmospheric_ppm == 0.0
    assert known.setup_covariance is not None
    assert known.setup_covariance.components == (
        "station3.z",
        "station2.x",
        "prism2.x",
        "prism2.y",
        "prism2.z",
    )
    assert known.setup_covariance.matrix[1] == (1e-7, 1e-6, 0.0, 0.0, 0.0)
    assert known.setup_covariance.matrix[4][4] == 1e-6


@pytest.mark.parametrize(
    ("components", "matrix", "message"),
    [
        ('["station2.z"]', "[[-1.0]]", "no covariance"),
        ('["station2.z"]', "[[1.0, 0.0]]", "not 1 x 1"),
        ('["station7.z"]', "[[1.0]]", "station7.z is no quantity of this file"),
        ('["prism1.z"]', "[[1.0]]", "prism1.z is no quantity of this file"),
    ],
)
def test_wrong_covariance_is_rejected(folder: Path, components: str, matrix: str, message: str) -> None:
    """The message names file and reason."""
    frames = folder / "station_frames.example.toml"
    table = f"[covariance]\ncomponents = {components}\nmatrix = {matrix}\n"
    frames.write_text(f"{frames.read_text()}\n{table}")
    with pytest.raises(ConfigError, match=f"station_frames.*{message}"):
        _parameters(folder)


def test_defaults_are_those_of_the_model() -> None:
    """An empty configuration has the defaults of the parameters; recordings of older versions have no delays."""
    assert pipeline_parameters(PipelineConfig(smoothed_delays_s=())) == PipelineParameters()
    assert noise(NoiseConfig()) == TRACKING_NOISE


def test_delays_are_below_the_lag() -> None:
    """A lag below the default delay leaves none; a given delay that is too long is a mistake."""
    assert pipeline_parameters(PipelineConfig()).smoothed_delays_ns == (1_000_000_000,)
    assert pipeline_parameters(PipelineConfig(lag_s=0.8)).smoothed_delays_ns == ()
    with pytest.raises(ValueError, match=r"smoothed_delays_s: 1 is not below lag_s \(0.8\)"):
        PipelineConfig(lag_s=0.8, smoothed_delays_s=(0.5, 1.0))
    with pytest.raises(ValueError, match="each delay must be given once"):
        PipelineConfig(smoothed_delays_s=(0.5, 0.5))


def test_delays_differ_by_nanoseconds() -> None:
    """What the pipeline computes with; smaller differences are none."""
    assert pipeline_parameters(PipelineConfig(lag_s=1.0000000001)).smoothed_delays_ns == ()
    with pytest.raises(ValueError, match=r"smoothed_delays_s: 0.5 is not below lag_s"):
        PipelineConfig(lag_s=0.5000000001, smoothed_delays_s=(0.5,))
    with pytest.raises(ValueError, match="each delay must be given once"):
        PipelineConfig(smoothed_delays_s=(0.5, 0.5000000001))


def test_resynchronisation_takes_a_second_at_least() -> None:
    """The protocol classic divides by the interval."""
    with pytest.raises(ValueError, match=r"resync_interval_s\n.*greater than or equal to 1"):
        ClassicMasterConfig(kind="classic", resync_interval_s=1e-10)


def test_reference_point_of_the_imu_is_its_frame(folder: Path) -> None:
    """It needs the name alone."""
    (folder / "imu.toml").write_text(
        'kind = "imu_mounting"\nposition_m = [0.2, -0.1, 0.4]\norientation_xyzw = [0.0, 0.0, 0.6, 0.8]\n'
        "latency_ms = 4.3\ngyro_matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\n"
    )
    path = folder / "master.example.toml"
    before, _, after = path.read_text().partition("[reference_point]")
    _, _, after = after.partition("\n[")
    imu = '[imu]\ncommand = ["/bin/imu"]\nmounting = "imu.toml"\nlatitude_deg = 46.8\n'
    path.write_text(f'{before}{imu}[reference_point]\nname = "imu"\n' + (f"[{after}" if after else ""))
    point = parameters(load(path, MasterConfig)).reference_point
    assert (point.name, point.position_m) == ("imu", (0.2, -0.1, 0.4))
    assert point.orientation_xyzw == (0.0, 0.0, 0.6, 0.8)


def test_untracked_prism_is_omitted(folder: Path) -> None:
    """Poses do not wait for a spare prism."""
    layout = folder / "prism_layout.example.toml"
    layout.write_text(layout.read_text() + "\n[prisms.4]\nposition_m = [0.0, 0.0, 2.0]\n")
    assert [prism.prism for prism in _parameters(folder).prisms] == [1, 2, 3]


def test_missing_frame_is_named(folder: Path) -> None:
    """The error names file and station."""
    with pytest.raises(ConfigError, match=r"station_frames\.example\.toml: stations\.5: missing"):
        _parameters(folder, ("station = 3", "station = 5"))


def test_missing_prism_is_named(folder: Path) -> None:
    """The error names file, prism and station."""
    with pytest.raises(
        ConfigError, match=r"prism_layout\.example\.toml: prisms\.4: missing; station 3 tracks it"
    ):
        _parameters(folder, ("prism = 3", "prism = 4"))


def test_fewer_than_three_prisms_are_rejected(folder: Path) -> None:
    """Three stations on two prisms determine no pose."""
    with pytest.raises(ConfigError, match="3 stations on 2 prisms cannot give poses without an IMU"):
        _parameters(folder, ("prism = 3", "prism = 2"))


def test_missing_set_up_file_is_named(folder: Path) -> None:
    """The error names the file."""
    with pytest.raises(ConfigError, match=r"tomorrow\.toml: no such file"):
        _parameters(folder, ("prism_layout.example.toml", "tomorrow.toml"))


def test_reference_scenario_has_the_published_prism_distances() -> None:
    """0.987, 0.681 and 0.815 m, as in DESIGN."""
    a, b, c = (np.array(prism.position_m) for prism in ScenarioConfig().prisms)
    distances = [np.linalg.norm(a - b), np.linalg.norm(a - c), np.linalg.norm(b - c)]
    np.testing.assert_allclose(distances, [0.987, 0.681, 0.815], atol=6e-4)


def test_scenario_frames_are_level_and_rigid() -> None:
    """A simulated station is rotated about the vertical only."""
    for station in scenario_parameters(ScenarioConfig()).stations:
        T = np.array(station.T_station1_station)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
        assert np.linalg.det(T[:3, :3]) > 0
        assert T[2, 2] == 1.0
    assert scenario_parameters(ScenarioConfig()).stations[0].T_station1_station[0] == (1.0, 0.0, 0.0, 0.0)


def test_missing_set_up_files_give_parameters_without_poses(folder: Path) -> None:
    """The reason names each missing file with its command; stations keep what the configuration says."""
    config = load(folder / "master.example.toml", MasterConfig)
    known = parameters(config)
    assert parameters_in_force(config) == known
    config.setup.station_frames.unlink()
    found = parameters_in_force(config)
    assert found.no_poses == (
        f"not calibrated: {config.setup.station_frames} (`tsgt calibrate targets` writes it) does not exist"
    )
    assert found.prisms == ()
    assert found.stations[0] == known.stations[0]  # the frame of the world
    assert [each.station for each in found.stations] == [1, 2, 3]


def test_broken_set_up_file_is_an_error(folder: Path) -> None:
    """Only a missing one is taken for the time before the first calibration."""
    config = load(folder / "master.example.toml", MasterConfig)
    config.setup.station_frames.write_text("nonsense")
    with pytest.raises(ConfigError, match="not TOML"):
        parameters_in_force(config)
