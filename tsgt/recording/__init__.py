"""Recordings: JSON lines on disk, appended in the order of arrival, with every parameter in force.

Problem: a robot loses power, a disk fills up, a program is killed, and what was measured until then has to be
there. Idea: one record is one line is one write to the kernel, at the end of a file that nobody else may write.
A killed program leaves at most one torn line, which the reader skips and the next writer cuts off. Only a power
cut can take more: what was written since the last :meth:`RecordingWriter.sync`. The format is described in
docs/reference/recording.md.

Nothing that can be imported from here waits, asks for the time or logs, so the pure parts of the program may use it;
:mod:`tsgt.recording.recorder` does log.
"""

from tsgt.recording.files import new_recording_path, sync_folder, write_atomically
from tsgt.recording.format import (
    FORMAT_VERSION,
    MAX_LINE_BYTES,
    Line,
    RecordingHeader,
    Typed,
    decode,
    decode_line,
    encode_line,
)
from tsgt.recording.merged import MergedRecord
from tsgt.recording.reader import Recording, load_recording, read_lines
from tsgt.recording.stream_records import (
    PROTOCOL_VERSION,
    BeaconRecord,
    ClockRecord,
    EventRecord,
    HelloRecord,
    Kind,
    PoseRecord,
    StationShare,
    StationStatus,
    StatusRecord,
)
from tsgt.recording.writer import RecordingWriter

__all__ = [
    "FORMAT_VERSION",
    "MAX_LINE_BYTES",
    "PROTOCOL_VERSION",
    "BeaconRecord",
    "ClockRecord",
    "EventRecord",
    "HelloRecord",
    "Kind",
    "Line",
    "MergedRecord",
    "PoseRecord",
    "Recording",
    "RecordingHeader",
    "RecordingWriter",
    "StationShare",
    "StationStatus",
    "StatusRecord",
    "Typed",
    "decode",
    "decode_line",
    "encode_line",
    "load_recording",
    "new_recording_path",
    "read_lines",
    "sync_folder",
    "write_atomically",
]
