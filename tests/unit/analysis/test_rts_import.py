from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.scene import FRAMES
from harness.files.authors_files import TARGET_CONSTANT_M, write_targets, write_tracks

from tsgt.analysis.formats.rts_files import PublishedTrack, read_track
from tsgt.analysis.rts_import import point_measurements, polar_measurements, stations_from_targets
from tsgt.errors import GeometryError, InputFileError
from tsgt.estimation import build_tracks
from tsgt.geometry import polar_to_cartesian
from tsgt.model import Parameters, PolarMeasurement, PrismPosition, StationParameters

if TYPE_CHECKING:
    from pathlib import Path

ANYWHERE = tuple(PrismPosition(prism=k, position_m=(0.0, 0.0, 0.0)) for k in (1, 2, 3))


def tracks_in(folder: Path) -> list[PublishedTrack]:
    """Write and read three tracks of the simulated robot."""
    return [read_track(path) for path in write_tracks(folder)]


def test_exact_targets_give_exact_frames(tmp_path: Path) -> None:
    """The prism constant is stored with them."""
    solved = stations_from_targets(
        write_targets(tmp_path), target_constant_m=TARGET_CONSTANT_M, prism_constant_m=0.0175
    )
    stations = solved.stations
    assert solved.notes == ()
    np.testing.assert_allclose([s.T_station1_station for s in stations], FRAMES, atol=1e-9)
    assert [(s.station, s.prism, s.prism_constant_m) for s in stations] == [(k, k, 0.0175) for k in (1, 2, 3)]


def test_rejected_target_is_named(tmp_path: Path) -> None:
    """Import continues without it and adds a note."""
    path = write_targets(tmp_path)
    lines = path.read_text(encoding="utf-8").splitlines()
    cells = lines[8].split(" , ")
    assert cells[:2] == ["2", "3"]
    lines[8] = " , ".join([*cells[:5], str(float(cells[5]) + 0.05), *cells[6:]])
    path.write_text("\n".join(lines), encoding="utf-8")
    solved = stations_from_targets(path, target_constant_m=TARGET_CONSTANT_M, prism_constant_m=0.0)
    (note,) = solved.notes
    assert note.startswith(f"{path}: station 2: target 3 rejected: 50.0 mm from the place")
    np.testing.assert_allclose([s.T_station1_station for s in solved.stations], FRAMES, atol=1e-9)


def test_inconsistent_targets_are_rejected(tmp_path: Path) -> None:
    """A wrong target constant distorts every distance."""
    path = write_targets(tmp_path)
    with pytest.raises(InputFileError, match="the targets are inconsistent"):
        stations_from_targets(path, target_constant_m=0.5, prism_constant_m=0.0)


def test_polar_measurements_reproduce_the_tracks(tmp_path: Path) -> None:
    """Positions converted to angles and distances are computed from them reproduced."""
    tracks = tracks_in(tmp_path)
    stations = stations_from_targets(
        write_targets(tmp_path), target_constant_m=0.01, prism_constant_m=0.01
    ).stations
    measurements = polar_measurements(tracks, stations)
    reproduced = build_tracks(Parameters(stations=stations, prisms=ANYWHERE), measurements)
    for prism, track in enumerate(tracks, start=1):
        np.testing.assert_array_equal(reproduced[prism].times_ns, track.stamps_ns)
        np.testing.assert_allclose(reproduced[prism].points_m, track.points_m, atol=1e-9)


def test_field_data_is_reproduced_within_a_micrometre(field_data: Path) -> None:
    """Both segments of the real tracks, with the targets of their day."""
    folder = field_data / "20220314"
    stations = stations_from_targets(
        folder / "GCP.txt", target_constant_m=0.01, prism_constant_m=0.01
    ).stations
    for segment in (folder, folder / "segment2"):
        tracks = [read_track(segment / f"trimble{k}.csv") for k in (1, 2, 3)]
        measurements = polar_measurements(tracks, stations)
        reproduced = build_tracks(Parameters(stations=stations, prisms=ANYWHERE), measurements)
        for prism, track in enumerate(tracks, start=1):
            np.testing.assert_array_equal(reproduced[prism].times_ns, track.stamps_ns)
            np.testing.assert_allclose(reproduced[prism].points_m, track.points_m, atol=1e-6)


def test_prism_constant_is_subtracted_from_the_distance(tmp_path: Path) -> None:
    """A raw distance and its constant add up to the distance of the point from its station."""
    tracks = tracks_in(tmp_path)
    stations = [StationParameters(station=k, prism=k, prism_constant_m=0.025) for k in (1, 2, 3)]
    first = polar_measurements(tracks, stations)[0]
    assert isinstance(first, PolarMeasurement)
    assert first.slope_distance_m is not None
    distance_m = first.slope_distance_m + 0.025
    point = polar_to_cartesian(first.horizontal_angle_rad, first.zenith_angle_rad, distance_m)
    np.testing.assert_allclose(point, tracks[0].points_m[0], atol=1e-9)


def test_points_are_unchanged(tmp_path: Path) -> None:
    """Without targets the recorded positions are the published ones to the last bit."""
    tracks = tracks_in(tmp_path)
    stations = tuple(StationParameters(station=k, prism=k) for k in (1, 2, 3))
    reproduced = build_tracks(Parameters(stations=stations, prisms=ANYWHERE), point_measurements(tracks))
    for prism, track in enumerate(tracks, start=1):
        np.testing.assert_array_equal(reproduced[prism].points_m, track.points_m)


@pytest.mark.parametrize("raw", [False, True])
def test_measurements_are_in_the_order_of_time(tmp_path: Path, *, raw: bool) -> None:
    """The three tracks are merged, each with its own sequence numbers, arrival set to the time of measurement."""
    tracks = tracks_in(tmp_path)
    stations = [StationParameters(station=k, prism=k) for k in (1, 2, 3)]
    measurements = polar_measurements(tracks, stations) if raw else point_measurements(tracks)
    stamps = [m.stamp_ns for m in measurements]
    assert stamps == sorted(stamps)
    assert [m.received_ns for m in measurements] == stamps
    for station in (1, 2, 3):
        own = [m for m in measurements if m.station == station]
        assert [m.sequence for m in own] == list(range(len(tracks[station - 1].stamps_ns)))
        assert {m.prism for m in own} == {station}


def test_prism_at_its_station_is_rejected() -> None:
    """A distance below zero is no measurement."""
    track = PublishedTrack(np.array([1], dtype=np.int64), np.array([[0.003, 0.0, 0.0]]))
    with pytest.raises(GeometryError, match=r"prism 2 is 3\.0 mm from station 2"):
        polar_measurements([track], [StationParameters(station=2, prism=2, prism_constant_m=0.01)])
