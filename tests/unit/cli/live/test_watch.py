"""``tsgt status --watch``: verdict, screen and reconnection."""

from __future__ import annotations

import socket
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import click
import numpy as np
import pytest
from harness.files.records import EVENT, HELLO, POSE, STATUS

from tsgt.cli.live.follower import RETRY_INTERVAL_S, StreamFollower
from tsgt.cli.live.pose_text import pose_block, worst_sigmas
from tsgt.cli.live.screen import layout
from tsgt.cli.live.status_text import WIDTH
from tsgt.cli.live.watch import Watch
from tsgt.model import Status
from tsgt.recording import DiskStatus, StationStatus, encode_line
from tsgt.web.mission.verdict import POSE_AGE_LIMIT_S, SILENCE_LIMIT_S

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.recording import PoseRecord, StatusRecord

STATION = StationStatus(
    id=1, measurements=5, usable=5, age_s=0.2, status=Status.OK, last_heard_s=0.1, answering=True
)
SOUND = replace(STATUS, stations=(STATION,))
LIVE = replace(POSE, kind="predicted", quality="good")


def watch_of(status: StatusRecord = SOUND, pose: PoseRecord = LIVE) -> Watch:
    """Return a watch that took a status and a pose at 100 s."""
    watch = Watch()
    for record in (HELLO, status, pose):
        watch.take(encode_line(record), 100.0)
    return watch


@pytest.mark.parametrize(
    ("status", "pose", "verdict", "cause"),
    [
        (SOUND, LIVE, "GOOD", ""),
        (SOUND, replace(LIVE, valid=False, reason="outage"), "NO POSE", "station 1 has not measured prism 1"),
        (SOUND, replace(LIVE, degraded_by=("prism_missing",)), "CARE", "has not measured prism"),
        (replace(SOUND, disk=DiskStatus(free_bytes=9, total_bytes=99)), LIVE, "CARE", "the disk is full"),
        (
            replace(SOUND, stations=(replace(STATION, status=Status.TILT),)),
            LIVE,
            "CARE",
            "station 1: not level",
        ),
        (SOUND, replace(LIVE, kind="smoothed"), "NO POSE", "no pose yet"),
    ],
)
def test_verdict_has_its_cause(status: StatusRecord, pose: PoseRecord, verdict: str, cause: str) -> None:
    """The worst first; smoothed poses are of the past."""
    found, why = watch_of(status, pose).verdict(100.1, "")
    assert found == verdict
    assert cause in why


def test_what_is_old_is_not_shown_as_present() -> None:
    """Poses that stop, a stream that stops, and a connection that is lost: no numbers stay on the screen."""
    watch = watch_of()
    assert watch.verdict(100.0 + POSE_AGE_LIMIT_S + 0.1, "")[0] == "NO POSE"
    assert watch.verdict(100.0 + SILENCE_LIMIT_S + 0.1, "")[0] == "STREAM STOPPED"
    assert watch.verdict(100.1, "the stream has ended") == ("NO CONNECTION", "the stream has ended")
    text = "\n".join("\n".join(block) for block in watch.view(100.1, "", width=40)[1])
    assert "x 1.000" in text
    assert "STATION 1" in text
    old = watch.view(100.0 + POSE_AGE_LIMIT_S + 0.1, "", width=40)[1]
    assert not any("x 1.000" in line for block in old for line in block)
    for later, problem in ((100.0 + SILENCE_LIMIT_S + 0.1, ""), (100.1, "gone")):
        assert watch.view(later, problem, width=40)[1] == []
    watch.take(encode_line(HELLO), 101.0)  # another master
    assert watch.verdict(101.1, "") == ("NO POSE", "no pose yet: no status yet")


@pytest.mark.parametrize(("width", "per_row"), [(40, 1), (79, 1), (80, 2), (200, 4)])
def test_layout_fits_the_terminal(width: int, per_row: int) -> None:
    """Blocks stand beside each other; the newest events get the rest of the screen."""
    blocks = [[click.style(f"STATION {number}", bold=True), "  line"] for number in range(4)]
    events = [f"event {number}" for number in range(50)]
    lines = layout(["GOOD"], blocks, events, width=width, height=24)
    plain = [click.unstyle(line) for line in lines]
    assert len(lines) == 24
    assert max(map(len, plain)) <= width
    assert plain[2].count("STATION") == per_row
    assert plain[-1] == "event 49"


def test_terminal_that_is_too_small_shows_the_verdict() -> None:
    """What does not fit is cut."""
    blocks = [["STATION 1", "a", "b", "c"]]
    assert layout(["GOOD"], blocks, ["event"], width=40, height=3) == ["GOOD", "", "STATION 1"]


def test_events_cannot_control_the_terminal() -> None:
    """Their text comes from outside."""
    watch = watch_of()
    watch.take(encode_line(replace(EVENT, message="\x1b[2J")), 100.0)
    assert layout([], [], list(watch.events), width=60, height=9)[-1] == "22:13:23 lines_lost: ?[2J"


@pytest.mark.parametrize("seed", range(5))
def test_worst_sigmas_are_the_largest_eigenvalues(seed: int) -> None:
    """Numpy's, in the least certain direction; also of a diagonal and of a zero covariance."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) * (0.0 if seed == 0 else 1e-3)
    if seed == 1:
        root = np.diag(rng.uniform(size=6))
    covariance = root @ root.T
    expected = [np.sqrt(np.linalg.eigvalsh(covariance[rows, rows])[-1]) for rows in (np.s_[:3], np.s_[3:])]
    assert worst_sigmas(covariance.ravel().tolist()) == pytest.approx(expected, rel=1e-9)


def test_sigmas_of_absurdly_large_covariances_do_not_overflow() -> None:
    """A line that a reader gets over the network may hold any numbers."""
    covariance = np.diag([1e200, 4e200, 1e200, 1e-300, 1e-300, 9e-300])
    assert worst_sigmas(covariance.ravel().tolist()) == pytest.approx((2e100, 3e-150), rel=1e-9)


def test_pose_block_is_narrow() -> None:
    """For the narrowest terminal."""
    for pose in (POSE, replace(POSE, kind="smoothed", delay_s=0.5, position_m=(-123.456, -234.567, -12.345))):
        assert max(len(click.unstyle(line)) for line in pose_block(pose)) <= WIDTH


def test_follower_connects_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the end of the stream, to the daemon that serves the socket then."""
    monkeypatch.setattr("tsgt.cli.live.follower.RETRY_INTERVAL_S", 0.05)
    assert RETRY_INTERVAL_S >= 0.5
    path = tmp_path / "s"
    follower = StreamFollower([tmp_path / "none", path])
    assert list(follower.lines(time.monotonic() + 0.01)) == []
    assert "No such file" in follower.problem
    for number in range(2):
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(path))
            listener.listen()
            listener.settimeout(1.0)
            time.sleep(0.06)
            assert list(follower.lines(time.monotonic() + 0.06)) == []
            assert follower.problem == ""
            connection, _ = listener.accept()
            connection.sendall(b'{"number":%d}\n' % number)
            assert next(follower.lines(time.monotonic() + 1.0)) == b'{"number":%d}\n' % number
            connection.close()
        path.unlink()
        assert list(follower.lines(time.monotonic() + 0.06)) == []
        assert follower.problem
    follower.close()
