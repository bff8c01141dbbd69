"""Target search with a Leica instrument: executes a search window of the reacquisition sequence and locks on."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import structlog

from tsgt.errors import InstrumentRefusedError
from tsgt.station.geocom import Outcome, ReturnCode, Rpc, name_of, outcome_of
from tsgt.station.leica.identity import numeric_values, succeeded
from tsgt.station.leica.reacquisition import (
    ATR_FIELD_OF_VIEW_RAD,
    MAX_FINE_ADJUST_RAD,
    Lock,
    Pointing,
    SearchWindow,
)

if TYPE_CHECKING:
    from tsgt.station.geocom import GeoComConnection, Parameter, Reply

log = structlog.get_logger()

_TRIES: Final = 3
_TURN_TIMEOUT_S: Final = 30.0
_FINE_ADJUST_TIMEOUT_S: Final = 15.0  # the instrument gives up after 5 s
_WINDOW_TIMEOUT_S: Final = 90.0
_FULL_CIRCLE_TIMEOUT_S: Final = 120.0
_CLOCKWISE, _WITH_SWING = 1, 1
_MAX_SWEEPS: Final = 3
_HERE: Final = SearchWindow("pointing at it", False, None, ATR_FIELD_OF_VIEW_RAD, ATR_FIELD_OF_VIEW_RAD)
_NEARBY: Final = SearchWindow("searching nearby", True, None, MAX_FINE_ADJUST_RAD, MAX_FINE_ADJUST_RAD)


_UNAVAILABLE: Final = frozenset({Outcome.UNAVAILABLE, Outcome.LICENCE})


class RoboticLicenceMissing(Exception):  # noqa: N818 (not an error: the operator takes over)
    """The instrument lacks the licence GeoCOM Robotic: it must not be moved and cannot search."""


class TargetSearch:
    """Searches over one connection. Methods raise :class:`RoboticLicenceMissing` where the instrument lacks the licence.

    ``power_search``: whether the instrument has PowerSearch; otherwise the target recognition searches the same
    windows, more slowly. ``target_found``: whether the current search has found a target and only has to lock on.
    """

    def __init__(self, line: GeoComConnection, *, power_search: bool) -> None:
        self._line = line
        self._power_search = power_search
        self.target_found = False

    async def release_lock(self) -> Lock:
        """Release the target and return the lock state then; the telescope stays where it is, or where the operator turns it.

        Raises InstrumentRefusedError if it is not known to be released: it would be measured as the next target.
        """
        for _ in range(_TRIES):
            reply = await self._call(Rpc.AUS_SET_USER_LOCK_STATE, 0)
            lock = await lock_state(self._line)
            if lock is Lock.OUT or (succeeded(reply) and lock is not Lock.IN):
                return lock or Lock.OUT
        raise InstrumentRefusedError(
            f"the instrument does not release the prism that it follows: {name_of(reply.code)}; try again, or switch"
            " its lock off"
        )

    async def search(self, window: SearchWindow) -> bool:
        """Search a window and lock on, with target recognition on first; return whether it is locked on now."""
        self.target_found = False
        await self._call(Rpc.AUS_SET_USER_LOCK_STATE, 0)
        await self._call(Rpc.AUS_SET_USER_ATR_STATE, 1)
        if window.centre is not None and not (window.sweep and self._power_search):
            await self._call(Rpc.AUT_MAKE_POSITIONING, *window.centre, 0, 0, 0, timeout_s=_TURN_TIMEOUT_S)
        if not (
            await self._sweep_and_adjust(window) if window.sweep else succeeded(await self._adjust(window))
        ):
            return False
        self.target_found = True
        await self._call(Rpc.AUS_SET_USER_LOCK_STATE, 1)
        await self._call(Rpc.AUT_LOCK_IN, timeout_s=_FINE_ADJUST_TIMEOUT_S)
        return await lock_state(self._line) is Lock.IN

    async def _sweep_and_adjust(self, window: SearchWindow) -> bool:
        """Sweep and point at the target; sweep again nearby if the robot has moved on meanwhile."""
        for _ in range(_MAX_SWEEPS):
            if not await self._sweep(window):
                return False
            self.target_found = True
            # The operator may have locked on meanwhile; another sweep would release that lock.
            if succeeded(await self._adjust(_HERE)) or await lock_state(self._line) is Lock.IN:
                return True
            window = _NEARBY
        self.target_found = False
        return False

    async def _adjust(self, window: SearchWindow) -> Reply:
        area = window.width_rad, window.height_rad, 0
        return await self._call(Rpc.AUT_FINE_ADJUST, *area, timeout_s=_FINE_ADJUST_TIMEOUT_S)

    async def disable_atr(self) -> None:
        """Switch the target recognition off, for targets that it does not recognise."""
        await self._call(Rpc.AUS_SET_USER_ATR_STATE, 0)

    async def fine_adjust(self) -> Reply:
        """Point exactly at the prism in the field of view, without locking on; return the reply, which may be that there is none."""
        await self._call(Rpc.AUS_SET_USER_ATR_STATE, 1)
        return await self._adjust(_HERE)

    async def _sweep(self, window: SearchWindow) -> bool:
        if self._power_search:
            reply = await self._sweep_by_power_search(window)
            if reply is None:
                return False
            if outcome_of(reply.code, has_values=False) not in _UNAVAILABLE:
                return succeeded(reply)
            # The licence is present, as other procedures need it, too.
            self._power_search = False
            log.warning("power_search_unavailable", code=name_of(reply.code))
            if window.centre is not None:
                await self._call(Rpc.AUT_MAKE_POSITIONING, *window.centre, 0, 0, 0, timeout_s=_TURN_TIMEOUT_S)
        area = min(window.width_rad, math.pi), window.height_rad, 0
        return succeeded(await self._call(Rpc.AUT_SEARCH, *area, timeout_s=_WINDOW_TIMEOUT_S))

    async def _sweep_by_power_search(self, window: SearchWindow) -> Reply | None:
        """Return the reply; None where it is not known where to search."""
        if window.is_full_circle:
            return await self._line.call(
                Rpc.AUT_PS_SEARCH_NEXT, _CLOCKWISE, _WITH_SWING, timeout_s=_FULL_CIRCLE_TIMEOUT_S
            )
        centre = window.centre or await pointing(self._line)
        if centre is None:
            return None
        area = window.width_rad, window.height_rad, 1
        reply = await self._line.call(Rpc.AUT_SET_SEARCH_AREA, *centre, *area)
        if outcome_of(reply.code, has_values=False) in _UNAVAILABLE:
            return reply
        return await self._line.call(Rpc.AUT_PS_SEARCH_WINDOW, timeout_s=_WINDOW_TIMEOUT_S)

    async def _call(self, rpc: Rpc, *parameters: Parameter, timeout_s: float = 3.0) -> Reply:
        reply = await self._line.call(rpc, *parameters, timeout_s=timeout_s)
        if outcome_of(reply.code, has_values=False) is Outcome.LICENCE:
            raise RoboticLicenceMissing
        return reply


async def lock_state(line: GeoComConnection) -> Lock | None:
    """Query the lock state, which needs no licence; None where the instrument does not report it."""
    for _ in range(_TRIES):
        values = numeric_values(await line.call(Rpc.MOT_READ_LOCK_STATUS), 1)
        if values is not None and values[0] in (0, 1, 2):
            return Lock(int(values[0]))
    return None


async def pointing(line: GeoComConnection) -> Pointing | None:
    """Query where the telescope points; None where the instrument has no valid angles."""
    reply = await line.call(Rpc.TMC_GET_ANGLE5, 1)
    values = numeric_values(reply, 2)
    if values is None or reply.code == ReturnCode.TMC_ANGLE_ERROR:
        return None
    return Pointing(*values)
