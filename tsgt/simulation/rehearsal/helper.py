"""The helper at a tripod: aims at the target that is asked for, points at the robot again, changes batteries."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

from tsgt.simulation.instrument import Lock
from tsgt.simulation.instrument.edm import NON_PRISM_MODES

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.instrument import SimulatedTotalStation

POINTING_DELAY_S = 3.0
"""An instrument without its prism gets this time to find it by itself."""


class Helper:
    """Looks at one instrument again and again.

    Parameters
    ----------
    folder
        Holds the files of `calibrate collect`, which show what it asks for.
    targets
        Number of targets.
    """

    def __init__(
        self, instrument: SimulatedTotalStation, station: int, prism: int, folder: Path, targets: int
    ) -> None:
        self._instrument, self._station, self._prism = instrument, station, prism
        self._folder, self._count = folder, targets
        self._told: int | None = None
        self._aimed: int | None = None
        self._begun = 0  # distances before the instrument was set to targets
        self._lost_since_s: float | None = None

    def aim(self, target: int) -> None:
        """Aim at this target next."""
        self._told = target

    def look(self, now_s: float) -> None:
        """Do what has to be done now."""
        instrument = self._instrument
        if instrument.settings.edm_mode not in NON_PRISM_MODES:
            self._aimed, self._told = None, None
            self._point_at_robot(now_s)
            return
        if self._aimed is None:
            self._begun = len(instrument.reported_distances)
        target = self._told or self._asked()
        if target != self._aimed:
            instrument.aim_at_target(target)
            self._aimed = target

    def _asked(self) -> int:
        """Return the first target that the newest file lacks; in a check of all, the next one after each measurement."""
        files = sorted(self._folder.glob("*.csv"), key=lambda path: path.stat().st_mtime_ns)
        measured: set[int] = set()
        if files:
            with files[-1].open(newline="") as file:
                rows = csv.DictReader(line for line in file if not line.startswith("#"))
                measured = {int(row["target"]) for row in rows if row["station"] == str(self._station)}
        missing = [target for target in range(1, self._count + 1) if target not in measured]
        if missing:
            return missing[0]
        return min(len(self._instrument.reported_distances) - self._begun + 1, self._count)

    def _point_at_robot(self, now_s: float) -> None:
        instrument = self._instrument
        if not instrument.on or instrument.blocked:
            self._lost_since_s = None
            return
        instrument.advance()
        if instrument.telescope.lock is Lock.IN:
            self._lost_since_s = None
        elif self._lost_since_s is None:
            self._lost_since_s = now_s
        elif now_s - self._lost_since_s > POINTING_DELAY_S:
            instrument.lock_manually(self._prism)
            self._lost_since_s = None
