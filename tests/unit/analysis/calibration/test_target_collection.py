"""The state behind ``tsgt calibrate collect``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.analysis.calibration import TargetCollection
from tsgt.analysis.calibration.target_collection import HEADER
from tsgt.analysis.formats import TargetMeasurement

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.calibration.target_collection import StationTarget


def _measure(collection: TargetCollection, *pairs: StationTarget) -> None:
    for pair in pairs:
        collection.add(
            *pair,
            TargetMeasurement(
                horizontal_angle_rad=0.5, zenith_angle_rad=1.5, slope_distance_m=20.0, constant_m=0.0, line=0
            ),
        )


def _order(collection: TargetCollection) -> list[str]:
    """Return station and target of each line of the file."""
    return [line[:3] for line in collection.text().splitlines()[1:]]


def test_lines_are_in_the_order_of_measurement(tmp_path: Path) -> None:
    """Whether a tripod or a target moved is told by that order: a target that is measured again is the newest."""
    collection = TargetCollection(tmp_path / "targets.csv", (1, 2), (1, 2, 3))
    _measure(collection, (1, 1), (1, 2), (1, 3), (2, 1), (2, 2))
    assert collection.remove(1, 2)
    _measure(collection, (1, 2), (2, 3))
    assert _order(collection) == ["1,1", "1,3", "2,1", "2,2", "1,2", "2,3"]


def test_order_survives_an_interruption(tmp_path: Path) -> None:
    """The file is the whole state."""
    path = tmp_path / "targets.csv"
    collection = TargetCollection(path, (1, 2), (1, 2, 3))
    _measure(collection, (1, 3), (2, 3), (1, 1), (2, 1), (2, 1), (1, 3))
    path.write_text(collection.text())
    resumed = TargetCollection(path, (1, 2), (1, 2, 3))
    resumed.resume()
    assert resumed.text() == collection.text()


def test_file_of_an_earlier_version_is_continued(tmp_path: Path) -> None:
    """It has no column for the correction of the air."""
    path = tmp_path / "targets.csv"
    path.write_text(
        "station,target,horizontal_angle_rad,zenith_angle_rad,slope_distance_m,constant_mm\n1,1,0.5,1.5,20.0,0\n"
    )
    collection = TargetCollection(path, (1, 2), (1, 2, 3))
    collection.resume()
    assert collection.text().splitlines() == [HEADER, "1,1,0.5,1.5,20.0,0,0"]
