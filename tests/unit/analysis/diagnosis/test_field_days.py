"""Simulated field days: the planted fault is named, and none on a day without."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from harness.drives.field_day import START_NS, Kind, calibrated, field_day

from tsgt.analysis.diagnosis import diagnose
from tsgt.analysis.diagnosis.target_findings import calibration_findings
from tsgt.analysis.smoothing import estimate_motion_model
from tsgt.estimation import build_observations

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.diagnosis import Finding


def findings_of(kinds: Sequence[Kind], seed: int) -> tuple[Finding, ...]:
    """Diagnose a short day."""
    recording = calibrated(field_day(kinds, seed, duration_s=120.0))
    observations, _ = build_observations(recording.parameters, recording.measurements, origin_ns=START_NS)
    motion = estimate_motion_model(observations, recording.parameters.pipeline)
    return diagnose(recording.parameters, observations, motion).findings


@pytest.mark.slow
def test_clean_day_has_no_findings() -> None:
    """Errors within the data sheets are no cause."""
    assert not findings_of([], 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed", "where"),
    [
        (Kind.TURNED_TRIPOD, 1, "station 1"),
        (Kind.PRISM, 1, "prism 2"),
        (Kind.LATENCY, 1, "station 1"),
        (Kind.LOCK_LOSS, 1, "all stations"),
        (Kind.NOISE, 1, "stations 1, 2 and 3, horizontal angle"),
        (Kind.OUTLIERS, 1, "stations 1, 2 and 3"),
    ],
)
def test_fault_is_named(kind: Kind, seed: int, where: str) -> None:
    """The only finding is the planted fault, at its place."""
    assert [(each.cause, each.where) for each in findings_of([kind], seed)] == [(kind.value, where)]


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ([], []),
        ([Kind.VERTICAL_INDEX], [("vertical_index", "station 2")]),
        ([Kind.FAR_TARGETS], [("targets", "targets 11, 12")]),
    ],
)
def test_calibration_from_targets_tells_its_faults(
    kinds: list[Kind], expected: list[tuple[str, str]]
) -> None:
    """What the targets of a day show is a finding of its recording."""
    found = calibration_findings(calibrated(field_day(kinds, 2, duration_s=20.0)).parameters)
    assert [(each.cause, each.where) for each in found] == expected
