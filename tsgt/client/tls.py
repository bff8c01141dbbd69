"""Sans-I/O: TLS between a reader and a relay, for either side.

Certificates are not verified: the proofs of the handshake that follows contain the hash of the relay's certificate
(tls-server-end-point of RFC 5929), so only the relay with the key can have presented it. A self-signed certificate is as
good as any other.
"""

from __future__ import annotations

import ssl
from typing import TYPE_CHECKING

from tsgt.client.relay_wire import channel_of
from tsgt.errors import StreamError

if TYPE_CHECKING:
    from pathlib import Path

_READ_BYTES = 1 << 16


def reader_context() -> ssl.SSLContext:
    """Return the settings of a reader."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


def relay_context(certificate: Path, private_key: Path) -> tuple[ssl.SSLContext, str]:
    """Return the settings of a relay, and what binds proofs to its certificate; raises OSError, ValueError."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.num_tickets = 0  # no resumption
    context.load_cert_chain(certificate, private_key, password=_no_password)
    pem = certificate.read_text(encoding="ascii")
    end = "-----END CERTIFICATE-----"
    first, found, _ = pem[pem.find("-----BEGIN CERTIFICATE-----") :].partition(end)
    return context, channel_of(ssl.PEM_cert_to_DER_cert(first + found + "\n"))


def _no_password() -> str:
    raise ValueError("the private key is protected by a password, which nobody can enter for a service")


class Tls:
    """One side of a TLS connection: encrypted bytes in and out, plain bytes in and out."""

    def __init__(self, context: ssl.SSLContext, *, server_side: bool) -> None:
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side=server_side)
        self.open = False
        """Whether the handshake of TLS is complete."""

    def receive(self, data: bytes) -> bytes:
        """Take encrypted bytes, b"" to begin; return plain ones. Raises StreamError if the peer cannot be used."""
        self._incoming.write(data)
        plain = bytearray()
        try:
            if not self.open:
                self._tls.do_handshake()
                self.open = True
            while chunk := self._tls.read(_READ_BYTES):
                plain += chunk
        except ssl.SSLWantReadError:
            pass
        except ssl.SSLError as error:
            raise StreamError(
                f"TLS failed ({error.reason or error}); does the other side use TLS?"
            ) from error
        return bytes(plain)

    def send(self, plain: bytes) -> None:
        """Encrypt; see :meth:`outgoing`. Only while open."""
        view = memoryview(plain)
        while view:
            view = view[self._tls.write(view) :]

    def outgoing(self) -> bytes:
        """Return the encrypted bytes that are to be sent now."""
        return self._outgoing.read()

    def peer_channel(self) -> str:
        """Return what binds proofs to the certificate of the other side."""
        certificate = self._tls.getpeercert(binary_form=True)
        if certificate is None:
            raise StreamError("the relay has no certificate")
        return channel_of(certificate)
