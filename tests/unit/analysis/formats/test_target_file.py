"""Target and prism files: units, faces, repeats, and every error."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from tsgt.analysis.calibration import solve_prisms, solve_stations
from tsgt.analysis.formats import read_prism_file, read_target_file
from tsgt.errors import DegenerateGeometryError, InputFileError

DOCUMENT = Path(__file__).parents[4] / "docs" / "reference" / "target-file.md"

HEADER = "station,target,horizontal_angle_deg,zenith_angle_deg,slope_distance_m"
GOOD = """\
1,1,350.3336,88.7589,18.4663
1,2,73.6682,91.5345,22.4118
1,3,211.8658,86.3883,17.4613
2,1,24.2553,88.9790,16.8428
2,2,117.9731,91.9594,20.4692
2,3,252.6003,87.1258,19.9417
"""
MARKER = "theodolite_number , marker_number , status , elevation , azimuth , distance , sec , nsec"
PRISM_HEADER = "point,kind,horizontal_angle_deg,zenith_angle_deg,slope_distance_m,x_m,y_m,z_m"


def documented(number: int, folder: Path) -> Path:
    """Write one of the examples of the reference page to a file."""
    example = re.findall(r"```csv\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)[number]
    return written(folder, example)


def written(folder: Path, text: str) -> Path:
    """Write a file of this content."""
    path = folder / "measured.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_documented_target_file_is_solved(tmp_path: Path) -> None:
    """The example of the reference page, in both faces, gives the frame from which it was made."""
    frames = solve_stations(read_target_file(documented(0, tmp_path)), target_constant_m=0.0).frames
    assert list(frames) == [2]
    assert frames[2].used == (1, 2, 3, 4)
    np.testing.assert_allclose(frames[2].T[:3, 3], [2.0, -1.5, 0.1], atol=0.003)


def test_documented_marker_file_is_solved(tmp_path: Path) -> None:
    """The excerpt of the authors' file on the reference page is recognised by its header."""
    frames = solve_stations(read_target_file(documented(1, tmp_path)), target_constant_m=0.01).frames
    assert frames[2].used == (1, 6, 7)
    assert frames[2].rms_m < 0.002


def test_documented_prism_file_is_solved(tmp_path: Path) -> None:
    """The example of the reference page gives the prisms from which it was made."""
    file = read_prism_file(documented(2, tmp_path))
    prisms = solve_prisms(file, target_constant_m=0.0, prism_constant_m=0.01).prisms
    layout = [[-0.4559, -0.1759, 1.1167], [0.4844, -0.1759, 1.4167], [-0.0285, 0.3519, 1.0667]]
    assert prisms.names == (1, 2, 3)
    np.testing.assert_allclose(prisms.points_m, layout, atol=0.002)


@pytest.mark.parametrize(("unit", "circle"), [("rad", 2 * math.pi), ("deg", 360.0), ("gon", 400.0)])
def test_angles_are_read_in_each_unit(tmp_path: Path, unit: str, circle: float) -> None:
    """An eighth of a circle in each unit; the order of the columns is free."""
    text = f"zenith_angle_{unit},horizontal_angle_{unit},slope_distance_m,target,station\n" + "".join(
        f"{circle / 4!r},{circle / 8!r},10.5,7,{station}\n" for station in (1, 2)
    )
    (measurement,) = read_target_file(written(tmp_path, text)).measurements[2][7]
    assert measurement.horizontal_angle_rad == pytest.approx(math.pi / 4)
    assert measurement.zenith_angle_rad == pytest.approx(math.pi / 2)
    assert measurement.slope_distance_m == 10.5
    assert measurement.line == 3


def test_index_error_is_estimated_from_two_faces(tmp_path: Path) -> None:
    """Both faces with a zenith index error of 0.01 degrees give the error, and the frame without it."""
    lines = []
    for line in GOOD.splitlines():
        station, target, h, z, d = line.split(",")
        lines += [
            f"{station},{target},{h},{float(z) + 0.01!r},{d}",
            f"{station},{target},{(float(h) + 180) % 360!r},{360 - float(z) + 0.01!r},{d}",
        ]
    plain, both = (
        solve_stations(read_target_file(written(tmp_path, text)), target_constant_m=0.0)
        for text in (f"{HEADER}\n{GOOD}", "\n".join([HEADER, *lines]))
    )
    np.testing.assert_allclose(both.frames[2].T, plain.frames[2].T, atol=1e-5)
    for errors in both.instrument_errors().values():
        assert errors.vertical_index_rad == pytest.approx(math.radians(0.01), rel=0.01)
        assert errors.collimation_rad == pytest.approx(0.0, abs=1e-6)
    assert plain.instrument_errors()[2].vertical_index_rad == pytest.approx(0.0, abs=1e-5)


def test_constant_in_the_file_overrides_the_default(tmp_path: Path) -> None:
    """A line's own constant_mm counts; an empty cell uses the common one."""
    rows = [f"{row},{'10' if row[0] == '1' else ''}" for row in GOOD.splitlines()]
    own = solve_stations(
        read_target_file(written(tmp_path, "\n".join([f"{HEADER},constant_mm", *rows]))),
        target_constant_m=0.01,
    )
    common = solve_stations(read_target_file(written(tmp_path, f"{HEADER}\n{GOOD}")), target_constant_m=0.01)
    np.testing.assert_allclose(own.frames[2].T, common.frames[2].T, atol=1e-12)


def test_distances_are_corrected_for_the_air_by_the_file(tmp_path: Path) -> None:
    """As the master corrects those of the prisms: before the constant, which is not scaled."""
    rows = [f"{row},30,{'50' if row[0] == '1' else ''}" for row in GOOD.splitlines()]
    path = written(tmp_path, "\n".join([f"{HEADER},constant_mm,atmospheric_ppm", *rows]))
    measured = read_target_file(path).measurements
    first, second = measured[1][1][0], measured[2][1][0]
    assert first.distance_m(0.0) == pytest.approx(first.slope_distance_m * (1 + 50e-6) + 0.03, abs=1e-12)
    assert second.distance_m(0.0) == pytest.approx(second.slope_distance_m + 0.03, abs=1e-12)


def test_comments_blank_lines_and_byte_order_mark_are_ignored(tmp_path: Path) -> None:
    """Line numbers remain those of the file."""
    path = written(tmp_path, f"\ufeff# note\n\n{HEADER}\n  # another\n{GOOD}")
    assert read_target_file(path).measurements[1][1][0].line == 5


def test_marker_lines_with_an_error_status_are_skipped_with_a_note(tmp_path: Path) -> None:
    """Even if their numbers are invalid."""
    text = f"{MARKER}\n1,1,0,1.5,0.1,9.0,0,0\n2,1,0,1.5,0.2,9.0,0,0\n2,2,4,1.5,0.2,0.0,0,0\n"
    file = read_target_file(written(tmp_path, text))
    assert set(file.measurements[2]) == {1}
    (note,) = file.skipped
    assert "line 4: target 2 of station 2 skipped: the instrument reported status 4" in note


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("# only a comment\n", "is empty"),
        (f"{HEADER}\n", "no measurements"),
        (f"{HEADER}\n1,1,10,90\n", "line 2: expected 5 columns as in the header, got 4"),
        (f"{MARKER}\n1,1,0,1.5,0.1,9.0,0\n", "line 2: expected 8 columns as in the header, got 7"),
        (f"{HEADER},weather\n{GOOD}", "line 1: unknown column 'weather'"),
        (f"{HEADER},target\n{GOOD}", "line 1: expected one column target, got target and target"),
        (f"{HEADER[8:]}\n{GOOD}", "line 1: expected one column station, got none"),
        (f"{HEADER},zenith_angle_gon\n{GOOD}", "got zenith_angle_deg and zenith_angle_gon"),
        (f"{HEADER}\n1,1,10,90,nan\n", "line 2: slope_distance_m is 'nan'; expected a finite number"),
        (f"{HEADER}\n1,1,ten,90,5\n", "line 2: horizontal_angle_deg is 'ten'"),
        (f"{HEADER}\n1,1,10,90,0\n", "line 2: slope_distance_m is 0"),
        (f"{HEADER}\n1,1,10,90,-5\n", "line 2: slope_distance_m is -5"),
        (f"{HEADER}\n1,1,400,90,5\n", "line 2: horizontal_angle_deg 400 is more than a full circle"),
        (f"{HEADER}\n1,1,10,-1,5\n", "is measured from the zenith, not from the horizon"),
        (f"{HEADER}\n0,1,10,90,5\n", "line 2: station is '0'; expected a whole number from 1"),
        (f"{HEADER}\n1,A,10,90,5\n", "line 2: target is 'A'; expected a whole number from 1"),
        (f"{HEADER}\n2,1,10,90,5\n", "no usable target of station 1"),
        (f"{HEADER}\n1,1,10,90,5\n", "targets of station 1 only"),
    ],
)
def test_invalid_target_file_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    """One line names the file, the line and the column."""
    path = written(tmp_path, text)
    with pytest.raises(InputFileError, match=re.escape(message)) as raised:
        read_target_file(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", None])
def test_binary_or_missing_file_is_rejected(tmp_path: Path, content: bytes | None) -> None:
    """With a one-line error."""
    path = tmp_path / "targets.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputFileError, match=r"not a text file|No such file"):
        read_target_file(path)


def test_inconsistent_repeats_are_rejected(tmp_path: Path) -> None:
    """A second measurement 50 mm from the first is not averaged."""
    path = written(tmp_path, f"{HEADER}\n{GOOD}2,3,252.6003,87.1258,19.9917\n")
    with pytest.raises(
        InputFileError, match="target 3 of station 2: this measurement is 25 mm from the mean of the 2"
    ):
        solve_stations(read_target_file(path), target_constant_m=0.0)


def test_constant_larger_than_a_distance_is_rejected(tmp_path: Path) -> None:
    """A constant in the wrong unit must not mirror points."""
    path = written(tmp_path, f"{HEADER}\n{GOOD}")
    with pytest.raises(InputFileError, match=r"line 2: target 1 of station 1: .* the distance is -1\.534 m"):
        solve_stations(read_target_file(path), target_constant_m=-20.0)


def test_station_with_too_few_common_targets_is_named(tmp_path: Path) -> None:
    """With the targets that it shares with station 1."""
    path = written(tmp_path, f"{HEADER}\n{GOOD}3,1,10,90,5\n3,9,20,90,5\n")
    with pytest.raises(DegenerateGeometryError, match=r"station 3 against station 1: .* got 1 \(1\)"):
        solve_stations(read_target_file(path), target_constant_m=0.0)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("1,prism,10,90,5,,,\n", "holds no body point"),
        ("a,body,10,90,5,0,0,0\n", "holds no prism"),
        ("1,prism,10,90,5,1,2,3\n", "line 2: a prism has no position from CAD"),
        ("top,prism,10,90,5,,,\n", "line 2: point is 'top'; expected a whole number"),
        ("a,wheel,10,90,5,0,0,0\n", "line 2: kind is 'wheel'; expected prism or body"),
        ("a,body,10,90,5,0,,0\n", "line 2: y_m is ''; expected a finite number"),
        (",body,10,90,5,0,0,0\n", "line 2: a body point needs a name"),
        (
            "a,body,10,90,5,0,0,0\na,body,10,90,5,0,0,1\n",
            "line 3: body point a has different x_m, y_m, z_m in a previous line",
        ),
    ],
)
def test_invalid_prism_file_is_rejected(tmp_path: Path, rows: str, message: str) -> None:
    """One line names the file, the line and the column."""
    with pytest.raises(InputFileError, match=re.escape(message)):
        read_prism_file(written(tmp_path, f"{PRISM_HEADER}\n{rows}"))


def test_coinciding_prisms_are_rejected(tmp_path: Path) -> None:
    """Such a layout determines no pose."""
    path = documented(2, tmp_path)
    lines = path.read_text(encoding="utf-8").splitlines()
    lines[-1] = lines[-2].replace("2,", "3,", 1)
    with pytest.raises(DegenerateGeometryError, match=r"prisms 2 and 3 are 0\.0 mm apart"):
        solve_prisms(
            read_prism_file(written(tmp_path, "\n".join(lines))), target_constant_m=0.0, prism_constant_m=0.0
        )
