"""SIGKILL while a recording is being written."""

from __future__ import annotations

import itertools
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from harness.files.records import HEADER, PARAMETERS, measurement

from tsgt.recording import RecordingWriter, load_recording, read_lines

if TYPE_CHECKING:
    from tsgt.errors import RecordingError

ROOT = Path(__file__).parents[3]
KILLS = 8

WRITE_FOR_EVER = """
import itertools, sys
from pathlib import Path
from harness.files.records import HEADER, PARAMETERS, measurement
from tsgt.recording import RecordingWriter

with RecordingWriter(Path(sys.argv[1])) as writer:
    writer.write(HEADER)
    writer.write(PARAMETERS)
    print("writing", flush=True)
    for sequence in itertools.count():
        writer.write(measurement(sequence))
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return the path of the recording."""
    return tmp_path / "r.jsonl"


def write_until_killed(path: Path, after_s: float) -> None:
    """Have another process write as fast as it can, and kill it after a while."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(p) for p in (ROOT, ROOT / "tests"))}
    with subprocess.Popen(
        [sys.executable, "-c", WRITE_FOR_EVER, str(path)], stdout=subprocess.PIPE, env=environment
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"writing\n"
        time.sleep(after_s)  # the other process runs in real time
        process.kill()


def test_kill_tears_one_line_at_most(path: Path) -> None:
    """After kills at random times every session is whole but for its last line, and the file can be continued."""
    rng = random.Random(20220314)  # noqa: S311 (moments, not secrets)
    for session in range(1, KILLS + 1):
        write_until_killed(path, rng.uniform(0.0, 0.1))
        problems: list[RecordingError] = []
        kinds = [line.type for line in read_lines(path, on_problem=problems.append)]
        assert kinds.count("recording") == kinds.count("parameters") == session
        assert len(problems) <= 1
    recording = load_recording(path)
    # Within each session no line is missing: the numbers increase by one, or restart.
    sequences = [one.sequence for one in recording.measurements]
    assert all(b in (a + 1, 0) for a, b in itertools.pairwise(sequences))
    assert sequences.count(0) <= KILLS
    assert len(sequences) > KILLS


def test_file_of_a_killed_writer_can_be_continued(path: Path) -> None:
    """The lock ends with the process; the next writer appends after the last whole line."""
    write_until_killed(path, 0.02)
    with RecordingWriter(path) as writer:
        writer.write(HEADER)
        writer.write(PARAMETERS)
        writer.write(measurement(-1))
    assert load_recording(path).measurements[-1] == measurement(-1)
