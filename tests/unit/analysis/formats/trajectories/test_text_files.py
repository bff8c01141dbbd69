"""Estimates from text files: round trips bit for bit, columns by name and by number, what is repaired and what is refused."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.pose_files import START_NS, Poses, seconds, write_euroc, write_kitti, write_tum

from tsgt.analysis.formats.trajectories import read_estimates
from tsgt.errors import InputFileError

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.compare import Estimate

POSES = Poses()


def check_equal(found: Estimate, poses: Poses = POSES, tolerance: float = 1e-15) -> None:
    """Stamps and positions bit for bit, quaternions to their normalisation."""
    np.testing.assert_array_equal(found.stamp_ns, poses.stamp_ns)
    np.testing.assert_array_equal(found.position_m, poses.position_m)
    assert found.orientation_xyzw is not None
    same = np.abs((found.orientation_xyzw * poses.orientation_xyzw).sum(axis=1))
    np.testing.assert_allclose(same, 1.0, atol=tolerance)


def read(path: Path, text: str | None = None) -> Estimate:
    """Read the only estimate of a file, which is written first."""
    if text is not None:
        path.write_text(text)
    (found,) = read_estimates(path)
    return found


def test_tum_round_trips(tmp_path: Path) -> None:
    """Times to the nanosecond; the name is that of the file."""
    found = read(write_tum(tmp_path / "slam.txt", POSES))
    check_equal(found)
    assert found.name == "slam"
    assert found.notes == ()
    assert found.covariance is None


def test_euroc_round_trips(tmp_path: Path) -> None:
    """Nanoseconds, and quaternions with w first."""
    found = read(write_euroc(tmp_path / "data.csv", POSES))
    check_equal(found)


def test_euroc_order_without_header(tmp_path: Path) -> None:
    """What VINS-Mono writes: nanoseconds, w first, velocity, a comma at the end."""
    lines = [
        ",".join([str(t), *map(repr, (*p, q[3], *q[:3])), "0.1", "0.2", "0.3"]) + ",\n"
        for t, p, q in POSES.rows()
    ]
    found = read(tmp_path / "vins.csv", "".join(lines))
    check_equal(found)
    assert found.notes == ("times are nanoseconds, by their size",)


def test_kitti_round_trips(tmp_path: Path) -> None:
    """With the times beside it, under either name."""
    for times in ("times.txt", "00_times.txt"):
        folder = tmp_path / times
        folder.mkdir()
        check_equal(read(write_kitti(folder / "00.txt", POSES, folder / times)), tolerance=1e-14)


def test_kitti_without_times_names_the_files(tmp_path: Path) -> None:
    """KITTI's poses have no times of their own."""
    path = write_kitti(tmp_path / "00.txt", POSES, tmp_path / "elsewhere.txt")
    with pytest.raises(InputFileError, match=r"no file of their times beside it: 00_times\.txt"):
        read(path)
    (found,) = read_estimates(path, times=tmp_path / "elsewhere.txt")
    check_equal(found, tolerance=1e-14)


@pytest.mark.parametrize(
    "names",
    [
        "timestamp,tx,ty,tz,qx,qy,qz,qw",
        "time_s,position_x,position_y,position_z,orientation_x,orientation_y,orientation_z,orientation_w",
        "Stamp [s];X;Y;Z;q_x;q_y;q_z;q_w",
        "header.stamp,position.x,position.y,position.z,orientation.x,orientation.y,orientation.z,orientation.w",
        "/o/header/stamp,/o/position/x,/o/position/y,/o/position/z,/o/orientation/x,/o/orientation/y,/o/orientation/z,/o/orientation/w",
        "info,t,x,y,z,qx,qy,qz,qw",
        "t x y z qx qy qz qw",
    ],
)
def test_csv_columns_by_name(tmp_path: Path, names: str) -> None:
    """Column names as programs write them, with commas, semicolons or blanks."""
    separator = ";" if ";" in names else "," if "," in names else " "
    first = ["7"] if names.startswith("info") else []
    lines = [separator.join([*first, seconds(t), *map(repr, (*p, *q))]) for t, p, q in POSES.rows()]
    check_equal(read(tmp_path / "a.csv", "\n".join([names, *lines])))


def test_names_decide_the_order(tmp_path: Path) -> None:
    """Columns may come in any order; further ones are ignored, also a velocity."""
    lines = [
        ",".join([*map(repr, (q[3], *q[:3], 9.0, *p)), str(t // 10**9), str(t % 10**9)])
        for t, p, q in POSES.rows()
    ]
    names = "qw,qx,qy,qz,vx,x,y,z,sec,nanosec"
    check_equal(read(tmp_path / "a.csv", "\n".join([names, *lines])))


@pytest.mark.parametrize("further", ["", ",status", ",vx,vy,vz,status"])
def test_own_stamp_of_a_message_comes_first(tmp_path: Path, further: str) -> None:
    """As bagpy writes it: time of recording, then the stamp in two columns; 12 columns with names are not KITTI's."""
    lines = [
        ",".join(
            [
                seconds(t + 30_000_000),
                "7",
                str(t // 10**9),
                str(t % 10**9),
                *map(repr, (*p, *q)),
                *further.split(",")[1:],
            ]
        )
        for t, p, q in POSES.rows()
    ]
    pose = "pose.position.{0},pose.position.{1},pose.position.{2},pose.orientation.{0},pose.orientation.{1},pose.orientation.{2}"
    names = f"Time,header.seq,header.stamp.secs,header.stamp.nsecs,{pose.format(*'xyz')},pose.orientation.w{further}"
    check_equal(read(tmp_path / "a.csv", "\n".join([names, *lines])))


@pytest.mark.parametrize("comment", ["", "# "])
def test_twelve_named_columns_are_not_those_of_kitti(tmp_path: Path, comment: str) -> None:
    """A first line or a comment that names a pose decides, not the number of columns."""
    names = f"{comment}time,x,y,z,qx,qy,qz,qw,vx,vy,vz,status"
    lines = [",".join([seconds(t), *map(repr, (*p, *q)), "0", "0", "0", "1"]) for t, p, q in POSES.rows()]
    check_equal(read(tmp_path / "a.csv", "\n".join([names, *lines])))


@pytest.mark.parametrize(
    ("names", "named"),
    [
        ("qx,qy,qz", "qx, qy, qz"),
        ("q0,q1,q2,q3", "q0, q1, q2, q3"),
        ("q[0],q[1],q[2],q[3]", "q[0], q[1], q[2], q[3]"),
        ("qx,qy,qz,qw,imu.orientation.x", "qx, qy, qz, qw, imu.orientation.x"),
        ("Rotation_X,Rotation_Y,Rotation_Z", "Rotation_X, Rotation_Y, Rotation_Z"),
        ("q_RS_w,q_RS_x,q_RS_y", "q_RS_w, q_RS_x, q_RS_y"),
    ],
)
def test_orientation_in_part_is_refused(tmp_path: Path, names: str, named: str) -> None:
    """Without its orientation an estimate has other errors, so it is not left out silently."""
    count = len(names.split(","))
    rows = "".join(f"{t},1,2,{t}{',0.5' * count}\n" for t in range(3))
    with pytest.raises(InputFileError) as refused:
        read(tmp_path / "a.csv", f"t,x,y,z,{names}\n{rows}")
    assert f"the columns '{named}' are no whole orientation" in str(refused.value)
    assert refused.value.line == 1


@pytest.mark.parametrize("names", ["yaw", "orientation_covariance.0", "sigma_q_x,status,quality", "q"])
def test_columns_of_something_else_leave_positions_alone(tmp_path: Path, names: str) -> None:
    """What is no component of a quaternion is ignored, as any further column."""
    rows = "".join(f"{t},1,2,{t}{',0.5' * len(names.split(','))}\n" for t in range(3))
    assert read(tmp_path / "a.csv", f"t,x,y,z,{names}\n{rows}").orientation_xyzw is None


def test_positions_only(tmp_path: Path) -> None:
    """Four columns, or a quaternion that never changes."""
    rows = list(POSES.rows())
    four = read(tmp_path / "a.txt", "".join(f"{seconds(t)} {p[0]} {p[1]} {p[2]}\n" for t, p, _ in rows))
    eight = read(
        tmp_path / "b.txt", "".join(f"{seconds(t)} {p[0]} {p[1]} {p[2]} 0 0 0 1\n" for t, p, _ in rows)
    )
    for found in (four, eight):
        assert found.orientation_xyzw is None
        np.testing.assert_array_equal(found.position_m, POSES.position_m)
    assert eight.notes == ("the orientation never changes: positions alone are used",)


@pytest.mark.parametrize(("digits", "unit"), [(9, "nanoseconds"), (6, "microseconds"), (3, "milliseconds")])
@pytest.mark.parametrize("relative", [False, True])
def test_unit_of_times_by_their_size(tmp_path: Path, digits: int, unit: str, *, relative: bool) -> None:
    """Unix times cannot be mistaken; times from zero on are told by their steps, but for milliseconds."""
    start = 0 if relative else START_NS // 10 ** (9 - digits)
    step = 10**digits // 20
    text = "".join(f"{start + k * step} {k} 0 0 0 0 0.6 {0.8 + k / 1e5}\n" for k in range(4000))
    if relative and unit == "milliseconds":
        assert read(tmp_path / "a.txt", text).notes == ()
        return
    found = read(tmp_path / "a.txt", text)
    assert found.notes == (f"times are {unit}, by their size",)
    assert np.diff(found.stamp_ns).tolist() == [50_000_000] * 3999


def test_times_in_exponent_notation(tmp_path: Path) -> None:
    """As numpy's savetxt, and so evo, writes them."""
    text = "".join(f"{1.7e9 + k:.18e} {k} 0 0 0 0 0.6 {0.8 + k / 100}\n" for k in range(3))
    found = read(tmp_path / "a.txt", text)
    assert (found.stamp_ns - 1_700_000_000 * 10**9).tolist() == [0, 10**9, 2 * 10**9]


def test_unsorted_and_repeated_rows_are_repaired_with_notes(tmp_path: Path) -> None:
    """The result is that of the ordered file; the notes count what was done."""
    lines = write_tum(tmp_path / "a.txt", POSES).read_text().splitlines()
    text = "\n".join([*lines[25:], *lines[:27]])
    found = read(tmp_path / "a.txt", text)
    check_equal(found)
    assert found.notes == (
        "times ran backwards once; the poses were sorted by time",
        "2 poses with the time of another left out; the first one was kept",
    )


def test_rows_without_numbers_are_left_out_with_a_note(tmp_path: Path) -> None:
    """NaN and zero quaternions, as programs write them while tracking is lost, and positions that run away."""
    lines = write_tum(tmp_path / "a.txt", POSES).read_text().splitlines()
    lines[1] = f"{seconds(START_NS - 30)} nan nan nan nan nan nan nan"
    lines[2] = f"{seconds(START_NS - 20)} 0 0 0 0 0 0 0"
    lines[3] = f"{seconds(START_NS - 10)} 1e12 0 0 0 0 0 1"
    found = read(tmp_path / "a.txt", "\n".join(lines))
    np.testing.assert_array_equal(found.stamp_ns, POSES.stamp_ns[3:])
    assert found.notes == (
        "2 poses without numbers (NaN, empty or zero quaternion) left out",
        "1 pose farther away than 1e+08 m left out",
    )


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("", None, "holds no poses"),
        ("1 0 0 0 0 0 0 1\n", None, "fewer than two poses"),
        ("1 nan 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", None, "1 pose without numbers"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0\n", 2, "has 7 columns where the lines before have 8"),
        ("1 0 0 0 0 0 0 1\n2 0 zero 0 0 0 0 1\n", 2, "'zero' is no number"),
        ("1 0 0 0 0 0 0 1\nx 0 0 0 0 0 0 1\n", 2, "'x' is no number"),
        ("1 0 0 0 0 0 0 1\n-2 0 0 0 0 0 0 1\n", 2, "negative or beyond"),
        ("1 0 0 0 0 0 0 1\n1e999999 0 0 0 0 0 0 1\n", 2, "no number of this century"),
        ("1 0 0 0 3 4 5 6\n2 0 0 0 3 4 5 6\n", 1, "the quaternion has length 9.27"),
        ("1 2 3 4 5\n6 7 8 9 10\n", 1, "has 5 columns, which is no pose"),
        ('{"type":"recording"}\n', None, "holds JSON, as a recording does"),
        ("a,b,c\n1,2,3\n", 1, "do not name a pose; expected time, x, y, z"),
        ("t,x,y,z,qx\n1,2,3\n", 2, "has 3 columns where the header names 5"),
        ("t,x,y,z,valid\n1,2,3,4,maybe\n", 2, "valid is neither 0 nor 1"),
    ],
)
def test_refused(tmp_path: Path, text: str, line: int | None, message: str) -> None:
    """One line with the path, and the line where there is one."""
    with pytest.raises(InputFileError) as refused:
        read(tmp_path / "a.txt", text)
    assert message in str(refused.value)
    assert refused.value.line == line
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("times", "matrix", "message"),
    [
        (
            "1\n",
            "1 0 0 0 0 1 0 0 0 0 1 0",
            "has 1 lines of 1 columns; expected one time for each of the 2 poses",
        ),
        ("1\n2\n", "2 0 0 0 0 1 0 0 0 0 1 0", "line 1: holds no rotation"),
        ("1\n2\n", "0 1 0 0 1 0 0 0 0 0 1 0", "line 1: holds no rotation"),
    ],
)
def test_kitti_refused(tmp_path: Path, times: str, matrix: str, message: str) -> None:
    """Times that do not fit, a matrix that scales, one that mirrors."""
    (tmp_path / "times.txt").write_text(times)
    with pytest.raises(InputFileError, match=message):
        read(tmp_path / "00.txt", f"{matrix}\n" * 2)


def test_missing_file_is_one_line(tmp_path: Path) -> None:
    """As for every file of the user's."""
    with pytest.raises(InputFileError, match=r"none\.txt: cannot be read: No such file"):
        read(tmp_path / "none.txt")
