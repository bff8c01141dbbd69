"""What the radios have said, as the guest's far ends report it to the host: which measurements were acknowledged."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import TYPE_CHECKING

from tsgt.errors import MessageError
from tsgt.radio.superframe.wire import ACK_FRAMES, CODE_BYTES, decode_beacon, decode_reply

if TYPE_CHECKING:
    from pathlib import Path

SEQUENCES = 256
"""A short reply has the low bits of its sequence numbers only, which suffice for some minutes."""


def acknowledged(report: Path, start: int = 0) -> set[int]:
    """Return the low bits of the sequence numbers that a beacon has acknowledged; ``start``: bytes of the report to skip."""
    found: set[int] = set()
    replies: dict[int, list[int]] = {}
    frame = -1
    *lines, _torn = report.read_bytes()[start:].split(b"\n")
    for line in lines:
        packet = json.loads(line)
        content = bytes.fromhex(packet["payload"])[:-CODE_BYTES]
        with suppress(MessageError):
            if packet["from"] == "client":
                blocks = decode_reply(content).blocks
                replies[frame] = [m.sequence % SEQUENCES for block in blocks for m in block.measurements]
                continue
            beacon = decode_beacon(content)
            frame = beacon.frame
            for age in range(ACK_FRAMES):
                if beacon.stations[0].ack_bitmap >> age & 1:
                    found.update(replies.get((frame - 1 - age) % 256, ()))
            replies.pop((frame + 128) % 256, None)  # of an earlier round of the counter
    return found
