"""TODO face."""

from tsgt.analysis.merge.merge import Merged, MergedJournal, merge

__all__ = [
    "Merged",
    "MergedJournal",
    "merge",
]
