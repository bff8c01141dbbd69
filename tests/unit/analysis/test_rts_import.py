from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.published import TARGET_CONSTANT_M, write_targets, write_tracks
from harness.scene import FRAMES

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
    """Three tracks of the simulated robot."""
    return [read_track(path) for path in write_tracks(folder)]


def test_stations_stand_where_the_targets_say(tmp_path: Path) -> None:
    """Exact targets give the exact frames, and the prism constant is kept with them."""
    solved = stations_from_targets(
        write_targets(tmp_path), target_constant_m=TARGET_CONSTANT_M, prism_constant_m=0.0175
    )
    stations = solved.stations
    assert solved.notes == ()
    np.testing.assert_allclose([s.T_station1_station for s in stations], FRAMES, atol=1e-9)
    assert [(s.station, s.prism, s.prism_constant_m) for s in stations] == [(k, k, 0.0175) for k in (1, 2, 3)]


def test_a_bad_target_is_named(tmp_path: Path) -> None:
    """Import goes on without it, but not silently."""
    path = write_targets(tmp_path)
    lines = path.read_text(encoding="utf-8").splitlines()
    cells = lines[8].split(" , ")
    assert cells[:2] == ["2", "3"]
    lines[8] = " , ".join([*cells[:5], str(float(cells[5]) + 0.05), *cells[6:]])
    path.write_text("\n".join(lines), encoding="utf-8")
    solved = stations_from_targets(path, target_constant_m=TARGET_CONSTANT_M, prism_constant_m=0.0)
    assert solved.notes == (f"{path}: target 3 of station 2 rejected",)
    np.testing.assert_allclose([s.T_station1_station for s in solved.stations], FRAMES, atol=1e-9)


def test_contradicting_targets_are_refused(tmp_path: Path) -> None:
    """A wrong target constant bends every distance; no frame is made of that."""
    path = write_targets(tmp_path)
    with pytest.raises(InputFileError, match="targets of station 2 contradict each other"):
        stations_from_targets(path, target_constant_m=0.5, prism_constant_m=0.0)


def test_raw_measurements_give_the_tracks_again(tmp_path: Path) -> None:
    """What was taken back to angles and distances comes out of the pipeline as it went in."""
    tracks = tracks_in(tmp_path)
    stations = stations_from_targets(
        write_targets(tmp_path), target_constant_m=0.01, prism_constant_m=0.01
    ).stations
    measurements = polar_measurements(tracks, stations)
    again = build_tracks(Parameters(stations=stations, prisms=ANYWHERE), measurements)
    for prism, track in enumerate(tracks, start=1):
        np.testing.assert_array_equal(again[prism].times_ns, track.stamps_ns)
        np.testing.assert_allclose(again[prism].points_m, track.points_m, atol=1e-9)


def test_field_data_comes_back_within_a_micrometre(field_data: Path) -> None:
    """The same with both segments of the real tracks and the targets of their day."""
    folder = field_data / "20220314"
    stations = stations_from_targets(
        folder / "GCP.txt", target_constant_m=0.01, prism_constant_m=0.01
    ).stations
    for segment in (folder, folder / "segment2"):
        tracks = [read_track(segment / f"trimble{k}.csv") for k in (1, 2, 3)]
        measurements = polar_measurements(tracks, stations)
        again = build_tracks(Parameters(stations=stations, prisms=ANYWHERE), measurements)
        for prism, track in enumerate(tracks, start=1):
            np.testing.assert_array_equal(again[prism].times_ns, track.stamps_ns)
            np.testing.assert_allclose(again[prism].points_m, track.points_m, atol=1e-6)


def test_the_prism_constant_is_taken_off_the_distance(tmp_path: Path) -> None:
    """A raw distance and its constant add up to the distance of the point from its station."""
    tracks = tracks_in(tmp_path)
    stations = [StationParameters(station=k, prism=k, prism_constant_m=0.025) for k in (1, 2, 3)]
    first = polar_measurements(tracks, stations)[0]
    assert isinstance(first, PolarMeasurement)
    assert first.slope_distance_m is not None
    distance_m = first.slope_distance_m + 0.025
    point = polar_to_cartesian(first.horizontal_angle_rad, first.zenith_angle_rad, distance_m)
    np.testing.assert_allclose(point, tracks[0].points_m[0], atol=1e-9)


def test_points_stay_as_they_are(tmp_path: Path) -> None:
    """Without targets the recorded positions are the published ones to the last bit."""
    tracks = tracks_in(tmp_path)
    stations = tuple(StationParameters(station=k, prism=k) for k in (1, 2, 3))
    again = build_tracks(Parameters(stations=stations, prisms=ANYWHERE), point_measurements(tracks))
    for prism, track in enumerate(tracks, start=1):
        np.testing.assert_array_equal(again[prism].points_m, track.points_m)


@pytest.mark.parametrize("raw", [False, True])
def test_measurements_come_in_the_order_of_time(tmp_path: Path, *, raw: bool) -> None:
    """The three tracks are merged, each with its own running number, arrival taken as the measurement's time."""
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


def test_a_prism_at_its_station_cannot_be_taken_back() -> None:
    """A distance below zero is no measurement."""
    track = PublishedTrack(np.array([1], dtype=np.int64), np.array([[0.003, 0.0, 0.0]]))
    with pytest.raises(GeometryError, match=r"prism 2 lies 3\.0 mm from station 2"):
        polar_measurements([track], [StationParameters(station=2, prism=2, prism_constant_m=0.01)])
