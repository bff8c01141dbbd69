"""Print poses with their age, from the robot's socket or from a relay on another computer.

Usage: ``python follow_poses.py [/run/tsgt/poses.sock | relay://HOST KEY_FILE]``. docs/reference/client.md describes ``tsgt.client``.
"""

from __future__ import annotations

import sys

from tsgt.client import Event, Gap, Pose, Stream, default_max_age_s


def follow(source: str, key: str | None) -> None:
    """Print live poses, events and gaps, for ever; connections are made again when they are lost."""
    with Stream(source, key=key) as stream:
        for record in stream:
            if isinstance(record, Event):
                print(f"event: {record.message}", flush=True)
            elif isinstance(record, Gap):
                print(f"gap: {record.lines or 'some'} lines ({record.reason})", flush=True)
            elif isinstance(record, Pose) and record.kind != "smoothed":
                if not record.valid:
                    print(f"no pose: {record.reason}", flush=True)
                elif record.position_m is not None and record.age_s() <= default_max_age_s(record):
                    x, y, z = record.position_m
                    print(f"{record.stamp_ns} ns: {x:.3f} {y:.3f} {z:.3f} m", flush=True)


if __name__ == "__main__":
    follow(
        sys.argv[1] if len(sys.argv) > 1 else "/run/tsgt/poses.sock",
        sys.argv[2] if len(sys.argv) > 2 else None,
    )
