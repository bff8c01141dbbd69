"""What an air server and its clients say to each other: one JSON object a line, checked on arrival."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, Self, TypeVar

from pydantic import Field

from tsgt.recording import Typed, decode
from tsgt.simulation.lora.frames import Frame, Modulation

T = TypeVar("T")

MAX_LINE_BYTES = 4096
"""Longest line; a frame of 255 bytes takes less than a thousand."""

Name = Annotated[str, Field(min_length=1, max_length=64)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Nanoseconds = Annotated[int, Field(ge=-(2**63), lt=2**63)]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLine:
    """A frame, flat; the fields are those of :class:`Frame` and :class:`Modulation`."""

    frequency_hz: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    spreading_factor: Annotated[int, Field(ge=6, le=12)]
    bandwidth_hz: Annotated[float, Field(ge=1_000, le=1_000_000)]
    inverted_iq: bool
    sync_word: Annotated[int, Field(ge=0, le=0xFF)]
    explicit_header: bool
    low_data_rate: bool
    coding_rate: Annotated[int, Field(ge=5, le=8)]
    crc: bool
    preamble_symbols: Annotated[int, Field(ge=0, le=0xFFFF)]
    payload_hex: Annotated[str, Field(pattern="^([0-9a-f]{2}){1,255}$")]
    power_dbm: Annotated[float, Field(ge=-200, le=100)]
    start_ns: Nanoseconds

    @classmethod
    def of(cls, frame: Frame) -> Self:
        """Make the line of a frame."""
        modulation = frame.modulation
        return cls(
            frequency_hz=modulation.frequency_hz,
            spreading_factor=modulation.spreading_factor,
            bandwidth_hz=modulation.bandwidth_hz,
            inverted_iq=modulation.inverted_iq,
            sync_word=modulation.sync_word,
            explicit_header=modulation.explicit_header,
            low_data_rate=modulation.low_data_rate,
            coding_rate=frame.coding_rate,
            crc=frame.crc,
            preamble_symbols=frame.preamble_symbols,
            payload_hex=frame.payload.hex(),
            power_dbm=frame.power_dbm,
            start_ns=frame.start_ns,
        )

    def frame(self) -> Frame:
        """Make the frame of a line."""
        return Frame(
            modulation=Modulation(
                frequency_hz=self.frequency_hz,
                spreading_factor=self.spreading_factor,
                bandwidth_hz=self.bandwidth_hz,
                inverted_iq=self.inverted_iq,
                sync_word=self.sync_word,
                explicit_header=self.explicit_header,
                low_data_rate=self.low_data_rate,
            ),
            coding_rate=self.coding_rate,
            crc=self.crc,
            preamble_symbols=self.preamble_symbols,
            payload=bytes.fromhex(self.payload_hex),
            power_dbm=self.power_dbm,
            start_ns=self.start_ns,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Join:
    """The first line of a client: what its radio is called and how far off its crystal is."""

    type: Literal["join"] = "join"
    name: Name
    crystal_ppm: Annotated[float, Field(ge=-1_000, le=1_000)] = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Transmit:
    """A client's radio sends a frame."""

    type: Literal["transmit"] = "transmit"
    frame: FrameLine


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """It stops sending before the frame has ended."""

    type: Literal["stop"] = "stop"
    at_ns: Nanoseconds


@dataclass(frozen=True, slots=True, kw_only=True)
class Welcome:
    """The server's answer to :class:`Join`: what all receivers have in common."""

    type: Literal["welcome"] = "welcome"
    seed: int
    noise_figure_db: Finite


@dataclass(frozen=True, slots=True, kw_only=True)
class Refused:
    """Its other answer: why not. Also said when it drops a client later."""

    type: Literal["refused"] = "refused"
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Incoming:
    """Another radio sends a frame.

    Attributes
    ----------
    sender
        Its name.
    crystal_ppm
        How far its carrier lies above what it is set to.
    loss_db
        Between the two, fading included.
    loss_probability
        That the frame is not heard nevertheless.
    frame
        What it sends.
    """

    type: Literal["incoming"] = "incoming"
    sender: Name
    crystal_ppm: Finite
    loss_db: Finite
    loss_probability: Finite
    frame: FrameLine


@dataclass(frozen=True, slots=True, kw_only=True)
class Stopped:
    """Another radio cut its frame short."""

    type: Literal["stopped"] = "stopped"
    sender: Name
    at_ns: Nanoseconds


@dataclass(frozen=True, slots=True, kw_only=True)
class Left:
    """Another radio is gone, and with it the frame that it was sending."""

    type: Literal["left"] = "left"
    sender: Name


FromClient = Join | Transmit | Stop
FromServer = Welcome | Refused | Incoming | Stopped | Left

_FROM_CLIENT: dict[str, type[FromClient]] = {"join": Join, "transmit": Transmit, "stop": Stop}
_FROM_SERVER: dict[str, type[FromServer]] = {
    "welcome": Welcome,
    "refused": Refused,
    "incoming": Incoming,
    "stopped": Stopped,
    "left": Left,
}


def decode_from_client(data: bytes) -> FromClient:
    """Read a client's line; raise ValueError, in one line, on anything else."""
    return _decode(_FROM_CLIENT, data)


def decode_from_server(data: bytes) -> FromServer:
    """Read a server's line; raise ValueError, in one line, on anything else."""
    return _decode(_FROM_SERVER, data)


def _decode(kinds: dict[str, type[T]], data: bytes) -> T:
    kind = decode(Typed, data).type
    if kind not in kinds:
        raise ValueError(f"there is no line of type {kind!r}")
    return decode(kinds[kind], data)


class LineBuffer:
    """Cuts what a socket delivers into lines."""

    def __init__(self) -> None:
        self._data = b""

    def lines(self, data: bytes) -> list[bytes]:
        """Take more bytes, return the lines that are whole now; raise ValueError if one is too long to be ours."""
        *lines, self._data = (self._data + data).split(b"\n")
        if max(map(len, (*lines, self._data))) > MAX_LINE_BYTES:
            raise ValueError(f"a line is longer than {MAX_LINE_BYTES} bytes")
        return lines
