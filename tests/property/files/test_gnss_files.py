"""The reader of RTKLIB files: valid files are read exactly, all others are rejected in one line."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from harness.files.pos_files import SECOND, Variant, write_pos
from hypothesis import given
from hypothesis import strategies as st

from tsgt.analysis.formats import read_pos
from tsgt.analysis.gnss import receivers
from tsgt.errors import InputFileError

FIRST = 1_483_228_800  # 2017-01-01, from when on GPS is 18 s ahead of UTC
LAST = 4_000_000_000

variants = st.builds(
    Variant,
    coordinates=st.sampled_from(["geodetic", "sexagesimal", "ecef", "baseline"]),
    system=st.sampled_from(["GPST", "UTC", "JST"]),
    week=st.booleans(),
    separator=st.sampled_from([" ", ",", "\t", ";"]),
    velocity=st.booleans(),
    decimals=st.integers(0, 9),
)
metres = st.floats(-5e3, 5e3).map(lambda value: round(value, 4))
rows = st.lists(
    st.tuples(
        st.integers(FIRST, LAST), st.tuples(metres, metres, metres), st.integers(1, 7), st.integers(0, 60)
    ),
    min_size=1,
    max_size=8,
    unique_by=lambda row: row[0],
)


@given(variants, rows)
def test_written_files_are_read_exactly(
    variant: Variant, written: list[tuple[int, tuple[float, ...], int, int]]
) -> None:
    """Times exactly, positions to the last digit of each format, in any order of time."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_pos(
            Path(folder) / "rover.pos",
            [second * SECOND for second, *_ in written],
            np.array([place for _, place, *_ in written]),
            variant,
            quality=[quality for *_, quality, _ in written],
            satellites=[satellites for *_, satellites in written],
        )
        file = read_pos(path)
        (found,) = receivers([file])
    expected = sorted(written)
    assert found.times_ns.tolist() == [second * SECOND for second, *_ in expected]
    assert found.quality.tolist() == [quality for *_, quality, _ in expected]
    assert found.satellites.tolist() == [satellites for *_, satellites in expected]
    places = np.array([place for _, place, *_ in expected])
    apart_m = np.linalg.norm(found.points_m[1:] - found.points_m[0], axis=1)
    np.testing.assert_allclose(apart_m, np.linalg.norm(places[1:] - places[0], axis=1), atol=5e-4)


@given(
    variants,
    st.integers(0, 1500),
    st.integers(0, 30),
    st.text(st.sampled_from("0123456789.-/:, %\n\teE+abQ'\"é\u0660"), max_size=30),
)
@pytest.mark.slow
def test_damaged_file_is_read_or_rejected(variant: Variant, start: int, length: int, put_in: str) -> None:
    """A file with overwritten characters; the error names the file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rover.pos"
        times = [FIRST * SECOND + k * SECOND for k in range(3)]
        write_pos(path, times, np.array([[k, 1.0, 2.0] for k in range(3)]), variant)
        text = path.read_text(encoding="utf-8")
        path.write_text(text[:start] + put_in + text[start + length :], encoding="utf-8")
        check(path)


@given(st.binary(max_size=200), st.booleans())
def test_random_bytes_are_rejected(content: bytes, header: bool) -> None:  # noqa: FBT001 (given by hypothesis)
    """Also after a valid header."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rover.pos"
        before = "\n".join([*Variant().header(), ""]).encode() if header else b""
        path.write_bytes(before + content)
        check(path)


def check(path: Path) -> None:
    """Read a file; without an error, the numbers are finite and times increase."""
    message = ""
    try:
        (found,) = receivers([read_pos(path)])
    except InputFileError as error:
        message = str(error)
    if message:
        assert message.startswith(str(path))
        assert "\n" not in message
        return
    assert np.isfinite(found.points_m).all()
    assert (np.diff(found.times_ns) > 0).all()
