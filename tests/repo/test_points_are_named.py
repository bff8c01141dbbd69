"""Every figure of a position in the documentation names its point: a rotation error moves each point differently."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

# A key such as `position_rms_mm`: an error, a sigma or a limit of a position.
KEY = re.compile(r"`[a-z_.<>]*position(?:_[a-z]+)*_(?:rms|sigma|mean|max|std|norm|limit)[a-z_]*`")
RMS = re.compile(r"\brms\b.*\d ?mm\b|\d ?mm\b.*\brms\b", re.DOTALL)
POINT = re.compile(r"reference point|centroid|origin|`--point`")
OTHER = re.compile(r"target|tracks|inter-prism|between (the )?prisms")  # not errors of a pose


def blocks(page: Path) -> list[str]:
    """Paragraphs and tables; of a table of keys each row."""
    found: list[str] = []
    for block in re.split(r"\n\s*\n", page.read_text(encoding="utf-8")):
        rows = block.startswith(("| key", "| field"))
        found += block.splitlines() if rows else [block]
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_figures_of_positions_name_their_point(page: Path) -> None:
    """Keys of errors and sigmas, and rms errors in mm."""
    unnamed = [
        block
        for block in blocks(page)
        if (KEY.search(block) or (RMS.search(block) and not OTHER.search(block))) and not POINT.search(block)
    ]
    assert unnamed == []


@pytest.mark.parametrize(
    "text",
    [
        "| `position_rms_mm` | mm | root mean square of the position error |",
        "Ours has 1.5 mm and 0.16 degrees rms.",
        "`predicted_position_sigma_limit_mm` limits the sigma.",
    ],
)
def test_a_figure_without_its_point_is_found(text: str) -> None:
    """The scan can fail."""
    assert KEY.search(text) or RMS.search(text)
    assert not POINT.search(text)
