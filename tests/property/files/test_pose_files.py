"""Any content of a file with poses gives an estimate that keeps its promises, or one line that says what is wrong."""

from __future__ import annotations

import struct
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
from harness.files.pose_files import Poses, odometry, write_bag
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin

from tsgt.analysis.formats.trajectories import read_estimates, read_reference_poses
from tsgt.analysis.formats.trajectories.cdr import LAYOUTS, decode_messages, decode_path, decode_transforms
from tsgt.errors import InputFileError, TsgtError

numbers = (
    st.floats()
    | st.integers(-(10**25), 10**25)
    | st.sampled_from(["9e999999", "-0", "1_0", "0x1", "x", "", "nan", "1,2", "1;2", "#", '"1"'])
)
separators = st.sampled_from([" ", ",", ";", ", "])
names = st.sampled_from(
    [
        "t",
        "stamp_ns",
        "time [us]",
        "sec",
        "nanosec",
        "x",
        "p_RS_R_y",
        "z",
        "qw",
        "qx",
        "qy",
        "qz",
        "valid",
        "sigma_x_m",
        "v",
    ]
)


@st.composite
def tables(draw: st.DrawFn) -> str:
    """Draw lines of numbers of equal or unequal length, perhaps under a header."""
    separator, count = draw(separators), draw(st.sampled_from([1, 4, 7, 8, 11, 12, 17]))
    lines = draw(
        st.lists(
            st.lists(numbers, min_size=count, max_size=count).map(lambda w: separator.join(map(str, w))),
            max_size=4,
        )
    )
    header = draw(st.none() | st.lists(names, min_size=count, max_size=count).map(separator.join))
    return "\n".join(lines if header is None else [draw(st.sampled_from(["", "# "])) + header, *lines])


@given(tables() | st.binary(max_size=80))
@settings(max_examples=40)
def test_any_text_is_an_estimate_or_an_error(content: str | bytes) -> None:
    """TUM, KITTI, EuRoC and CSV are told by the content."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.txt"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        (Path(folder) / "times.txt").write_text("1\n2\n3\n")
        _check(path)
        with suppress(TsgtError):
            read_reference_poses(path)


def _bags(folder: Path) -> dict[str, bytes]:
    rows = list(Poses(3).rows())
    messages = [(t, odometry(t, p, q, np.eye(6))) for t, p, q in rows]
    found = {}
    for plugin in StoragePlugin:
        bag = write_bag(folder / plugin.name, {"/odometry": messages}, plugin=plugin)
        found.update({each.suffix: each.read_bytes() for each in bag.iterdir() if each.suffix != ".yaml"})
    return found


with tempfile.TemporaryDirectory() as _folder:
    BAGS = _bags(Path(_folder))


@given(st.sampled_from(sorted(BAGS)), st.data())
@settings(max_examples=15)
def test_damaged_bag_is_an_estimate_or_an_error(suffix: str, data: st.DataObject) -> None:
    """Changed bytes, and a file that was cut off."""
    content = bytearray(BAGS[suffix])
    for at in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[at] = data.draw(st.integers(0, 255))
    end = data.draw(st.none() | st.integers(0, len(content)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"bag{suffix}"
        path.write_bytes(content[:end])
        _check(path)


@given(st.binary(max_size=200) | st.binary(max_size=200).map(b"\x00\x01\x00\x00".__add__))
def test_any_message_is_decoded_or_refused(data: bytes) -> None:
    """No count or length in a message makes the reader leave it."""
    for layout in LAYOUTS.values():
        with suppress(ValueError, struct.error, IndexError):
            decode_messages([data], layout)
    for decode in (decode_path, decode_transforms):
        with suppress(ValueError, struct.error):
            list(decode(data))


def _check(path: Path) -> None:
    try:
        (found,) = read_estimates(path)
    except InputFileError:
        return
    assert len(found.stamp_ns) >= 2
    assert np.all(np.diff(found.stamp_ns) > 0)
    assert np.isfinite(found.position_m).all()
    if found.orientation_xyzw is not None:
        np.testing.assert_allclose(np.linalg.norm(found.orientation_xyzw, axis=1), 1.0, atol=1e-12)
