"""Set-up files: what is written is what is read."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.formats import InstrumentErrors, write_prism_layout, write_station_frames
from tsgt.config import load_prism_layout, load_station_calibration
from tsgt.model import SetupCovariance

if TYPE_CHECKING:
    from pathlib import Path


def test_instrument_errors_and_covariance_are_read_as_written(tmp_path: Path) -> None:
    """Of a station without estimated errors nothing is written."""
    path = tmp_path / "frames.toml"
    covariance = SetupCovariance(
        components=("station2.z", "station1.vertical_index"), matrix=((1e-6, -3e-10), (-3e-10, 2.5e-11))
    )
    write_station_frames(
        path,
        {1: np.eye(4), 2: np.eye(4)},
        {},
        comment="test",
        instrument_errors={2: InstrumentErrors(vertical_index_rad=2.25e-4, range_scale_ppm=-3.5)},
        covariance=covariance,
    )
    read = load_station_calibration(path)
    assert read.covariance == covariance
    assert read.stations[2].vertical_index_rad == 2.25e-4
    assert read.stations[2].range_scale_ppm == -3.5
    assert read.stations[1].range_scale_ppm is None
    assert path.read_text().count("_mrad") == 1


def test_covariance_of_prisms_is_read_as_written(tmp_path: Path) -> None:
    """The joint covariance takes precedence over the sigmas."""
    path = tmp_path / "layout.toml"
    covariance = SetupCovariance(components=("prism1.x", "prism2.x"), matrix=((1e-6, 9e-7), (9e-7, 1e-6)))
    positions, sigmas = {1: np.zeros(3), 2: np.ones(3)}, {1: np.full(3, 1e-3), 2: np.full(3, 1e-3)}
    write_prism_layout(path, positions, sigmas, comment="test", covariance=covariance)
    assert load_prism_layout(path).covariance == covariance
    write_prism_layout(path, positions, sigmas, comment="test")
    alone = load_prism_layout(path).covariance
    assert alone is not None
    np.testing.assert_allclose(np.array(alone.matrix), 1e-6 * np.eye(6))
