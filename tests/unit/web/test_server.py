"""The server on real loopback, and what attackers try."""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import shutil
import socket
import ssl
import subprocess
from contextlib import suppress
from dataclasses import replace
from importlib import resources
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest
from harness.files.records import EVENT
from harness.readers.web import client, feed, in_real_time, mission, pose, served, status
from structlog.testing import capture_logs

from tsgt.web import connections, server
from tsgt.web.access import SECURITY_HEADERS, Access

if TYPE_CHECKING:
    import aiohttp

CODE = "correct horse"

OPENSSL = shutil.which("openssl")


@pytest.fixture(scope="module")
def access() -> Access:
    """Return what a code protects."""
    return Access(CODE)


async def message(stream: aiohttp.ClientResponse) -> dict[str, Any]:
    """Return the next message of an event stream."""
    async for line in stream.content:
        if line.startswith(b"data: "):
            content: dict[str, Any] = json.loads(line.removeprefix(b"data: "))
            return content
    raise AssertionError("the stream has ended")


async def raw(url: str, request: bytes) -> bytes:
    """Send bytes and return everything that comes until the end."""
    host, port = urlsplit(url).hostname, urlsplit(url).port
    reader, writer = await asyncio.open_connection(host, port)
    writer.write(request)
    try:
        async with asyncio.timeout(10):
            return await reader.read()
    except ConnectionResetError:
        return b""
    finally:
        writer.close()


async def connected(url: str, *, receive_buffer: int = 65_536) -> socket.socket:
    """Return a connection on which nothing is sent or read."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
    connection.setblocking(False)
    await asyncio.get_running_loop().sock_connect(connection, ("127.0.0.1", urlsplit(url).port))
    return connection


def closed(connection: socket.socket) -> bool:
    """Return whether the other end has closed a connection."""
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True


def host(url: str) -> str:
    """Return host and port of an address."""
    return urlsplit(url).netloc


async def login(session: aiohttp.ClientSession, url: str, code: str = CODE, **headers: str) -> int:
    """Send the form with the code; return the status of the answer."""
    origin = {"Origin": url.rstrip("/")} | headers
    async with session.post(f"{url}login", data={"code": code}, headers=origin, allow_redirects=False) as got:
        return got.status


@in_real_time
async def test_page_and_stream_without_a_code_on_loopback() -> None:
    """The page with its files, and a message at once, then five a second."""
    async with served(mission()) as url, client() as session:
        async with session.get(url) as page:
            text = await page.text()
        for path in re.findall(r'(?:src|href)="(/[^"]+)"', text):
            async with session.get(url + path[1:]) as file:
                assert file.status == 200, path
        async with session.get(f"{url}stream") as stream:
            assert (await message(stream))["first"] is True
            then = await message(stream)
        assert (then["first"], then["view"]["verdict"]["words"]) == (False, "STREAM STOPPED")


@in_real_time
async def test_every_answer_protects_itself(access: Access) -> None:
    """With headers against scripts of others, frames, sniffing; also a refusal, and the stream."""
    async with served(mission(), access) as url, client() as session:
        assert await login(session, url) == 303
        for path in ("", "page.js", "stream", "nothing"):
            async with session.get(url + path) as got:
                assert SECURITY_HEADERS.items() <= dict(got.headers).items(), path
                assert "Access-Control-Allow-Origin" not in got.headers
                assert got.headers["Server"] == "tsgt"
    assert "unsafe" not in SECURITY_HEADERS["Content-Security-Policy"]


@in_real_time
async def test_code_gives_a_cookie_that_scripts_and_other_sites_do_not_get(access: Access) -> None:
    """HttpOnly and SameSite=Strict; with it the stream flows."""
    async with served(mission(), access) as url, client() as session:
        headers = {"Origin": url.rstrip("/")}
        async with session.post(
            f"{url}login", data={"code": CODE}, headers=headers, allow_redirects=False
        ) as got:
            cookie = got.headers["Set-Cookie"]
            assert (got.status, got.headers["Location"]) == (303, "/")
        assert {"HttpOnly", "SameSite=Strict"} <= set(cookie.split("; "))
        async with session.get(f"{url}stream") as stream:
            assert (await message(stream))["first"] is True


@pytest.mark.parametrize(
    ("method", "path", "headers", "expected"),
    [
        ("GET", "stream", {}, 401),
        ("GET", "stream", {"Cookie": "tsgt_web=00.00"}, 401),
        ("GET", "", {}, 401),
        ("GET", "", {"Host": "attacker.example"}, 421),
        ("GET", "", {"Host": "attacker.example:{port}"}, 421),
        ("GET", "stream", {"Host": "127.0.0.1.attacker.example:{port}"}, 421),
        ("GET", "page.js", {"Origin": "http://attacker.example"}, 403),
        ("GET", "stream", {"Origin": "null"}, 403),
        ("GET", "stream", {"Sec-Fetch-Site": "cross-site"}, 403),
        ("POST", "login", {}, 403),
        ("POST", "login", {"Origin": "http://attacker.example"}, 403),
        ("POST", "login", {"Origin": "http://127.0.0.1"}, 403),
        ("GET", "login", {}, 405),
        ("POST", "stream", {"Origin": "http://127.0.0.1:{port}"}, 405),
        ("PUT", "", {}, 405),
        ("DELETE", "page.js", {}, 405),
        ("OPTIONS", "stream", {}, 405),
        ("GET", "../../../../etc/passwd", {}, 404),
        ("GET", "%2e%2e/%2e%2e/etc/passwd", {}, 404),
        ("GET", "page/../server.py", {}, 404),
        ("GET", "page.js%00.css", {}, 404),
        ("GET", "..%5c..%5cetc%5cpasswd", {}, 404),
        ("GET", "stream", {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Key": "AA==",
                           "Sec-WebSocket-Version": "13"}, 400),
    ],
)  # fmt: skip
@in_real_time
async def test_attack_is_refused(
    access: Access, method: str, path: str, headers: dict[str, str], expected: int
) -> None:
    """Without cookie, origin or host, with a name that was rebound, out of the folder, as a WebSocket."""
    async with served(mission(), access) as url:
        port = str(urlsplit(url).port)
        sent = {"Host": host(url)} | {name: value.format(port=port) for name, value in headers.items()}
        lines = [f"{method} /{path} HTTP/1.1", *(f"{name}: {value}" for name, value in sent.items())]
        answer = await raw(url, ("\r\n".join(lines) + "\r\n\r\n").encode())
    assert int(answer.split()[1]) == expected
    assert b"root:" not in answer
    assert b"data: " not in answer


@in_real_time
async def test_right_cookie_does_not_help_a_foreign_site(access: Access) -> None:
    """A page of another site, or one whose name was rebound to this address, gets no message."""
    async with served(mission(), access) as url, client() as session:
        cookie = {"Cookie": f"tsgt_web={access.cookie()}"}
        async with session.get(f"{url}stream", headers=cookie | {"Origin": "http://attacker.example"}) as got:
            assert got.status == 403
        async with session.get(f"{url}stream", headers=cookie | {"Host": "attacker.example"}) as got:
            assert got.status == 421


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the settings for TLS with a certificate of one's own."""
    if OPENSSL is None:
        pytest.skip("openssl, which makes the certificate, is not installed")
    folder = tmp_path_factory.mktemp("certificate")
    files = {"certificate": folder / "robot.pem", "key": folder / "robot.key"}
    request = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=robot -addext subjectAltName=IP:127.0.0.1"
    subprocess.run(
        [OPENSSL, *request.split(), "-out", files["certificate"], "-keyout", files["key"]],
        check=True,
        capture_output=True,
    )
    return files


def test_tls_with_a_certificate_of_ones_own(certificate: dict[str, Any], access: Access) -> None:
    """The cookie is then for encrypted connections only, and plain HTTP gets nothing."""
    trusting = ssl.create_default_context(cafile=str(certificate["certificate"]))

    async def check() -> None:
        async with served(mission(), access, **certificate) as url, client() as session:
            assert url.startswith("https://")
            headers = {"Origin": url.rstrip("/")}
            async with session.post(
                f"{url}login", data={"code": CODE}, headers=headers, allow_redirects=False, ssl=trusting
            ) as got:
                assert got.status == 303
                assert "Secure" in got.headers["Set-Cookie"].split("; ")
            async with session.get(f"{url}stream", ssl=trusting) as stream:
                assert (await message(stream))["first"] is True
            assert await raw(url, f"GET / HTTP/1.1\r\nHost: {host(url)}\r\n\r\n".encode()) == b""

    asyncio.run(check())


@in_real_time
async def test_unfinished_handshakes_are_limited(
    monkeypatch: pytest.MonkeyPatch, certificate: dict[str, Any]
) -> None:
    """They count as connections, as each takes memory, and have some seconds."""
    monkeypatch.setattr(connections, "HANDSHAKE_TIMEOUT_S", 0.5)
    hello = b"\x16\x03\x01\x40\x00\x01\x00\x3f\xfc" + b"x" * 16_000  # not complete
    async with served(mission(), **certificate) as url:
        sockets = [await connected(url) for _ in range(100)]
        for each in sockets:
            with suppress(ConnectionError):
                each.send(hello)
        await asyncio.sleep(0.2)
        assert sum(not closed(each) for each in sockets) <= connections.MAX_CONNECTIONS_PER_ADDRESS
        async with asyncio.timeout(5):
            for each in sockets:
                with suppress(ConnectionError):
                    assert await asyncio.get_running_loop().sock_recv(each, 1) == b""
        async with client() as session, session.get(url, ssl=False) as page:  # there is room again
            assert page.status == 200
    for each in sockets:
        each.close()


@in_real_time
async def test_ipv6_connections_are_counted_by_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """One computer has as many addresses in it as it likes."""
    monkeypatch.setattr(connections, "MAX_CONNECTIONS_PER_ADDRESS", 1)
    loop = asyncio.get_running_loop()
    accept, peers = loop.sock_accept, iter(["2001:db8::1", "2001:db8::2", "2001:db8:0:1::1"])

    async def accept_from_afar(listener: socket.socket) -> tuple[socket.socket, tuple[str, int, int, int]]:
        return (await accept(listener))[0], (next(peers), 1024, 0, 0)

    monkeypatch.setattr(loop, "sock_accept", accept_from_afar)
    async with served(mission()) as url:
        sockets = [await connected(url) for _ in range(3)]
        await asyncio.sleep(0.2)
        assert [closed(each) for each in sockets] == [False, True, False]
    for each in sockets:
        each.close()


@in_real_time
async def test_wrong_codes_are_limited() -> None:
    """Five a minute; then not even the right one is looked at."""
    async with served(mission(), Access(CODE)) as url, client() as session:
        statuses = [await login(session, url, f"guess {i}") for i in range(7)]
        assert statuses == [403, 403, 403, 403, 403, 429, 429]
        assert await login(session, url) == 429


FORM = "application/x-www-form-urlencoded"
PART = b'--b\r\nContent-Disposition: form-data; name="code"\r\nContent-%s: nope\r\n\r\nx\r\n--b--\r\n'


@pytest.mark.parametrize(
    ("kind", "body", "expected"),
    [
        (f"{FORM}; charset=nope", b"code=x", b"400"),
        (f"{FORM}; charset=hex", b"code=x", b"400"),
        (f"{FORM}; charset=\xff", b"code=x", b"400"),
        (f"{FORM}; charset=utf-7", b"code=+2AA-", b"403"),  # half a surrogate pair
        (FORM, b"code=%ff", b"403"),
        (FORM, b"code=\xff", b"400"),
        ("multipart/form-data", b"code=x", b"400"),
        ("multipart/form-data; boundary=b", PART % b"Transfer-Encoding", b"400"),
        ("multipart/form-data; boundary=b", PART % b"Encoding", b"400"),
        ("/", b"code=x", b"400"),
    ],
)
@in_real_time
async def test_unreadable_form_is_no_failure(kind: str, body: bytes, expected: bytes) -> None:
    """It is refused, and no failure is logged: they could fill the disk."""
    with capture_logs() as logged:
        async with served(mission(), Access(CODE)) as url:
            head = f"POST /login HTTP/1.1\r\nHost: {host(url)}\r\nOrigin: http://{host(url)}\r\n"
            head += f"Content-Type: {kind}\r\nContent-Length: {len(body)}\r\n\r\n"
            answer = await raw(url, head.encode("latin-1") + body)
    assert answer.split()[1] == expected
    assert "web_request_failed" not in {each["event"] for each in logged}


@pytest.mark.parametrize("cookie", [b"a.\xff\xfe", b"\xff.a", b"a.\xc3\xa4", b'"\\377.\\377"'])
@in_real_time
async def test_cookie_that_is_no_text_is_no_failure(access: Access, cookie: bytes) -> None:
    """It is no cookie."""
    with capture_logs() as logged:
        async with served(mission(), access) as url:
            head = f"GET /stream HTTP/1.1\r\nHost: {host(url)}\r\nCookie: tsgt_web=".encode()
            assert (await raw(url, head + cookie + b"\r\n\r\n")).split()[1] == b"401"
    assert "web_request_failed" not in {each["event"] for each in logged}


@pytest.mark.parametrize(
    "request_bytes",
    [
        b"GET /" + b"x" * 100_000 + b" HTTP/1.1\r\nHost: HOST\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: HOST\r\nX: " + b"x" * 100_000 + b"\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: HOST\r\n" + b"".join(b"X-%d: x\r\n" % i for i in range(500)) + b"\r\n",
        b"POST /login HTTP/1.1\r\nHost: HOST\r\nOrigin: http://HOST\r\nContent-Length: 9000000\r\n\r\n",
        b"POST /login HTTP/1.1\r\nHost: HOST\r\nOrigin: http://HOST\r\nContent-Type: application/x-www-form-urlencoded\r\n"
        b"Content-Length: 3000\r\n\r\ncode=" + b"x" * 2995,
        b"GET / HTTP/1.1\r\nHost: HOST\r\nHost: HOST\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: HOST\r\nContent-Length: 5\r\n\r\nhello",
        b"GET / HTTP/1.1\r\nHost: HOST\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(256)),
        b"GET / HTTP/0.9\r\n\r\n",
    ],
    ids=["path", "header", "headers", "announced body", "body", "hosts", "body of GET", "lengths", "TLS", "no host"],
)  # fmt: skip
@in_real_time
async def test_huge_or_malformed_request_is_refused(
    access: Access, request_bytes: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing of it is kept, the connection is closed, and nothing is logged: it could fill the disk."""
    async with served(mission(), access) as url:
        answer = await raw(url, request_bytes.replace(b"HOST", host(url).encode()))
    assert caplog.text == ""
    assert not answer or 400 <= int(answer.split()[1]) < 500, answer[:100]


@in_real_time
async def test_slow_request_is_disconnected(monkeypatch: pytest.MonkeyPatch, access: Access) -> None:
    """One that sends its headers a byte at a time, or nothing, or empty lines before them, or no body."""
    monkeypatch.setattr(connections, "REQUEST_TIMEOUT_S", 0.2)
    monkeypatch.setattr(server, "BODY_TIMEOUT_S", 0.2)
    begun = b"POST /login HTTP/1.1\r\nHost: HOST\r\nOrigin: http://HOST\r\nContent-Length: 20\r\n\r\nco"
    async with served(mission(), access) as url, asyncio.timeout(3):
        for start in (b"", b"GET / HT", b"\r\n\r\n", b"\r\n\r\nGET / HT", begun):
            await raw(url, start.replace(b"HOST", host(url).encode()))


@in_real_time
async def test_thousand_connections_cost_a_reader_nothing() -> None:
    """Those beyond the limit are closed at once; the reader that was there before gets every message."""
    async with served(mission()) as url, client() as session, session.get(f"{url}stream") as stream:
        await message(stream)
        sockets = [await connected(url) for _ in range(1000)]
        times = [(await message(stream))["sent_s"] for _ in range(3)]
        open_ones = sum(not closed(each) for each in sockets)
    assert open_ones <= connections.MAX_CONNECTIONS_PER_ADDRESS
    assert times[2] - times[0] < 1.0
    for each in sockets:
        each.close()


@in_real_time
async def test_stalled_reader_is_disconnected_and_costs_the_others_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It takes nothing; another one meanwhile gets everything in time."""
    monkeypatch.setattr(server, "WRITE_TIMEOUT_S", 0.3)
    monkeypatch.setattr(server, "SEND_BUFFER_BYTES", 4096)
    state = mission()
    for _ in range(100):  # a first message that no socket buffer takes
        feed(state, replace(EVENT, message="x" * 300), now_s=0.0)
    with capture_logs() as logged:
        async with served(state) as url, client() as session, session.get(f"{url}stream") as stream:
            stalled = await connected(url, receive_buffer=4096)
            stalled.send(f"GET /stream HTTP/1.1\r\nHost: {host(url)}\r\n\r\n".encode())
            times = [(await message(stream))["sent_s"] for _ in range(5)]
    stalled.close()
    assert max(b - a for a, b in itertools.pairwise(times)) < 0.5
    assert [each["event"] for each in logged].count("web_reader_stalled") == 1


@in_real_time
async def test_defect_closes_the_connection_of_its_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    """The browser then connects again, instead of waiting for ever."""
    state = mission()

    def fail(_now_s: float) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(state, "view", fail)
    with capture_logs() as logged:
        async with served(state) as url, asyncio.timeout(5):
            answer = await raw(url, f"GET /stream HTTP/1.1\r\nHost: {host(url)}\r\n\r\n".encode())
    assert b" 500 " not in answer  # a second answer within the first one
    assert "web_request_failed" in {each["event"] for each in logged}


@in_real_time
async def test_readers_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """Further ones are refused, and have room when another has left."""
    monkeypatch.setattr(server, "MAX_READERS", 1)
    async with served(mission()) as url, client() as session:
        async with session.get(f"{url}stream") as first:
            await message(first)
            async with session.get(f"{url}stream") as second:
                assert second.status == 503
        await asyncio.sleep(0.1)
        async with session.get(f"{url}stream") as third:
            assert third.status == 200


def test_page_writes_text_from_outside_as_text_only() -> None:
    """No markup is ever built from strings, and nothing comes from another address."""
    for file in (resources.files("tsgt.web") / "page").iterdir():
        text = file.read_text()
        assert not re.search(
            r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(|new Function|srcdoc", text
        )
        assert not re.search(r"(?<!xmlns=\")https?://|@import|url\(", text), file.name
        assert not re.search(r"<script(?![^>]*\bsrc=)|<style|\bon\w+=\"|\bstyle=\"", text), file.name


@in_real_time
async def test_view_follows_the_stream() -> None:
    """What the state was told is in the next message."""
    state = mission()
    loop = asyncio.get_running_loop()
    async with served(state) as url, client() as session, session.get(f"{url}stream") as stream:
        await message(stream)
        now_s = loop.time()
        state.connected(now_s)
        feed(state, status(1.0), pose(1.0), now_s=now_s)
        assert (await message(stream))["view"]["pose"]["at"] == [10.0, 10.0, 0.0]
