from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_log_event_is_documented() -> None:
    """The page of log events names exactly those that the program logs, each with its level."""
    logged = {
        (event, level)
        for path in (ROOT / "tsgt").rglob("*.py")
        for level, event in re.findall(r"\blog\.(debug|info|warning|error)\(\s*\"(\w+)\"", path.read_text())
    }
    page = (ROOT / "docs" / "reference" / "log-events.md").read_text()
    documented = set(re.findall(r"^\| `(\w+)` \| (\w+) \|", page, flags=re.MULTILINE))
    assert documented == logged
