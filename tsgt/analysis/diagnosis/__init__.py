"""Diagnosis: which errors of set-up, instruments and noise a recording shows, and how to repair them.

Comes in: measurements with their parameters, the motion model, held-out errors. Goes out: findings, each with cause, size and
uncertainty, confidence and repair. docs/reference/diagnosis.md defines them and shows how often they are right.
"""

from tsgt.analysis.diagnosis.diagnosis import Diagnosis, diagnose, diagnose_smoothed
from tsgt.analysis.diagnosis.finding import GEOMETRY, TARGETS, Finding
from tsgt.analysis.diagnosis.held_out_finding import HELD_OUT, Part

__all__ = [
    "GEOMETRY",
    "HELD_OUT",
    "TARGETS",
    "Diagnosis",
    "Finding",
    "Part",
    "diagnose",
    "diagnose_smoothed",
]
