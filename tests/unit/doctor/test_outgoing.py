"""Checks of ``tsgt doctor``: commands and web server that the master calls."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

import pytest
from harness.hardware.fake_machine import FakeMachine

from tsgt.doctor import Outcome, reach_server

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.doctor import Finding

ALARMS = """
[alarms]
site = "yard"
command = ["/usr/local/bin/siren", "--loud"]
webhook = "https://alarms.example.org/secret-7f3a"
"""

FENCE = """
[[geofences]]
name = "yard"
allowed_side = "inside"
polygon_m = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]
command = ["stop-robot"]
"""

DROP_IN = {
    "PrivateNetwork": "no",
    "RestrictAddressFamilies": "AF_UNIX AF_INET AF_INET6",
    "IPAddressAllow": "0.0.0.0/0 ::/0",
}


@pytest.fixture
def fake(tmp_path: Path) -> FakeMachine:
    """Return a machine whose master has alarms and a geofence with a command."""
    machine = FakeMachine(tmp_path)
    machine.change("master.toml", "[[stations]]\nstation = 1", ALARMS + FENCE + "[[stations]]\nstation = 1")
    machine.programs |= {"/usr/local/bin/siren", "stop-robot"}
    return machine


async def found(fake: FakeMachine, name: str) -> Finding:
    """Return a finding of the master's checks."""
    return (await fake.run_checks("master.toml"))[name]


@pytest.mark.parametrize("name", ["alarms_command", "geofence_command"])
async def test_command_must_exist(fake: FakeMachine, name: str) -> None:
    """It is named when it does not."""
    assert (await found(fake, name)).outcome is Outcome.OK
    fake.programs.clear()
    missing = await found(fake, name)
    assert missing.outcome is Outcome.FAILED
    assert "does not exist or is not executable" in missing.detail


async def test_command_in_a_home_is_hidden_by_the_service(fake: FakeMachine) -> None:
    """It works by hand and never from the service."""
    fake.change("master.toml", "/usr/local/bin/siren", "/home/pi/siren")
    fake.programs.add("/home/pi/siren")
    hidden = await found(fake, "alarms_command")
    assert (hidden.outcome, "put it under /usr/local/bin" in hidden.detail) == (Outcome.FAILED, True)


@pytest.mark.parametrize("removed", DROP_IN)
async def test_webhook_needs_the_whole_drop_in(fake: FakeMachine, removed: str) -> None:
    """Each of its lines, or the sandbox denies the network; then nothing is connected."""
    assert fake.service is not None
    fake.service |= {key: value for key, value in DROP_IN.items() if key != removed}
    denied = await found(fake, "alarms_webhook")
    assert denied.outcome is Outcome.FAILED
    assert "sudo systemctl edit tsgt-master" in denied.detail
    assert fake.reached == []


async def test_webhook_is_reached_without_a_request(fake: FakeMachine) -> None:
    """The path is a secret, and not shown; a server that is away is a note: there may be no network indoors."""
    assert fake.service is not None
    fake.service |= DROP_IN
    reached = await found(fake, "alarms_webhook")
    assert (reached.outcome, "secret" in reached.detail) == (Outcome.OK, False)
    fake.unreached = "it is not reached (timed out)"
    away = await found(fake, "alarms_webhook")
    assert (away.outcome, "secret" in away.detail) == (Outcome.NOTE, False)
    fake.unreached = ""
    fake.change("master.toml", "https://", "http://")
    assert "without encryption" in (await found(fake, "alarms_webhook")).detail


async def test_nothing_configured_is_no_finding(tmp_path: Path) -> None:
    """A master without alarms and geofences."""
    names = set(await FakeMachine(tmp_path).run_checks("master.toml"))
    assert not names & {"alarms", "alarms_command", "alarms_webhook", "geofence_command"}


def test_server_is_reached_or_named() -> None:
    """Without a byte of a request."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        assert reach_server(f"http://127.0.0.1:{port}/alarm") == ""
        connection, _ = listener.accept()
        with connection:
            assert connection.recv(10) == b""
    assert "refused" in reach_server(f"http://127.0.0.1:{port}/alarm")
