"""``tsgt rehearse``: what the debriefing judges; the steps themselves are played in ``tests/process``."""

from __future__ import annotations

import asyncio
import math
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pytest
from harness.files.records import EVENT

from tsgt.cli.simulate.rehearsal_day import Day
from tsgt.cli.simulate.rehearsal_watch import Accuracy
from tsgt.cli.simulate.rehearse import INCIDENTS

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable

    from harness.files.cli import Tsgt

    from tsgt.recording import EventRecord

GOOD = Accuracy(400, 6.0, 20.0, 0.1)
NO_POSE = Accuracy(0, math.nan, math.nan, math.nan)


class _Site:
    """A site on which nothing runs."""

    def __init__(self, *_arguments: object, **_options: object) -> None:
        self.instruments: dict[int, object] = {}

    def now_s(self) -> float:
        return 0.0

    @asynccontextmanager
    async def open(self) -> AsyncGenerator[None]:
        yield

    def __getattr__(self, _name: str) -> Callable[..., None]:
        return lambda *_arguments: None  # the incidents


@dataclass
class _Watch:
    """A master that notices every incident."""

    accuracies: list[Accuracy]  # of the parts, in their order
    events: list[EventRecord] = field(default_factory=list)
    connected: bool = True
    status: None = None

    async def run(self) -> None:
        await asyncio.Event().wait()

    def event(self, *_arguments: object) -> EventRecord:
        return EVENT

    def site_s(self, _unix_ns: int) -> float:
        return 0.0

    def measuring(self, _station: int) -> bool:
        return False

    def accuracy(self, _from_s: float, _to_s: float) -> Accuracy:
        return self.accuracies.pop(0)


async def _step(_day: Day, *_text: str, watch: Callable[[], None] = lambda: None, **_options: object) -> None:
    """Take a step as done at once."""
    watch()


@pytest.mark.usefixtures("short_temporary_folder")
def test_rehearsal_that_ends_before_the_first_recording(tsgt: Tsgt, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C at once: the debriefing has nothing to tell, and nothing is shown to be right."""

    async def ended(_day: Day, _incidents: object) -> None:
        """Nothing was done."""

    monkeypatch.setattr("tsgt.cli.simulate.rehearse.Site", _Site)
    monkeypatch.setattr("tsgt.cli.simulate.rehearse.Watch", lambda *_arguments: _Watch([]))
    monkeypatch.setattr(Day, "play", ended)
    result = tsgt("rehearse", "--auto")
    assert result.code == 3, result.err
    assert result.out.endswith(", without a recording\n")


@pytest.mark.usefixtures("short_temporary_folder")
@pytest.mark.parametrize("incident", INCIDENTS)
@pytest.mark.parametrize(("drive", "code"), [(GOOD, 0), (NO_POSE, 3)])
def test_first_drive_is_judged_whatever_goes_wrong_later(
    tsgt: Tsgt, monkeypatch: pytest.MonkeyPatch, incident: str, drive: Accuracy, code: int
) -> None:
    """Exit code 3 if its poses were wrong, or if there was none."""
    watch = _Watch([drive, GOOD, GOOD])
    monkeypatch.setattr("tsgt.cli.simulate.rehearse.Site", _Site)
    monkeypatch.setattr("tsgt.cli.simulate.rehearse.Watch", lambda *_arguments: watch)
    monkeypatch.setattr(Day, "_step", _step)
    result = tsgt("rehearse", "--auto", "--incident", incident, "--json")
    assert result.code == code, result.err
    found: dict[str, Any] = result.json()
    assert next(iter(found["parts"])) == "drive"
    assert len(found["incidents"]) == 1
