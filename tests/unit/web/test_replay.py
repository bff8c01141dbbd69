from __future__ import annotations

import json
from contextlib import aclosing
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from harness.files.records import EVENT, HEADER, PARAMETERS, SETUP, START
from harness.readers.web import pose, status

from tsgt.errors import RecordingError
from tsgt.recording import SetupRecord, encode_line
from tsgt.simulation.kernel import VirtualClock
from tsgt.web.recorded import RecordingIndex, index_of
from tsgt.web.replay import ReplayMessages

if TYPE_CHECKING:
    from pathlib import Path

LENGTH_S = 60


@pytest.fixture
def index(tmp_path: Path) -> RecordingIndex:
    """Return a recording of a minute, in which the robot drives along x at 1 m/s."""
    at_half = replace(EVENT, event="station_lost", message="station 2", stamp_ns=START + 30 * 10**9)
    records: list[object] = [HEADER, PARAMETERS, replace(SETUP, stamp_ns=START)]
    for second in range(LENGTH_S + 1):
        records += [pose(second, position_m=(float(second), 5.0, 0.0)), status(second)]
        records += [at_half] if second == 30 else []
    path = tmp_path / "drive.jsonl"
    path.write_bytes(b"".join(encode_line(record) + b"\n" for record in records) + b'{"type":"pose","torn')
    return index_of(path)


async def messages(index: RecordingIndex, count: int, **query: str) -> list[dict[str, Any]]:
    """Return the first messages of a reader."""
    found: list[dict[str, Any]] = []
    async with aclosing(ReplayMessages(index, VirtualClock(0)).messages(query)) as source:
        async for data in source:
            found.append(json.loads(data))
            if len(found) == count:
                break
    return found


def x_m(message: dict[str, Any]) -> float:
    """Return where the robot is."""
    x: float = message["view"]["pose"]["at"][0]
    return x


async def test_replay_starts_where_the_reader_asks(index: RecordingIndex) -> None:
    """With the trail from before, the set-up, and the marks of the whole recording for the time bar."""
    (first,) = await messages(index, 1, at="20")
    assert x_m(first) == 20.0
    assert first["trail"]["items"][0][0] == 0.0
    assert first["replay"] == {
        "at_s": 20.0, "speed": 1.0, "length_s": 60.0, "start_ms": START // 10**6, "marks": [[30.0, "alarm"]],
    }  # fmt: skip
    assert [each["id"] for each in first["setup"]["stations"]] == [1, 2, 3]
    assert first["events"]["items"] == []


async def test_events_from_before_are_known_after_a_seek(index: RecordingIndex) -> None:
    """Of the five minutes before the place, and all that came earlier."""
    (first,) = await messages(index, 1, at="40")
    assert [each["event"] for each in first["events"]["items"]] == ["station_lost"]


async def test_replay_runs_at_the_asked_speed(index: RecordingIndex) -> None:
    """Ten messages are two seconds, which are ten at speed 5."""
    found = await messages(index, 11, at="10", speed="5")
    assert [x_m(found[0]), x_m(found[10])] == [10.0, 20.0]
    assert [found[10]["view"]["verdict"]["words"], found[10]["first"]] == ["GOOD", False]


async def test_replay_stands_while_paused(index: RecordingIndex) -> None:
    """Messages still come: the page must not think that the connection is lost."""
    found = await messages(index, 5, at="10", speed="0")
    assert {x_m(each) for each in found} == {10.0}
    assert {each["view"]["verdict"]["words"] for each in found} == {"GOOD"}


@pytest.mark.parametrize("query", [{"at": "nan"}, {"at": "-5"}, {"at": "x", "speed": "inf"}, {"speed": ""}])
async def test_nonsense_in_the_query_is_the_default(index: RecordingIndex, query: dict[str, str]) -> None:
    """From the start, at speed 1."""
    (first,) = await messages(index, 1, **query)
    assert (first["replay"]["at_s"], first["replay"]["speed"]) == (0.0, 1.0)


async def test_replay_ends_at_the_end(index: RecordingIndex) -> None:
    """And stays there; a torn last line is no problem."""
    found = await messages(index, 20, at="999", speed="50")
    assert found[-1]["replay"]["at_s"] == 60.0
    assert x_m(found[-1]) == 60.0


async def test_sessions_follow_one_another(index: RecordingIndex) -> None:
    """A second session in the file, on a clock that was set back meanwhile, comes after the first."""
    earlier = [HEADER, PARAMETERS, *(pose(second - 500) for second in range(10))]
    with index.path.open("ab") as file:
        file.write(b"\n" + b"".join(encode_line(record) + b"\n" for record in earlier))
    assert index_of(index.path).length_s == pytest.approx(60.0 + 2.0 + 9.0)


FAILED = [
    replace(EVENT, event="radio_failed", message="the radio of the master failed", stamp_ns=START + 9 * 10**9),
    replace(EVENT, event="geofence_exited", message="geofence site exited: no valid pose for 2 s", stamp_ns=START + 9 * 10**9),
]  # fmt: skip


@pytest.mark.parametrize("setup", [[], [SETUP]], ids=["old version", "with set-up"])
@pytest.mark.parametrize("at_s", ["5", "330"])
@pytest.mark.parametrize("begin_s", [3600, -60])
async def test_second_run_knows_nothing_of_the_first(
    tmp_path: Path, begin_s: int, at_s: str, setup: list[SetupRecord]
) -> None:
    """Neither its alarms nor its clock, which was set back meanwhile; whether its end is played or only read."""
    records: list[object] = []
    for start_s, length_s, events in ((0, 10, FAILED), (begin_s, 400, [])):
        own = [replace(each, stamp_ns=START + start_s * 10**9) for each in setup]
        records += [HEADER, PARAMETERS, *own]
        for second in range(start_s, start_s + length_s):
            records += [status(second), pose(second)]
        records += events
    path = tmp_path / "runs.jsonl"
    path.write_bytes(b"".join(encode_line(record) + b"\n" for record in records))
    found = await messages(index_of(path), 10, at=at_s, speed="10")
    assert found[-1]["replay"]["at_s"] == pytest.approx(float(at_s) + 18.0)
    view = found[-1]["view"]
    assert (view["verdict"]["words"], view["alarms"]) == ("GOOD", [])
    assert {each["state"] for each in view["stations"]} == {"tracking"}
    assert [each["setup"] for each in found if "setup" in each][-1]["stations"]
    told = [item["event"] for each in found for item in each["events"]["items"]]
    assert told == ["radio_failed", "geofence_exited"]


@pytest.mark.parametrize("torn", [EVENT, PARAMETERS, SETUP, pose(61)])
@pytest.mark.parametrize("end", [b"", b"\n"])
async def test_torn_last_line_is_left_out(index: RecordingIndex, torn: object, end: bytes) -> None:
    """After a power cut, whatever its type: the rest is shown, to its end."""
    whole = index.path.read_bytes().rpartition(b"\n")[0] + b"\n"
    index.path.write_bytes(whole + encode_line(torn)[:60] + end)
    (first,) = await messages(index_of(index.path), 1, at="60")
    assert x_m(first) == 60.0
    assert first["replay"]["marks"] == [[30.0, "alarm"]]
    if not end:
        assert "cannot be read" not in json.dumps(first["view"])


async def test_old_recording_has_the_set_up_of_its_parameters(tmp_path: Path) -> None:
    """It has no record `setup` yet."""
    path = tmp_path / "old.jsonl"
    path.write_bytes(b"".join(encode_line(each) + b"\n" for each in (HEADER, PARAMETERS, pose(1), status(2))))
    (first,) = await messages(index_of(path), 1)
    assert len(first["setup"]["stations"]) == 3


def test_recording_without_poses_is_refused(tmp_path: Path) -> None:
    """With the way that shows it nevertheless."""
    path = tmp_path / "imported.jsonl"
    path.write_bytes(encode_line(HEADER) + b"\n" + encode_line(PARAMETERS) + b"\n")
    with pytest.raises(RecordingError, match="tsgt replay"):
        index_of(path)
