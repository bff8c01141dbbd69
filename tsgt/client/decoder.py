"""Sans-I/O: lines become records; poses and measurements get their time on the clock of this computer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tsgt.client.build import INTEGER_BITS, TYPES, build, load
from tsgt.client.delay import LeastDelay
from tsgt.client.records import PROTOCOL_VERSION, Event, Gap, Measurement, Pose, Record
from tsgt.errors import StreamError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.client.links import Arrival, Link

_MADE_KEY = {
    "status": "stamp_ns",
    "event": "stamp_ns",
    "measurement": "received_ns",
    "point": "received_ns",
}
"""Of lines that are sent as soon as they are made: the key of that time on the master's Unix clock."""


@dataclass(frozen=True, slots=True)
class MasterClock:
    """The master's Unix clock in one session, as far as lines have told its offset to the clock of this computer."""

    link: Link
    delay: LeastDelay
    """From the master's clock to the link's."""

    @property
    def known(self) -> bool:
        """Whether there was a line that tells the offset."""
        return self.delay.known

    def here_ns(self, stamp_ns: int) -> int:
        """Return a time of the master's clock on the clock of this computer, by all lines so far."""
        return self.link.here_ns(self.delay.here_ns(stamp_ns))


class Decoder:
    """Decodes the lines of a link."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self.clock = MasterClock(link, LeastDelay())
        """The clock of the present session."""
        self.greeted = False
        """Whether there was a greeting."""

    @property
    def offset_ns(self) -> float:
        """Upper bound of the offset from the master's clock to ours; infinite without a line that tells it."""
        return self.clock.here_ns(0) if self.clock.known else math.inf

    def decode(self, arrival: Arrival) -> Iterator[Record]:
        """Yield the records of a line, none for an unknown type; raises StreamError for another protocol or a wrong line.

        The epochs of poses and measurements are those by the lines so far; later ones may show them to be earlier.
        """
        data = load(arrival.line)
        kind = data["type"]
        if kind == "hello":
            protocol = data.get("protocol")
            if protocol != PROTOCOL_VERSION:
                raise ProtocolVersionError(
                    f"the stream has protocol version {protocol}, this program supports version {PROTOCOL_VERSION}"
                )
            self.greeted = True
            # The Unix clock of the next session may differ.
            self.clock = MasterClock(self._link, LeastDelay())
        elif not self.greeted:
            raise StreamError("the stream does not begin with a greeting: not a stream of tsgt")
        if (made_ns := _made_ns(kind, data)) is not None:
            self.clock.delay.sample(made_ns, arrival.arrived_ns)
        cls = TYPES.get(kind)
        if cls is None:
            return
        if cls is Pose or cls is Measurement:
            yield build(cls, data, epoch_ns=self._epoch_ns(data, arrival))
            return
        record = build(cls, data)
        yield record
        if isinstance(record, Event) and record.event == "lines_lost":
            yield Gap(lines=record.count, reason="this reader was too slow for the master")

    def _epoch_ns(self, data: dict[str, Any], arrival: Arrival) -> int:
        stamp_ns = data.get("stamp_ns")
        if not isinstance(stamp_ns, int):
            raise StreamError(f"a {data['type']} has no integer stamp_ns")
        return self.clock.here_ns(stamp_ns) if self.clock.known else self._link.here_ns(arrival.arrived_ns)


class ProtocolVersionError(StreamError):
    """The stream is of another version, which this program would misread; trying again does not help."""


def _made_ns(kind: str, data: dict[str, Any]) -> int | None:
    if kind == "pose":
        made_ns = data.get("stamp_ns") if data.get("kind") == "predicted" else None
    else:
        made_ns = data.get(_MADE_KEY.get(kind, ""))
    return made_ns if isinstance(made_ns, int) and made_ns.bit_length() <= INTEGER_BITS else None
