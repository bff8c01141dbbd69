"""geocompy, an independent client, operates the simulated total station through a pseudo-terminal in real time."""

from __future__ import annotations

import asyncio
import math
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import pytest
from geocompy.communication import open_serial
from geocompy.data import Angle
from geocompy.geo import GeoCom
from geocompy.geo.gcdata import Adjust, ATRLock, EDMModeV2, Measurement, PowerSource, Prism
from geocompy.geo.gctypes import GeoComCode

from tsgt.config import ScenarioConfig
from tsgt.simulation.instrument import PtyLine, SimulatedTotalStation
from tsgt.simulation.kernel import LoopTimeline
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator
    from pathlib import Path

SCENARIO = ScenarioConfig(targets_m=((20.0, 5.0, 0.5),))


@contextmanager
def served(link: Path) -> Iterator[SimulatedTotalStation]:
    """Serve an instrument from its own thread: geocompy blocks its caller."""
    ready = threading.Event()
    made: list[SimulatedTotalStation] = []
    loop = asyncio.new_event_loop()
    done = asyncio.Event()

    async def serve() -> None:
        world = scenario_world(SCENARIO, 60.0, np.random.default_rng(1))
        timeline = LoopTimeline(loop)
        # The motion starts in an hour: nothing moves.
        start_ns = timeline.now_ns() + 3600 * 10**9
        made.append(
            SimulatedTotalStation(
                SCENARIO.stations[0], SCENARIO, world, timeline, np.random.default_rng(2), start_ns=start_ns
            )
        )
        async with PtyLine(made[0], link):
            ready.set()
            await done.wait()

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()))
    thread.start()
    assert ready.wait(10)
    try:
        yield made[0]
    finally:
        loop.call_soon_threadsafe(done.set)
        thread.join()
        loop.close()


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Generator[SimulatedTotalStation]:
    """One instrument for all tests: geocompy takes a second and a half to connect."""
    with served(tmp_path_factory.mktemp("dev") / "ttyUSB0") as instrument:
        yield instrument


@pytest.fixture(scope="module")
def client(station: SimulatedTotalStation, tmp_path_factory: pytest.TempPathFactory) -> Generator[GeoCom]:
    """Connect geocompy to it."""
    assert station.on
    link = tmp_path_factory.getbasetemp() / "dev0" / "ttyUSB0"
    with open_serial(str(link), speed=115_200, timeout=10) as connection:
        yield GeoCom(connection)


def test_identity(client: GeoCom) -> None:
    """Name, serial number and versions are those of the instrument."""
    assert client.csv.get_instrument_name().params == "TCRP1201+"
    assert client.csv.get_serial_number().params == 230_001
    assert client.com.get_geocom_version().params == (1, 20, 0)
    assert client.csv.get_firmware_version().params == (5, 50, 0)
    assert client.csv.check_power().params == (85, PowerSource.INTERNAL, PowerSource.INTERNAL)
    assert client.com.get_double_precision().params == 15


def test_angles(client: GeoCom, station: SimulatedTotalStation) -> None:
    """Horizontal and zenith angle point to the tracked prism."""
    horizontal, zenith = client.tmc.get_angle().params or (None, None)
    truth = station.telescope.direction()
    assert horizontal is not None
    assert zenith is not None
    assert float(horizontal) == pytest.approx(truth[0], abs=1e-4)
    assert float(zenith) == pytest.approx(truth[1], abs=1e-4)


def test_full_measurement(client: GeoCom, station: SimulatedTotalStation) -> None:
    """Angles, inclination, distance and time come together, with the distance that the instrument reported."""
    assert client.tmc.set_edm_mode_v2(EDMModeV2.CONT_FAST)
    assert client.tmc.do_measurement(Measurement.DISTANCE)
    answer = client.tmc.get_complete_measurement(wait=2)
    assert answer.error is GeoComCode.OK
    assert answer.params is not None
    *_, distance_m, _time = answer.params
    assert distance_m == station.reported_distances[-1].distance_m
    assert distance_m == pytest.approx(74.7, abs=0.3)
    assert client.tmc.do_measurement(Measurement.CLEAR)


def test_lock_is_released_and_reacquired(client: GeoCom) -> None:
    """Lock state, fine adjustment and lock-in behave as at the instrument's keys."""
    assert client.mot.get_lockon_status().params is ATRLock.LOCK
    assert client.aus.switch_user_lock(False)
    assert client.mot.get_lockon_status().params is ATRLock.NONE
    assert client.aus.get_user_lock_state().params is False
    assert client.aut.set_fine_adjust_mode(Adjust.POINT)
    assert client.aut.fine_adjust(Angle(0.05), Angle(0.05))
    assert client.aus.switch_user_lock(True)
    assert client.aut.lock_in()
    assert client.mot.get_lockon_status().params is ATRLock.LOCK


def test_positioning(client: GeoCom, station: SimulatedTotalStation) -> None:
    """A positioning loses the prism; the search window of the target recognition finds it again."""
    horizontal, zenith = station.telescope.direction()
    assert client.aut.turn_to(Angle(horizontal + 0.03), Angle(zenith))
    assert client.mot.get_lockon_status().params is ATRLock.NONE
    assert float(client.tmc.get_angle().params[0]) == pytest.approx(horizontal + 0.03, abs=1e-4)  # type: ignore[index]
    assert client.aut.search(Angle(0.1), Angle(0.1))
    assert client.aut.lock_in()


def test_distance_mode_prism_and_constant(client: GeoCom) -> None:
    """Settings can be read back, and a prism type sets its constant."""
    assert client.tmc.set_edm_mode_v2(EDMModeV2.CONT_DYNAMIC)
    assert client.tmc.get_edm_mode_v2().params is EDMModeV2.CONT_DYNAMIC
    assert client.bap.set_prism_type(Prism.MINI360)
    assert client.bap.get_prism_type().params is Prism.MINI360
    assert client.tmc.get_prism_correction().params == pytest.approx(0.030)
    assert client.tmc.set_prism_correction(0.0123)
    assert client.tmc.get_distance_correction().params == pytest.approx((0.0, 0.0123), abs=0.01)


def test_atmosphere(client: GeoCom) -> None:
    """The atmospheric correction can be read; writing it with geocompy would round the wavelength to 1 µm."""
    assert client.tmc.get_atmospheric_corrections().params == (6.58e-7, 1013.25, 12.0, 8.6)
    assert client.tmc.set_atmospheric_correction_ppm(8.0)
    assert client.tmc.get_atmospheric_correction_ppm().params == 8.0


def test_tilt(client: GeoCom, station: SimulatedTotalStation) -> None:
    """The compensator reports the tilt, and beyond its range the instrument gives no angles."""
    answer = client.tmc.get_angle_inclination().params
    assert answer is not None
    assert [float(angle) for angle in answer[4:6]] == pytest.approx(station.tilt_rad, abs=2e-5)
    upright, station.tilt_rad = station.tilt_rad, (math.radians(0.1), 0.0)
    assert client.tmc.get_angle().error is GeoComCode.TMC_ANGLE_ERROR
    station.tilt_rad = upright
    assert client.tmc.get_compensator_status().params is True


def test_requests_of_geocompys_command_line_tool(client: GeoCom) -> None:
    """Every request of the command line tool gets a response."""
    assert client.mot.stop_controller()
    assert client.mot.start_controller()
    assert client.sup.get_poweroff_configuration()
    assert client.edm.switch_laserpointer(False)
    assert client.bap.get_measurement_program()
    assert client.tmc.get_station()
    assert client.csv.get_datetime()
    assert client.abort()
