"""The list of conformance points in docs/explanation/simulated-radio.md and the tests themselves agree."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "explanation" / "simulated-radio.md"
POINTS = range(1, 21)


def test_each_conformance_point_has_a_test() -> None:
    """All twenty points stand in the table, with the prefix that belongs to the point."""
    listed = {(int(point), int(prefix)) for point, prefix, _ in _rows()}
    assert listed == {(point, point) for point in POINTS}


def test_the_table_names_the_tests_that_exist() -> None:
    """Each row leads to tests, and no conformance test is left out."""
    existing = {
        (int(number), str(path.relative_to(ROOT)))
        for path in (ROOT / "tests").rglob("test_*.py")
        for number in re.findall(
            r"^(?:async )?def test_conformance_(\d+)_\w+\(", path.read_text(), re.MULTILINE
        )
    }
    assert {(int(point), path) for point, _, path in _rows()} == existing


def _rows() -> list[tuple[str, str, str]]:
    return re.findall(
        r"^\| (\d+) \|.*\| `test_conformance_(\d+)_` \| `(\S+)` \|$", PAGE.read_text(), re.MULTILINE
    )
