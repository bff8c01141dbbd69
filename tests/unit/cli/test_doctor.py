"""``tsgt doctor``: text, JSON and exit code."""

from __future__ import annotations

import os
import socket
from typing import TYPE_CHECKING

import pytest
from harness.hardware.fake_machine import ADAPTER, FakeMachine

from tsgt.cli import doctor
from tsgt.cli.doctor import this_machine

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeMachine:
    """Return a fake machine without hardware, whose checks need virtual time."""
    made = FakeMachine(tmp_path)
    made.change("client.toml", 'kind = "sx127x"', 'kind = "simulated"\nair_socket = "air"\nname = "one"')
    made.change("client.toml", 'kind = "leica"', 'kind = "bridge"')
    made.change("client.toml", f'port = "dev/serial/by-id/{ADAPTER}"', 'command = ["my-program", "--all"]')
    made.change("client.toml", 'prism_type = "mini_360"', "")
    made.programs = {"my-program"}
    monkeypatch.setattr(doctor, "this_machine", made.machine)
    return made


def test_ready_machine_exits_with_0(tsgt: Tsgt, fake: FakeMachine) -> None:
    """One line per check, then the sum."""
    done = tsgt("doctor", fake.folder / "client.toml")
    assert done.code == 0, done.out
    *lines, total = done.out.splitlines()
    assert lines[0].startswith("ok      configuration")
    assert {line.split()[0] for line in lines} <= {"ok", "note", "skipped"}
    assert total == f"all {sum(not line.startswith('skipped') for line in lines)} checks passed"


def test_failed_check_exits_with_3(tsgt: Tsgt, fake: FakeMachine) -> None:
    """The other checks run as well."""
    fake.programs = set()
    done = tsgt("doctor", fake.folder / "client.toml")
    assert done.code == 3
    (line,) = (line for line in done.out.splitlines() if line.startswith("FAILED"))
    assert "instrument" in line
    assert "my-program" in line
    assert done.out.splitlines()[-1].startswith("1 of ")


def test_json_has_each_check_by_name(tsgt: Tsgt, fake: FakeMachine) -> None:
    """``ok`` of a skipped check is null."""
    fake.programs = set()
    done = tsgt("doctor", fake.folder / "client.toml", "--json")
    assert done.code == 3
    said = done.json()
    assert said["ok"] is False
    checks = said["checks"]
    assert (checks["configuration"]["ok"], checks["instrument"]["ok"], checks["radio"]["ok"]) == (
        True,
        False,
        None,
    )
    assert all(check["detail"] and check["outcome"] for check in checks.values())


def test_default_configuration_is_found(
    tsgt: Tsgt, fake: FakeMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If both defaults exist, one has to be given."""
    there, missing = fake.folder / "client.toml", fake.folder / "no.toml"
    monkeypatch.setattr(doctor, "DEFAULT_CONFIGS", (there, missing))
    assert tsgt("doctor").code == 0
    monkeypatch.setattr(doctor, "DEFAULT_CONFIGS", (there, there))
    assert tsgt("doctor").code == 2
    monkeypatch.setattr(doctor, "DEFAULT_CONFIGS", (missing, missing))
    done = tsgt("doctor")
    assert done.code == 3
    assert "no such file" in done.out


def test_doctor_on_this_machine(tsgt: Tsgt, tmp_path: Path) -> None:
    """Missing hardware is a finding, not an error."""
    FakeMachine(tmp_path)
    done = tsgt("doctor", tmp_path / "client.toml", "--json")
    assert done.code == 3  # the adapter of the fake machine is no terminal
    assert all(check["detail"] for check in done.json()["checks"].values())
    assert "please report" not in done.out


def test_only_a_served_socket_is_a_daemon(tmp_path: Path) -> None:
    """A stale socket and a missing file are not."""
    machine = this_machine()
    stale, served = tmp_path / "stale", tmp_path / "served"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(os.fspath(stale))
    assert not machine.serves(stale)
    assert not machine.serves(tmp_path / "nothing")
    assert machine.client_status(stale) is None
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(os.fspath(served))
        listener.listen()
        assert machine.serves(served)
