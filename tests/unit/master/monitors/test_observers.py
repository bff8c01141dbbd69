"""What the observers of the publisher cost."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from harness.drives.scene import SECOND, driving, stationary_scene

from tsgt.config import FrameWatchConfig
from tsgt.master.monitors.layout import LayoutMonitor
from tsgt.master.monitors.observers import layout_monitor

if TYPE_CHECKING:
    import pytest

    from tsgt.recording import EventRecord, PoseRecord

SCENE = stationary_scene().moving(driving).with_limits(estimator="continuous")


def test_poses_of_a_silence_are_computed_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first measurement after hours would block the master for as long as all of them take."""
    stamps_ns: list[int] = []

    def take(_monitor: LayoutMonitor, pose: PoseRecord, _now_ns: int) -> list[EventRecord]:
        stamps_ns.append(pose.stamp_ns)
        return []

    monkeypatch.setattr(LayoutMonitor, "pose", take)

    def poses_after(silence_s: float, *, ticks: bool) -> tuple[list[int], int]:
        """Return the times of all poses, and how many of them were computed at once at most."""
        stamps_ns.clear()
        observer, most = layout_monitor(FrameWatchConfig(), SCENE.parameters), 0
        for number in range(5):
            for station in (1, 2, 3):
                observer.measurement(
                    replace(SCENE.measure(station, 0.4 * number + 0.1 * station), sequence=number)
                )
        last = replace(SCENE.measure(1, 2.0 + silence_s), sequence=5)
        while ticks and (due_ns := observer.next_deadline_ns()) is not None and due_ns < last.received_ns:
            before = len(stamps_ns)
            observer.tick(due_ns)
            most = max(most, len(stamps_ns) - before)
        before = len(stamps_ns)
        observer.measurement(last)
        return list(stamps_ns), max(most, len(stamps_ns) - before)

    at_once, blocking = poses_after(60.0, ticks=False)
    meanwhile, shortly = poses_after(60.0, ticks=True)
    assert meanwhile == at_once
    assert blocking > 5 * shortly
    assert shortly <= 6 * SECOND // SCENE.parameters.pipeline.period_ns
