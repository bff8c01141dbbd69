"""Who may see the page: host, origin, access code, cookie, attempts. Sans-I/O.

Host and origin are checked on every request, also without a code: a page of another site that the operator has open, or
a name that an attacker has rebound to this address, gets nothing.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import secrets
from collections import deque
from dataclasses import dataclass

MIN_CODE_CHARACTERS = 8
MAX_CODE_CHARACTERS = 256

ATTEMPT_SPAN_S = 60.0
ATTEMPTS_PER_ADDRESS = 5
ATTEMPTS = 30
"""Wrong codes within the span, from one address and from all. Guessing a code of eight letters and digits at this pace
takes ten thousand years."""

KEY_ITERATIONS = 200_000
_NONCE_BYTES = 16


@dataclass(frozen=True, slots=True)
class Site:
    """The names under which the page may be asked for.

    Parameters
    ----------
    scheme
        ``http`` or ``https``.
    names
        Host names that the operator has allowed, lower case, without port.
    """

    scheme: str
    names: frozenset[str] = frozenset()

    def host_allowed(self, host: str, address: str, port: int) -> bool:
        """Return whether the header Host names the address and port that this connection was made to.

        ``address``: of this end of the connection. The address itself, an allowed name, and for a loopback address
        ``localhost``: nothing that another site's owner can choose.
        """
        name, colon, given_port = host.rpartition(":")
        if not colon or name.endswith(":") or (name.startswith("[") != name.endswith("]")):
            name, given_port = host, "443" if self.scheme == "https" else "80"
        if given_port != str(port):
            return False
        name = name.lower()
        if name in self.names:
            return True
        own = _address(address)
        if own is None:
            return False
        if name == "localhost":
            return own.is_loopback
        return _address(name.removeprefix("[").removesuffix("]")) == own

    def origin_allowed(self, origin: str | None, host: str, *, required: bool) -> bool:
        """Return whether the header Origin is that of this page; browsers omit it from reading requests of their own."""
        if origin is None:
            return not required
        return origin.lower() == f"{self.scheme}://{host.lower()}"


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


class Access:
    """The access code, the cookies that it gives, and the limit on wrong attempts.

    A cookie is a random number with its authentication code under a key that is derived from the access code: nothing is
    stored, it survives a restart, and it ends with a change of the code.
    """

    def __init__(self, code: str) -> None:
        self._code = hashlib.sha256(code.encode()).digest()
        # Slow on purpose: whoever has got hold of a cookie must not find the code by trying.
        self._key = hashlib.pbkdf2_hmac("sha256", code.encode(), b"tsgt web cookie", KEY_ITERATIONS)
        self._failures: deque[tuple[float, str]] = deque(maxlen=ATTEMPTS)

    def cookie(self) -> str:
        """Return a new cookie."""
        nonce = secrets.token_hex(_NONCE_BYTES)
        return f"{nonce}.{self._signature(nonce)}"

    def cookie_valid(self, cookie: str | None) -> bool:
        """Return whether a cookie was given for this access code."""
        if cookie is None or not cookie.isascii():
            return False
        nonce, _, signature = cookie.partition(".")
        return hmac.compare_digest(signature.encode(), self._signature(nonce).encode())

    def retry_after_s(self, address: str, now_s: float) -> float:
        """Return how long an address has to wait before its next attempt; 0: it may try now."""
        own_network = network(address)
        recent = [(at_s, by) for at_s, by in self._failures if now_s - at_s < ATTEMPT_SPAN_S]
        own = [at_s for at_s, by in recent if by == own_network]
        if len(own) >= ATTEMPTS_PER_ADDRESS:
            return own[-ATTEMPTS_PER_ADDRESS] + ATTEMPT_SPAN_S - now_s
        if len(recent) >= ATTEMPTS:
            return recent[0][0] + ATTEMPT_SPAN_S - now_s
        return 0.0

    def attempt(self, code: str, address: str, now_s: float) -> bool:
        """Return whether a code is right; False as well, without a look at it, when the address has to wait."""
        if self.retry_after_s(address, now_s) > 0:
            return False
        # Also of what is no text: half a surrogate pair, from a form or an address.
        given = hashlib.sha256(code.strip().encode(errors="surrogatepass")).digest()
        right = hmac.compare_digest(given, self._code)
        if not right:
            self._failures.append((now_s, network(address)))
        return right

    def _signature(self, nonce: str) -> str:
        return hmac.new(self._key, nonce.encode(), hashlib.sha256).hexdigest()


def network(address: str) -> str:
    """Return what counts as one address: with IPv6 a whole network, within which one computer has as many as it likes."""
    known = _address(address)
    if isinstance(known, ipaddress.IPv6Address):
        return str(ipaddress.ip_network((int(known) >> 64 << 64, 64)))
    return str(known)


SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    # Not no-referrer: a form would then be sent with the origin "null".
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Cache-Control": "no-store",
}
