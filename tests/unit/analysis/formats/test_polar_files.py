from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tsgt.analysis.formats import check_tracks, measurement_csv, read_polar_tracks, tracked_prisms
from tsgt.errors import InputFileError
from tsgt.model import PointMeasurement, PolarMeasurement, Status

if TYPE_CHECKING:
    from pathlib import Path

START_NS = 1_700_000_000_000_000_000

instants = st.integers(0, 2**63 - 1)
lengths = st.floats(0.0, 1e6)
polar = st.builds(
    PolarMeasurement,
    station=st.integers(1, 16),
    prism=st.integers(1, 16),
    sequence=st.integers(0, 2**31),
    stamp_ns=instants,
    stamp_sigma_ns=st.integers(0, 10**9),
    stamp_bound_ns=st.none() | st.integers(0, 10**9),
    received_ns=instants,
    horizontal_angle_rad=st.floats(-2 * math.pi, 2 * math.pi),
    zenith_angle_rad=st.floats(0, 2 * math.pi),
    slope_distance_m=st.none() | lengths,
    status=st.sampled_from(Status),
    raw_status=st.integers(-(10**6), 10**6),
    host_time_ns=st.none() | instants,
    instrument_time_ns=st.none() | instants,
)
points = st.builds(
    PointMeasurement,
    station=st.integers(1, 16),
    prism=st.integers(1, 16),
    sequence=st.integers(0, 2**31),
    stamp_ns=instants,
    received_ns=instants,
    position_m=st.tuples(lengths, lengths, lengths),
    status=st.sampled_from(Status),
)


def written(folder: Path, *lines: str, name: str = "polar.csv") -> Path:
    """Write a file of these lines."""
    path = folder / name
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
@given(
    measurements=st.lists(
        polar | points, min_size=1, max_size=8, unique_by=lambda m: (m.station, m.prism, m.stamp_ns)
    )
)
def test_exported_measurements_are_read_back(
    tmp_path: Path, measurements: list[PolarMeasurement | PointMeasurement]
) -> None:
    """The same measurements to the last bit, in the order of arrival."""
    path = tmp_path / "exported.csv"
    path.write_text("".join(measurement_csv(measurements)), encoding="utf-8")
    assert read_polar_tracks([path]) == sorted(measurements, key=lambda m: m.received_ns)


@pytest.mark.parametrize(
    ("unit", "half_circle", "quarter"), [("rad", math.pi, math.pi / 2), ("deg", 180, 90), ("gon", 200, 100)]
)
def test_column_names_state_the_angle_unit(
    tmp_path: Path, unit: str, half_circle: float, quarter: float
) -> None:
    """Radians, degrees and gon; missing columns get their defaults."""
    path = written(
        tmp_path,
        f"time_s,horizontal_angle_{unit},zenith_angle_{unit},slope_distance_m",
        f"1700000000.000000001,{half_circle!r},{quarter!r},12.5",
    )
    (found,) = read_polar_tracks([path])
    assert isinstance(found, PolarMeasurement)
    assert (found.station, found.prism, found.sequence, found.status) == (1, 1, 0, Status.OK)
    assert found.stamp_ns == found.received_ns == START_NS + 1
    assert found.horizontal_angle_rad == pytest.approx(math.pi)
    assert found.zenith_angle_rad == pytest.approx(math.pi / 2)
    assert found.slope_distance_m == 12.5


def test_file_per_station(tmp_path: Path) -> None:
    """Without a station column the position of the file counts; the measurements are in the order of time."""
    header = "stamp_ns,prism,horizontal_angle_deg,zenith_angle_deg,slope_distance_m,status"
    one = written(
        tmp_path, header, f"{START_NS + 5},7,1,90,10,", f"{START_NS + 9},7,1,90,,no_target", name="1"
    )
    two = written(tmp_path, header, f"{START_NS + 7},8,1,90,10,low_accuracy", name="2")
    found = read_polar_tracks([one, two])
    assert [(m.station, m.prism, m.sequence, m.status.value) for m in found] == [
        (1, 7, 0, "ok"),
        (2, 8, 0, "low_accuracy"),
        (1, 7, 1, "no_target"),
    ]
    assert tracked_prisms(found) == {1: 7, 2: 8}


@pytest.mark.parametrize("angle", ["400.0000", "-400.0000"])
def test_rounded_full_circle_is_an_angle(tmp_path: Path, angle: str) -> None:
    """An instrument rounds the last angle before zero up."""
    header = "stamp_ns,horizontal_angle_gon,zenith_angle_gon,slope_distance_m"
    (found,) = read_polar_tracks([written(tmp_path, header, f"{START_NS},{angle},100,10")])
    assert isinstance(found, PolarMeasurement)
    assert abs(found.horizontal_angle_rad) == pytest.approx(2 * math.pi)


@pytest.mark.parametrize("order", [1, -1])
def test_line_without_a_target_is_no_duplicate(tmp_path: Path, order: int) -> None:
    """Whichever of both comes first."""
    lines = [GOOD, GOOD.replace("ok", "no_target")]
    assert len(read_polar_tracks([written(tmp_path, HEADER, *lines[::order])])) == 2


HEADER = "stamp_ns,station,horizontal_angle_rad,zenith_angle_rad,slope_distance_m,status"
GOOD = f"{START_NS},1,1.0,1.5,20.0,ok"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([HEADER], "holds a header but no measurements"),
        ([HEADER.replace("_rad", ""), GOOD], "line 1: unknown column 'horizontal_angle'; expected"),
        ([HEADER.replace("stamp_ns,", ""), GOOD], "line 1: expected one column stamp_ns or time_s, got none"),
        (
            [f"{HEADER},horizontal_angle_deg", f"{GOOD},1"],
            "line 1: expected one column horizontal_angle_rad or",
        ),
        ([HEADER, GOOD, f"{GOOD},1"], "line 3: expected 6 columns as in the header, got 7"),
        ([HEADER, GOOD.replace("1.0", "nan")], "line 2: horizontal_angle_rad is 'nan'; expected a finite"),
        (
            [HEADER, GOOD.replace("1.0", "57.3")],
            "line 2: horizontal_angle_rad 57.3 is more than a full circle",
        ),
        ([HEADER, GOOD.replace(str(START_NS), "1.7e18")], "line 2: stamp_ns is '1.7e18'; expected a whole"),
        ([HEADER, GOOD.replace("20.0", "-2")], "line 2: slope_distance_m is -2; expected a distance"),
        ([HEADER, GOOD.replace("ok", "0")], "line 2: status is '0'; expected one of ok, low_accuracy"),
        ([f"{HEADER},raw_status", f"{GOOD},1.5"], "line 2: raw_status is '1.5'; expected a whole number"),
        ([HEADER, GOOD, GOOD], "line 3: duplicate of .*line 2: station 1, prism 1, same time"),
        ([f"{HEADER},type", f"{GOOD},point"], "line 2: a point needs the columns x_m, y_m and z_m"),
        ([f"{HEADER},type", f"{GOOD},pose"], "line 2: type is 'pose'; expected measurement or point"),
        ([f"{HEADER},type", f"{GOOD},{'9' * 5000}"], "99...; expected measurement or point"),
    ],
)
def test_error_names_the_line(tmp_path: Path, lines: list[str], message: str) -> None:
    """File, line, value, and what was expected."""
    with pytest.raises(InputFileError, match=rf"polar\.csv.*{message}"):
        read_polar_tracks([written(tmp_path, *lines)])


def test_tracks_without_overlap_are_rejected(tmp_path: Path) -> None:
    """And tracks without usable measurements."""
    late = GOOD.replace(str(START_NS), str(START_NS + 3_000_000_000)).replace(",1,", ",2,", 1)
    path = written(tmp_path, HEADER, GOOD, late)
    with pytest.raises(InputFileError, match=r"station 2 begin 3\.0 s after the last one of station 1"):
        check_tracks(read_polar_tracks([path]), [path])
    path = written(tmp_path, HEADER, GOOD.replace("ok", "no_target"))
    with pytest.raises(InputFileError, match="no measurement has a usable status"):
        check_tracks(read_polar_tracks([path]), [path])
