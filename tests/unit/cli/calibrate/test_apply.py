"""``--apply``: set-up files that a master uses, of ``tsgt calibrate targets`` and ``prisms``."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.records import PARAMETERS
from harness.files.target_files import write_master, write_targets
from harness.instruments.target_field import TargetField

from tsgt.analysis.formats import write_prism_layout, write_station_frames
from tsgt.config import load_station_calibration
from tsgt.model import SetupCovariance

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from harness.files.cli import Tsgt

LATENCY = SetupCovariance(components=("station2.x", "station2.latency"), matrix=((1e-6, 1e-9), (1e-9, 4e-8)))


@pytest.fixture
def master(tmp_path: Path) -> Path:
    """Return a master that is calibrated, with latencies of a drive, and is not running."""
    path = tmp_path / "master.toml"
    write_master(path)
    latencies_ms = {1: 0.0, 2: 30.0, 3: 0.0}
    frames = {number: np.eye(4) for number in latencies_ms}
    write_station_frames(
        tmp_path / "frames.toml",
        frames,
        {},
        comment="by a test",
        latencies_ms=latencies_ms,
        covariance=LATENCY,
    )
    positions_m = {each.prism: np.array(each.position_m) for each in PARAMETERS.prisms}
    sigmas_m = dict.fromkeys(positions_m, np.full(3, 0.001))
    write_prism_layout(tmp_path / "layout.toml", positions_m, sigmas_m, comment="by a test")
    return path


@pytest.fixture
def private() -> Iterator[None]:
    """Create files that other users cannot read."""
    before = os.umask(0o077)
    yield
    os.umask(before)


def targets(folder: Path, stations: int = 3) -> Path:
    """Measure targets with the first stations."""
    return write_targets(TargetField(rng=np.random.default_rng(2), stations=stations), folder)


def apply(tsgt: Tsgt, file: Path, master: Path) -> tuple[int, str]:
    """Apply targets; return the exit code and the messages."""
    done = tsgt("calibrate", "targets", file, "--target-constant-mm", 0, "--apply", master)
    return done.code, done.err


def test_set_up_that_the_master_could_not_use_replaces_none(tsgt: Tsgt, tmp_path: Path, master: Path) -> None:
    """Station 3 has not measured: the file before stays, and no other is left."""
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    file = targets(tmp_path, stations=2)
    code, err = apply(tsgt, file, master)
    assert code == 1
    assert (
        "is not replaced, because the master could not use the new one: the new file: stations.3: missing"
        in err
    )
    file.unlink()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_set_up_file_of_an_unusable_set_up_is_written(tsgt: Tsgt, tmp_path: Path, master: Path) -> None:
    """Before the first calibration, or where the other file is wrong: the files come one after the other."""
    for damage in ("", None):
        (tmp_path / "layout.toml").unlink()
        if damage is not None:
            (tmp_path / "layout.toml").write_text(damage, encoding="utf-8")
        (tmp_path / "frames.toml").unlink()
        code, err = apply(tsgt, targets(tmp_path), master)
        assert (tmp_path / "frames.toml").exists(), err
        assert code == (0 if damage is None else 1)


def test_latencies_of_the_set_up_before_are_kept(tsgt: Tsgt, tmp_path: Path, master: Path) -> None:
    """A drive told them, with their sigma; targets tell nothing of them."""
    code, err = apply(tsgt, targets(tmp_path), master)
    assert code == 0, err
    assert "keeps the latency of station 2, 30 ms, which targets do not tell" in err
    found = load_station_calibration(tmp_path / "frames.toml")
    assert [found.stations[number].latency_ns for number in (1, 2, 3)] == [0, 30_000_000, 0]
    assert found.covariance is not None
    row = found.covariance.components.index("station2.latency")
    assert [value for value in found.covariance.matrix[row] if value] == [4e-8]


@pytest.mark.usefixtures("private")
def test_master_may_read_its_file(tsgt: Tsgt, tmp_path: Path, master: Path) -> None:
    """Its user is another one: the permissions are those of the file before, or those of any configuration."""
    frames = tmp_path / "frames.toml"
    for mode, expected in ((0o640, 0o640), (None, 0o644)):
        frames.unlink() if mode is None else frames.chmod(mode)
        assert apply(tsgt, targets(tmp_path), master)[0] == 0
        assert stat.S_IMODE(frames.stat().st_mode) == expected


def test_way_on_after_a_failure_can_be_copied(tsgt: Tsgt, tmp_path: Path, master: Path) -> None:
    """It applies the file as well, and quotes its name."""
    field = TargetField(
        rng=np.random.default_rng(2), displaced={(1, 3): np.array([0.5, 0.0, 0.0])}, targets=4
    )
    file = write_targets(field, tmp_path).rename(tmp_path / "my targets.csv")
    code, err = apply(tsgt, file, master)
    assert code == 3
    assert f"tsgt calibrate targets '{file}' --weights model" in err.replace(" --target-constant-mm 0", "")
    assert f"--apply {master}" in err
    assert "--output" not in err
