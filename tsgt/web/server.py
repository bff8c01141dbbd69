"""The HTTP server of the page: a thin shell around state and access.

It answers GET of fixed paths, one of them a WebSocket for Foxglove apps if they are served, and one POST, the access code. Connections, requests and readers are limited, and each
reader has a queue of its own: one that stalls is disconnected, and its browser connects again.
"""

from __future__ import annotations

import asyncio
import html
import logging
import socket
import ssl
from contextlib import aclosing, suppress
from dataclasses import dataclass, field
from importlib import resources
from typing import TYPE_CHECKING, Any, Protocol

import structlog
from aiohttp import web

from tsgt.errors import ConfigError, StreamError
from tsgt.web.access import MAX_CODE_CHARACTERS, SECURITY_HEADERS, Access, Site
from tsgt.web.connections import Connections

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.web.foxglove import FoxgloveServer

MAX_READERS = 32
MAX_REQUEST_BYTES = 1024
MAX_HEADERS = 64

BODY_TIMEOUT_S = 3.0
WRITE_TIMEOUT_S = 5.0
"""A browser that has taken nothing for this long is disconnected."""

BACKLOG = 100
"""Connections that wait for their acceptance."""

SEND_BUFFER_BYTES = 32_768
"""Of a reader's socket: what waits in larger ones would be old when it arrives."""

COOKIE = "tsgt_web"

FOXGLOVE_PATH = "/foxglove"
FOXGLOVE_ORIGINS = frozenset({"file://", "https://app.foxglove.dev"})
"""Of Foxglove's own app, on the desktop and in the browser. A program that is no browser sends none."""

_FILES = {
    "/page.js": ("page.js", "text/javascript"),
    "/map.js": ("map.js", "text/javascript"),
    "/chart.js": ("chart.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}

log = structlog.get_logger()


class Messages(Protocol):
    """Where the messages for readers come from: a live mission or a recording."""

    @property
    def replay(self) -> bool:
        """Whether it is a recording, for which the page has a time bar."""

    def messages(self, query: Any, /) -> AsyncGenerator[bytes]:
        """Return the messages for one reader, each a JSON object; ``query``: what the reader has asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How the page is served."""

    address: str
    port: int
    access: Access | None
    """None: without a code, which is for loopback addresses only."""
    names: frozenset[str] = frozenset()
    certificate: Path | None = None
    key: Path | None = None


@dataclass(slots=True)
class Page:
    """The request handlers."""

    settings: Settings
    messages: Messages
    clock: Clock
    foxglove: FoxgloveServer | None = None
    """Serves Foxglove apps; None: they are not served."""
    readers: int = 0
    connections: Connections = field(default_factory=Connections)
    _site: Site = field(init=False)
    _files: dict[str, bytes] = field(init=False)

    def __post_init__(self) -> None:
        self._site = Site("https" if self.settings.certificate else "http", self.settings.names)
        folder = resources.files("tsgt.web") / "page"
        self._files = {
            name: (folder / name).read_bytes()
            for name in ("index.html", "login.html", *(name for name, _ in _FILES.values()))
        }

    def application(self) -> web.Application:
        """Return the application."""
        application = web.Application(
            middlewares=[self._checked],
            client_max_size=MAX_REQUEST_BYTES,
        )
        application.router.add_get("/", self._index)
        application.router.add_get("/stream", self._stream)
        application.router.add_post("/login", self._login)
        if self.foxglove is not None:
            application.router.add_get(FOXGLOVE_PATH, self._foxglove, allow_head=False)
        for path in _FILES:
            application.router.add_get(path, self._file)
        return application

    @web.middleware
    async def _checked(
        self,
        request: web.Request,
        handler: Callable[[web.Request], Awaitable[web.StreamResponse]],
    ) -> web.StreamResponse:
        """Refuse what does not come from this page, and add the headers that protect it."""
        self.connections.headers_complete(request)
        try:
            self._check(request)
            response = await handler(request)
        except web.HTTPException as refusal:
            response = web.Response(status=refusal.status, text=f"{refusal.status} {refusal.reason}\n")
            for name in ("Allow", "Location", "Retry-After"):
                if name in refusal.headers:
                    response.headers[name] = refusal.headers[name]
        except Exception as error:  # noqa: BLE001 (a defect costs one request, not the page)
            log.error("web_request_failed", path=request.path, error=repr(error))  # noqa: TRY400 (aiohttp would print a traceback as well)
            response = web.Response(status=500, text="500 Internal Server Error\n")
        if not response.prepared:
            _protect(response)
        return response

    def _check(self, request: web.Request) -> None:
        own = request.transport.get_extra_info("sockname") if request.transport is not None else None
        hosts = request.headers.getall("Host", [])
        if own is None or len(hosts) != 1 or not self._site.host_allowed(hosts[0], own[0], own[1]):
            raise web.HTTPMisdirectedRequest
        if self.foxglove is not None and request.path == FOXGLOVE_PATH:
            return  # has an origin of its own, and upgrades the connection
        origins = request.headers.getall("Origin", [])
        posted = request.method == "POST"
        if len(origins) > 1 or not self._site.origin_allowed(
            origins[0] if origins else None, hosts[0], required=posted
        ):
            raise web.HTTPForbidden
        # A link on another site may lead here; a script there may read nothing.
        foreign = request.headers.get("Sec-Fetch-Site", "none") not in {"same-origin", "none"}
        if foreign and (posted or request.path == "/stream"):
            raise web.HTTPForbidden
        if "Upgrade" in request.headers:
            raise web.HTTPBadRequest
        if request.method == "GET" and request.body_exists:
            raise web.HTTPBadRequest

    def _allowed(self, request: web.Request) -> bool:
        access = self.settings.access
        return access is None or access.cookie_valid(request.cookies.get(COOKIE))

    async def _index(self, request: web.Request) -> web.StreamResponse:
        if not self._allowed(request):
            return self._login_form(401, "")
        encrypted = "yes" if self.settings.certificate else "no"
        text = self._files["index.html"].replace(b"{{encrypted}}", encrypted.encode())
        text = text.replace(b"{{replay}}", b"yes" if self.messages.replay else b"no")
        return web.Response(body=text, content_type="text/html", charset="utf-8")

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name, kind = _FILES[request.path]
        return web.Response(body=self._files[name], content_type=kind, charset="utf-8")

    async def _login(self, request: web.Request) -> web.StreamResponse:
        access = self.settings.access
        if access is None:
            raise web.HTTPNotFound
        address, now_s = request.remote or "", self.clock.monotonic_ns() / 1e9
        wait_s = access.retry_after_s(address, now_s)
        if wait_s > 0:
            response = self._login_form(429, f"Too many wrong codes. Wait {wait_s:.0f} s.")
            response.headers["Retry-After"] = str(max(1, round(wait_s)))
            return response
        if request.content_type != "application/x-www-form-urlencoded":
            raise web.HTTPBadRequest
        try:
            async with asyncio.timeout(BODY_TIMEOUT_S):
                form = await request.post()
        except TimeoutError:
            raise web.HTTPRequestTimeout from None
        except (ValueError, LookupError):  # LookupError: an unknown charset
            raise web.HTTPBadRequest from None
        code = form.get("code", "")
        if not isinstance(code, str) or len(code) > MAX_CODE_CHARACTERS:
            raise web.HTTPBadRequest
        if not access.attempt(code, address, now_s):
            log.warning("web_code_rejected", address=address)
            return self._login_form(403, "Wrong code.")
        log.info("web_code_accepted", address=address)
        response = web.Response(status=303, headers={"Location": "/"})
        response.set_cookie(
            COOKIE,
            access.cookie(),
            path="/",
            httponly=True,
            samesite="Strict",
            secure=self.settings.certificate is not None,
        )
        return response

    def _login_form(self, status: int, message: str) -> web.Response:
        encrypted = "yes" if self.settings.certificate else "no"
        text = self._files["login.html"].replace(b"{{message}}", html.escape(message).encode())
        text = text.replace(b"{{encrypted}}", encrypted.encode())
        return web.Response(status=status, body=text, content_type="text/html", charset="utf-8")

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        if not self._allowed(request):
            raise web.HTTPUnauthorized
        if request.method != "GET":
            raise web.HTTPMethodNotAllowed(request.method, ["GET"])
        return await self._counted(request, self._send_all)

    async def _counted(
        self,
        request: web.Request,
        serve_reader: Callable[[web.Request], Awaitable[web.StreamResponse]],
    ) -> web.StreamResponse:
        """Serve a reader, if there are not too many already."""
        if self.readers >= MAX_READERS:
            raise web.HTTPServiceUnavailable
        self.readers += 1
        log.info("web_reader_connected", address=request.remote, readers=self.readers)
        try:
            return await serve_reader(request)
        finally:
            self.readers -= 1
            log.info("web_reader_disconnected", address=request.remote, readers=self.readers)

    async def _foxglove(self, request: web.Request) -> web.StreamResponse:
        """Serve an app: with the access code in the address, else for Foxglove's own origins only."""
        access = self.settings.access
        origins = request.headers.getall("Origin", [])
        if access is None:
            if len(origins) != 1 or origins[0] not in FOXGLOVE_ORIGINS:
                log.warning("foxglove_origin_rejected", origins=origins, address=request.remote)
                raise web.HTTPForbidden
        else:
            address, now_s = request.remote or "", self.clock.monotonic_ns() / 1e9
            if access.retry_after_s(address, now_s) > 0:
                raise web.HTTPTooManyRequests
            if not access.attempt(request.query.get("code", "")[:MAX_CODE_CHARACTERS], address, now_s):
                log.warning("web_code_rejected", address=address)
                raise web.HTTPForbidden
        return await self._counted(request, self._converse)

    async def _converse(self, request: web.Request) -> web.StreamResponse:
        assert self.foxglove is not None  # noqa: S101 (else the path is not served)
        _limit_buffers(request.transport)
        return await self.foxglove.converse(request)

    async def _send_all(self, request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse(headers={"Content-Type": "text/event-stream; charset=utf-8"})
        _protect(response)
        _limit_buffers(request.transport)
        await response.prepare(request)
        try:
            with suppress(ConnectionError):
                async with aclosing(self.messages.messages(request.query)) as messages:
                    if not await self._send(request, response, messages):
                        log.warning("web_reader_stalled", address=request.remote)
        finally:  # also after a defect: else the browser would wait on this connection
            if request.transport is not None:
                request.transport.abort()
        return response

    async def _send(
        self, request: web.Request, response: web.StreamResponse, messages: AsyncGenerator[bytes]
    ) -> bool:
        """Send messages to their end; False: the browser has stalled."""
        unsent_since_ns: int | None = None
        async for message in messages:
            try:
                # It waits only now and then, so what is unsent is looked at below.
                async with asyncio.timeout(WRITE_TIMEOUT_S):
                    await response.write(b"data: " + message + b"\n\n")
            except TimeoutError:
                return False
            now_ns = self.clock.monotonic_ns()
            if request.transport is None or request.transport.get_write_buffer_size() == 0:
                unsent_since_ns = None
            elif unsent_since_ns is None:
                unsent_since_ns = now_ns
            elif now_ns - unsent_since_ns > WRITE_TIMEOUT_S * 1e9:
                return False
        return True


def _protect(response: web.StreamResponse) -> None:
    """Add the protecting headers. Each connection serves one request: a limit on connections limits everything."""
    response.headers.update(SECURITY_HEADERS)
    response.headers["Server"] = "tsgt"
    response.force_close()


def _limit_buffers(transport: asyncio.Transport | None) -> None:
    if transport is None:
        return
    connection = transport.get_extra_info("socket")
    if connection is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    transport.set_write_buffer_limits(high=SEND_BUFFER_BYTES)


async def serve(page: Page, opened: Callable[[str], None]) -> None:
    """Serve the page until cancelled; ``opened`` is called with its address.

    Raises
    ------
    ConfigError
        The certificate or its key cannot be used.
    StreamError
        The address cannot be listened on.
    """
    settings = page.settings
    runner = web.AppRunner(
        page.application(),
        access_log=None,
        logger=_silent_logger(),
        handler_cancellation=True,
        shutdown_timeout=0.5,
        lingering_time=0.0,
        auto_decompress=False,
        max_headers=MAX_HEADERS,
    )
    context = _tls(settings)
    await runner.setup()
    try:
        assert runner.server is not None  # noqa: S101 (the runner is set up)
        with _listener(settings) as listener:
            address, port = listener.getsockname()[:2]
            host = f"[{address}]" if ":" in address else address
            url = f"{'https' if context else 'http'}://{host}:{port}/"
            log.info("web_opened", url=url, code=settings.access is not None)
            opened(url)
            await page.connections.accept(listener, runner.server, context)
    finally:
        await runner.cleanup()


def _listener(settings: Settings) -> socket.socket:
    """Return a listening socket; raises StreamError."""
    try:
        found = socket.getaddrinfo(settings.address, settings.port, type=socket.SOCK_STREAM)
        family, _, _, _, address = found[0]  # of an address there is one
        listener = socket.create_server(address, family=family, backlog=BACKLOG)
    except OSError as error:
        raise StreamError(
            f"{settings.address} port {settings.port}: cannot listen there ({error.strerror or error}); give the "
            "right --listen, or another --port"
        ) from error
    listener.setblocking(False)
    return listener


def _silent_logger() -> logging.Logger:
    """Return a logger that drops everything: aiohttp prints a traceback for each malformed request."""
    logger = logging.getLogger("tsgt.web.aiohttp")
    logger.disabled = True
    return logger


def _tls(settings: Settings) -> ssl.SSLContext | None:
    if settings.certificate is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(settings.certificate, settings.key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(
            f"{settings.certificate}: certificate and key cannot be used ({error.strerror or error})",
            path=settings.certificate,
        ) from error
    return context
