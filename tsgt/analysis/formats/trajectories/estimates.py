"""Estimates of other programs from files, whatever their format."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.analysis.formats.bag import is_bag
from tsgt.analysis.formats.trajectories.bag_files import read_bag
from tsgt.analysis.formats.trajectories.raw import estimate_of
from tsgt.analysis.formats.trajectories.reference_files import is_recording
from tsgt.analysis.formats.trajectories.text_files import read_text
from tsgt.analysis.text_file import utf8_name
from tsgt.errors import InputFileError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.compare import Estimate
    from tsgt.analysis.formats.trajectories.columns import TextFormat


def read_estimates(
    path: Path,
    *,
    topics: Sequence[str] = (),
    text_format: TextFormat | None = None,
    times: Path | None = None,
) -> tuple[Estimate, ...]:
    """Read the estimates of a file: one of a text file, one for each topic of a bag.

    Parameters
    ----------
    topics
        Of a bag, ``TOPIC`` or ``TOPIC:PARENT.CHILD`` of transforms; none: the only one with poses.
    text_format
        Of a text file; None: by its columns and their names.
    times
        Of a KITTI file; None: a file beside it.

    Raises
    ------
    InputFileError
        The file cannot be used.
    MissingExtraError
        A library for it is not installed: rosbags for bags, pymap3d for GNSS fixes.
    """
    name, file = utf8_name(path.stem or path.name), utf8_name(str(path))
    if is_bag(path):
        found = read_bag(path, topics)
        return tuple(
            estimate_of(
                raw,
                name=name if len(found) == 1 else f"{name} {topic}",
                source=f"{file}, {topic}, {kind}",
                path=path,
            )
            for topic, kind, raw in found
        )
    if is_recording(path):
        raise InputFileError(
            "holds JSON, as a recording does; export its poses: tsgt export FILE --output FILE.tum", path=path
        )
    raw = read_text(path, text_format=text_format, times=times)
    return (estimate_of(raw, name=name, source=file, path=path),)
