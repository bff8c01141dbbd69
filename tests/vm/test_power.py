"""Power cuts: every measurement that was acknowledged over the radio is in the recording afterwards.

Both services write to one disk with a write cache. Twenty cuts end QEMU at random instants, when the guest's memory is
lost; twenty more replay the log of all writes to a random request, of which the disk had not flushed the last ones.
"""

from __future__ import annotations

import random
import shutil
import threading
import time
from typing import TYPE_CHECKING

import pytest
from vm import write_log
from vm.acknowledgements import acknowledged
from vm.cut_disk import examine
from vm.guest import Guest

if TYPE_CHECKING:
    from pathlib import Path

    from vm.guest import State
    from vm.image import Image

CUTS = 20
PACKETS_OF_LOG = 60


def packets(report: Path, start: int = 0) -> int:
    """Return how many packets have been on the air."""
    return report.read_bytes()[start:].count(b"\n") if report.exists() else 0


def wait_for_packets(guest: Guest, report: Path, count: int, start: int = 0) -> None:
    """Wait until so many packets have been on the air."""
    while packets(report, start) < count:
        guest.check_runs()
        time.sleep(0.01)


@pytest.mark.parametrize("cut", range(CUTS))
def test_machine_ends(
    bare_image: Image,
    kvm: bool,  # noqa: FBT001 (a fixture)
    streaming: State,
    run_folder: Path,
    tmp_path: Path,
    cut: int,
) -> None:
    """What the guest's kernel had not given to the disk is lost."""
    generator = random.Random(cut)  # noqa: S311 (instants)
    with Guest(bare_image, run_folder / "cut", kvm=kvm) as guest:
        report = guest.folder / "report.log"
        report.unlink(missing_ok=True)
        guest.start(streaming)
        wait_for_packets(guest, report, generator.randint(10, 30))
        time.sleep(generator.uniform(0, 1))
        guest.kill()
    expected = acknowledged(report)
    remains = examine(guest.folder / "data.img", tmp_path / "files")
    print(f"{len(expected)} acknowledged, {len(expected - remains.recorded)} not recorded, ", end="")  # noqa: T201
    print(f"{remains.zero_bytes} zero bytes")  # noqa: T201
    assert expected
    assert expected <= remains.recorded


def test_disk_loses_its_cache(
    bare_image: Image,
    kvm: bool,  # noqa: FBT001 (a fixture)
    streaming: State,
    run_folder: Path,
    tmp_path: Path,
) -> None:
    """What the disk had not flushed is lost in any order."""
    with Guest(bare_image, run_folder / "logged", kvm=kvm) as guest:
        report, log = guest.folder / "report.log", guest.folder / "writes.log"
        report.unlink(missing_ok=True)
        guest.start(streaming, write_log=log)
        history: list[tuple[int, set[int]]] = []  # writes at most before these were acknowledged
        ended = threading.Event()

        def follow() -> None:
            while not ended.wait(0.05):
                known = acknowledged(report)
                if not history or known != history[-1][1]:
                    history.append((write_log.count(log), known))

        follower = threading.Thread(target=follow)
        follower.start()
        try:
            wait_for_packets(guest, report, PACKETS_OF_LOG)
        finally:
            ended.set()
            follower.join()
        guest.kill()
    writes = write_log.read(log)
    flushes = [number for number, write in enumerate(writes) if write.flush]
    lost, checked = [], 0
    for cut in range(CUTS):
        generator = random.Random(cut)  # noqa: S311 (instants)
        disk = tmp_path / f"{cut}.img"
        shutil.copy(streaming.folder / "data.img", disk)
        at = min(generator.choice(flushes) + generator.randint(0, 20), len(writes))
        write_log.replay(log, writes, at, disk, generator)
        expected = next((known for number, known in reversed(history) if number <= at), set())
        remains = examine(disk, tmp_path / f"{cut}")
        disk.unlink()
        checked += len(expected)
        lost += [(at, expected - remains.recorded)] if expected - remains.recorded else []
    print(f"{len(writes)} writes, {len(flushes)} flushes, {checked} acknowledged")  # noqa: T201
    assert checked
    assert not lost
