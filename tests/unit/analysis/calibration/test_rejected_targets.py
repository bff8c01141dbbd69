"""What is said about a target that contradicts other stations."""

from __future__ import annotations

import numpy as np
import pytest
from harness.instruments.target_field import TargetField

from tsgt.analysis.calibration import TargetCalibration, target_notes
from tsgt.geometry.target_calibration import calibrate_network
from tsgt.model import TARGET_NOISE, SetupCovariance

SKEW = np.array([0.6, 0.6, 0.52])


def note(direction: np.ndarray, *stations: int, size_m: float = 0.2, count: int = 3) -> str:
    """Return the note on target 1, displaced in axes along and across the line of sight from station 1."""
    field = TargetField(rng=np.random.default_rng(5), targets=9, stations=count)
    x, y, _ = field.points_m[0] / np.hypot(*field.points_m[0, :2])
    shift = size_m * np.array([[x, -y, 0], [y, x, 0], [0, 0, 1]]) @ direction
    field.displaced = {(station, 0): shift for station in stations}
    network = calibrate_network(field.measure(), TARGET_NOISE)
    solved = TargetCalibration(
        network, {}, SetupCovariance(components=(), matrix=()), applied=True, atmospheric_ppm={}
    )
    (text,) = target_notes(solved)
    return text


@pytest.mark.parametrize(
    ("direction", "stations", "words"),
    [
        (SKEW, (1, 2), "the target moved after this station measured it"),
        (SKEW, (2,), "the target moved before this station measured it"),
        (
            SKEW,
            (1,),
            "the station erred, or aimed at another point, as those that measured before and after it agree",
        ),
        (np.array([0.999, 0.0, 0.03]), (0,), "the station erred, its distance is wrong"),
    ],
)
def test_who_is_wrong_is_said(direction: np.ndarray, stations: tuple[int, ...], words: str) -> None:
    """The first and the last station may have seen a target elsewhere; one between them not."""
    assert words in note(direction, *stations)


@pytest.mark.parametrize(
    ("station", "decides"),
    [(0, "measured again it agrees with the others either way"), (2, "at the same place again it has moved")],
)
def test_undecided_case_names_the_deciding_measurement(station: int, decides: str) -> None:
    """Across the line of sight it may be the target or the aim."""
    text = note(np.array([0.0, 0.8, 0.6]), station, size_m=0.03)
    assert "it cannot be told whether the station erred" in text
    assert decides in text


def test_two_and_two_stations_are_named() -> None:
    """Of four stations two see the target elsewhere."""
    text = note(SKEW, 2, 3, count=4)
    assert "stations 3 and 4 do not see it where stations 1 and 2 agree" in text or (
        "stations 1 and 2 do not see it where stations 3 and 4 agree" in text
    )
