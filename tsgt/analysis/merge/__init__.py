"""Merging station journals into the master's recording: adds what the radio did not deliver, on the master's clock.

Comes in: a recording and journals. Goes out: ``merged`` records with timestamp, sigma and bound, and counts per journal.
``recording_index`` reads what identifies and times measurements, ``matching`` relates a station's journals to a session of
the master, ``timing`` computes times from synchronisations and beacons.
"""

from tsgt.analysis.merge.merge import Merged, MergedJournal, merge

__all__ = [
    "Merged",
    "MergedJournal",
    "merge",
]
