"""Bags of ROS (rosbag2 with SQLite or MCAP, single MCAP files, bags of ROS 1), opened with rosbags."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from tsgt.errors import InputFileError, MissingExtraError, TsgtError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rosbags.highlevel import AnyReader

BAG_SUFFIXES = (".mcap", ".db3", ".bag")


def is_bag(path: Path) -> bool:
    """Whether a path names a bag: a folder, or a file with the suffix of one."""
    return path.is_dir() or path.suffix.lower() in BAG_SUFFIXES


@contextmanager
def open_bag(path: Path) -> Iterator[AnyReader]:
    """Open a bag for reading; whatever rosbags raises until it is closed becomes InputFileError.

    Raises MissingExtraError without the library.
    """
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 (an extra)
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise MissingExtraError("bags of ROS", library="rosbags", extra="mcap") from error
    if not path.exists():
        raise InputFileError("cannot be read: No such file or directory", path=path)
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except TsgtError:
        raise
    except Exception as error:
        # Damaged bags make the libraries of SQLite, MCAP, YAML and CDR raise what they like.
        raise InputFileError(f"is no bag of ROS that can be read: {_reason(error)}", path=path) from error


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text or type(error).__name__
