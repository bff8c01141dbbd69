"""Points of measurements in the client against those of the estimators."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from harness.files.records import PARAMETERS, START
from hypothesis import given
from hypothesis import strategies as st

from tsgt.client import Measurement, Setup, measured_point
from tsgt.client.build import build
from tsgt.estimation import build_tracks
from tsgt.geometry import exp_so3, transform_from
from tsgt.model import PolarMeasurement, Status
from tsgt.recording import SetupRecord, encode_line

small = st.floats(-0.01, 0.01)


def _measurement(**values: object) -> PolarMeasurement:
    polar = PolarMeasurement(
        station=2,
        prism=2,
        sequence=0,
        stamp_ns=START,
        received_ns=START,
        horizontal_angle_rad=1.0,
        zenith_angle_rad=1.5,
        slope_distance_m=60.0,
        host_time_ns=None,
    )
    return replace(polar, **values)  # type: ignore[arg-type]  # names of its fields


def _read(line: bytes, cls: type) -> object:
    return build(cls, json.loads(line))


@given(
    horizontal=st.floats(0, 6.28),
    zenith=st.one_of(st.floats(0.1, 3.0), st.floats(3.3, 6.2)),
    slope=st.floats(1, 500),
    constant=small,
    ppm=st.floats(-50, 50),
    index=small,
    collimation=small,
    turn=st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3)),
)
def test_point_is_that_of_the_estimators(
    horizontal: float,
    zenith: float,
    slope: float,
    constant: float,
    ppm: float,
    index: float,
    collimation: float,
    turn: tuple[float, float, float],
) -> None:
    """With all corrections, in both faces."""
    T = transform_from(exp_so3(np.array(turn)), np.array([10.0, -5.0, 1.0]))
    station = replace(
        PARAMETERS.stations[1],
        T_station1_station=tuple(tuple(row) for row in T.tolist()),  # type: ignore[arg-type]  # 4x4
        prism_constant_m=constant,
        atmospheric_ppm=ppm,
        vertical_index_rad=index,
        collimation_rad=collimation,
    )
    parameters = replace(PARAMETERS, stations=(PARAMETERS.stations[0], station, PARAMETERS.stations[2]))
    polar = _measurement(horizontal_angle_rad=horizontal, zenith_angle_rad=zenith, slope_distance_m=slope)
    setup = _read(encode_line(SetupRecord.of(parameters, START)), Setup)
    measurement = _read(encode_line(polar), Measurement)
    assert isinstance(setup, Setup)
    assert isinstance(measurement, Measurement)
    expected = build_tracks(parameters, [polar])[2].points_m[0]
    assert measured_point(measurement, setup) == pytest.approx(tuple(expected), abs=1e-9)


@pytest.mark.parametrize(
    "unusable",
    [{"slope_distance_m": None}, {"status": Status.TILT}, {"station": 9}],
    ids=lambda each: next(iter(each)),
)
def test_unusable_measurement_gives_no_point(unusable: dict[str, object]) -> None:
    """No distance, an error status, or a station that the set-up does not have."""
    setup = _read(encode_line(SetupRecord.of(PARAMETERS, START)), Setup)
    measurement = _read(encode_line(_measurement(**unusable)), Measurement)
    assert isinstance(setup, Setup)
    assert isinstance(measurement, Measurement)
    assert measured_point(measurement, setup) is None
