"""Limits of attempts."""

from __future__ import annotations

from tsgt.relay.admission import ATTEMPTS, MAX_ADDRESSES, Admission

SECOND = 1_000_000_000


def admitted(admission: Admission, address: str, now_ns: int, count: int) -> int:
    """Return how many of a number of attempts are admitted."""
    return sum(admission.admits(address, now_ns) for _ in range(count))


def test_attempts_are_limited_and_come_back() -> None:
    """Ten at once, then one per second."""
    admission = Admission()
    assert admitted(admission, "10.0.0.1", 0, 100) == ATTEMPTS
    assert admitted(admission, "10.0.0.1", 3 * SECOND, 100) == 3


def test_rejected_attempts_cost_nothing() -> None:
    """Whoever keeps trying is admitted as soon as one who waits."""
    admission = Admission()
    times = [round(0.01 * SECOND * step) for step in range(1000)]
    assert sum(admission.admits("10.0.0.1", at) for at in times) in (ATTEMPTS + 9, ATTEMPTS + 10)


def test_addresses_do_not_affect_each_other() -> None:
    """But for those of one IPv6 network."""
    admission = Admission()
    admitted(admission, "10.0.0.1", 0, 100)
    assert admission.admits("10.0.0.2", 0)
    assert admitted(admission, "2001:db8::1", 0, 100) == ATTEMPTS
    assert not admission.admits("2001:db8::2", 0)
    assert admission.admits("2001:db8:0:1::2", 0)
    assert not admission.admits("::ffff:10.0.0.1", 0)


def test_wrong_keys_cost_more() -> None:
    """Two, and the address has to wait."""
    admission = Admission()
    for _ in range(2):
        assert admission.admits("10.0.0.1", 0)
        admission.wrong_key("10.0.0.1", 0)
    assert not admission.admits("10.0.0.1", 0)


def test_right_key_ends_the_suspicion() -> None:
    """A reader that reconnects often stays welcome."""
    admission = Admission()
    for _ in range(100):
        assert admission.admits("10.0.0.1", 0)
        admission.right_key("10.0.0.1")


def test_memory_is_bounded() -> None:
    """However many addresses there are."""
    admission = Admission()
    for number in range(2 * MAX_ADDRESSES):
        admission.admits(f"10.{number >> 16}.{number >> 8 & 255}.{number & 255}", 0)
    assert len(admission._spent) <= MAX_ADDRESSES
