"""Who a Leica instrument is, what it can do, and how it is fed.

What is known of Leica's instruments by model: what no instrument says of itself.

Sources: the delays between distance and angles are constants of the University of Bonn's open tracking software
(rts-network), found by calibration there; how a name begins is as instruments of each series give it. No latency from a
measurement to the fastest answer is known of any model: published figures contain the line. It has to be measured, or
found from a recording in motion, and put into the configuration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

from tsgt.station.geocom import ReturnCode, Rpc, Verdict, verdict

if TYPE_CHECKING:
    from tsgt.station.geocom import GeoComConnection, Reply

Numbers = tuple[float, ...]

_ATR, _POWER_SEARCH = 0x8, 0x800

_WARNINGS: Final = {
    int(ReturnCode.LOW_POWER): "its battery lasts for some 30 minutes more; change it",
    int(ReturnCode.BATT_EMPTY): "its battery is empty; it switches off within a minute",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """Who an instrument is and what it can do.

    Attributes
    ----------
    model, serial_number, firmware, geocom_release
        As it says them; empty where it does not.
    robotic
        Whether it may be moved and made to search: the licence GeoCOM Robotic. None: not known.
    atr, power_search
        Whether it has target recognition and PowerSearch; true where it does not say.
    battery_percent
        Charge; None where it does not say.
    external_power
        Whether it is fed from outside.
    power_problem
        What a person should see to about that; empty when there is nothing.
    """

    model: str = ""
    serial_number: str = ""
    firmware: str = ""
    geocom_release: str = ""
    robotic: bool | None = None
    atr: bool = True
    power_search: bool = True
    battery_percent: int | None = None
    external_power: bool = False
    power_problem: str = ""

    def fed(self, power: Power) -> Identity:
        """Return the same instrument, fed like this."""
        return replace(
            self,
            battery_percent=power.percent,
            external_power=power.external,
            power_problem=power.problem,
        )


class Power(NamedTuple):
    """How an instrument is fed.

    Attributes
    ----------
    percent
        Charge of the battery; None where it does not say.
    external
        Whether it is fed from outside.
    problem
        What a person should see to; empty when there is nothing.
    """

    percent: int | None
    external: bool
    problem: str


def numbers(reply: Reply, count: int) -> Numbers | None:
    """Return the first values of a reply; None if there are fewer, or one is no finite number."""
    values = reply.values[:count]
    if len(values) < count or any(isinstance(value, str) or not math.isfinite(value) for value in values):
        return None
    return tuple(float(value) for value in values)


def done(reply: Reply) -> bool:
    """Tell whether a procedure has been carried out."""
    return verdict(reply.code, has_values=bool(reply.values)) is Verdict.USABLE


async def identify(line: GeoComConnection, before: Identity | None = None) -> Identity:
    """Ask an instrument who it is.

    Parameters
    ----------
    line
        To it.
    before
        Whom this computer had met before; if it is the same one, only what changes is asked.

    Raises
    ------
    InstrumentError
        It does not answer.
    """
    serial = await line.call(Rpc.CSV_GET_INSTRUMENT_NO)
    serial_number = str(serial.values[0]) if serial.values else ""
    robotic = await may_search(line)
    power = await check_power(line)
    if before is not None and serial_number and serial_number == before.serial_number:
        return replace(before, robotic=robotic).fed(power)
    name = await line.call(Rpc.CSV_GET_INSTRUMENT_NAME)
    device = numbers(await line.call(Rpc.CSV_GET_DEVICE_CONFIG), 2)
    return Identity(
        model=str(name.values[0]).strip() if name.values else "",
        serial_number=serial_number,
        firmware=_version(await line.call(Rpc.CSV_GET_SW_VERSION)),
        geocom_release=_version(await line.call(Rpc.COM_GET_SW_VERSION)),
        robotic=robotic,
        atr=device is None or bool(int(device[1]) & _ATR),
        power_search=device is None or bool(int(device[1]) & _POWER_SEARCH),
    ).fed(power)


async def may_search(line: GeoComConnection) -> bool | None:
    """Ask whether the instrument has the licence GeoCOM Robotic; None where that cannot be told."""
    reply = await line.call(Rpc.AUT_GET_FINE_ADJUST_MODE)
    if done(reply):
        return True
    return False if verdict(reply.code, has_values=False) is Verdict.LICENCE else None


async def check_power(line: GeoComConnection) -> Power:
    """Ask how the instrument is fed."""
    reply = await line.call(Rpc.CSV_CHECK_POWER)
    values = numbers(reply, 2)
    percent = round(values[0]) if values is not None and 0 <= values[0] <= 100 else None
    problem = _WARNINGS.get(reply.code, "")
    return Power(percent, values is not None and values[1] == 1, problem)


def _version(reply: Reply) -> str:
    values = numbers(reply, 3)
    if values is None:
        return ""
    release, version, sub = (int(value) for value in values)
    return f"{release}.{version:02d}" + (f".{sub}" if sub else "")


class Model(NamedTuple):
    """What is known of a model.

    Attributes
    ----------
    angle_delay_ns
        By how much its angles are newer than its distance, in ns.
    latency_ns
        From a measurement to the fastest answer, in ns.
    precise_tape
        Whether it has the EDM mode for precise distances to tape, which came with the TS30.
    """

    angle_delay_ns: int = 0
    latency_ns: int = 0
    precise_tape: bool = False


_MODELS: Final = (
    ("TS16", Model(angle_delay_ns=7_220_000)),
    ("TS60", Model(angle_delay_ns=4_980_000, precise_tape=True)),
    ("MS60", Model(precise_tape=True)),
    ("TS30", Model(precise_tape=True)),
    ("TM30", Model(precise_tape=True)),
    ("MS50", Model(precise_tape=True)),
    ("TS50", Model(precise_tape=True)),
    ("TM50", Model(precise_tape=True)),
)


def model_of(name: str) -> Model:
    """Return what is known of the model with this name, as the instrument gives it."""
    plain = name.upper().replace(" ", "").removeprefix("LEICA").removeprefix("NOVA")
    return next((model for begin, model in _MODELS if plain.startswith(begin)), Model())
