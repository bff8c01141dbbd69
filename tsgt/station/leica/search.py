"""Making a Leica instrument look for its prism and lock in on it: a look of the loss sequence, carried out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from tsgt.station.geocom import ReturnCode, Rpc, Verdict, verdict
from tsgt.station.leica.identity import done, numbers
from tsgt.station.leica.reacquisition import NARROWEST_RAD, WIDEST_ADJUST_RAD, Lock, Look, Pointing

if TYPE_CHECKING:
    from tsgt.station.geocom import GeoComConnection, Parameter, Reply

_TRIES: Final = 3
_TURN_S: Final = 30.0
_ADJUST_S: Final = 15.0  # it gives up by itself after 5 s
_WINDOW_S: Final = 90.0
_ROUND_S: Final = 120.0
_CLOCKWISE, _WITH_SWING = 1, 1
_CHASES: Final = 3
_HERE: Final = Look("pointing at it", False, None, NARROWEST_RAD, NARROWEST_RAD)
_NEARBY: Final = Look("searching where it was found", True, None, WIDEST_ADJUST_RAD, WIDEST_ADJUST_RAD)


class LicenceMissing(Exception):  # noqa: N818 (it is no error: there is another way to go on)
    """The instrument may not be moved or made to search."""


class Finder:
    """Searches with one connection.

    Parameters
    ----------
    line
        To the instrument.
    power_search
        Whether it has PowerSearch; else the target recognition looks in the same windows, which takes longer.

    Attributes
    ----------
    has_found
        Whether the search has come upon a prism, and only has to lock in.
    """

    def __init__(self, line: GeoComConnection, *, power_search: bool) -> None:
        self._line = line
        self._power_search = power_search
        self.has_found = False

    async def lock(self) -> Lock | None:
        """Ask whether the instrument is locked in on a prism; None where it does not say."""
        for _ in range(_TRIES):
            values = numbers(await self._line.call(Rpc.MOT_READ_LOCK_STATUS), 1)
            if values is not None and values[0] in (0, 1, 2):
                return Lock(int(values[0]))
        return None

    async def release(self) -> None:
        """Let the prism go; the telescope stays where it is, or where a person turns it.

        Raises
        ------
        LicenceMissing
            It may not be told to.
        """
        await self._ask(Rpc.AUS_SET_USER_LOCK_STATE, 0)

    async def look(self, look: Look) -> bool:
        """Carry out a search and lock in; return whether the instrument is locked in now.

        Target recognition goes on before the lock, for switching it on afterwards would end that.

        Raises
        ------
        LicenceMissing
            It may not be made to search.
        InstrumentError
            It does not answer.
        """
        self.has_found = False
        await self._ask(Rpc.AUS_SET_USER_LOCK_STATE, 0)
        await self._ask(Rpc.AUS_SET_USER_ATR_STATE, 1)
        if look.centre is not None and not (look.sweep and self._power_search):
            await self.position(look.centre)
        if not await (self._sweep_and_adjust(look) if look.sweep else self._adjust(look)):
            return False
        self.has_found = True
        await self._ask(Rpc.AUS_SET_USER_LOCK_STATE, 1)
        await self._ask(Rpc.AUT_LOCK_IN, timeout_s=_ADJUST_S)
        return await self.lock() is Lock.IN

    async def _sweep_and_adjust(self, look: Look) -> bool:
        """Sweep, and point at what was found; a robot that has driven on before that is looked for nearby, at once."""
        sweeping = look
        for _ in range(_CHASES):
            if not done(await self._sweep(sweeping)):
                return False
            self.has_found = True
            # A person may have locked in meanwhile, which a sweep would undo.
            if await self._adjust(_HERE) or await self.lock() is Lock.IN:
                return True
            sweeping = _NEARBY
        self.has_found = False
        return False

    async def _adjust(self, look: Look) -> bool:
        area = look.width_rad, look.height_rad, 0
        return done(await self._ask(Rpc.AUT_FINE_ADJUST, *area, timeout_s=_ADJUST_S))

    async def position(self, to: Pointing) -> None:
        """Turn the telescope there; a lock is let go.

        Raises
        ------
        LicenceMissing
            It may not be moved.
        """
        await self._ask(Rpc.AUT_MAKE_POSITIONING, *to, 0, 0, 0, timeout_s=_TURN_S)

    async def stop_recognising(self) -> None:
        """Switch the target recognition off, for targets that it does not know.

        Raises
        ------
        LicenceMissing
            It may not be told to.
        """
        await self._ask(Rpc.AUS_SET_USER_ATR_STATE, 0)

    async def adjust(self) -> None:
        """Point exactly at the prism in the field of view, if there is one; it is not locked in on.

        Raises
        ------
        LicenceMissing
            It may not be moved.
        """
        await self._ask(Rpc.AUS_SET_USER_ATR_STATE, 1)
        await self._adjust(_HERE)

    async def _sweep(self, look: Look) -> Reply:
        if not self._power_search:
            area = min(look.width_rad, math.pi), look.height_rad, 0
            return await self._ask(Rpc.AUT_SEARCH, *area, timeout_s=_WINDOW_S)
        if look.is_round:
            return await self._ask(Rpc.AUT_PS_SEARCH_NEXT, _CLOCKWISE, _WITH_SWING, timeout_s=_ROUND_S)
        centre = look.centre or await self._here()
        await self._ask(Rpc.AUT_SET_SEARCH_AREA, *centre, look.width_rad, look.height_rad, 1)
        return await self._ask(Rpc.AUT_PS_SEARCH_WINDOW, timeout_s=_WINDOW_S)

    async def _here(self) -> Pointing:
        return await pointing(self._line) or Pointing(0.0, math.pi / 2)

    async def _ask(self, rpc: Rpc, *parameters: Parameter, timeout_s: float = 3.0) -> Reply:
        reply = await self._line.call(rpc, *parameters, timeout_s=timeout_s)
        if verdict(reply.code, has_values=False) is Verdict.LICENCE:
            raise LicenceMissing
        return reply


async def pointing(line: GeoComConnection) -> Pointing | None:
    """Ask where the telescope points; None where the instrument cannot tell."""
    reply = await line.call(Rpc.TMC_GET_ANGLE5, 1)
    values = numbers(reply, 2)
    if values is None or reply.code == ReturnCode.TMC_ANGLE_ERROR:
        return None
    return Pointing(*values)
