"""The station's side of the paper's protocol: packets and their instants in, answers and orders out."""

from __future__ import annotations

from tsgt.radio.classic.messages import (
    Acknowledgement,
    MeasurementMessage,
    PingReply,
    TimeReply,
    decode_command,
    no_measurement_yet,
)
from tsgt.radio.commands import DirectCommand, MeasureCommand, TrackCommand

_INTRODUCTIONS = 8
"""So many requests are answered as if there were no measurement yet, unless the station is synchronised before.

A master that knew the station before its restart cannot see from a measurement that its clock may be another one. One
that is told that there is none can. It may not hear the first answers; but after five seconds of silence it doubts the
clock by itself, and into these fit about six of its requests."""


ClassicCommand = TrackCommand | DirectCommand | MeasureCommand
"""What this protocol can order."""


class ClassicStation:
    """What a station answers.

    One order is under way at a time. Until it has been reported as done (:meth:`executed`, :meth:`shot`), others
    are passed over: the master asks again.

    Parameters
    ----------
    station
        Its number, 1 to 9.
    """

    def __init__(self, station: int) -> None:
        self._station = station
        self._newest = no_measurement_yet(station)
        self._introductions = _INTRODUCTIONS
        self._stamp_ns = 0
        self._direct = False
        self._prism: int | None = None
        self._under_way: ClassicCommand | None = None

    def measured(self, message: MeasurementMessage) -> None:
        """Keep the newest measurement of the tracked prism for the next request, and for those after it."""
        self._newest = message

    def received(self, payload: bytes, at_ns: int) -> bytes | ClassicCommand | None:
        """Take a packet.

        Parameters
        ----------
        payload
            Whatever the radio has heard.
        at_ns
            Its RxDone on the station's Unix clock in ns.

        Returns
        -------
        bytes, ClassicOrder or None
            The answer, to be sent at once; an order to be carried out and then reported; or None, where there is
            nothing to answer: the packet is not for this station, not of this protocol, or ``p`` or ``c``.
        """
        command = decode_command(payload)
        if command is None or command.station != self._station:
            return None
        match command.letter:
            case "t" if self._direct:
                return self._begin(MeasureCommand())
            case "t" if self._introductions:
                self._introductions -= 1
                return no_measurement_yet(self._station).to_bytes()
            case "t":
                return self._newest.to_bytes()
            case "e":
                self._introductions = 0
                self._stamp_ns = at_ns
                return PingReply(self._station).to_bytes()
            case "s":
                return TimeReply(self._stamp_ns).to_bytes()
            case "d" if self._direct and self._under_way is None:
                return Acknowledgement("d", ok=True).to_bytes()
            case "d":
                return self._begin(DirectCommand())
            case "n" if self._tracks(command.prism) and self._under_way is None:
                return Acknowledgement("n", ok=True).to_bytes()
            case "n":
                return self._begin(TrackCommand(command.prism))
            case "p" | "c":  # synchronisation is no mode here: a ping is answered at any time
                return None

    def executed(self, order: TrackCommand | DirectCommand, *, ok: bool) -> bytes:
        """Report that an order has been carried out, or has failed; return the answer to be sent."""
        self._under_way = None
        if isinstance(order, DirectCommand):
            self._direct = self._direct or ok
            return Acknowledgement("d", ok).to_bytes()
        if ok:
            self._direct = False
            self._prism = order.prism or self._prism
            # What was measured before may have been another prism.
            self._newest = no_measurement_yet(self._station)
        return Acknowledgement("n", ok).to_bytes()

    def shot(self, message: MeasurementMessage) -> bytes:
        """Report a single measurement, or with its status that it failed; return the answer to be sent."""
        self._under_way = None
        return message.to_bytes()

    def _tracks(self, prism: int | None) -> bool:
        return not self._direct and prism in (None, self._prism)

    def _begin(self, order: ClassicCommand) -> ClassicCommand | None:
        if self._under_way is not None:
            return None
        self._under_way = order
        return order
