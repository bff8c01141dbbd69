"""Single measurements of targets over the radio, for ``tsgt calibrate collect`` and ``check``; no master runs then."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from typing import TYPE_CHECKING

from tsgt.analysis.formats import Sight
from tsgt.cli.calibrate.commands import ClassicOrders, superframe_orders
from tsgt.cli.composition import radio_key, radio_opener
from tsgt.config import ClassicMasterConfig
from tsgt.errors import InstrumentError, RadioError, StreamError, TsgtError
from tsgt.model import Status
from tsgt.radio import DirectOrder, MeasureOrder, TrackOrder
from tsgt.radio.from_config import lora_settings

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Mapping
    from pathlib import Path

    from tsgt.cli.calibrate.commands import Answer, Orders
    from tsgt.cli.operator import Operator
    from tsgt.clock import Clock
    from tsgt.config import MasterConfig
    from tsgt.radio import OpenRadio, Order

MEANING = {
    Status.TILT: "the instrument is not level; level it, then all its targets have to be measured again",
    Status.WRONG_DISTANCE: "the instrument says that the distance is wrong; aim at the middle of the foil",
    Status.NO_TARGET: "the instrument found no target, or reports another error; aim again",
    Status.ANGLE_ONLY: "angles but no distance; aim at the middle of the foil, no nearer than 1 m",
    Status.ERROR: "the instrument reports an error; look at its display",
}


class TargetSession:
    """Lets stations measure targets, and puts them back to tracking.

    Parameters
    ----------
    orders
        Gives them to the stations.
    prisms
        By station: the prism that it tracks otherwise.

    Attributes
    ----------
    direct
        Stations that may be in direct mode.
    """

    def __init__(self, orders: Orders, prisms: Mapping[int, int]) -> None:
        self._orders = orders
        self._prisms = prisms
        self.direct: set[int] = set()

    async def shoot(self, station: int, *, constant_m: float) -> Sight:
        """Have a station measure what it points at, once.

        Parameters
        ----------
        station
            Its number.
        constant_m
            Goes into the result.

        Raises
        ------
        InstrumentError
            There is no measurement; the text tells the operator why and what to do.
        RadioError
            The master's radio failed.
        """
        # Each time: a station that has started anew tracks its prism, and would answer with that.
        self.direct.add(station)
        if not (await self._give(station, DirectOrder())).ok:
            raise InstrumentError(
                f"station {station} cannot leave its tracking; look at its instrument, then try again"
            )
        answer = await self._orders.give(station, MeasureOrder())
        if answer is None:
            raise InstrumentError(f"station {station} has not sent a measurement; aim again and repeat")
        status = answer.status if answer.slope_distance_m or not answer.status.usable else Status.ANGLE_ONLY
        if not status.usable:
            raise InstrumentError(f"station {station}: {MEANING[status]}")
        return Sight(
            horizontal_angle_rad=answer.horizontal_angle_rad,
            zenith_angle_rad=answer.zenith_angle_rad,
            slope_distance_m=answer.slope_distance_m,
            constant_m=constant_m,
            line=0,
        )

    async def release(self) -> list[str]:
        """Put the stations back to tracking; return a sentence for each one that does not say that it does."""
        sentences = []
        for station in sorted(self.direct):
            try:
                if (await self._give(station, TrackOrder(self._prisms[station]))).ok:
                    continue
                trouble = f"it does not find prism {self._prisms[station]}; see that it has sight of it"
            except InstrumentError:
                trouble = "it does not answer; see that its client runs"
            except RadioError as error:
                trouble = f"the radio failed ({error})"
            sentences.append(
                f"station {station} is not tracking again: {trouble}. tsgt-master puts it back when it starts"
            )
        self.direct.clear()
        return sentences

    async def _give(self, station: int, order: Order) -> Answer:
        answer = await self._orders.give(station, order)
        if answer is None:
            raise InstrumentError(
                f"station {station} does not answer; see that its client runs and is in reach, then try again"
            )
        return answer


async def shot(session: TargetSession, operator: Operator, station: int, constant_m: float) -> Sight | None:
    """Have a station measure; tell the operator what was wrong and return None where there is nothing."""
    operator.say("measuring ...")
    try:
        return await session.shoot(station, constant_m=constant_m)
    except InstrumentError as error:
        operator.say(f"failed: {error}")
        return None


@asynccontextmanager
async def target_session(
    config: MasterConfig,
    path: Path,
    clock: Clock,
    say: Callable[[str], None],
    open_radio: OpenRadio | None = None,
) -> AsyncGenerator[TargetSession]:
    """Open the master's radio; at the end, however it comes, stations are put back to tracking.

    Parameters
    ----------
    config, path
        Of the master, and where it stands.
    clock
        The machine's.
    say
        Told at the end which stations are not back to tracking.
    open_radio
        Another radio than the configuration names.

    Raises
    ------
    TsgtError
        The radio cannot be opened, as a rule because the master uses it.
    ConfigError
        The chip cannot do what the configuration asks of it, or the key cannot be read.
    """
    settings = lora_settings(config.radio, path)
    protocol = config.protocol
    key = radio_key(protocol)
    if await _answers(config.stream.socket):
        raise TsgtError(
            f"tsgt-master is running (it serves {config.stream.socket}) and owns the radio; stop it first: "
            "sudo systemctl stop tsgt-master"
        )
    async with AsyncExitStack() as stack:
        try:
            radio = await stack.enter_async_context(
                (open_radio or radio_opener(config.radio, settings, clock))()
            )
        except (RadioError, StreamError) as error:
            raise TsgtError(
                f"{error}; if another program such as tsgt-master uses the radio, stop it first"
            ) from error
        prisms = {station.station: station.prism for station in config.stations}
        orders: Orders
        if isinstance(protocol, ClassicMasterConfig):
            orders = ClassicOrders(radio, clock, protocol, settings)
        else:
            orders = await stack.enter_async_context(
                superframe_orders(radio, clock, prisms, protocol, settings, key)
            )
        session = TargetSession(orders, prisms)
        try:
            yield session
        finally:
            if session.direct:
                say("putting the stations back to tracking ...")
            for sentence in await session.release():
                say(f"note: {sentence}")


async def _answers(socket_path: Path) -> bool:
    """Tell whether somebody serves a UNIX socket."""
    with suppress(OSError):
        _, writer = await asyncio.open_unix_connection(socket_path)
        writer.close()
        with suppress(OSError):
            await writer.wait_closed()
        return True
    return False
