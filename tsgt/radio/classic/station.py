"""The station's side of the paper's protocol: packets and their timestamps in, replies and commands out. Sans-I/O."""

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

_INITIAL_EMPTY_REPLIES = 8
"""This many polls after the start are answered as if there were no measurement, unless a synchronisation comes first.

A master that knew the station before a restart cannot see from a measurement that its clock may be another one; from a
missing measurement it can. It may miss the first replies, but after five seconds of silence it distrusts the clock itself,
and about six of its requests fit into these."""


ClassicCommand = TrackCommand | DirectCommand | MeasureCommand  # the commands of this protocol


class ClassicStation:
    """The replies of station ``station``, 1 to 9.

    One command is executed at a time. Until its result is reported (:meth:`executed`, :meth:`single_measured`), others
    are ignored, and the master repeats them.
    """

    def __init__(self, station: int) -> None:
        self._station = station
        self._newest = no_measurement_yet(station)
        self._empty_replies_left = _INITIAL_EMPTY_REPLIES
        self._ping_ns = 0
        self._direct = False
        self._prism: int | None = None
        self._executing: ClassicCommand | None = None

    def measured(self, message: MeasurementMessage) -> None:
        """Keep the newest measurement of the tracked prism; it answers every poll until there is a newer one."""
        self._newest = message

    def received(self, payload: bytes, at_ns: int) -> bytes | ClassicCommand | None:
        """Take any packet, with its RxDone on the station's Unix clock.

        Returns a reply to send at once; a command to execute and report; or None: the packet is not for this station,
        not of this protocol, or ``p`` or ``c``.
        """
        command = decode_command(payload)
        if command is None or command.station != self._station:
            return None
        match command.letter:
            case "t" if self._direct:
                return self._begin(MeasureCommand())
            case "t" if self._empty_replies_left:
                self._empty_replies_left -= 1
                return no_measurement_yet(self._station).to_bytes()
            case "t":
                return self._newest.to_bytes()
            case "e":
                self._empty_replies_left = 0
                self._ping_ns = at_ns
                return PingReply(self._station).to_bytes()
            case "s":
                return TimeReply(self._ping_ns).to_bytes()
            case "d" if self._direct and self._executing is None:
                return Acknowledgement("d", ok=True).to_bytes()
            case "d":
                return self._begin(DirectCommand())
            case "n" if self._tracks(command.prism) and self._executing is None:
                return Acknowledgement("n", ok=True).to_bytes()
            case "n":
                return self._begin(TrackCommand(command.prism))
            case "p" | "c":  # synchronisation is no mode here: a ping is answered at any time
                return None

    def executed(self, command: TrackCommand | DirectCommand, *, ok: bool) -> bytes:
        """Report that a command was executed or has failed; return the reply."""
        self._executing = None
        if isinstance(command, DirectCommand):
            self._direct = self._direct or ok
            return Acknowledgement("d", ok).to_bytes()
        if ok:
            self._direct = False
            self._prism = command.prism or self._prism
            # The last measurement may be of another prism.
            self._newest = no_measurement_yet(self._station)
        return Acknowledgement("n", ok).to_bytes()

    def single_measured(self, message: MeasurementMessage) -> bytes:
        """Report a single measurement, or its failure by its status; return the reply."""
        self._executing = None
        return message.to_bytes()

    def _tracks(self, prism: int | None) -> bool:
        return not self._direct and prism in (None, self._prism)

    def _begin(self, command: ClassicCommand) -> ClassicCommand | None:
        if self._executing is not None:
            return None
        self._executing = command
        return command
