"""Where poses come from: the master's UNIX socket, or a relay on another computer."""

from __future__ import annotations

import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path

from tsgt.client.relay_wire import DEFAULT_PORT, KEY_BYTES
from tsgt.errors import StreamError

DEFAULT_SOCKET = Path("/run/tsgt/poses.sock")

_RELAY = re.compile(r"relay(s?)://(\[[^\]/]+\]|[^\[\]:/?#@\s]+)(?::(\d{1,5}))?/?")
_MAX_KEY_FILE_BYTES = 1024


@dataclass(frozen=True, slots=True)
class SocketSource:
    """A UNIX socket: of a master, of ``tsgt replay``, or the local end of ``ssh -L``."""

    path: Path

    def __str__(self) -> str:
        return str(self.path)


@dataclass(frozen=True, slots=True)
class RelaySource:
    """A relay."""

    host: str
    port: int
    tls: bool

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"relay{'s' if self.tls else ''}://{host}:{self.port}"


def parse_source(source: str | os.PathLike[str]) -> SocketSource | RelaySource:
    """Parse ``/run/tsgt/poses.sock``, ``relay://HOST[:PORT]`` or, with TLS, ``relays://HOST[:PORT]``; raises ValueError."""
    text = os.fspath(source)
    if "://" not in text:
        return SocketSource(Path(text))
    match = _RELAY.fullmatch(text)
    port = int(match[3]) if match is not None and match[3] else DEFAULT_PORT
    if match is None or not 0 < port < 1 << 16:
        raise ValueError(
            f"{text}: expected the path of a socket, relay://HOST:PORT, or relays://HOST:PORT with TLS"
        )
    return RelaySource(match[2].strip("[]"), port, tls=bool(match[1]))


def read_key_file(path: str | os.PathLike[str]) -> bytes:
    """Read a relay's key, as ``tsgt relay --make-key`` makes it; raises StreamError if it is none, or others may read it."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            status = os.fstat(descriptor)
            content = os.read(descriptor, _MAX_KEY_FILE_BYTES)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise StreamError(f"{os.fspath(path)}: the key cannot be read ({error.strerror})") from error
    if not stat.S_ISREG(status.st_mode) or status.st_mode & 0o077:
        raise StreamError(f"{os.fspath(path)}: only its owner may have access to a key; `chmod 600` the file")
    if re.fullmatch(rb"\s*[0-9A-Fa-f]{%d}\s*" % (2 * KEY_BYTES), content) is None:
        raise StreamError(
            f"{os.fspath(path)}: not a key, which is one line of {2 * KEY_BYTES} hexadecimal digits"
        )
    return bytes.fromhex(content.decode("ascii"))
