"""MCAP files, read back by rosbags, which shares no code with what wrote them."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.records import HEADER
from harness.scene import FRAMES, LAYOUT, START, driving, stationary_scene
from rosbags.highlevel import AnyReader

from tsgt.analysis.evaluation import Reference
from tsgt.analysis.formats import messages, write_mcap
from tsgt.errors import MissingExtraError
from tsgt.estimation import LinearEstimator, build_tracks
from tsgt.geometry import rotation_from_quaternion
from tsgt.model import StationParameters
from tsgt.recording import Recording

if TYPE_CHECKING:
    from tsgt.estimation import PoseBatch

DOCUMENT = Path(__file__).parents[4] / "docs" / "reference" / "mcap.md"

Read = dict[str, list[tuple[int, Any]]]

SCENE = stationary_scene().moving(driving)
RECORDING = Recording(
    header=HEADER,
    parameters=SCENE.parameters,
    measurements=[
        SCENE.measure(station, 0.4 * step + 0.11 * station) for step in range(10) for station in (1, 2, 3)
    ],
    end_ns=None,
)


def processed(recording: Recording) -> PoseBatch:
    """Process some seconds of a driving robot; the first epochs are invalid."""
    pipeline = LinearEstimator(recording.parameters)
    for measurement in recording.measurements:
        pipeline.add(measurement)
    return pipeline.advance(START + 3_900_000_000)


def read(path: Path) -> Read:
    """Time and message of each topic, in the order of the file's times."""
    found: Read = {}
    with AnyReader([path]) as reader:
        for connection, stamp_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp_ns, message))
    return found


def written(path: Path, recording: Recording, poses: PoseBatch, reference: Reference | None = None) -> Read:
    """Write a file and read it back."""
    with path.open("wb") as file:
        write_mcap(file, messages(recording, poses.records(), reference))
    return read(path)


def vector(message: Any) -> list[float]:
    """Return x, y, z of a point or vector, or x, y, z, w of a quaternion."""
    return [getattr(message, name) for name in ("x", "y", "z", "w") if hasattr(message, name)]


def stamp_ns(header: Any) -> int:
    """Return the time of a header."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


@pytest.fixture
def poses() -> PoseBatch:
    """Poses of the recording."""
    return processed(RECORDING)


def test_poses_come_back_exactly(tmp_path: Path, poses: PoseBatch) -> None:
    """The valid ones, with time, frame and covariance to the last bit."""
    found = written(tmp_path / "a.mcap", RECORDING, poses)["/tsgt/pose"]
    valid = poses.valid
    assert 0 < len(found) < len(poses)
    assert [at for at, _ in found] == [stamp_ns(m.header) for _, m in found] == poses.stamp_ns[valid].tolist()
    assert {m.header.frame_id for _, m in found} == {"station1"}
    assert [vector(m.pose.pose.position) for _, m in found] == poses.position_m[valid].tolist()
    assert [vector(m.pose.pose.orientation) for _, m in found] == poses.orientation_xyzw[valid].tolist()
    covariance = np.array([m.pose.covariance for _, m in found]).reshape(-1, 6, 6)
    np.testing.assert_array_equal(covariance, poses.covariance[valid])


def test_odometry_has_its_twist_in_the_robot_frame(tmp_path: Path, poses: PoseBatch) -> None:
    """As nav_msgs asks for; a robot that drives along its own x axis has a velocity along x alone."""
    found = [m for _, m in written(tmp_path / "a.mcap", RECORDING, poses)["/tsgt/odometry"]]
    valid = poses.valid
    rotation = rotation_from_quaternion(poses.orientation_xyzw[valid])
    expected = np.einsum("nji,nj->ni", rotation, poses.velocity_mps[valid])
    linear = np.array([vector(m.twist.twist.linear) for m in found])
    np.testing.assert_allclose(linear, expected, atol=1e-14)
    np.testing.assert_allclose(linear[5:-5], np.tile([0.3, 0.0, 0.0], (len(linear) - 10, 1)), atol=0.02)
    angular = [vector(m.twist.twist.angular) for m in found]
    assert angular == poses.angular_velocity_radps[valid].tolist()
    assert {(m.header.frame_id, m.child_frame_id) for m in found} == {("station1", "robot")}
    assert [vector(m.pose.pose.position) for m in found] == poses.position_m[valid].tolist()


def test_the_robot_moves_in_the_tree_of_frames(tmp_path: Path, poses: PoseBatch) -> None:
    """The transform takes the robot's coordinates to frame 1, as the pose does."""
    found = [t for _, m in written(tmp_path / "a.mcap", RECORDING, poses)["/tf"] for t in m.transforms]
    assert {(t.header.frame_id, t.child_frame_id) for t in found} == {("station1", "robot")}
    assert [stamp_ns(t.header) for t in found] == poses.stamp_ns[poses.valid].tolist()
    assert [vector(t.transform.translation) for t in found] == poses.position_m[poses.valid].tolist()
    assert [vector(t.transform.rotation) for t in found] == poses.orientation_xyzw[poses.valid].tolist()


def test_stations_and_prisms_stand_where_they_are(tmp_path: Path, poses: PoseBatch) -> None:
    """Before everything else, at its time; station 1 is the frame itself."""
    [(at, message)] = written(tmp_path / "a.mcap", RECORDING, poses)["/tf_static"]
    frames = {t.child_frame_id: t for t in message.transforms}
    assert sorted(frames) == ["prism1", "prism2", "prism3", "station2", "station3"]
    assert at == START + 110_000_000
    assert frames["prism2"].header.frame_id == "robot"
    assert vector(frames["prism2"].transform.translation) == LAYOUT[1].tolist()
    station = frames["station3"]
    assert station.header.frame_id == "station1"
    assert vector(station.transform.translation) == FRAMES[2, :3, 3].tolist()
    turned = rotation_from_quaternion(np.array(vector(station.transform.rotation)))
    np.testing.assert_allclose(turned, FRAMES[2, :3, :3], atol=1e-15)


def test_a_late_subscriber_gets_the_fixed_frames(tmp_path: Path, poses: PoseBatch) -> None:
    """A player offers them reliable and transient local; without that tf2 would refuse the topic."""
    path = tmp_path / "a.mcap"
    written(path, RECORDING, poses)
    with AnyReader([path]) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}  # type: ignore[union-attr]
    [profile] = offered.pop("/tf_static")
    assert (profile.reliability.name, profile.durability.name) == ("RELIABLE", "TRANSIENT_LOCAL")
    assert set(map(len, offered.values())) == {0}


def test_prisms_are_where_they_were_measured(tmp_path: Path, poses: PoseBatch) -> None:
    """One topic each, at the instants of the measurements, in frame 1 with all corrections."""
    late = [dataclasses.replace(s, latency_ns=20_000_000) for s in RECORDING.parameters.stations]
    parameters = dataclasses.replace(RECORDING.parameters, stations=tuple(late))
    recording = dataclasses.replace(RECORDING, parameters=parameters)
    found = written(tmp_path / "a.mcap", recording, poses)
    for prism, track in build_tracks(parameters, recording.measurements).items():
        points = found[f"/tsgt/prism{prism}"]
        assert [at for at, _ in points] == [stamp_ns(m.header) for _, m in points] == track.times_ns.tolist()
        assert [vector(m.point) for _, m in points] == track.points_m.tolist()
        assert {m.header.frame_id for _, m in points} == {"station1"}
        assert points[0][0] == RECORDING.measurements[prism - 1].stamp_ns - 20_000_000


def test_stations_that_have_no_frame_are_not_put_at_one_place(tmp_path: Path, poses: PoseBatch) -> None:
    """Where only points were imported nobody knows where the stations stood."""
    stations = tuple(StationParameters(station=k, prism=k) for k in (1, 2, 3))
    recording = dataclasses.replace(
        RECORDING, parameters=dataclasses.replace(RECORDING.parameters, stations=stations), measurements=[]
    )
    found = written(tmp_path / "a.mcap", recording, poses)
    [(_, message)] = found["/tf_static"]
    assert [t.child_frame_id for t in message.transforms] == ["prism1", "prism2", "prism3"]
    assert [topic for topic in found if topic.startswith("/tsgt/prism")] == []


def test_a_reference_stands_beside_the_poses(tmp_path: Path, poses: PoseBatch) -> None:
    """On a topic of its own, exactly as it was read."""
    reference = Reference(
        np.array([START, START + 1]), np.array([[1.0, 2.0, 1 / 3], [4.0, 5.0, 6.0]]), np.eye(4)[[3, 0]]
    )
    found = written(tmp_path / "a.mcap", RECORDING, poses, reference)["/tsgt/reference"]
    assert [at for at, _ in found] == [START, START + 1]
    assert [vector(m.pose.position) for _, m in found] == reference.position_m.tolist()
    assert [vector(m.pose.orientation) for _, m in found] == reference.orientation_xyzw.tolist()


def test_messages_stand_in_the_order_of_time(poses: PoseBatch) -> None:
    """Poses and prisms mixed, so that a player need not search."""
    stamps = [message.stamp_ns for message in messages(RECORDING, poses.records())]
    assert stamps == sorted(stamps)


def test_every_topic_and_its_type_is_documented(tmp_path: Path, poses: PoseBatch) -> None:
    """In a row of docs/reference/mcap.md; of the prisms the first stands for all."""
    path = tmp_path / "a.mcap"
    written(path, RECORDING, poses, Reference(poses.stamp_ns[:1], np.zeros((1, 3)), np.eye(4)[[3]]))
    with AnyReader([path]) as reader:
        topics = {c.topic: c.msgtype for c in reader.connections}
    assert set(topics) >= {"/tsgt/pose", "/tsgt/reference", "/tsgt/prism1", "/tf_static"}
    rows = DOCUMENT.read_text(encoding="utf-8").splitlines()
    for topic in set(topics) - {"/tsgt/prism2", "/tsgt/prism3"}:
        assert [row for row in rows if row.startswith(f"| `{topic}`") and f"`{topics[topic]}`" in row], topic


def test_nothing_makes_an_empty_file(tmp_path: Path, poses: PoseBatch) -> None:
    """No valid pose and no measurement: a file that opens, with nothing in it."""
    nothing = poses.__class__.blank(poses.stamp_ns[:0], poses.prisms)
    recording = dataclasses.replace(RECORDING, measurements=[])
    assert written(tmp_path / "a.mcap", recording, nothing) == {}


def test_without_the_library_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one line, before anything is computed."""
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with (tmp_path / "a.mcap").open("wb") as file, pytest.raises(MissingExtraError, match=r"tsgt\[mcap\]"):
        write_mcap(file, (pytest.fail("computed") for _ in range(1)))
