"""What is on the services' disk after a power cut."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vm.acknowledgements import SEQUENCES
from vm.image import tool_environment

from tsgt.recording import load_recording
from tsgt.recording.journal import is_unfinished_journal, load_journal

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.errors import RecordingError

REPAIRED = 1
"""Exit code of e2fsck after it has repaired what the next boot would have repaired."""


@dataclass(frozen=True, slots=True)
class Remains:
    """Low bits of the sequence numbers that are left, and the zero bytes at the ends of files."""

    recorded: set[int]
    journalled: set[int]
    zero_bytes: int


def examine(disk: Path, folder: Path) -> Remains:
    """Repair a disk as a boot does, copy its files, and read each as the programs do that work with them."""
    check = _run("e2fsck", "-fy", str(disk))
    assert check.returncode <= REPAIRED, check.stdout
    folder.mkdir()
    _run("debugfs", "-R", f"rdump / {folder}", str(disk))
    recorded: set[int] = set()
    journalled: set[int] = set()
    zero_bytes = 0
    for path in sorted(folder.glob("*.jsonl")):
        content = path.read_bytes()
        zero_bytes += len(content) - len(content.rstrip(b"\0"))
        problems: list[RecordingError] = []
        if is_unfinished_journal(path):
            continue
        if path.name.startswith("master"):
            measurements = load_recording(path, on_problem=problems.append).measurements
            recorded.update(m.sequence % SEQUENCES for m in measurements)
        else:
            journal = load_journal(path, on_problem=problems.append)
            journalled.update(m.sequence % SEQUENCES for m in journal.measurements)
        assert len(problems) <= 1, problems
    return Remains(recorded, journalled, zero_bytes)


def _run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, env=tool_environment(), capture_output=True, text=True, check=False)
