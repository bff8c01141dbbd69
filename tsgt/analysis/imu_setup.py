"""Check of the recorded set-up of the IMU against parts of the recording, as the master does while driving."""

from __future__ import annotations

from bisect import bisect_left
from typing import TYPE_CHECKING

from tsgt.estimation import check_recorded_setup

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import ImuSamples, Measurement, Parameters

PART_NS = 50_000_000_000
MAX_PARTS = 3  # Each takes a quarter of a second of computing
MARGIN_NS = 1_000_000_000  # Samples beyond a part, whose stamps may be late


def wrong_imu_setup(
    parameters: Parameters, measurements: Sequence[Measurement], records: Sequence[ImuSamples]
) -> str:
    """Return what is wrong in the set-up of the IMU, by parts of the recording; empty if nothing is known to be."""
    ordered = sorted(measurements, key=lambda each: each.stamp_ns)
    samples = sorted(records, key=lambda each: each.stamp_ns[-1])
    if not ordered or not samples:
        return ""
    stamps_ns = [each.stamp_ns for each in ordered]
    samples_ns = [each.stamp_ns[-1] for each in samples]
    first_ns, last_ns = stamps_ns[0], max(stamps_ns[-1] - PART_NS, stamps_ns[0])
    count = min(MAX_PARTS, 1 + (last_ns - first_ns) // PART_NS)
    causes: dict[str, str] = {}
    for part in range(count):
        begin_ns = first_ns + (last_ns - first_ns) * (part + 1) // (count + 1)
        end_ns = begin_ns + PART_NS
        found = check_recorded_setup(
            parameters,
            ordered[bisect_left(stamps_ns, begin_ns) : bisect_left(stamps_ns, end_ns)],
            samples[
                bisect_left(samples_ns, begin_ns - MARGIN_NS) : bisect_left(samples_ns, end_ns + MARGIN_NS)
            ],
        )
        for finding in found.findings:
            causes.setdefault(finding.cause, finding.text)
    return "; ".join(causes.values())
