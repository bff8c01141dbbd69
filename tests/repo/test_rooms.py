"""A folder of code shows at a glance what it holds: decision 11."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAX_FILES = 15


@pytest.mark.parametrize("top", ["tsgt", "tests", "benchmarks"])
def test_rooms_have_few_files(top: str) -> None:
    """A newcomer finds the right file in a list that he can read at once."""
    rooms = {path.parent for path in (ROOT / top).rglob("*.py")}
    crowded = {
        str(room.relative_to(ROOT)): count
        for room in rooms
        if (count := len(list(room.glob("*.py")))) > MAX_FILES
    }
    assert not crowded


def test_rooms_say_what_they_do() -> None:
    """The face of a room has a docstring."""
    silent = [
        str(face.relative_to(ROOT))
        for face in (ROOT / "tsgt").rglob("__init__.py")
        if not face.read_text().startswith('"""')
    ]
    assert not silent
