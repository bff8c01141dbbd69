"""Report of ``tsgt compare``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tsgt.analysis.comparison_report import comparison_headline, comparison_map, comparison_sections
from tsgt.cli.desk.report import write_page
from tsgt.cli.progress import progress

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.compare import Comparison


def write_comparison_report(
    found: Sequence[Comparison], figures: Mapping[str, Any], folder: Path, reference: str
) -> None:
    """Write page, figures and numbers into a folder. Raises OutputFileError if a file cannot be written."""
    with progress("drawing") as on_progress:
        write_page(
            folder,
            f"Comparison with {reference}",
            comparison_headline(found),
            comparison_map(found),
            comparison_sections(found),
            figures,
            on_progress=on_progress,
        )
