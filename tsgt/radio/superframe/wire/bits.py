"""Bit fields of any width, most significant bit first, without gaps."""

from __future__ import annotations

from tsgt.errors import MessageError

_BYTE = 8


class BitWriter:
    """Appends unsigned integers to a bit string."""

    __slots__ = ("_bits", "_value")

    def __init__(self) -> None:
        self._value = 0
        self._bits = 0

    def put(self, value: int, width: int) -> None:
        """Append a number as ``width`` bits; raise MessageError if it is not in 0 to 2**width - 1."""
        if value < 0 or value >> width:
            raise MessageError(f"{value} does not fit into {width} bits")
        self._value = self._value << width | value
        self._bits += width

    def to_bytes(self) -> bytes:
        """Return the bit string, zero-padded to whole bytes."""
        padding = -self._bits % _BYTE
        return (self._value << padding).to_bytes((self._bits + padding) // _BYTE, "big")


class BitReader:
    """Reads unsigned integers from a bit string; ``remaining`` is the number of unread bits."""

    __slots__ = ("_value", "remaining")

    def __init__(self, content: bytes) -> None:
        self._value = int.from_bytes(content, "big")
        self.remaining = _BYTE * len(content)

    def take(self, width: int) -> int:
        """Return the next ``width`` bits; raise MessageError if fewer are left."""
        self.remaining -= width
        if self.remaining < 0:
            raise MessageError("the message is cut off")
        return self._value >> self.remaining & (1 << width) - 1
