from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from harness.files.records import (
    EVENT,
    HEADER,
    IMU_PARAMETERS,
    NO_POSE,
    PARAMETERS,
    POINT,
    POSE,
    SECOND,
    SETUP,
    START,
    STATUS,
    imu_samples,
    measurement,
    recording_bytes,
)

from tsgt.errors import CorruptLineError, RecordingError, RecordingVersionError
from tsgt.recording import (
    MAX_LINE_BYTES,
    MergedRecord,
    encode_line,
    load_recording,
    read_imu_samples,
    read_lines,
    replaced_line,
)

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the recording is."""
    return tmp_path / "r.jsonl"


def test_measurements_are_in_order_of_arrival(path: Path) -> None:
    """Measurements are in order of arrival."""
    path.write_bytes(recording_bytes(measurement(1), POINT, POSE, measurement(0)))
    recording = load_recording(path)
    assert recording.header == HEADER
    assert recording.parameters == PARAMETERS
    assert recording.measurements == [measurement(1), POINT, measurement(0)]


def test_merged_measurements_are_read(path: Path) -> None:
    """They follow the others and may be later than every arrival."""
    merged = MergedRecord(journal="station1.jsonl", measurement=measurement(9))
    path.write_bytes(recording_bytes(measurement(1), merged))
    recording = load_recording(path)
    assert recording.measurements == [measurement(1), measurement(9)]
    assert recording.end_ns == measurement(9).received_ns
    path.write_bytes(recording_bytes(measurement(1)) + b'{"type":"merged","journal":"station1.jsonl"}\n')
    with pytest.raises(CorruptLineError, match="line 4: cannot be used as merged"):
        load_recording(path)


@pytest.mark.parametrize(
    ("records", "end_ns"),
    [
        ([], None),
        ([NO_POSE], None),
        ([measurement(5), measurement(0)], START + 2_100_000_000),
        ([measurement(0), STATUS], START + 2 * SECOND),
        ([EVENT, measurement(0)], START + 3 * SECOND),
        ([POINT], START + SECOND),
    ],
    ids=["empty", "pose", "measurements", "status", "event", "point"],
)
def test_end_is_the_latest_arrival_status_or_event(
    path: Path, records: list[object], end_ns: int | None
) -> None:
    """Poses do not count."""
    path.write_bytes(recording_bytes(*records))
    assert load_recording(path).end_ns == end_ns


def test_last_parameters_are_in_force(path: Path) -> None:
    """Of several parameters lines the last one counts, of several headers the first."""
    later = PARAMETERS.__class__(stations=PARAMETERS.stations, prisms=PARAMETERS.prisms[:2])
    second = HEADER.__class__(software="other", created_ns=1, source="later session")
    path.write_bytes(recording_bytes(measurement(0), second, later, measurement(1)))
    recording = load_recording(path)
    assert recording.parameters == later
    assert recording.header == HEADER


def test_unknown_types_are_ignored(path: Path) -> None:
    """read_lines yields them."""
    path.write_bytes(recording_bytes(measurement(0)) + b'{"type":"weather","wind":"strong"}\n')
    assert [line.type for line in read_lines(path)] == ["recording", "parameters", "measurement", "weather"]
    assert load_recording(path).measurements == [measurement(0)]


def test_line_keeps_number_and_bytes(path: Path) -> None:
    """A line comes as it stands in the file, with its number."""
    path.write_bytes(recording_bytes(POSE))
    assert list(read_lines(path))[2] == (3, "pose", encode_line(POSE))


def test_lines_of_the_imu_are_for_those_who_ask(path: Path) -> None:
    """Other readers skip them, and lines keep their numbers."""
    path.write_bytes(recording_bytes(imu_samples(0), measurement(0), imu_samples(10)))
    assert [(line.number, line.type) for line in read_lines(path)][2:] == [(4, "measurement")]
    assert [line.type for line in read_lines(path, imu=True)][2:] == ["imu", "measurement", "imu"]
    assert list(read_imu_samples(path)) == [imu_samples(0), imu_samples(10)]


def test_poses_are_skipped_for_those_who_need_none(path: Path) -> None:
    """Other lines keep their numbers."""
    path.write_bytes(recording_bytes(POSE, measurement(0), NO_POSE))
    lines = read_lines(path, poses=False)
    assert [(line.number, line.type) for line in lines][2:] == [(4, "measurement")]


@pytest.mark.parametrize("before", [POSE, imu_samples(0)], ids=["pose", "imu"])
@pytest.mark.parametrize("kept", [None, -20], ids=["whole", "cut"])
def test_measurement_after_a_lost_line_end_is_not_skipped(
    path: Path, before: object, kept: int | None
) -> None:
    """A measurement in the same line as a pose or samples of the IMU is a problem, although neither of them is read."""
    path.write_bytes(recording_bytes() + encode_line(before)[:kept] + encode_line(measurement(0)) + b"\n")
    with pytest.raises(CorruptLineError, match="line 3"):
        load_recording(path)


def test_torn_line_of_the_imu_is_reported(path: Path) -> None:
    """Like any other torn last line."""
    path.write_bytes(recording_bytes(imu_samples(0)) + encode_line(imu_samples(10))[:100])
    problems: list[RecordingError] = []
    list(read_lines(path, on_problem=problems.append))
    assert "torn" in str(problems)


def test_corrupt_line_of_the_imu_is_skipped_when_asked(path: Path) -> None:
    """A field is missing."""
    path.write_bytes(
        recording_bytes() + b'{"type":"imu","sequence":1}\n' + encode_line(imu_samples(10)) + b"\n"
    )
    with pytest.raises(CorruptLineError, match="line 3: cannot be used as imu"):
        list(read_imu_samples(path))
    problems: list[RecordingError] = []
    assert list(read_imu_samples(path, keep_going=True, on_problem=problems.append)) == [imu_samples(10)]
    assert len(problems) == 1


def test_torn_last_line_is_reported_and_skipped(path: Path) -> None:
    """Torn last line is reported and skipped."""
    path.write_bytes(recording_bytes(measurement(0), measurement(1))[:-20])
    problems: list[RecordingError] = []
    assert load_recording(path, on_problem=problems.append).measurements == [measurement(0)]
    assert [(problem.line, "torn" in str(problem)) for problem in problems] == [(4, True)]


def test_last_line_without_newline_is_read(path: Path) -> None:
    """Last line without newline is read."""
    path.write_bytes(recording_bytes(measurement(0)).rstrip())
    problems: list[RecordingError] = []
    assert load_recording(path, on_problem=problems.append).measurements == [measurement(0)]
    assert problems == []


@pytest.mark.parametrize(
    "bad",
    [
        b"",
        b"garbage",
        b'{"type":"pose",',
        b'["pose"]',
        b'{"kind":"pose"}',
        b'{"type":5}',
        b'{"type":"weather","text":"\xff\xfe"}',
        b"\0" * 100,
        encode_line(measurement(1)).replace(b'"station":1', b'"station":"one"'),
        b'{"type":"recording","version":1}',
        b'{"type":"status"}',
    ],
    ids=[
        "blank",
        "garbage",
        "cut",
        "array",
        "no-type",
        "number-type",
        "not-utf8",
        "zeros",
        "field",
        "header",
        "no-stamp",
    ],
)
class TestCorruptLine:
    def write(self, path: Path, bad: bytes) -> None:
        """Put the corrupt line in the middle of good ones."""
        path.write_bytes(recording_bytes(measurement(0)) + bad + b"\n" + encode_line(measurement(2)) + b"\n")

    def test_is_an_error_with_its_number(self, path: Path, bad: bytes) -> None:
        """A corrupt line in the middle ends the reading with one line that names file and line number."""
        self.write(path, bad)
        with pytest.raises(CorruptLineError, match=r"^[^\n]*r\.jsonl, line 4: [^\n]+$") as raised:
            load_recording(path)
        assert raised.value.line == 4

    def test_is_skipped_when_asked(self, path: Path, bad: bytes) -> None:
        """With keep_going the line is reported and the rest is read."""
        self.write(path, bad)
        problems: list[RecordingError] = []
        recording = load_recording(path, keep_going=True, on_problem=problems.append)
        assert recording.measurements == [measurement(0), measurement(2)]
        assert [problem.line for problem in problems] == [4]


def test_overlong_line_is_one_problem(path: Path) -> None:
    """It is not kept in memory, and line numbers stay correct."""
    long = b'{"type":"' + b"x" * (2 * MAX_LINE_BYTES + 5) + b'"}\n'
    path.write_bytes(recording_bytes() + long + encode_line(POSE) + b"\n")
    problems: list[RecordingError] = []
    lines = list(read_lines(path, keep_going=True, on_problem=problems.append))
    assert [line.number for line in lines] == [1, 2, 4]
    assert ["is longer than 1048576 bytes" in str(problem) for problem in problems] == [True]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n",
        b"1.0 2.0 3.0 4.0\n",
        b"\x7fELF\0\xff\xfe",
        encode_line(POSE) + b"\n",
        b'{"type":"recording"}\n',
    ],
    ids=["empty", "blank", "text", "binary", "no-header", "half-header"],
)
def test_file_without_header_is_rejected(path: Path, content: bytes) -> None:
    """Also with keep_going."""
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"^[^\n]*header of a recording[^\n]*$"):
        load_recording(path, keep_going=True)


def test_empty_file_is_rejected(path: Path) -> None:
    """Empty file is rejected."""
    path.touch()
    with pytest.raises(RecordingError, match="header of a recording"):
        list(read_lines(path))


def test_other_version_is_rejected(path: Path) -> None:
    """The error states both versions."""
    header = json.loads(encode_line(HEADER)) | {"version": 7}
    path.write_bytes(json.dumps(header).encode() + b"\n")
    with pytest.raises(RecordingVersionError, match=r"version 7, this program reads version 1"):
        load_recording(path, keep_going=True)


def test_recording_without_parameters_is_rejected(path: Path) -> None:
    """Recording without parameters is rejected."""
    path.write_bytes(encode_line(HEADER) + b"\n" + encode_line(measurement(0)) + b"\n")
    with pytest.raises(RecordingError, match="contains no parameters"):
        load_recording(path)


def test_missing_file_is_one_line(tmp_path: Path) -> None:
    """A path with nothing there is an error of ours that names it."""
    with pytest.raises(RecordingError, match=r"nowhere\.jsonl: cannot be read \(No such file"):
        load_recording(tmp_path / "nowhere.jsonl")


def test_folder_is_one_line(tmp_path: Path) -> None:
    """A folder in place of the file is an error of ours."""
    with pytest.raises(RecordingError, match=r"cannot be read \(Is a directory"):
        load_recording(tmp_path)


@pytest.mark.parametrize("torn", [b"", b'{"type":"mea'])
def test_long_tail_of_zeros_is_named(tmp_path: Path, torn: bytes) -> None:
    """A power cut may leave it."""
    path = tmp_path / "r.jsonl"
    path.write_bytes(recording_bytes(measurement(0)) + torn + b"\0" * 3_000_000)
    problems: list[RecordingError] = []
    assert len(load_recording(path, on_problem=problems.append).measurements) == 1
    assert [str(problem) for problem in problems] == [
        f"{path}, line 4: the file ends with zero bytes, as after a power cut; they are skipped"
    ]


def test_record_before_zeros_is_read(tmp_path: Path) -> None:
    """A power cut may leave zeros in place of its newline."""
    path = tmp_path / "r.jsonl"
    path.write_bytes(recording_bytes(measurement(0)).rstrip(b"\n") + b"\0" * 100)
    assert load_recording(path).measurements == [measurement(0)]


def test_zeros_within_a_file_are_named(tmp_path: Path) -> None:
    """Blocks of a file can be lost while later ones are on the disk."""
    path = tmp_path / "r.jsonl"
    path.write_bytes(recording_bytes(measurement(0)) + b'{"type":' + b"\0" * 100 + b"}\n")
    with pytest.raises(CorruptLineError, match=r"line 4: .*zero bytes, as after a power cut; --keep-going"):
        load_recording(path)


def test_file_of_zeros_is_named(tmp_path: Path) -> None:
    """Nothing of it was on the disk when the power was cut."""
    path = tmp_path / "r.jsonl"
    path.write_bytes(b"\0" * 4096)
    with pytest.raises(RecordingError, match="holds only zero bytes: a power cut"):
        load_recording(path)


def test_joined_runs_may_have_different_set_ups(path: Path) -> None:
    """The last one is used for all measurements, and the recording says so; of equal ones it does not."""
    first, *others = PARAMETERS.stations
    moved = replace(PARAMETERS, stations=PARAMETERS.stations[:2])
    late = replace(PARAMETERS, stations=(replace(first, latency_ns=1_000_000), *others))
    equipped = replace(PARAMETERS, imu=IMU_PARAMETERS)
    for second, differ in ((PARAMETERS, False), (moved, True), (late, True), (equipped, True)):
        joined = b"".join(encode_line(record) + b"\n" for record in (HEADER, second, measurement(1)))
        path.write_bytes(recording_bytes(measurement(0)) + joined)
        recording = load_recording(path)
        assert recording.measurements == [measurement(0), measurement(1)]
        assert (recording.parameters, recording.set_ups_differ) == (second, differ)


def test_measurement_that_two_joined_runs_recorded_counts_once(path: Path) -> None:
    """A master that is killed before it acknowledges one has recorded it; the next master receives and records it again."""
    first = measurement(5)
    again = replace(first, stamp_ns=first.stamp_ns + 3_000_000, received_ns=first.received_ns + 20 * SECOND)
    others = [replace(again, station=2), replace(again, sequence=6), replace(again, zenith_angle_rad=1.4)]
    much_later = replace(again, stamp_ns=first.stamp_ns + 60 * SECOND)
    joined = [HEADER, PARAMETERS, again, *others, much_later]
    path.write_bytes(recording_bytes(first) + b"".join(encode_line(record) + b"\n" for record in joined))
    assert load_recording(path).measurements == [first, *others, much_later]


def test_measurement_that_was_merged_into_joined_runs_counts_once(path: Path) -> None:
    """Journals are merged into the runs of a day one by one, and each takes what it has not received; the radio rounds."""
    delivered = replace(measurement(5), host_time_ns=None, horizontal_angle_rad=0.8142857)
    merged = MergedRecord(
        journal="station1.jsonl",
        measurement=replace(delivered, horizontal_angle_rad=0.81428571, stamp_ns=START),
    )
    again = replace(merged, measurement=replace(merged.measurement, stamp_ns=START + 80_000))
    delivered = replace(delivered, stamp_ns=START + 10_000)
    for runs, kept in (
        (((merged,), (again,)), merged.measurement),
        (((merged,), (delivered,), (again,)), delivered),
        (((delivered,), (again,)), delivered),
    ):
        path.write_bytes(b"".join(recording_bytes(*records) for records in runs))
        assert load_recording(path).measurements == [kept]


def test_set_up_that_is_read_again_replaces_nothing(path: Path) -> None:
    """Its files were the same; another set-up replaces it, so that what precedes is left out."""
    moved = replace(PARAMETERS, stations=PARAMETERS.stations[::-1])
    for second, left_out in ((PARAMETERS, 0), (moved, 1)):
        path.write_bytes(recording_bytes(measurement(0), second, SETUP, measurement(9)))
        recording = load_recording(path)
        assert (len(recording.measurements), recording.left_out) == (2 - left_out, left_out)


@pytest.mark.parametrize(("kept", "torn"), [(-1, 0), (-40, 1)])
def test_run_after_one_that_was_cut_is_read(path: Path, kept: int, torn: int) -> None:
    """Its header follows the torn last line of the run before, or one that lacks the line end alone."""
    problems: list[RecordingError] = []
    first = recording_bytes(measurement(0), measurement(1))
    path.write_bytes(first[:kept] + recording_bytes(measurement(2)))
    recording = load_recording(path, on_problem=problems.append)
    assert [each.sequence for each in recording.measurements] == [[0, 1, 2], [0, 2]][torn]
    assert recording.left_out == 0
    assert ["the last line of a run is torn" in str(each) for each in problems] == [True] * torn
    assert replaced_line(path) == 0


def test_one_run_keeps_equal_measurements(path: Path) -> None:
    """Nothing is left out of a file that is no join, whatever the master wrote."""
    path.write_bytes(recording_bytes(measurement(5), measurement(5)))
    assert load_recording(path).measurements == [measurement(5), measurement(5)]


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (
            {"zenith_angle_rad": 89.7},
            "its angles are in another unit: the median zenith angle is 89.7, but in rad",
        ),
        ({"slope_distance_m": 41_234.0}, "its distances are in another unit: the median is 41234, but in m"),
    ],
)
def test_other_units_are_an_error(path: Path, changed: dict[str, Any], expected: str) -> None:
    """A search for poses takes minutes, and finds none; single measurements may be damaged."""
    path.write_bytes(recording_bytes(*(replace(measurement(number), **changed) for number in range(30))))
    with pytest.raises(RecordingError, match=expected):
        load_recording(path)
    few = [replace(measurement(number), **(changed if number % 3 else {})) for number in range(9)]
    path.write_bytes(recording_bytes(*few))
    assert len(load_recording(path).measurements) == 9


def test_points_in_another_unit_are_an_error(path: Path) -> None:
    """Points in millimetres likewise."""
    points = (replace(POINT, sequence=number, position_m=(41_234.0, 2.0, 3.0)) for number in range(30))
    path.write_bytes(recording_bytes(*points))
    with pytest.raises(
        RecordingError, match="its distances are in another unit: the median is 41234, but in m"
    ):
        load_recording(path)
