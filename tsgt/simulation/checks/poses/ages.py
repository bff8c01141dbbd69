"""Ages of the prisms' last measurements, as the poses state them, recomputed from the measurements."""

from __future__ import annotations

import bisect
import math
from typing import TYPE_CHECKING

from tsgt.estimation import usable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.model import Parameters
    from tsgt.simulation.mission import MasterLog

_TOLERANCE_NS = 1_000

PROMPT_NS = 1_000_000_000
"""A measurement that arrives within this time is used by every pose that follows; an older one may be outside the lag window."""


def age_failures(master_log: MasterLog, parameters: Parameters) -> Iterator[str]:
    """Yield the first valid pose that states another age of a prism's last measurement than the stream tells."""
    poses = master_log.valid_poses()
    latency_ns = {station.station: station.latency_ns for station in parameters.stations}
    columns = {prism.prism: column for column, prism in enumerate(parameters.prisms)}
    outage_limit_ns = parameters.pipeline.outage_limit_ns
    every_ns: list[list[int]] = [[] for _ in columns]
    prompt_ns: list[list[int]] = [[] for _ in columns]
    published = 0
    each = zip(
        poses.stamp_ns.tolist(),
        poses.measurements_before.tolist(),
        poses.station_age_s.tolist(),
        poses.series.tolist(),
        strict=True,
    )
    for stamp_ns, before, ages_s, series in each:
        for measurement in master_log.measurements[published:before]:
            if usable(measurement):
                column = columns[measurement.prism]
                time_ns = measurement.stamp_ns - latency_ns[measurement.station]
                bisect.insort(every_ns[column], time_ns)
                if measurement.received_ns - time_ns <= PROMPT_NS:
                    bisect.insort(prompt_ns[column], time_ns)
        published = before
        for column, age_s in enumerate(ages_s):
            newest_ns = _last(prompt_ns[column], stamp_ns)
            if newest_ns is not None and math.isnan(age_s) and stamp_ns - newest_ns > outage_limit_ns:
                continue  # a smoothed pose knows none that is older
            if math.isnan(age_s):
                stated_ns, found_ns = None, None
            else:
                stated_ns = stamp_ns - round(age_s * 1e9)
                found_ns = _last(every_ns[column], stated_ns + _TOLERANCE_NS)
            exists = stated_ns is None or (found_ns is not None and stated_ns - found_ns <= _TOLERANCE_NS)
            is_last = newest_ns is None or (stated_ns is not None and newest_ns <= stated_ns + _TOLERANCE_NS)
            if not (exists and is_last):
                expected_s = math.nan if newest_ns is None else (stamp_ns - newest_ns) / 1e9
                yield (
                    f"{series} pose at {(stamp_ns - master_log.unix_at_zero_ns) / 1e9:.3f} s: the last measurement of the "
                    f"prism in column {column} is {age_s} s old, by the stream {expected_s:.6f} s"
                )
                return


def _last(times_ns: list[int], until_ns: int) -> int | None:
    index = bisect.bisect_right(times_ns, until_ns) - 1
    return times_ns[index] if index >= 0 else None
