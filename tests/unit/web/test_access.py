from __future__ import annotations

import pytest

from tsgt.web import access
from tsgt.web.access import Access, Site


@pytest.fixture(scope="module")
def locked() -> Access:
    """Return what a code protects; it takes a tenth of a second to make."""
    return Access("correct horse")


@pytest.mark.parametrize(
    ("host", "address", "allowed"),
    [
        ("192.168.4.1:8023", "192.168.4.1", True),
        ("192.168.4.1:80", "192.168.4.1", False),
        ("192.168.4.1", "192.168.4.1", False),
        ("192.168.4.2:8023", "192.168.4.1", False),
        ("127.0.0.1:8023", "127.0.0.1", True),
        ("LOCALHOST:8023", "127.0.0.1", True),
        ("localhost:8023", "192.168.4.1", False),
        ("localhost:8023", "::1", True),
        ("[::1]:8023", "::1", True),
        ("[fe80::1]:8023", "fe80::1%wlan0", True),
        ("192.168.4.1:8023", "::ffff:192.168.4.1", True),
        ("robot.local:8023", "192.168.4.1", True),
        ("Robot.Local:8023", "192.168.4.1", True),
        ("attacker.example:8023", "192.168.4.1", False),
        ("127.0.0.1.attacker.example:8023", "127.0.0.1", False),
        ("", "127.0.0.1", False),
        ("[::1:8023", "::1", False),
        ("robot.local:8023@attacker.example:8023", "127.0.0.1", False),
    ],
)
def test_host_is_the_address_of_this_connection_or_a_given_name(
    host: str, address: str, *, allowed: bool
) -> None:
    """A name that an attacker has rebound to this address is refused."""
    assert Site("http", frozenset({"robot.local"})).host_allowed(host, address, 8023) == allowed


def test_host_without_port_means_the_default_one() -> None:
    """Browsers omit it."""
    assert Site("http").host_allowed("10.0.0.1", "10.0.0.1", 80)
    assert Site("https").host_allowed("10.0.0.1", "10.0.0.1", 443)
    assert not Site("http").host_allowed("10.0.0.1", "10.0.0.1", 443)


@pytest.mark.parametrize(
    ("origin", "required", "allowed"),
    [
        (None, False, True),
        (None, True, False),
        ("null", False, False),
        ("http://10.0.0.1:8023", True, True),
        ("https://10.0.0.1:8023", True, False),
        ("http://10.0.0.1", True, False),
        ("http://attacker.example", False, False),
    ],
)
def test_origin_is_this_page(origin: str | None, *, required: bool, allowed: bool) -> None:
    """Requests of another site's page are refused."""
    assert Site("http").origin_allowed(origin, "10.0.0.1:8023", required=required) == allowed


def test_cookie_is_only_that_of_the_code(locked: Access) -> None:
    """Not one of another code, an altered one, or none; a restarted program still takes it."""
    cookie = locked.cookie()
    assert locked.cookie_valid(cookie)
    assert Access("correct horse").cookie_valid(cookie)
    assert not Access("another code").cookie_valid(cookie)
    assert not locked.cookie_valid(cookie[:-1] + ("0" if cookie[-1] != "0" else "1"))
    assert not locked.cookie_valid("0" + cookie)
    for nonsense in (None, "", ".", "é.ü", "\udcff.\udcff", "x" * 5000):
        assert not locked.cookie_valid(nonsense)


def test_code_that_is_no_text_is_a_wrong_one(locked: Access) -> None:
    """Bytes that are no UTF-8 arrive as surrogates."""
    assert not locked.attempt("correct horse\udcff", "192.0.2.1", 0.0)


def test_wrong_codes_lock_an_address_for_a_while() -> None:
    """Even the right code is then refused, and other addresses are not."""
    door = Access("correct horse")
    for i in range(access.ATTEMPTS_PER_ADDRESS):
        assert not door.attempt("guess", "10.0.0.2", float(i))
    assert door.retry_after_s("10.0.0.2", 5.0) == pytest.approx(access.ATTEMPT_SPAN_S - 5.0)
    assert not door.attempt("correct horse", "10.0.0.2", 5.0)
    assert door.attempt("correct horse", "10.0.0.3", 5.0)
    assert door.attempt("correct horse", "10.0.0.2", access.ATTEMPT_SPAN_S + 5.0)


def test_many_addresses_are_limited_together() -> None:
    """And the addresses of one IPv6 network count as one."""
    door = Access("correct horse")
    for i in range(access.ATTEMPTS):
        door.attempt("guess", f"10.0.1.{i}", 0.0)
    assert door.retry_after_s("10.9.9.9", 1.0) > 0
    door = Access("correct horse")
    for i in range(access.ATTEMPTS_PER_ADDRESS):
        door.attempt("guess", f"2001:db8::{i}", 0.0)
    assert door.retry_after_s("2001:db8::ffff", 1.0) > 0
    assert door.retry_after_s("2001:db8:1::1", 1.0) == 0
