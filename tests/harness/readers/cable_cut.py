"""A relay on one computer, a reader on another one, and a cable between them that is cut for a while."""

from __future__ import annotations

import itertools
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from harness.readers.network import (
    FOLLOW,
    PERIOD_NS,
    ROBOT_ADDRESS,
    TSGT,
    Followed,
    Master,
    network,
)

from tsgt.radio.key_file import write_key

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(frozen=True)
class CableCut:
    """What the reader got."""

    sent: int
    """Poses that the master sent from the first to the last that arrived."""
    received: int
    repeated: int
    out_of_order: int
    told_missing: int
    """Lines of the gaps that the reader was told."""
    gaps: int
    outage_s: float
    """Longest time without an arrival."""
    stale_shown_fresh: int
    """Poses that said to be younger than half a second, and were older than a second."""


def cut_cable(folder: Path, cut_s: float, hold_s: float) -> CableCut:
    """Cut the cable for a while, and let the reader read until it has had new poses for two seconds."""
    write_key(folder / "relay.key")
    socket = folder / "poses.sock"
    relay = [
        *TSGT, "relay", "--socket", str(socket), "--key", str(folder / "relay.key"),
        "--listen", ROBOT_ADDRESS, "--hold-s", str(hold_s),
    ]  # fmt: skip
    reader = [sys.executable, "-c", FOLLOW, f"relay://{ROBOT_ADDRESS}", str(folder / "relay.key")]
    with (
        network() as pair,
        Master(socket).running(),
        pair.start(pair.robot, relay, folder, "relay"),
        pair.start(pair.reader, reader, folder, "reader") as following,
    ):
        following.wait_for_lines(40)
        pair.cable(plugged=False)
        time.sleep(cut_s)
        pair.cable(plugged=True)
        following.wait_for_lines(following.lines() + 1)
        time.sleep(2)
    found = Followed.read(following.output)
    stamps, arrived = found.stamps_ns, found.arrived_ns
    return CableCut(
        sent=(max(stamps) - min(stamps)) // PERIOD_NS + 1,
        received=len(stamps),
        repeated=len(stamps) - len(set(stamps)),
        out_of_order=sum(after <= before for before, after in itertools.pairwise(stamps)),
        told_missing=sum(lines or 0 for lines in found.gaps),
        gaps=len(found.gaps),
        outage_s=max(after - before for before, after in itertools.pairwise(arrived)) / 1e9,
        stale_shown_fresh=sum(
            age < 0.5 and at - stamp > 1_000_000_000
            for age, at, stamp in zip(found.ages_s, arrived, stamps, strict=True)
        ),
    )
