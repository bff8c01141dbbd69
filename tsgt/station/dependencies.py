"""Everything that the client daemon is given from outside."""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.clock import suspended_ns

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.radio import RadioOpener
    from tsgt.station.instrument import Instrument


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientDependencies:
    """Everything a station's client is given from outside.

    Attributes
    ----------
    clock
        Its Unix time is read once, at the start, and need not be right.
    key
        Key shared by the radios of a mission, for protocols with authentication; None: every sender is accepted.
    random_bits
        Returns a random number with a given number of bits.
    boot
        Identifies the start of this computer from which ``clock`` counts; empty where unknown: no other run is then
        assumed to share the clock.
    suspended_ns
        Returns for how long this computer has been suspended since that start.
    write
        See :class:`~tsgt.recording.RecordingWriter`.
    """

    instrument: Instrument
    open_radio: RadioOpener
    clock: Clock
    key: bytes | None = None
    random_bits: Callable[[int], int] = secrets.randbits
    boot: str = ""
    suspended_ns: Callable[[], int] = suspended_ns
    write: Callable[[int, memoryview], int] | None = None
