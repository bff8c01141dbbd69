"""Keeps a connection to a source and reads it, without ever waiting; the faces wait for it, each in its way.

:meth:`Pump.step` does what can be done at once. Between steps, wait until :meth:`Pump.wait_for` says that there is more
to do. Names are resolved in a thread, because a name that is out of reach takes seconds.
"""

from __future__ import annotations

import errno
import logging
import os
import select
import socket
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

from tsgt.client.backlog import Backlog
from tsgt.client.decoder import Decoder, ProtocolVersionError
from tsgt.client.links import Arrival, Link, RelayLink, SocketLink
from tsgt.client.records import Gap, Record, monotonic_ns
from tsgt.client.relay_wire import NO_CHANNEL, NONCE_BYTES, AuthenticationError
from tsgt.client.source import RelaySource, SocketSource
from tsgt.errors import StreamError

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.client.tls import Tls

BACK_OFF_S = (0.1, 2.0)
"""Wait before the first further attempt to connect, and the longest; it doubles in between."""

CONNECT_TIMEOUT_NS = 5_000_000_000
"""For everything until the first line."""

MAX_FAILURES_AT_KEY = 2
"""A relay that closes the connection at the proof of the key may have been busy; when it does again, the key is wrong."""

RECEIVE_BYTES = 1 << 16

MAX_RECEIVES = 2
"""Of one step, so that a burst, as after a resumption, neither keeps the caller for long nor overflows its queues."""

log = logging.getLogger("tsgt.client")


class WaitFor(NamedTuple):
    """What the next step needs."""

    descriptor: int | None
    write: bool
    """Whether the descriptor has to become writable; else readable."""
    until_ns: int | None
    """When to step in any case."""


class Pump:
    """Connection to a source, with reconnection.

    Parameters
    ----------
    source, key, resume
        Where from; the relay's key; whether a relay is asked for missed lines.
    reconnect
        Whether to connect again when the connection is lost or refused; else that is the end, or raises StreamError.
    """

    def __init__(
        self,
        source: SocketSource | RelaySource,
        key: bytes | None,
        *,
        reconnect: bool = True,
        resume: bool = True,
        now_ns: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._source = source
        self._link: Link = SocketLink()
        if isinstance(source, RelaySource):
            if key is None:
                raise StreamError(f"{source}: a relay needs its key")
            self._link = RelayLink(key, lambda: os.urandom(NONCE_BYTES), resume=resume)
        self._decoder = Decoder(self._link)
        self._backlog = Backlog(self._decoder, now_ns())
        self._reconnect = reconnect
        self._now_ns = now_ns
        self._socket: socket.socket | None = None
        self._resolver: _Resolver | None = None
        self._connecting = False
        self._tls: Tls | None = None
        self._outgoing = bytearray()
        self._back_off_s = BACK_OFF_S[0]
        self._retry_ns = 0
        self._attempts = 0
        self._received_ns = 0
        self._was_ready = False
        self._failures_at_key = 0
        self._logged: set[str] = set()
        self._over = False
        self.more = False
        """Whether the next step is due at once: the last one may have left data, or records."""
        self.problem = ""
        """Why there is no connection, in one line; empty while there is one."""

    @property
    def ended(self) -> bool:
        """Whether nothing will follow."""
        return self._over and not self._backlog.left

    def step(self) -> list[Record]:
        """Connect, send and receive as far as possible at once; return what arrived, unless its age is not known yet.

        Raises StreamError where another attempt does not help: another protocol, a wrong key at the first connection,
        any failure without reconnection.
        """
        self.more = False
        if not (self._over or self._backlog.left):
            self._advance()
        records = self._backlog.take()
        self.more = self.more or self._backlog.left
        return records

    def wait_for(self) -> WaitFor:
        """Return what to wait for before the next step."""
        if self.more:
            return WaitFor(None, write=False, until_ns=self._now_ns())
        if self._resolver is not None:
            return WaitFor(self._resolver.descriptor, write=False, until_ns=None)
        if self._socket is None:
            return WaitFor(None, write=False, until_ns=self._retry_ns)
        times_ns = (self._deadline_ns(), self._backlog.until_ns)
        return WaitFor(
            self._socket.fileno(),
            self._connecting or bool(self._outgoing),
            until_ns=min((time_ns for time_ns in times_ns if time_ns is not None), default=None),
        )

    def close(self) -> None:
        """Close the connection for good."""
        self._over = True
        self._backlog.clear()
        self._disconnect()

    def _advance(self) -> None:
        try:
            if self._socket is None and self._now_ns() >= self._retry_ns:
                self._connect()
            if self._socket is not None and self._connected():
                self._exchange()
            self._check_silence()
        except ProtocolVersionError as error:
            self.problem = f"{self._source}: {error}"
            self.close()
            raise
        except OSError as error:  # also StreamError
            self._lost(error)

    def _connect(self) -> None:
        source = self._source
        if isinstance(source, SocketSource):
            self._open(socket.AF_UNIX, str(source.path))
            return
        if self._resolver is None:
            self._resolver = _Resolver(source.host, source.port)
        addresses = self._resolver.result()
        if addresses is None:
            return
        self._resolver = None
        if not addresses:
            raise StreamError(f"{source.host}: no computer of this name")
        family, address = addresses[self._attempts % len(addresses)]
        self._attempts += 1
        self._open(family, address)

    def _open(self, family: int, address: Any) -> None:
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._socket.setblocking(False)
        self._received_ns = self._now_ns()
        self._backlog.connected(self._received_ns)
        self._connecting = True
        code = self._socket.connect_ex(address)
        if code not in (0, errno.EINPROGRESS):
            raise OSError(code, os.strerror(code))

    def _connected(self) -> bool:
        assert self._socket is not None  # noqa: S101 (its caller has looked)
        if not self._connecting:
            return True
        poller = select.poll()
        poller.register(self._socket, select.POLLOUT)
        if not poller.poll(0):
            return False
        if code := self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(code, os.strerror(code))
        self._connecting = False
        if isinstance(self._source, RelaySource) and self._source.tls:
            from tsgt.client.tls import Tls, reader_context  # noqa: PLC0415 (ssl is loaded by those who use it)

            self._tls = Tls(reader_context(), server_side=False)
            self._tls.receive(b"")
        else:
            self._link.connected(NO_CHANNEL)
        return True

    def _exchange(self) -> None:
        assert self._socket is not None  # noqa: S101 (its caller has looked)
        for _ in range(MAX_RECEIVES):
            self._send()
            try:
                data = self._socket.recv(RECEIVE_BYTES)
            except BlockingIOError:
                self._backlog.emptied(self._now_ns())
                return
            if not data:
                raise StreamError("the stream has ended")
            self._received_ns = self._now_ns()
            self._backlog.received(self._received_ns)
            self._take(data)
        self._send()
        self.more = True

    def _take(self, data: bytes) -> None:
        if self._tls is not None:
            was_open = self._tls.open
            data = self._tls.receive(data)
            if self._tls.open and not was_open:
                self._link.connected(self._tls.peer_channel())
            if not self._tls.open:
                return
        for item in self._link.receive(data, self._received_ns):
            if isinstance(item, bytes):
                if self._tls is not None:
                    self._tls.send(item)
                else:
                    self._outgoing += item
            elif isinstance(item, Gap):
                self._backlog.put(item)
            else:
                self._decode(item)
        if self._link.ready and not self._link.full:
            self._was_ready = True
            self._back_off_s = BACK_OFF_S[0]
            self._logged.clear()
            self.problem = ""

    def _decode(self, arrival: Arrival) -> None:
        try:
            for record in self._decoder.decode(arrival):
                self._backlog.put(record)
        except ProtocolVersionError:
            raise
        except StreamError as error:
            if not self._decoder.greeted:
                raise
            self._backlog.put(Gap(lines=1, reason=str(error)))

    def _send(self) -> None:
        assert self._socket is not None  # noqa: S101 (its caller has looked)
        if self._tls is not None:
            self._outgoing += self._tls.outgoing()
        if self._outgoing:
            with suppress(BlockingIOError):
                del self._outgoing[: self._socket.send(self._outgoing, socket.MSG_NOSIGNAL)]

    def _deadline_ns(self) -> int | None:
        if self._connecting or not self._link.ready:
            if isinstance(self._source, SocketSource) and not self._connecting:
                return None
            return self._received_ns + CONNECT_TIMEOUT_NS
        timeout_ns = self._link.silence_timeout_ns
        return None if timeout_ns is None else self._received_ns + timeout_ns

    def _check_silence(self) -> None:
        if self._socket is None:
            return
        deadline_ns = self._deadline_ns()
        if deadline_ns is not None and self._now_ns() >= deadline_ns:
            silent_s = (deadline_ns - self._received_ns) / 1e9
            raise StreamError(f"nothing received for {silent_s:.0f} s; check the network and the relay")

    def _lost(self, error: OSError) -> None:
        self._failures_at_key = self._failures_at_key + 1 if self._link.failed_at_key else 0
        if self._link.full:
            error = StreamError("the relay has too many readers")
        self._disconnect()
        self._backlog.ended()
        reason = str(error) if isinstance(error, StreamError) else error.strerror or str(error)
        self.problem = problem = f"{self._source}: {reason}"
        if self._failures_at_key >= MAX_FAILURES_AT_KEY and not self._was_ready:
            self._over = True
            self.problem = (
                f"{self._source}: the relay has another key, or has seen too many attempts with wrong ones"
            )
            raise AuthenticationError(self.problem) from error
        if not self._reconnect:
            self._over = True
            if self._was_ready and reason == "the stream has ended":
                return
            raise StreamError(problem) from error
        if problem not in self._logged:
            self._logged.add(problem)
            log.warning("no stream: %s; trying again", problem)
        self._retry_ns = self._now_ns() + round(self._back_off_s * 1e9)
        self._back_off_s = min(2 * self._back_off_s, BACK_OFF_S[1])

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
        if self._resolver is not None:
            self._resolver.close()
        self._socket = self._resolver = self._tls = None
        self._connecting = False
        self._link.ready = self._link.failed_at_key = self._link.full = False
        self._outgoing.clear()


class _Resolver:
    """Resolves a name in a thread; the descriptor becomes readable when it has."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._found: list[tuple[int, Any]] | None = None
        self._done, self._waker = socket.socketpair()
        threading.Thread(target=self._resolve, daemon=True).start()

    @property
    def descriptor(self) -> int:
        return self._done.fileno()

    def result(self) -> list[tuple[int, Any]] | None:
        """Return the addresses with their families, None: not yet."""
        if self._found is not None:
            self.close()
        return self._found

    def close(self) -> None:
        self._done.close()

    def _resolve(self) -> None:
        found: list[tuple[int, Any]] = []
        with suppress(OSError, UnicodeError):
            found = [
                (int(family), address)
                for family, *_, address in socket.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM)
            ]
        self._found = found
        self._waker.close()
