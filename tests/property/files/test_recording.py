from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest
from harness.files.damage import examples
from harness.files.records import HEADER, PARAMETERS, POINT, POSE, STATUS, measurement, recording_bytes
from hypothesis import given
from hypothesis import strategies as st

from tsgt.errors import CorruptLineError, RecordingError
from tsgt.model import PointMeasurement
from tsgt.recording import RecordingWriter, decode, encode_line, load_recording, read_lines

MEASUREMENTS = [measurement(0), POINT, measurement(1)]
WHOLE = recording_bytes(measurement(0), POSE, POINT, STATUS, measurement(1))
BEGINNING = len(recording_bytes())
LINES_BEFORE = [WHOLE[:end].count(b"\n") for end in range(len(WHOLE) + 1)]


@pytest.mark.slow
@pytest.mark.parametrize("beginning", [True, False], ids=["header and parameters", "rest"])
def test_truncation_loses_one_line_at_most(tmp_path: Path, *, beginning: bool) -> None:
    """Truncation loses one line at most."""
    path = tmp_path / "r.jsonl"
    header = len(encode_line(HEADER))
    for end in range(header, BEGINNING) if beginning else range(BEGINNING, len(WHOLE) + 1):
        path.write_bytes(WHOLE[:end])
        problems: list[RecordingError] = []
        numbers = [line.number for line in read_lines(path, on_problem=problems.append)]
        assert numbers[: LINES_BEFORE[end]] == list(range(1, LINES_BEFORE[end] + 1))
        # The rest behind the last whole line: nothing, a line without its newline, or torn and reported.
        rest = WHOLE[:end].rpartition(b"\n")[2]
        assert len(numbers) - LINES_BEFORE[end] + len(problems) == bool(rest)


@pytest.mark.slow
def test_truncated_recording_can_be_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even within the header."""
    monkeypatch.setattr(os, "fsync", lambda _: None)  # thousands of them, and nobody cuts the power
    path = tmp_path / "r.jsonl"
    session = (HEADER, PARAMETERS, measurement(7))
    for end in range(len(WHOLE) + 1):
        path.write_bytes(WHOLE[:end])
        before = WHOLE[:end]
        with RecordingWriter(path) as writer:
            cut_bytes = writer.cut_bytes
            for record in session:
                writer.write(record)
        kept = before[: end - cut_bytes]
        newline = b"" if kept.endswith(b"\n") or not kept else b"\n"
        assert path.read_bytes() == kept + newline + recording_bytes(measurement(7))
        assert cut_bytes == 0 or b"\n" not in before[end - cut_bytes :]
        assert load_recording(path).measurements[-1] == measurement(7)


@examples(200)
@given(at=st.integers(0, len(WHOLE) - 2), bits=st.integers(1, 255))
def test_flipped_byte_is_detected_or_valid(at: int, bits: int) -> None:
    """An error with the line number, or another valid value."""
    spoilt = bytearray(WHOLE)
    spoilt[at] ^= bits
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.jsonl"
        path.write_bytes(spoilt)
        failure: RecordingError | None = None
        kept = len(MEASUREMENTS)
        try:
            kept = len(load_recording(path).measurements)
        except RecordingError as error:
            failure = error
    if isinstance(failure, CorruptLineError):
        assert failure.line == 1 + WHOLE[:at].count(b"\n")
    elif failure is not None:
        assert at < BEGINNING  # the header, or the type of the only parameters line
    else:
        assert kept >= len(MEASUREMENTS) - 1


@given(
    st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3),
    st.integers(0, 2**63 - 1),
)
def test_numbers_round_trip_bit_for_bit(position_m: tuple[float, float, float], stamp_ns: int) -> None:
    """Numbers round trip bit for bit."""
    point = PointMeasurement(
        station=1, prism=1, sequence=0, stamp_ns=stamp_ns, received_ns=stamp_ns, position_m=position_m
    )
    back = decode(PointMeasurement, encode_line(point))
    assert [value.hex() for value in back.position_m] == [value.hex() for value in position_m]
    assert back.stamp_ns == stamp_ns
