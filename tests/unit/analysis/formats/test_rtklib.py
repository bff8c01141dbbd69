from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.pos_files import BASE, SECOND, Variant, write_pos

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
    """Write a file by hand."""
    path = folder / "rover.pos"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(path: Path) -> str:
    """Return what is said of a file that cannot be used, without its name."""
    with pytest.raises(InputFileError) as error:
        read_pos(path)
    return str(error.value).removeprefix(str(path))


def test_a_line_is_read_as_it_stands(tmp_path: Path) -> None:
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
def test_every_variant_says_the_same(tmp_path: Path, coordinates: str, system: str, week: bool) -> None:  # noqa: FBT001 (a parameter of the test)
    """Whatever RTKLIB was told to write: times on the named calendar, Q and satellites."""
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
def test_fields_may_be_separated_otherwise(tmp_path: Path, separator: str, velocity: bool) -> None:  # noqa: FBT001 (as above)
    """By what RTKLIB's option for it says; columns of velocity may follow."""
    variant = Variant(coordinates="sexagesimal", separator=separator, velocity=velocity)
    points = np.array([[-3.0, 4.0, 0.5]])
    found = read_pos(write_pos(tmp_path / "a.pos", [GPST_2022], points, variant))
    np.testing.assert_allclose(np.degrees(found.positions[0, :2]), [46.779436, -71.2746393], atol=1e-6)


def test_a_baseline_comes_with_its_base(tmp_path: Path) -> None:
    """East, north and up in m, and where the base stands."""
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
    """None to dead reckoning."""
    times = [GPST_2022 + k * SECOND for k in range(len(QUALITIES))]
    path = write_pos(tmp_path / "a.pos", times, np.zeros((len(times), 3)), quality=list(QUALITIES))
    assert read_pos(path).quality.tolist() == list(QUALITIES)


def test_a_backward_solution_is_turned_round(tmp_path: Path) -> None:
    """RTKLIB writes it last epoch first."""
    times = [GPST_2022 + k * SECOND for k in (2, 1, 0)]
    found = read_pos(write_pos(tmp_path / "a.pos", times, np.zeros((3, 3)), satellites=[7, 8, 9]))
    assert found.satellites.tolist() == [9, 8, 7]
    assert np.all(np.diff(found.times_ns) == SECOND)


def test_names_of_files_in_the_header_may_be_in_any_encoding(tmp_path: Path) -> None:
    """RTKPOST on Windows writes them in the computer's own."""
    path = tmp_path / "a.pos"
    path.write_bytes("% inp file  : C:\\données\\é.obs\r\n".encode("cp1252") + (HEADER + ROW).encode())
    assert len(read_pos(path).times_ns) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ": holds no positions; expected a solution file of RTKLIB"),
        (HEADER, ": holds no positions; expected a solution file of RTKLIB"),
        (ROW, ", line 1: stands before the line that names time system and columns"),
        ("$GPGGA,123519,4807.038,N\n", ", line 1: is NMEA or a status; let RTKLIB"),
        (HEADER + ROW + ROW, ", line 9: has the time of line 8; keep one of the two"),
        (
            HEADER + ROW[:80],
            ", line 8: expected 15 fields as in the header, got 8; remove the line if it was",
        ),
        (HEADER.replace("GPST    ", "TAI     ") + ROW, ", line 7: expected the time system GPST, UTC or JST"),
        (HEADER.replace("   Q  ns", "") + ROW, ", line 7: names no columns Q and ns"),
        (
            HEADER.replace("WGS84", "Tokyo") + ROW,
            ", line 6: is in the datum Tokyo; let RTKLIB write it in WGS84",
        ),
        (HEADER + ROW + HEADER.replace("GPST  ", "UTC   "), ", line 15: the columns change here"),
        (HEADER + ROW.replace("  2   5", "  8   5"), ", line 8: column Q: expected 0 to 7, got '8'"),
        (HEADER + ROW.replace("  2   5", "  2  -5"), ", line 8: column ns: expected 0 to 999, got '-5'"),
        (HEADER + ROW.replace("53.1613", "nan"), ", line 8: expected a finite number, got 'nan'"),
        (
            HEADER + ROW.replace("46.779", "96.779"),
            ", line 8: latitude 96.7799, longitude -71.2741 deg is nowhere",
        ),
        (HEADER + ROW.replace("53.1613", "9e30"), ", line 8: 9e30 m is not near the Earth"),
        (HEADER + ROW.replace("/05/25", "/02/31"), ", line 8: expected a time (2022/03/14 14:47:49.000, or"),
        (HEADER + ROW.replace("17:21:01", "17:61:01"), ", line 8: expected a time"),
        (HEADER + ROW.replace("2022/05/25 17:21:01.600", "2211 604800.000"), ", line 8: expected a time"),
        ("\0" + HEADER, ": is not a text file"),
    ],
)
def test_what_cannot_be_used_is_refused(tmp_path: Path, text: str, message: str) -> None:
    """With the line, and what to do."""
    assert refusal(written(tmp_path, text)).startswith(message)


def test_a_baseline_without_its_base_is_refused(tmp_path: Path) -> None:
    """As of a moving base: two such files have nothing in common."""
    header = "%  GPST e-baseline(m) n-baseline(m) u-baseline(m) Q ns\n"
    path = written(tmp_path, header + "2022/05/25 17:21:00 1.0 2.0 3.0 1 12\n")
    assert refusal(path).startswith(": holds positions relative to a base, and no line with its position")


def test_a_base_that_is_no_position_is_refused(tmp_path: Path) -> None:
    """In the header, with its line."""
    header = "% ref pos : 46.0 -71.0\n%  GPST e-baseline(m) n-baseline(m) u-baseline(m) Q ns\n"
    path = written(tmp_path, header + "2022/05/25 17:21:00 1.0 2.0 3.0 1 12\n")
    assert refusal(path) == ", line 1: expected latitude, longitude and height of the base"


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    """As the operating system puts it."""
    assert refusal(tmp_path / "rover.pos") == ": No such file or directory"
