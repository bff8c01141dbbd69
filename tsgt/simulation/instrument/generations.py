"""What the generations of Leica's robotic total stations know of GeoCOM: procedures, EDM modes, prism types, devices.

Sources: Leica, TPS1200 GeoCOM Reference Manual, version 1.20, for the TPS1200; for the others the generation in which a
procedure was added or removed, as the documentation of GeoComPy 1.0 states it from Leica's manuals. Which procedures a firmware
really has is known to nobody but its owner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from tsgt.station.geocom import Rpc

_MOTORS, _ATR, _REFLECTORLESS, _POWER_SEARCH, _SIMULATOR = 0x4, 0x8, 0x400, 0x800, 0x4000
_ALL_DEVICES: Final = _MOTORS | _ATR | _REFLECTORLESS | _POWER_SEARCH | _SIMULATOR

_SINCE_TPS1200: Final = frozenset(
    {
        Rpc.TMC_SET_ATM_PPM,
        Rpc.TMC_GET_ATM_PPM,
        Rpc.TMC_SET_GEO_PPM,
        Rpc.TMC_GET_GEO_PPM,
        Rpc.TMC_GET_FULL_MEAS,
        Rpc.CSV_GET_REFLECTORLESS_CLASS,
        Rpc.CSV_GET_DATE_TIME_CENTI_SEC,
        Rpc.AUT_PS_SET_RANGE,
        Rpc.AUT_PS_ENABLE_RANGE,
        Rpc.AUT_PS_SEARCH_NEXT,
        Rpc.AUT_PS_SEARCH_WINDOW,
        Rpc.BAP_SET_PRISM_TYPE2,
        Rpc.BAP_GET_PRISM_TYPE2,
        Rpc.BAP_SET_USER_PRISM_DEF,
        Rpc.BAP_GET_USER_PRISM_DEF,
        Rpc.BAP_GET_ATR_SETTING,
        Rpc.BAP_SET_ATR_SETTING,
        Rpc.BAP_GET_RED_ATR_FOV,
        Rpc.BAP_SET_RED_ATR_FOV,
    }
)
_SINCE_VIVA: Final = frozenset({Rpc.EDM_IS_CONT_MEAS_ACTIVE})
_UNTIL_TPS1100: Final = frozenset(
    {
        Rpc.AUT_SET_ATR_STATUS,
        Rpc.AUT_GET_ATR_STATUS,
        Rpc.AUT_SET_LOCK_STATUS,
        Rpc.AUT_GET_LOCK_STATUS,
        Rpc.CTL_GET_UP_COUNTER,
    }
)
_MODES: Final = frozenset(range(1, 13))
_PROGRAMS: Final = frozenset({0, 1, 2, 3, 4, 6, 7, 8, 9})
_SYNCHRO: Final = 10
_PRECISE_MODES: Final = frozenset({13, 14})
_OLD_PRISMS: Final = frozenset({0, 1, 2, 3})
_PRISMS: Final = frozenset({0, 1, 2, 3, 7, 8, 9, 10, 11, 12})


@dataclass(frozen=True, slots=True)
class Generation:
    """A generation of instruments.

    Attributes
    ----------
    name
        As it identifies itself.
    unknown
        Procedures that it does not have.
    edm_modes, programs, prism_types
        Numbers that it accepts.
    devices
        Bit mask of what is built in.
    """

    name: str
    unknown: frozenset[Rpc] = frozenset()
    edm_modes: frozenset[int] = _MODES
    programs: frozenset[int] = _PROGRAMS | {_SYNCHRO}
    prism_types: frozenset[int] = _PRISMS
    devices: int = _ALL_DEVICES


GENERATIONS: Final = {
    "TPS1100": Generation(
        "TCRA1101plus",
        _SINCE_TPS1200 | _SINCE_VIVA,
        programs=_PROGRAMS,
        prism_types=_OLD_PRISMS,
        devices=_ALL_DEVICES & ~_POWER_SEARCH,
    ),
    # Its manual has neither full measurements nor the procedure that sets a prism constant.
    "TPS1200": Generation(
        "TCRP1201",
        _SINCE_VIVA | _UNTIL_TPS1100 | {Rpc.TMC_SET_PRISM_CORR, Rpc.TMC_GET_FULL_MEAS},
        programs=_PROGRAMS,
    ),
    "TPS1200+": Generation("TCRP1201+"),  # of all that have been, so that other clients can be tested with it
    "TS15": Generation("TS15 P 1 R1000", _UNTIL_TPS1100),
    "MS50": Generation("MS50 1 R2000", _UNTIL_TPS1100, edm_modes=_MODES | _PRECISE_MODES),
    "TS16": Generation("TS16 P 1 R500", _UNTIL_TPS1100),
    "MS60": Generation("MS60 1 R2000", _UNTIL_TPS1100, edm_modes=_MODES | _PRECISE_MODES),
}
