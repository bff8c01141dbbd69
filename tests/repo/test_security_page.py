"""The page on security names tests and benchmarks for what it claims: they exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = re.sub(r"\s*\n\s*", " ", (ROOT / "docs" / "explanation" / "security.md").read_text())


def test_each_named_file_exists() -> None:
    """Of tests, programs and benchmarks."""
    named = re.findall(r"`(?:python )?((?:unit|property|process|benchmarks|tsgt|configs)/[\w/.-]+)", PAGE)
    assert len(named) > 30
    roots = (ROOT, ROOT / "tests")
    assert [name for name in named if not any((root / name).exists() for root in roots)] == []


def test_each_named_test_exists() -> None:
    """In the file that is named with it, or else in any."""
    named = re.findall(r"`(?:([\w/]+\.py)::|\.\.::)? ?(test_\w+)`", PAGE)
    assert len(named) > 30
    every = {path: path.read_text() for path in (ROOT / "tests").rglob("test_*.py")}
    for file, test in named:
        texts = [every[ROOT / "tests" / file]] if file else every.values()
        assert any(f"def {test}(" in text for text in texts), f"{file} {test}"
