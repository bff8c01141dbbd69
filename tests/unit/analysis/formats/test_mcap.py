"""MCAP export, decoded by rosbags and compared with goldens of an independent encoder."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.drives.scene import FRAMES, LAYOUT, START, driving, stationary_scene
from harness.files.records import HEADER
from harness.readers import foxglove_layout
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tsgt.analysis.evaluation import Reference
from tsgt.analysis.formats import mcap, messages, write_mcap
from tsgt.errors import MessageError, MissingExtraError
from tsgt.estimation import LinearEstimator, build_tracks
from tsgt.geometry import rotation_from_quaternion
from tsgt.model import Parameters, PointMeasurement, PrismPosition, StationParameters
from tsgt.recording import PoseRecord, Recording

if TYPE_CHECKING:
    from tsgt.estimation import PoseBatch

DOCUMENT = Path(__file__).parents[4] / "docs" / "reference" / "mcap.md"
GOLDENS = Path(__file__).parent / "mcap_messages.txt"
GOLDEN_NS = 1_700_000_000_000_000_000
HUMBLE = get_typestore(Stores.ROS2_HUMBLE)

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
    """Return time and message of each topic, in the order of the file's times."""
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


def test_valid_poses_are_exported_exactly(tmp_path: Path, poses: PoseBatch) -> None:
    """Valid poses, with time, frame and covariance to the last bit."""
    found = written(tmp_path / "a.mcap", RECORDING, poses)["/tsgt/pose"]
    valid = poses.valid
    assert 0 < len(found) < len(poses)
    assert [at for at, _ in found] == [stamp_ns(m.header) for _, m in found] == poses.stamp_ns[valid].tolist()
    assert {m.header.frame_id for _, m in found} == {"station1"}
    assert [vector(m.pose.pose.position) for _, m in found] == poses.position_m[valid].tolist()
    assert [vector(m.pose.pose.orientation) for _, m in found] == poses.orientation_xyzw[valid].tolist()
    covariance = np.array([m.pose.covariance for _, m in found]).reshape(-1, 6, 6)
    np.testing.assert_array_equal(covariance, poses.covariance[valid])


def test_odometry_twist_is_in_the_robot_frame(tmp_path: Path, poses: PoseBatch) -> None:
    """As nav_msgs specifies; a robot driving along its own x axis has a velocity along x only."""
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


def test_tf_contains_the_robot_pose(tmp_path: Path, poses: PoseBatch) -> None:
    """The transform converts the robot's coordinates to frame 1, as the pose does."""
    found = [t for _, m in written(tmp_path / "a.mcap", RECORDING, poses)["/tf"] for t in m.transforms]
    assert {(t.header.frame_id, t.child_frame_id) for t in found} == {("station1", "robot")}
    assert [stamp_ns(t.header) for t in found] == poses.stamp_ns[poses.valid].tolist()
    assert [vector(t.transform.translation) for t in found] == poses.position_m[poses.valid].tolist()
    assert [vector(t.transform.rotation) for t in found] == poses.orientation_xyzw[poses.valid].tolist()


def test_static_transforms_hold_stations_and_prisms(tmp_path: Path, poses: PoseBatch) -> None:
    """They precede all other messages, with the same time; station 1 is the frame itself."""
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


def test_static_transforms_are_offered_to_late_subscribers(tmp_path: Path, poses: PoseBatch) -> None:
    """Reliable and transient local, which tf2 requires."""
    path = tmp_path / "a.mcap"
    written(path, RECORDING, poses)
    with AnyReader([path]) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}  # type: ignore[union-attr]
    [profile] = offered.pop("/tf_static")
    assert (profile.reliability.name, profile.durability.name) == ("RELIABLE", "TRANSIENT_LOCAL")
    assert set(map(len, offered.values())) == {0}


def test_prism_topics_hold_the_corrected_positions(tmp_path: Path, poses: PoseBatch) -> None:
    """One topic each, at the times of the measurements, in frame 1 with all corrections."""
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


def test_stations_without_frame_have_no_transform(tmp_path: Path, poses: PoseBatch) -> None:
    """Imported points do not contain the station positions."""
    stations = tuple(StationParameters(station=k, prism=k) for k in (1, 2, 3))
    recording = dataclasses.replace(
        RECORDING, parameters=dataclasses.replace(RECORDING.parameters, stations=stations), measurements=[]
    )
    found = written(tmp_path / "a.mcap", recording, poses)
    [(_, message)] = found["/tf_static"]
    assert [t.child_frame_id for t in message.transforms] == ["prism1", "prism2", "prism3"]
    assert [topic for topic in found if topic.startswith("/tsgt/prism")] == []


def test_reference_has_its_own_topic(tmp_path: Path, poses: PoseBatch) -> None:
    """Exactly as it was read."""
    reference = Reference(
        np.array([START, START + 1]), np.array([[1.0, 2.0, 1 / 3], [4.0, 5.0, 6.0]]), np.eye(4)[[3, 0]]
    )
    found = written(tmp_path / "a.mcap", RECORDING, poses, reference)["/tsgt/reference"]
    assert [at for at, _ in found] == [START, START + 1]
    assert [vector(m.pose.position) for _, m in found] == reference.position_m.tolist()
    assert [vector(m.pose.orientation) for _, m in found] == reference.orientation_xyzw.tolist()


def test_messages_are_in_the_order_of_time(poses: PoseBatch) -> None:
    """Poses and prisms interleaved, so that a player need not sort."""
    stamps = [message.stamp_ns for message in messages(RECORDING, poses.records())]
    assert stamps == sorted(stamps)


def test_every_topic_is_documented(tmp_path: Path, poses: PoseBatch) -> None:
    """In a row of docs/reference/mcap.md, with its type; prism 1 represents all prisms."""
    path = tmp_path / "a.mcap"
    written(path, RECORDING, poses, Reference(poses.stamp_ns[:1], np.zeros((1, 3)), np.eye(4)[[3]]))
    with AnyReader([path]) as reader:
        topics = {c.topic: c.msgtype for c in reader.connections}
    assert set(topics) >= {"/tsgt/pose", "/tsgt/reference", "/tsgt/prism1", "/tf_static"}
    rows = DOCUMENT.read_text(encoding="utf-8").splitlines()
    for topic in set(topics) - {"/tsgt/prism2", "/tsgt/prism3"}:
        assert [row for row in rows if row.startswith(f"| `{topic}`") and f"`{topics[topic]}`" in row], topic


def test_layout_names_what_is_exported(tmp_path: Path, poses: PoseBatch) -> None:
    """Every topic of the layout for Foxglove is in a file, and every path leads to a number in its message."""
    reference = Reference(poses.stamp_ns[:1], np.zeros((1, 3)), np.eye(4)[[3]])
    found = written(tmp_path / "a.mcap", RECORDING, poses, reference)
    named = foxglove_layout.paths("recording.json")
    assert {foxglove_layout.topic_of(path) for path in named} == set(found) - {"/tf", "/tf_static"}
    for path in named:
        topic = foxglove_layout.topic_of(path)
        if path != topic:
            _, message = found[topic][0]
            assert np.isfinite(foxglove_layout.value_at(message, path.removeprefix(topic))), path


def test_no_data_gives_an_empty_file(tmp_path: Path, poses: PoseBatch) -> None:
    """No valid pose and no measurement: a readable file without messages."""
    nothing = poses.__class__.blank(poses.stamp_ns[:0], poses.prisms)
    recording = dataclasses.replace(RECORDING, measurements=[])
    assert written(tmp_path / "a.mcap", recording, nothing) == {}


def test_missing_mcap_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line, before any pose is computed."""
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with (tmp_path / "a.mcap").open("wb") as file, pytest.raises(MissingExtraError, match=r"tsgt\[mcap\]"):
        write_mcap(file, (pytest.fail("computed") for _ in range(1)))


def synthetic_recording() -> Recording:
    """Two stations, two prisms and one Cartesian measurement, with numbers that are exact in binary."""
    away = ((-1.0, 0.0, 0.0, 5.0), (0.0, -1.0, 0.0, -2.0), (0.0, 0.0, 1.0, 0.5), (0.0, 0.0, 0.0, 1.0))
    return Recording(
        header=HEADER,
        parameters=Parameters(
            stations=(
                StationParameters(station=1, prism=1),
                StationParameters(station=12, prism=1, T_station1_station=away),
            ),
            prisms=(
                PrismPosition(prism=1, position_m=(0.5, -0.25, 1.0)),
                PrismPosition(prism=2, position_m=(-0.5, 0.25, 1.5)),
            ),
        ),
        measurements=[
            PointMeasurement(
                station=1,
                prism=1,
                sequence=0,
                stamp_ns=GOLDEN_NS + 1,
                received_ns=GOLDEN_NS + 2,
                position_m=(1.5, -2.25, 0.125),
            )
        ],
        end_ns=None,
    )


def synthetic_pose(stamp_ns: int = GOLDEN_NS + 2) -> PoseRecord:
    """Return a valid smoothed pose with velocities and a covariance of different numbers."""
    return PoseRecord(
        stamp_ns=stamp_ns,
        valid=True,
        reason="",
        position_m=(30.5, 20.25, -1.0),
        orientation_xyzw=(0.0, 0.0, 0.6, 0.8),
        covariance=tuple(k / 8 for k in range(36)),
        velocity_mps=(0.5, -0.25, 0.125),
        angular_velocity_radps=(0.0, 0.0625, -0.5),
        residual_m=0.001,
        estimator="continuous",
        kind="smoothed",
        stations=(),
    )


def test_messages_equal_the_goldens() -> None:
    """Topics, times and CDR bytes equal those in mcap_messages.txt, which an independent encoder wrote."""
    reference = Reference(
        np.array([GOLDEN_NS + 3]), np.array([[1.0, 2.0, 4.0]]), np.array([[0.0, 0.6, 0.0, 0.8]])
    )
    encoded = messages(synthetic_recording(), [synthetic_pose()], reference)
    lines = [f"{m.topic} {m.stamp_ns - GOLDEN_NS} {m.data.hex()}" for m in encoded]
    assert lines == GOLDENS.read_text(encoding="ascii").splitlines()


names = st.text(st.characters(codec="utf-8", exclude_characters="\x00"), max_size=9)


@pytest.mark.slow
@given(st.integers(0, 2**31 * 1_000_000_000 - 1), names, names)
def test_frame_names_and_times_are_decoded_exactly(at: int, frame: str, child: str) -> None:
    """Any time before 2038, and frame names of any length between the numbers."""
    pose = dataclasses.replace(synthetic_pose(at), frame=frame, child_frame=child)
    recording = dataclasses.replace(
        synthetic_recording(),
        measurements=[],
        parameters=dataclasses.replace(synthetic_recording().parameters, stations=(), prisms=()),
    )
    decoded = {m.topic: HUMBLE.deserialize_cdr(m.data, m.type) for m in messages(recording, [pose])}
    odometry: Any = decoded["/tsgt/odometry"]
    assert (stamp_ns(odometry.header), odometry.header.frame_id, odometry.child_frame_id) == (
        at,
        frame,
        child,
    )
    assert odometry.pose.covariance.tolist() == list(pose.covariance or ())
    [transform] = decoded["/tf"].transforms  # type: ignore[attr-defined]
    assert (stamp_ns(transform.header), transform.header.frame_id, transform.child_frame_id) == (
        at,
        frame,
        child,
    )


def test_time_after_january_2038_is_rejected() -> None:
    """ROS 2 has 32-bit signed seconds; a wrapped time would be in 1901."""
    assert list(messages(synthetic_recording(), [synthetic_pose(2**31 * 1_000_000_000 - 1)]))
    with pytest.raises(MessageError, match="January 2038"):
        list(messages(synthetic_recording(), [synthetic_pose(2**31 * 1_000_000_000)]))


def test_missing_rosbags_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rosbags encodes the messages; its absence is one line."""
    mcap._typestore.cache_clear()
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(MissingExtraError, match=r"need rosbags.*tsgt\[mcap\]"):
        list(messages(synthetic_recording(), [synthetic_pose()]))


def test_schemas_are_those_of_ros_2(tmp_path: Path, poses: PoseBatch) -> None:
    """The type hash (RIHS01) of each definition in the file covers names, order and types of all fields."""
    path = tmp_path / "a.mcap"
    written(path, RECORDING, poses, Reference(poses.stamp_ns[:1], np.zeros((1, 3)), np.eye(4)[[3]]))
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.schemas) == 5
    for schema in summary.schemas.values():
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(schema.data.decode(), schema.name))
        assert store.hash_rihs01(schema.name) == HUMBLE.hash_rihs01(schema.name)
