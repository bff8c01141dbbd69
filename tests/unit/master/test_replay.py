"""Replay: order, output, and errors of unsuitable recordings."""

from __future__ import annotations

import asyncio
import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from harness.drives.scene import START, stationary_scene
from harness.files.records import EVENT, HEADER, PARAMETERS, measurement, recording_bytes

from tsgt.errors import CorruptLineError, RecordingError
from tsgt.estimation import LiveEstimator
from tsgt.master.replay import greeting, replay, replayed
from tsgt.master.stream_server import StreamServer
from tsgt.recording import RecordingWriter, SetupGeofence, SetupRecord, ValidityLimits, encode_line
from tsgt.simulation.kernel import VirtualClock

if TYPE_CHECKING:
    from pathlib import Path

    from harness.drives.scene import Scene

SCENE = stationary_scene()
FENCE = SetupGeofence(
    name="site", allowed_side="inside", polygon_m=((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)), margin_m=0.5
)
SETUP = encode_line(SetupRecord.of(SCENE.parameters, START, protocol="superframe", geofences=[FENCE]))


def live_lines(path: Path, seconds: int = 3, *, scene: Scene = SCENE) -> list[bytes]:
    """Record a short live run, as a master does; return the lines that its readers got."""
    feed = LiveEstimator(scene.parameters)
    lines = [encode_line(SetupRecord.of(scene.parameters, START, protocol="superframe", geofences=[FENCE]))]
    for step in range(seconds * 10):
        for station in (1, 2, 3):
            lines += map(encode_line, feed.measurement(scene.measure(station, step / 10)))
    event = replace(EVENT, stamp_ns=START + seconds * 1_000_000_000 + 5_000_000_000)
    lines += [*map(encode_line, feed.advance(event.stamp_ns)), encode_line(event)]
    with RecordingWriter(path) as writer:
        for line in (encode_line(HEADER), encode_line(scene.parameters), *lines):
            writer.write_line(line)
    return lines


def replayed_lines(path: Path) -> list[bytes]:
    """All lines of a replay."""
    return [line for _, lines in replayed(path) for line in lines]


def test_replay_equals_the_stream(tmp_path: Path) -> None:
    """Poses, measurements and events, bit for bit."""
    path = tmp_path / "run.jsonl"
    lines = live_lines(path)
    assert len(lines) > 100
    assert replayed_lines(path) == lines


def test_replay_recomputes_poses(tmp_path: Path) -> None:
    """Without its pose lines a recording gives the same stream."""
    path = tmp_path / "run.jsonl"
    lines = live_lines(path)
    kept = [line for line in path.read_bytes().splitlines(keepends=True) if b'"type":"pose"' not in line]
    path.write_bytes(b"".join(kept))
    assert replayed_lines(path) == lines


def test_poses_of_the_timer_are_replayed(tmp_path: Path) -> None:
    """When the stations are silent, poses continue until the master is killed; the replay includes them."""
    path = tmp_path / "run.jsonl"
    feed = LiveEstimator(SCENE.parameters)
    records = [
        r for step in range(5) for s in (1, 2, 3) for r in feed.measurement(SCENE.measure(s, step / 10))
    ]
    for _ in range(7):
        deadline_ns = feed.next_deadline_ns()
        assert deadline_ns is not None
        records += feed.advance(deadline_ns)
    with RecordingWriter(path) as writer:
        for line in (encode_line(HEADER), encode_line(SCENE.parameters), SETUP, *map(encode_line, records)):
            writer.write_line(line)
    assert replayed_lines(path) == [SETUP, *map(encode_line, records)]


def test_unknown_keys_are_replayed(tmp_path: Path) -> None:
    """A measurement is published as in the file."""
    path = tmp_path / "run.jsonl"
    line = encode_line(SCENE.measure(1, 0.0))[:-1] + b',"temperature_degC":-12.5}'
    with RecordingWriter(path) as writer:
        writer.write(HEADER)
        writer.write(SCENE.parameters)
        writer.write_line(SETUP)
        writer.write_line(line)
    assert replayed_lines(path) == [SETUP, line]


def test_each_session_starts_with_a_new_estimator(tmp_path: Path) -> None:
    """As in a master that was restarted on the same file."""
    path = tmp_path / "run.jsonl"
    lines = live_lines(path)
    assert live_lines(path) == lines
    assert replayed_lines(path) == lines + lines


def test_recording_without_setup_gets_that_of_its_parameters(tmp_path: Path) -> None:
    """Those of older versions, and imports; in force since the first arrival."""
    path = tmp_path / "run.jsonl"
    first = SCENE.measure(1, 0.0)
    with RecordingWriter(path) as writer:
        for record in (HEADER, SCENE.parameters, first):
            writer.write(record)
    setup = SetupRecord.of(SCENE.parameters, first.received_ns)
    assert replayed_lines(path) == [encode_line(setup), encode_line(first)]


def test_measurement_before_parameters_is_an_error(tmp_path: Path) -> None:
    """Measurement before parameters is an error."""
    path = tmp_path / "run.jsonl"
    with RecordingWriter(path) as writer:
        writer.write(HEADER)
        writer.write(SCENE.measure(1, 0.0))
    with pytest.raises(RecordingError, match="line 2: a line of type measurement precedes all parameters"):
        replayed_lines(path)


def test_invalid_line_stops_the_replay_unless_skipped(tmp_path: Path) -> None:
    """An error with its number, or reported and skipped."""
    path = tmp_path / "run.jsonl"
    lines = live_lines(path)
    with path.open("ab") as file:
        file.write(b'{"type":"measurement","station":"one"}\n')
    with pytest.raises(CorruptLineError, match="station"):
        replayed_lines(path)
    problems: list[RecordingError] = []
    again = [line for _, some in replayed(path, keep_going=True, on_problem=problems.append) for line in some]
    assert again == lines
    assert len(problems) == 1


@pytest.mark.parametrize(("speed", "lasts_s"), [(1.0, 8.0), (4.0, 2.0), (float("inf"), 0.0)])
async def test_speed_changes_the_pace_only(tmp_path: Path, speed: float, lasts_s: float) -> None:
    """The lines are the same at any speed."""
    path, clock = tmp_path / "run.jsonl", VirtualClock(0)
    lines = live_lines(path)
    began_ns = clock.monotonic_ns()
    async with StreamServer(tmp_path / "poses.sock", b"{}") as server:
        reader, writer = await asyncio.open_unix_connection(tmp_path / "poses.sock")
        await server.wait_for_reader()
        published = await replay(replayed(path), server, clock, speed=speed)
        ended_ns = clock.monotonic_ns()
    received = (await reader.read()).splitlines()
    writer.close()
    assert received[1:] == lines
    assert published == len(lines)
    assert (ended_ns - began_ns) / 1e9 == pytest.approx(lasts_s, abs=0.2)


@pytest.mark.slow
async def test_reader_tells_the_delays_apart(tmp_path: Path) -> None:
    """Each epoch has one pose of each series, and each arrives when its delay has passed, before the next prediction."""
    path = tmp_path / "run.jsonl"
    delays_ns = {0.2: 200_000_000, 1.0: 1_000_000_000}
    scene = SCENE.with_limits(estimator="continuous", smoothed_delays_ns=tuple(delays_ns.values()))
    live_lines(path, scene=scene)
    async with StreamServer(tmp_path / "poses.sock", b"{}") as server:
        reader, writer = await asyncio.open_unix_connection(tmp_path / "poses.sock")
        await server.wait_for_reader()
        reading = asyncio.create_task(reader.read())
        await replay(replayed(path), server, VirtualClock(0), speed=math.inf)
        await server.finish()
    poses = [json.loads(line) for line in (await reading).splitlines() if b'"type":"pose"' in line]
    writer.close()
    # A final pose has no key: its line is that of a stream without delays.
    series = {(pose["kind"], pose.get("delay_s")) for pose in poses}
    assert series == {("predicted", None), ("smoothed", None), ("smoothed", 0.2), ("smoothed", 1.0)}
    waiting: list[dict[str, Any]] = []
    seen = set()
    for pose in poses:
        assert (pose["kind"], pose.get("delay_s"), pose["stamp_ns"]) not in seen
        seen.add((pose["kind"], pose.get("delay_s"), pose["stamp_ns"]))
        if pose["kind"] == "predicted":
            for each in waiting:
                assert pose["stamp_ns"] - each["stamp_ns"] == delays_ns[each["delay_s"]]
            waiting = []
        elif "delay_s" in pose:
            waiting.append(pose)


def test_greeting_has_the_limits_of_the_first_session(tmp_path: Path) -> None:
    """A replay promises what the recorded stream promised."""
    path = tmp_path / "r.jsonl"
    path.write_bytes(recording_bytes(measurement(0)))
    assert greeting(path).limits == ValidityLimits.of(PARAMETERS)
