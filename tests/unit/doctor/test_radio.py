"""Checks of ``tsgt doctor``: the radio."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.hardware.fake_machine import FakeMachine

from tsgt.doctor import Outcome
from tsgt.doctor.machine import User
from tsgt.errors import RadioError

if TYPE_CHECKING:
    from pathlib import Path


async def test_responding_radio_passes(tmp_path: Path) -> None:
    """The simulated chip is reset, identified, configured and put to sleep without transmitting."""
    findings = await FakeMachine(tmp_path).run_checks()
    assert findings["radio_devices"].outcome is Outcome.OK
    assert findings["radio"].outcome is Outcome.OK
    assert "0x12" in findings["radio"].detail


async def test_unconnected_dio0_fails(tmp_path: Path) -> None:
    """The chip responds, but nothing would tell when a packet ends."""
    fake = FakeMachine(tmp_path)
    fake.dio0_connected = False
    found = (await fake.run_checks())["radio"]
    assert found.ok is False
    assert "BCM 4 does not follow its DIO0" in found.detail


async def test_disabled_bus_fails(tmp_path: Path) -> None:
    """Without SPI there is no radio."""
    fake = FakeMachine(tmp_path)
    (tmp_path / "dev/spidev0.0").unlink()
    findings = await fake.run_checks()
    assert findings["radio_devices"].ok is False
    assert "raspi-config nonint do_spi 0" in findings["radio_devices"].detail
    assert findings["radio"].ok is None


async def test_missing_pins_fail(tmp_path: Path) -> None:
    """A kernel without a driver for the pins has no GPIO chip."""
    fake = FakeMachine(tmp_path)
    (tmp_path / "dev/gpiochip0").unlink()
    assert (await fake.run_checks())["radio_devices"].ok is False


async def test_missing_permissions_fail(tmp_path: Path) -> None:
    """The finding names both devices."""
    fake = FakeMachine(tmp_path)
    fake.daemon = User(name="tsgt", uid=4711, groups=frozenset())
    found = (await fake.run_checks())["radio_devices"]
    assert found.ok is False
    assert "spidev0.0" in found.detail
    assert "gpiochip0" in found.detail


async def test_missing_package_is_a_finding(tmp_path: Path) -> None:
    """The finding has the error of the bus."""
    fake = FakeMachine(tmp_path)
    fake.hal_error = RadioError("the Python package spidev is missing: pip install 'tsgt[pi]'")
    found = (await fake.run_checks())["radio"]
    assert found.ok is False
    assert "pip install 'tsgt[pi]'" in found.detail


async def test_unexpected_error_is_a_finding(tmp_path: Path) -> None:
    """The other checks run nevertheless."""
    fake = FakeMachine(tmp_path)
    fake.hal_error = ZeroDivisionError("what?")
    findings = await fake.run_checks()
    assert findings["radio"].ok is False
    assert "ZeroDivisionError" in findings["radio"].detail
    assert "boot_id" in findings


async def test_radio_of_a_running_daemon_is_left_alone(tmp_path: Path) -> None:
    """Two programs would disturb each other."""
    fake = FakeMachine(tmp_path)
    fake.served = {tmp_path / "poses.sock"}
    fake.hal_error = AssertionError("must not be opened")
    findings = await fake.run_checks("master.toml")
    assert findings["radio"].outcome is Outcome.SKIPPED
    assert "is running" in findings["daemon"].detail


async def test_busy_radio_is_not_opened(tmp_path: Path) -> None:
    """The finding names the other process."""
    fake = FakeMachine(tmp_path)
    fake.holders["spidev0.0"] = "tsgt-master (process 77)"
    fake.hal_error = AssertionError("must not be opened")
    found = (await fake.run_checks())["radio"]
    assert found.ok is False
    assert "tsgt-master (process 77)" in found.detail


async def test_simulated_radio_is_skipped(tmp_path: Path) -> None:
    """A demo has no hardware."""
    fake = FakeMachine(tmp_path)
    fake.change("client.toml", 'kind = "sx127x"', 'kind = "simulated"\nair_socket = "air"\nname = "one"')
    findings = await fake.run_checks()
    assert (findings["radio"].ok, findings["radio_devices"].ok) == (None, None)


async def test_settings_within_limits_pass(tmp_path: Path) -> None:
    """500 kHz in Canada, and 7 dBm above 869.7 MHz in Europe; the finding has the radiated power."""
    fake = FakeMachine(tmp_path)
    for file, radiated in (("master.toml", "19.1 dBm e.i.r.p."), ("client.toml", "7.0 e.r.p.")):
        found = (await fake.run_checks(file))["limits"]
        assert found.outcome is Outcome.OK
        assert radiated in found.detail


async def test_violation_fails_with_the_remedy(tmp_path: Path) -> None:
    """The finding is one line; the settings in it comply."""
    fake = FakeMachine(tmp_path)
    fake.change("master.toml", "bandwidth_khz = 500.0", "bandwidth_khz = 250.0")
    found = (await fake.run_checks("master.toml"))["limits"]
    assert found.outcome is Outcome.FAILED
    assert found.detail.endswith("Under [radio], in all radios: bandwidth_khz = 500, power_dbm = 17")
    assert "RSS-210" in found.detail


async def test_antenna_with_too_much_gain_fails(tmp_path: Path) -> None:
    """The radiated power counts."""
    fake = FakeMachine(tmp_path)
    fake.change("client.toml", 'region = "EU868"', 'region = "EU868"\npower_dbm = 7\nantenna_gain_dbi = 5.15')
    found = (await fake.run_checks())["limits"]
    assert found.outcome is Outcome.FAILED
    assert found.detail.endswith("power_dbm = 4")


async def test_licence_is_a_note(tmp_path: Path) -> None:
    """Its holder knows its limits."""
    fake = FakeMachine(tmp_path)
    fake.change("client.toml", 'region = "EU868"', 'licence = "BAKOM 1234"\npower_dbm = 17')
    found = (await fake.run_checks())["limits"]
    assert found.outcome is Outcome.NOTE
    assert "BAKOM 1234" in found.detail
