"""Check of the recorded set-up of the IMU against parts of the recording, as the master does while driving."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.estimation import MOVE_CAUSES, check_recorded_setup
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry.inertial_calibration import Cause, SetupCheck
    from tsgt.model import ImuSamples, Measurement, Parameters

PART_NS = 50_000_000_000
MAX_PARTS = 3  # Each takes a quarter of a second of computing
MARGIN_NS = 1_000_000_000  # Samples beyond a part, whose stamps may be late


@dataclass(frozen=True, slots=True)
class RecordedSetup:
    """What parts of a recording say about the set-up of the IMU."""

    wrong: str = ""  # Empty if nothing is known to be wrong
    confirmed: bool = False  # In one of the parts, at least
    has_moved: bool = False  # It was right in one part, and another shows what a move of the IMU, a tripod or a prism changes


def recorded_imu_setup(
    parameters: Parameters, measurements: Sequence[Measurement], records: Sequence[ImuSamples]
) -> RecordedSetup:
    """Compare the set-up of the IMU with parts of a recording; if it is wrong and there are three prisms, also with its beginning and end."""
    ordered = sorted(measurements, key=lambda each: each.stamp_ns)
    samples = sorted(records, key=lambda each: each.stamp_ns[-1])
    if not ordered or not samples:
        return RecordedSetup()
    stamps_ns = [each.stamp_ns for each in ordered]
    samples_ns = [each.stamp_ns[-1] for each in samples]
    first_ns, last_ns = stamps_ns[0], max(stamps_ns[-1] - PART_NS, stamps_ns[0])
    count = min(MAX_PARTS, 1 + (last_ns - first_ns) // PART_NS)

    def checked(part: int) -> SetupCheck:
        begin_ns = first_ns + (last_ns - first_ns) * part // (count + 1)
        end_ns = begin_ns + PART_NS
        return check_recorded_setup(
            parameters,
            ordered[bisect_left(stamps_ns, begin_ns) : bisect_left(stamps_ns, end_ns)],
            samples[
                bisect_left(samples_ns, begin_ns - MARGIN_NS) : bisect_left(samples_ns, end_ns + MARGIN_NS)
            ],
        )

    parts = [checked(1 + part) for part in range(count)]
    if len(parameters.prisms) >= MIN_PRISMS and any(part.findings for part in parts):
        parts += [checked(0), checked(count + 1)]
    causes: dict[Cause, str] = {}
    for finding in (finding for part in parts for finding in part.findings):
        causes.setdefault(finding.cause, finding.text)
    confirmed = any(part.confirmed for part in parts)
    return RecordedSetup(
        "; ".join(causes.values()), confirmed, confirmed and not MOVE_CAUSES.isdisjoint(causes)
    )
