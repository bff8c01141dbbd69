from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsgt.analysis.evaluation import Reference, read_tum
from tsgt.analysis.formats import tum_lines
from tsgt.errors import InputFileError
from tsgt.model import ROBOT_ORIGIN

stamps = st.lists(st.integers(0, 2**63 - 1), min_size=2, max_size=20, unique=True).map(sorted)
metres = st.floats(-1e5, 1e5)
parts = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)

numbers = (
    st.floats() | st.integers(-(10**400), 10**400) | st.sampled_from(["9e999999", "-0", "1_0", "0x1", "x"])
)
lines = st.lists(numbers, max_size=9).map(lambda words: " ".join(map(str, words)))


def read(text: str | bytes) -> Reference:
    """Read a trajectory from a file of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.tum"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return read_tum(path)


@given(stamps, st.data())
@pytest.mark.slow
def test_exported_trajectory_round_trips(stamps_ns: list[int], data: st.DataObject) -> None:
    """Times exactly, positions to the nanometre, orientations to 1e-12."""
    rows = [(data.draw(st.tuples(metres, metres, metres)), data.draw(parts)) for _ in stamps_ns]
    positions = np.array([position for position, _ in rows])
    turns = np.array([turn for _, turn in rows])
    turns /= np.linalg.norm(turns, axis=1)[:, None]
    found = read(
        "".join(tum_lines(zip(stamps_ns, positions.tolist(), turns.tolist(), strict=True), ROBOT_ORIGIN))
    )
    assert found.stamp_ns.tolist() == stamps_ns
    np.testing.assert_allclose(found.position_m, positions, rtol=0, atol=0.51e-9)
    np.testing.assert_allclose(found.orientation_xyzw, turns, rtol=0, atol=2e-12)


@given(st.lists(lines, max_size=4).map("\n".join) | st.binary(max_size=80))
def test_any_input_is_a_trajectory_or_a_tsgt_error(text: str | bytes) -> None:
    """Any input is a trajectory or a tsgt error."""
    try:
        found = read(text)
    except InputFileError:
        return
    assert np.all(np.diff(found.stamp_ns) > 0)
    assert np.isfinite(found.position_m).all()
    np.testing.assert_allclose(np.linalg.norm(found.orientation_xyzw, axis=1), 1.0, atol=1e-12)
