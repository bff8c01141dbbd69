"""The Leica driver with each generation: what one lacks is met by the next best way, or by one clear line."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from harness.instruments.leica import LeicaBench, leica_bench, leica_config
from harness.instruments.total_stations import STANDING
from structlog.testing import capture_logs

from tsgt.config import InstrumentModelConfig
from tsgt.config.scenario import StatusFaultConfig
from tsgt.errors import InstrumentError
from tsgt.model import Status
from tsgt.simulation.instrument.geocom import ForcedResponse
from tsgt.station.geocom import ReturnCode, Rpc
from tsgt.station.leica.reacquisition import Pointing, SearchWindow
from tsgt.station.leica.search import TargetSearch

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

GENERATIONS = ("TPS1200+", "TS15", "MS50", "TS16", "MS60")
CODES = (None, ReturnCode.NOT_IMPL, ReturnCode.NA)
"""Of an unknown procedure: not understood, not implemented, or not available."""

POWER_SEARCH = frozenset(
    rpc for rpc in Rpc if rpc.name.startswith("AUT_PS_") or rpc is Rpc.AUT_SET_SEARCH_AREA
)

LOST = StatusFaultConfig(station=1, status="no_target", start_s=8.0, end_s=13.0)


def bench(
    generation: str, faults: tuple[StatusFaultConfig, ...] = (), *, standing: bool = False, **config: Any
) -> AbstractAsyncContextManager[LeicaBench]:
    """Set up a driver and an instrument of a generation."""
    model = InstrumentModelConfig.model_validate({"generation": generation})
    return leica_bench(
        leica_config(**config), model=model, faults=faults, motion=STANDING if standing else None
    )


@pytest.mark.parametrize(("generation", "code"), [*zip(GENERATIONS, (None, 5, 27, None, 5), strict=True)])
async def test_prism_is_tracked_lost_and_found(generation: str, code: int | None) -> None:
    """Set-up, tracking, and the search for a prism that was hidden: without a problem that remains."""
    async with bench(generation, (LOST,), prism_type="mini_360", prism_constant_mm=12.3) as day:
        day.station.server.unknown_code = None if code is None else ReturnCode(code)
        await day.begin()
        assert sum(reading.status.usable for reading in await day.read_for(4.0)) > 7
        await day.read_until(Status.NO_TARGET, within_s=10.0)
        await day.read_until(Status.OK, within_s=40.0)
        assert day.instrument.condition.problem == ""
        assert day.instrument.condition.activity == "tracking prism 1"
        assert day.station.settings.prism_constant_m == pytest.approx(0.0123)
        assert day.station.settings.edm_mode == 9


@pytest.mark.parametrize(("prism_type", "reflector"), [("mini_360", 1), ("tape", 2)])
async def test_own_constant_is_that_of_a_user_defined_prism(prism_type: str, reflector: int) -> None:
    """Where no procedure sets the constant alone; the instrument is told what the reflector is: 0 is undefined."""
    async with bench("TPS1200+", prism_type=prism_type, prism_constant_mm=12.3) as day:
        refused = ForcedResponse(code=ReturnCode.NOT_IMPL, rpc=Rpc.TMC_SET_PRISM_CORR, times=10)
        day.station.server.forced.append(refused)
        await day.begin()
        assert day.station.settings.user_reflector == reflector
        assert day.station.settings.prism_constant_m == pytest.approx(0.0123)


@pytest.mark.parametrize("target", ["foil", "prism"])
@pytest.mark.parametrize("generation", ["TPS1200+", "TS15", "MS50", "TS16"])
async def test_target_is_measured_in_two_faces(generation: str, target: str) -> None:
    """A foil with the precise mode where there is one, and a prism."""
    async with bench(generation, standing=True, target=target, target_faces=2) as day:
        await day.begin()
        await day.instrument.direct()
        if target == "foil":
            day.station.aim_at_target(1)
        reading = await day.instrument.measure()
        assert reading.status.usable
        assert day.instrument.condition.problem == ""
        precise = generation in ("MS50", "MS60") and target == "foil"
        assert day.station.settings.edm_mode == (14 if precise else 1 if target == "foil" else 2)


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("generation", ["TPS1100", "TPS1200"])
async def test_instrument_without_times_is_named(generation: str, code: ReturnCode | None) -> None:
    """They have no procedure for distances with times: one line, and nothing else."""
    async with bench(generation) as day:
        day.station.server.unknown_code = code
        await day.begin()
        with pytest.raises(
            InstrumentError, match=r"does not support TMC_GetFullMeas .* TPS1200\+ or newer is required"
        ):
            await day.read_for(10.0)


async def test_tracking_mode_that_it_lacks_is_replaced() -> None:
    """Synchronous tracking came with the TPS1200+: the fastest mode is used, and the problem stated."""
    async with bench("TPS1200", distance_mode="synchro") as day:
        await day.begin()
        assert day.station.settings.edm_mode == 9
        problem = day.instrument.condition.problem
        assert "synchronous tracking cannot be set: 2 IVPARAM; continuous_fast is used" in problem


@pytest.mark.parametrize("code", CODES)
async def test_search_without_power_search_commands(code: ReturnCode | None) -> None:
    """An instrument that claims PowerSearch and lacks its commands searches by its target recognition."""
    async with bench("TS15", standing=True) as day:
        day.station.server.unknown_code = code
        day.station.generation = replace(day.station.generation, unknown=POWER_SEARCH)
        await day.begin()
        day.station.telescope.release()
        day.station.telescope.turn_to((day.station.telescope.direction()[0] + 0.1, 1.5))
        here = day.station.circle_reading(day.station.telescope.direction())
        window = SearchWindow("searching", True, Pointing(*here), math.radians(30.0), math.radians(10.0))
        search = TargetSearch(day.instrument._connected(), power_search=True)
        with capture_logs() as logs:
            assert await search.search(window)
        assert [entry["event"] for entry in logs] == ["power_search_unavailable"]
