"""What the programs for all makes of devices share: the form of a codec, and the dialogue that sets a device up. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.imu.lines import HelloLine
    from tsgt.model import Vector3


class DeviceSample(NamedTuple):
    """One sample: its count and time on the device where it has them, and rotation and velocity over its interval."""

    counter: int | None
    instrument_time_ns: int | None
    delta_angle_rad: Vector3
    delta_velocity_mps: Vector3


class Step(NamedTuple):
    """One request to a device; ``matches`` recognises its response, ``refusal`` says why the device refuses it."""

    request: bytes
    matches: Callable[[bytes], bool]
    refusal: Callable[[bytes], str | None]


class Device(Protocol):
    """The codec of one make of devices; bytes in, samples out."""

    @property
    def steps(self) -> Sequence[Step]:
        """Requests that set the device up, in their order."""
        ...

    def push(self, data: bytes) -> tuple[list[DeviceSample], list[bytes]]:
        """Take bytes from the device; return the samples and the other messages that they complete."""
        ...

    def hello(self) -> HelloLine:
        """Return what the device has said about itself in the responses so far."""
        ...


@dataclass(slots=True)
class Unwrapped:
    """Continues a count of the device that begins again at ``modulus``."""

    modulus: int
    _value: int | None = None

    def __call__(self, count: int) -> int:
        """Return the count with all its digits; it runs forwards."""
        last = self._value
        self._value = count if last is None else last + (count - last) % self.modulus
        return self._value
