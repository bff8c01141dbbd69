"""Numbers of any width, packed into bytes: the most significant bit first, without gaps."""

from __future__ import annotations

from tsgt.errors import MessageError

_BYTE = 8


class BitWriter:
    """Appends numbers to a string of bits."""

    __slots__ = ("_bits", "_value")

    def __init__(self) -> None:
        self._value = 0
        self._bits = 0

    def put(self, value: int, width: int) -> None:
        """Append a number.

        Parameters
        ----------
        value
            0 to 2**width - 1.
        width
            In bits, 0 and more.

        Raises
        ------
        MessageError
            The number does not fit.
        """
        if value < 0 or value >> width:
            raise MessageError(f"{value} does not fit into {width} bits")
        self._value = self._value << width | value
        self._bits += width

    def to_bytes(self) -> bytes:
        """Return everything so far, filled up with zeros to whole bytes."""
        padding = -self._bits % _BYTE
        return (self._value << padding).to_bytes((self._bits + padding) // _BYTE, "big")


class BitReader:
    """Takes numbers from a string of bits, in the order in which they were appended.

    Parameters
    ----------
    content
        Whole bytes.
    """

    __slots__ = ("_remaining", "_value")

    def __init__(self, content: bytes) -> None:
        self._value = int.from_bytes(content, "big")
        self._remaining = _BYTE * len(content)

    @property
    def remaining(self) -> int:
        """How many bits are left."""
        return self._remaining

    def take(self, width: int) -> int:
        """Return the next number.

        Parameters
        ----------
        width
            In bits, 0 and more.

        Raises
        ------
        MessageError
            There are not that many bits any more.
        """
        self._remaining -= width
        if self._remaining < 0:
            raise MessageError("the message is cut off")
        return self._value >> self._remaining & (1 << width) - 1
