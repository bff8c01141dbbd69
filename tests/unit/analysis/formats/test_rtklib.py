from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.pos_files import BASE, SECOND, Variant, write_pos

from tsgt.analysis.formats import QUALITIES, read_pos
from tsgt.errors import InputFileError

if TYPE_CHECKING:
    from pathlib import Path

GPST_2022 = 1_653_499_260 * SECOND  # 2022/05/25 17:21:00 on a calendar
HEADER = """\
% program   : RTKPOST-QT ver.2.4.3 Emlid b33
% inp file  : /home/lab/reach-raw_202205251720.obs
% obs start : 2022/05/25 17:21:00.0 GPST (week2211 321660.0s)
% ref pos   : 46.779457236  -71.274608234    61.0204
%
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio
"""
ROW = (
    "2022/05/25 17:21:01.600   46.779872289  -71.274147600    53.1613   2   5"
    "   2.7396   3.6983   6.9438   2.2414  -4.0321  -3.1027  -0.01    0.0\n"
)


def written(folder: Path, text: str) -> Path:
    """Write a file."""
    path = folder / "rover.pos"
    path.write_text(text, encoding="utf-8")
    return path


def error_of(path: Path) -> str:
    """Return the error message of an unusable file, without its path."""
    with pytest.raises(InputFileError) as error:
        read_pos(path)
    return str(error.value).removeprefix(str(path))


def test_line_is_parsed(tmp_path: Path) -> None:
    """Time to the nanosecond on the file's own calendar, angles in rad, Q and satellites."""
    found = read_pos(written(tmp_path, HEADER + ROW))
    assert found.time_system == "GPST"
    assert found.times_ns.tolist() == [GPST_2022 + 1_600_000_000]
    np.testing.assert_allclose(np.degrees(found.positions[0, :2]), [46.779872289, -71.2741476], rtol=1e-15)
    assert found.positions[0, 2] == 53.1613
    assert (found.quality.tolist(), found.satellites.tolist(), found.base) == ([2], [5], None)


@pytest.mark.parametrize(
    ("coordinates", "system", "week"),
    list(product(["geodetic", "sexagesimal", "ecef", "baseline"], ["GPST", "UTC", "JST"], [False, True])),
)
def test_every_output_option_is_read(tmp_path: Path, coordinates: str, system: str, week: bool) -> None:  # noqa: FBT001 (a parameter of the test)
    """Times on the named calendar, Q and satellites, for all options of RTKLIB."""
    times = [1_653_499_242 * SECOND, 1_653_499_242 * SECOND + 200_000_000]
    variant = Variant(coordinates=coordinates, system=system, week=week)
    points = np.array([[3.0, 4.0, 0.5], [3.1, 4.2, 0.5]])
    found = read_pos(
        write_pos(tmp_path / "a.pos", times, points, variant, quality=[1, 7], satellites=[15, 0])
    )
    shift_s = {"GPST": 18, "UTC": 0, "JST": 9 * 3600}[system]
    assert found.time_system == system
    assert (found.times_ns - shift_s * SECOND).tolist() == times
    assert (found.quality.tolist(), found.satellites.tolist()) == ([1, 7], [15, 0])


@pytest.mark.parametrize("separator", [" ", "\t", ",", ";", " , "])
@pytest.mark.parametrize("velocity", [False, True])
def test_field_separators(tmp_path: Path, separator: str, velocity: bool) -> None:  # noqa: FBT001 (as above)
    """Every separator that RTKLIB offers; velocity columns may follow."""
    variant = Variant(coordinates="sexagesimal", separator=separator, velocity=velocity)
    points = np.array([[-3.0, 4.0, 0.5]])
    found = read_pos(write_pos(tmp_path / "a.pos", [GPST_2022], points, variant))
    np.testing.assert_allclose(np.degrees(found.positions[0, :2]), [46.779436, -71.2746393], atol=1e-6)


def test_baseline_has_its_base(tmp_path: Path) -> None:
    """East, north and up in m, and the position of the base."""
    points = np.array([[3.0, -4.0, 0.5]])
    found = read_pos(write_pos(tmp_path / "a.pos", [GPST_2022], points, Variant(coordinates="baseline")))
    np.testing.assert_array_equal(found.positions, points)
    assert found.base == pytest.approx(BASE, rel=1e-10)


def test_minus_zero_degrees_are_west(tmp_path: Path) -> None:
    """Half a degree west of Greenwich is written as -0 30 00."""
    header = "%  GPST latitude(d'\") longitude(d'\") height(m) Q ns\n"
    found = read_pos(written(tmp_path, header + "2022/05/25 17:21:00 51 28 40.12345 -0 30 0.0 45.0 1 12\n"))
    np.testing.assert_allclose(np.degrees(found.positions[0, :2]), [51.4778120694, -0.5], atol=1e-9)


def test_all_qualities_are_read(tmp_path: Path) -> None:
    """From none to dead reckoning."""
    times = [GPST_2022 + k * SECOND for k in range(len(QUALITIES))]
    path = write_pos(tmp_path / "a.pos", times, np.zeros((len(times), 3)), quality=list(QUALITIES))
    assert read_pos(path).quality.tolist() == list(QUALITIES)


def test_backward_solution_is_sorted(tmp_path: Path) -> None:
    """RTKLIB writes it last epoch first."""
    times = [GPST_2022 + k * SECOND for k in (2, 1, 0)]
    found = read_pos(write_pos(tmp_path / "a.pos", times, np.zeros((3, 3)), satellites=[7, 8, 9]))
    assert found.satellites.tolist() == [9, 8, 7]
    assert np.all(np.diff(found.times_ns) == SECOND)


def test_header_may_have_any_encoding(tmp_path: Path) -> None:
    """RTKPOST on Windows writes file names in the computer's own encoding."""
    path = tmp_path / "a.pos"
    path.write_bytes("% inp file  : C:\\données\\é.obs\r\n".encode("cp1252") + (HEADER + ROW).encode())
    assert len(read_pos(path).times_ns) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ": contains no positions; expected a solution file of RTKLIB"),
        (HEADER, ": contains no positions; expected a solution file of RTKLIB"),
        (ROW, ", line 1: precedes the line that names time system and columns"),
        ("$GPGGA,123519,4807.038,N\n", ", line 1: is NMEA or a status; configure RTKLIB"),
        (HEADER + ROW + ROW, ", line 9: has the time of line 8; keep one of the two"),
        (
            HEADER + ROW[:80],
            ", line 8: expected 15 fields as in the header, got 8; remove the line if it was",
        ),
        (HEADER.replace("GPST    ", "TAI     ") + ROW, ", line 7: expected the time system GPST, UTC or JST"),
        (HEADER.replace("   Q  ns", "") + ROW, ", line 7: names no columns Q and ns"),
        (
            HEADER.replace("WGS84", "Tokyo") + ROW,
            ", line 6: is in the datum Tokyo; set RTKLIB's output datum to WGS84",
        ),
        (HEADER + ROW + HEADER.replace("GPST  ", "UTC   "), ", line 15: the columns change here"),
        (HEADER + ROW.replace("  2   5", "  8   5"), ", line 8: column Q: expected 0 to 7, got '8'"),
        (HEADER + ROW.replace("  2   5", "  2  -5"), ", line 8: column ns: expected 0 to 999, got '-5'"),
        (HEADER + ROW.replace("53.1613", "nan"), ", line 8: expected a finite number, got 'nan'"),
        (
            HEADER + ROW.replace("46.779", "96.779"),
            ", line 8: latitude 96.7799, longitude -71.2741 deg is not on Earth",
        ),
        (HEADER + ROW.replace("53.1613", "9e30"), ", line 8: 9e30 m is too far from the Earth"),
        (HEADER + ROW.replace("/05/25", "/02/31"), ", line 8: expected a time (2022/03/14 14:47:49.000, or"),
        (HEADER + ROW.replace("17:21:01", "17:61:01"), ", line 8: expected a time"),
        (HEADER + ROW.replace("2022/05/25 17:21:01.600", "2211 604800.000"), ", line 8: expected a time"),
        ("\0" + HEADER, ": is not a text file"),
    ],
)
def test_invalid_file_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    """The message names the line and the remedy."""
    assert error_of(written(tmp_path, text)).startswith(message)


def test_baseline_without_base_is_rejected(tmp_path: Path) -> None:
    """As from a moving base: two such files have no common frame."""
    header = "%  GPST e-baseline(m) n-baseline(m) u-baseline(m) Q ns\n"
    path = written(tmp_path, header + "2022/05/25 17:21:00 1.0 2.0 3.0 1 12\n")
    assert error_of(path).startswith(": contains positions relative to a base, but no line with its position")


def test_invalid_base_is_rejected(tmp_path: Path) -> None:
    """In the header, with its line."""
    header = "% ref pos : 46.0 -71.0\n%  GPST e-baseline(m) n-baseline(m) u-baseline(m) Q ns\n"
    path = written(tmp_path, header + "2022/05/25 17:21:00 1.0 2.0 3.0 1 12\n")
    assert error_of(path) == ", line 1: expected latitude, longitude and height of the base"


def test_missing_file_is_rejected(tmp_path: Path) -> None:
    """With the reason of the operating system."""
    assert error_of(tmp_path / "rover.pos") == ": No such file or directory"
