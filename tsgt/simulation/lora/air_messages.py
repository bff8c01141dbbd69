"""Messages between air server and clients: one JSON object per line, validated on arrival."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Annotated, Literal, Self, TypeVar

from pydantic import Field

from tsgt.recording import Typed, decode
from tsgt.simulation.lora.frames import Frame, Modulation

T = TypeVar("T")

MAX_LINE_BYTES = 4096
"""Maximum line length; a frame of 255 bytes takes less than 1000."""

Name = Annotated[str, Field(min_length=1, max_length=64)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Nanoseconds = Annotated[int, Field(ge=-(2**63), lt=2**63)]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMessage:
    """A :class:`Frame` with its :class:`Modulation` as flat fields."""

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
        """Convert a frame to its message."""
        flat = {**vars(frame.modulation), **{each.name: getattr(frame, each.name) for each in fields(frame)}}
        del flat["modulation"]
        return cls(payload_hex=flat.pop("payload").hex(), **flat)

    def frame(self) -> Frame:
        """Convert the message to a frame."""
        flat = asdict(self)
        modulation = Modulation(**{each.name: flat.pop(each.name) for each in fields(Modulation)})
        return Frame(modulation=modulation, payload=bytes.fromhex(flat.pop("payload_hex")), **flat)


@dataclass(frozen=True, slots=True, kw_only=True)
class Join:
    """First message of a client: name and crystal offset of its radio."""

    type: Literal["join"] = "join"
    name: Name
    crystal_ppm: Annotated[float, Field(ge=-1_000, le=1_000)] = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Transmit:
    """The client's radio transmits a frame."""

    type: Literal["transmit"] = "transmit"
    frame: FrameMessage


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """The client's radio cuts its frame."""

    type: Literal["stop"] = "stop"
    at_ns: Nanoseconds


@dataclass(frozen=True, slots=True, kw_only=True)
class Welcome:
    """Response to :class:`Join`: what all receivers share."""

    type: Literal["welcome"] = "welcome"
    seed: int
    noise_figure_db: Finite


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejected:
    """Rejection of a join or a message; the server closes the connection."""

    type: Literal["rejected"] = "rejected"
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Incoming:
    """Another radio transmits a frame."""

    type: Literal["incoming"] = "incoming"
    sender: Name
    crystal_ppm: Finite  # offset of the sender's carrier in 1e-6
    loss_db: Finite  # path loss to this radio, fading included
    loss_probability: Finite  # probability that the frame is lost in addition
    frame: FrameMessage


@dataclass(frozen=True, slots=True, kw_only=True)
class Stopped:
    """Another radio cut its frame."""

    type: Literal["stopped"] = "stopped"
    sender: Name
    at_ns: Nanoseconds


@dataclass(frozen=True, slots=True, kw_only=True)
class Left:
    """Another radio left the channel; its frame is cut."""

    type: Literal["left"] = "left"
    sender: Name


FromClient = Join | Transmit | Stop
FromServer = Welcome | Rejected | Incoming | Stopped | Left

_FROM_CLIENT: dict[str, type[FromClient]] = {"join": Join, "transmit": Transmit, "stop": Stop}
_FROM_SERVER: dict[str, type[FromServer]] = {
    "welcome": Welcome,
    "rejected": Rejected,
    "incoming": Incoming,
    "stopped": Stopped,
    "left": Left,
}


def decode_from_client(data: bytes) -> FromClient:
    """Decode a client's message; raise ValueError with a one-line text if it is invalid."""
    return _decode(_FROM_CLIENT, data)


def decode_from_server(data: bytes) -> FromServer:
    """Decode a server's message; raise ValueError with a one-line text if it is invalid."""
    return _decode(_FROM_SERVER, data)


def _decode(kinds: dict[str, type[T]], data: bytes) -> T:
    kind = decode(Typed, data).type
    if kind not in kinds:
        raise ValueError(f"unknown message type {kind!r}")
    return decode(kinds[kind], data)


class LineBuffer:
    """Splits a byte stream into lines."""

    def __init__(self) -> None:
        self._data = b""

    def lines(self, data: bytes) -> list[bytes]:
        """Add bytes and return the lines completed; raise ValueError if a line exceeds the limit."""
        *lines, self._data = (self._data + data).split(b"\n")
        if max(map(len, (*lines, self._data))) > MAX_LINE_BYTES:
            raise ValueError(f"line longer than {MAX_LINE_BYTES} bytes")
        return lines
