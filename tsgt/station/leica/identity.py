"""Identity, capabilities and power supply of a Leica instrument: what it reports, and what is known of its model.

The delays between distance and angles are those of the University of Bonn's tracking software (rts-network). The latency
to the fastest reply is unknown, as published figures include the serial line: measure it, or estimate it from motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

from tsgt.station.geocom import Outcome, ReturnCode, Rpc, outcome_of

if TYPE_CHECKING:
    from tsgt.station.geocom import GeoComConnection, Reply

Numbers = tuple[float, ...]

_ATR, _POWER_SEARCH = 0x8, 0x800

_POWER_PROBLEMS: Final = {
    int(ReturnCode.LOW_POWER): "its battery lasts for some 30 minutes more; change it",
    int(ReturnCode.BATT_EMPTY): "its battery is empty; it switches off within a minute",
}


class ModelProperties(NamedTuple):
    """Properties of a model that the instrument does not report.

    Attributes
    ----------
    angle_delay_ns
        Time of the angles minus time of the distance.
    latency_ns
        Time from a measurement to the fastest reply.
    precise_tape
        Whether it has the EDM mode for precise distances to tape, introduced with the TS30.
    """

    angle_delay_ns: int = 0
    latency_ns: int = 0
    precise_tape: bool = False


_MODELS: Final = {
    "TS16": ModelProperties(angle_delay_ns=7_220_000),
    "TS60": ModelProperties(angle_delay_ns=4_980_000, precise_tape=True),
    **dict.fromkeys(("MS60", "TS30", "TM30", "MS50", "TS50", "TM50"), ModelProperties(precise_tape=True)),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """Identity and capabilities of an instrument; text is empty where the instrument does not report it.

    Attributes
    ----------
    robotic
        Whether it has the licence GeoCOM Robotic, without which it must not be moved or made to search. None: unknown.
    atr, power_search
        Whether it has target recognition and PowerSearch; True where it does not report it.
    battery_percent
        None where it does not report it.
    external_power
        Whether it has an external power supply.
    power_problem
        Action required of the operator; empty for none.
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

    @property
    def properties(self) -> ModelProperties:
        """Properties of its model, by the prefix of the name; the defaults for an unknown model."""
        name = self.model.upper().replace(" ", "").removeprefix("LEICA").removeprefix("NOVA")
        return next(
            (model for prefix, model in _MODELS.items() if name.startswith(prefix)), ModelProperties()
        )


def numeric_values(reply: Reply, count: int) -> Numbers | None:
    """Return the first values of a reply; None if there are fewer, or one is not a finite number."""
    values = reply.values[:count]
    if len(values) < count or any(isinstance(value, str) or not math.isfinite(value) for value in values):
        return None
    return tuple(float(value) for value in values)


def succeeded(reply: Reply) -> bool:
    """Whether a procedure was carried out."""
    return outcome_of(reply.code, has_values=bool(reply.values)) is Outcome.USABLE


async def identify(line: GeoComConnection, before: Identity | None = None) -> Identity:
    """Query an instrument's identity; only what changes, if it is the one met before."""
    serial = await line.call(Rpc.CSV_GET_INSTRUMENT_NO)
    serial_number = str(serial.values[0]) if serial.values else ""
    robotic = await _has_robotic_licence(line)
    if before is not None and serial_number and serial_number == before.serial_number:
        return await read_power(line, replace(before, robotic=robotic))
    identity = await read_power(line, Identity(serial_number=serial_number, robotic=robotic))
    name = await line.call(Rpc.CSV_GET_INSTRUMENT_NAME)
    device = numeric_values(await line.call(Rpc.CSV_GET_DEVICE_CONFIG), 2)
    return replace(
        identity,
        model=str(name.values[0]).strip() if name.values else "",
        firmware=_version(await line.call(Rpc.CSV_GET_SW_VERSION)),
        geocom_release=_version(await line.call(Rpc.COM_GET_SW_VERSION)),
        atr=device is None or bool(int(device[1]) & _ATR),
        power_search=device is None or bool(int(device[1]) & _POWER_SEARCH),
    )


async def _has_robotic_licence(line: GeoComConnection) -> bool | None:
    reply = await line.call(Rpc.AUT_GET_FINE_ADJUST_MODE)
    if succeeded(reply):
        return True
    return False if outcome_of(reply.code, has_values=False) is Outcome.LICENCE else None


async def read_power(line: GeoComConnection, identity: Identity) -> Identity:
    """Return the identity with the current state of the power supply, unchanged where the instrument does not report it."""
    reply = await line.call(Rpc.CSV_CHECK_POWER)
    if not succeeded(reply):
        return identity
    values = numeric_values(reply, 2)
    return replace(
        identity,
        battery_percent=round(values[0]) if values is not None and 0 <= values[0] <= 100 else None,
        external_power=values is not None and values[1] == 1,
        power_problem=_POWER_PROBLEMS.get(reply.code, ""),
    )


def _version(reply: Reply) -> str:
    values = numeric_values(reply, 3)
    if values is None:
        return ""
    release, version, sub = (int(value) for value in values)
    return f"{release}.{version:02d}" + (f".{sub}" if sub else "")
