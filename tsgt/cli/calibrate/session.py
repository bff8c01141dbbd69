"""Single measurements of targets over the radio, for ``tsgt calibrate collect`` and ``check``, while no master runs."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from typing import TYPE_CHECKING

from tsgt.analysis.formats import TargetMeasurement
from tsgt.cli.calibrate.commands import ClassicCommandSender, superframe_command_sender
from tsgt.cli.composition import radio_key, radio_opener
from tsgt.config import ClassicMasterConfig
from tsgt.errors import InstrumentError, RadioError, StreamError, TsgtError
from tsgt.model import Status
from tsgt.radio import DirectCommand, MeasureCommand, TrackCommand
from tsgt.radio.from_config import lora_settings
from tsgt.radio.legality import check_legality

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Mapping
    from pathlib import Path

    from tsgt.cli.calibrate.commands import CommandResponse, CommandSender
    from tsgt.cli.calibrate.operator import Operator
    from tsgt.clock import Clock
    from tsgt.config import MasterConfig
    from tsgt.radio import Command, RadioOpener

PROBLEMS = {
    Status.TILT: "the instrument is not level; level it, then measure all its targets again",
    Status.WRONG_DISTANCE: "the instrument reports a wrong distance; aim at the centre of the foil",
    Status.NO_TARGET: "the instrument found no target, or reports another error; aim again",
    Status.ANGLE_ONLY: "angles but no distance; aim at the centre of the foil, from at least 1 m",
    Status.ERROR: "the instrument reports an error; look at its display",
}


class TargetSession:
    """Has stations measure targets, and returns them to tracking.

    Parameters
    ----------
    prisms
        By station: the prism that it tracks otherwise.
    atmospheric_ppm
        By station: the correction of its distances that the instrument does not make.

    Attributes
    ----------
    direct
        Stations that may be in direct mode.
    """

    def __init__(
        self, sender: CommandSender, prisms: Mapping[int, int], atmospheric_ppm: Mapping[int, float]
    ) -> None:
        self._sender = sender
        self._prisms, self._atmospheric_ppm = prisms, atmospheric_ppm
        self.direct: set[int] = set()

    async def measure(self, station: int, *, constant_m: float) -> TargetMeasurement:
        """Measure the target at which a station is aimed, once.

        Raises
        ------
        InstrumentError
            There is no measurement; the text says why and what to do.
        RadioError
            The master's radio failed.
        """
        # Each time: a client that has restarted tracks its prism, and would respond with that.
        self.direct.add(station)
        if not (await self._send(station, DirectCommand())).ok:
            raise InstrumentError(
                f"station {station} cannot stop tracking; look at its instrument, then try again"
            )
        response = await self._sender.send(station, MeasureCommand())
        if response is None:
            raise InstrumentError(f"station {station} has not sent a measurement; aim and measure again")
        status = response.status
        if status.usable and not response.slope_distance_m:
            status = Status.ANGLE_ONLY
        if not status.usable:
            raise InstrumentError(f"station {station}: {PROBLEMS[status]}")
        return TargetMeasurement(
            horizontal_angle_rad=response.horizontal_angle_rad,
            zenith_angle_rad=response.zenith_angle_rad,
            slope_distance_m=response.slope_distance_m,
            constant_m=constant_m,
            atmospheric_ppm=self._atmospheric_ppm[station],
            line=0,
        )

    async def try_measure(
        self, operator: Operator, station: int, constant_m: float
    ) -> TargetMeasurement | None:
        """Measure as :meth:`measure`; report a failure to the operator and return None."""
        operator.say("measuring ...")
        try:
            return await self.measure(station, constant_m=constant_m)
        except InstrumentError as error:
            operator.say(f"failed: {error}")
            return None

    async def release(self) -> list[str]:
        """Return the stations to tracking; return a sentence for each one that does not confirm it."""
        sentences = []
        for station in sorted(self.direct):
            try:
                if (await self._send(station, TrackCommand(self._prisms[station]))).ok:
                    continue
                problem = f"it does not find prism {self._prisms[station]}; check its line of sight"
            except InstrumentError:
                problem = "it does not respond; check that its client runs"
            except RadioError as error:
                problem = f"the radio failed ({error})"
            sentences.append(
                f"station {station} has not returned to tracking: {problem}. tsgt-master returns it when it starts"
            )
        self.direct.clear()
        return sentences

    async def _send(self, station: int, command: Command) -> CommandResponse:
        response = await self._sender.send(station, command)
        if response is None:
            raise InstrumentError(
                f"station {station} does not respond; check that its client runs and is in range, then try again"
            )
        return response


@asynccontextmanager
async def target_session(
    config: MasterConfig,
    path: Path,
    clock: Clock,
    say: Callable[[str], None],
    open_radio: RadioOpener | None = None,
) -> AsyncGenerator[TargetSession]:
    """Open the master's radio; at the end, also after an error, return the stations to tracking.

    Parameters
    ----------
    config, path
        Of the master, and its file.
    say
        Called at the end with each station that has not returned to tracking.
    open_radio
        Radio to use instead of the configured one.

    Raises
    ------
    TsgtError
        The radio cannot be opened, usually because the master uses it.
    ConfigError
        The chip does not support the settings, or the key cannot be read.
    """
    settings = lora_settings(config.radio, path)
    check_legality(config, path)
    protocol = config.protocol
    key = radio_key(protocol)
    if await _is_served(config.stream.socket):
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
        sender: CommandSender
        if isinstance(protocol, ClassicMasterConfig):
            sender = ClassicCommandSender(radio, clock, protocol, settings)
        else:
            sender = await stack.enter_async_context(
                superframe_command_sender(radio, clock, prisms, protocol, settings, key)
            )
        ppm = {station.station: station.atmospheric_ppm for station in config.stations}
        session = TargetSession(sender, prisms, ppm)
        try:
            yield session
        finally:
            if session.direct:
                say("returning the stations to tracking ...")
            for sentence in await session.release():
                say(f"note: {sentence}")


async def _is_served(socket_path: Path) -> bool:
    """Whether a process serves a UNIX socket."""
    with suppress(OSError):
        _, writer = await asyncio.open_unix_connection(socket_path)
        writer.close()
        with suppress(OSError):
            await writer.wait_closed()
        return True
    return False
