"""The checks of ``tsgt doctor`` that look at the radio."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.made_up_machine import MadeUpMachine

from tsgt.doctor import Outcome
from tsgt.doctor.machine import User
from tsgt.errors import RadioError

if TYPE_CHECKING:
    from pathlib import Path


async def test_radio_that_answers_is_well(tmp_path: Path) -> None:
    """The simulated chip is reset, identified, set up and put to sleep; nothing goes on the air."""
    findings = await MadeUpMachine(tmp_path).examine()
    assert findings["radio_devices"].outcome is Outcome.OK
    assert findings["radio"].outcome is Outcome.OK
    assert "0x12" in findings["radio"].detail


async def test_bus_that_is_switched_off_fails(tmp_path: Path) -> None:
    """Without SPI there is no radio to look for."""
    made_up = MadeUpMachine(tmp_path)
    (tmp_path / "dev/spidev0.0").unlink()
    findings = await made_up.examine()
    assert findings["radio_devices"].ok is False
    assert "raspi-config nonint do_spi 0" in findings["radio_devices"].detail
    assert findings["radio"].ok is None


async def test_missing_pins_fail(tmp_path: Path) -> None:
    """A kernel without a driver for the pins has no GPIO chip."""
    made_up = MadeUpMachine(tmp_path)
    (tmp_path / "dev/gpiochip0").unlink()
    assert (await made_up.examine())["radio_devices"].ok is False


async def test_missing_rights_fail(tmp_path: Path) -> None:
    """Both devices are named, in one line."""
    made_up = MadeUpMachine(tmp_path)
    made_up.daemon = User(name="tsgt", uid=4711, groups=frozenset())
    found = (await made_up.examine())["radio_devices"]
    assert found.ok is False
    assert "spidev0.0" in found.detail
    assert "gpiochip0" in found.detail


async def test_missing_package_is_a_finding(tmp_path: Path) -> None:
    """What the bus says when it is opened is the line, whatever it is."""
    made_up = MadeUpMachine(tmp_path)
    made_up.hal_error = RadioError("the Python package spidev is missing: pip install 'tsgt[pi]'")
    found = (await made_up.examine())["radio"]
    assert found.ok is False
    assert "pip install 'tsgt[pi]'" in found.detail


async def test_error_that_nobody_thought_of_is_a_finding(tmp_path: Path) -> None:
    """A library by others may raise what it likes; the other checks are made nevertheless."""
    made_up = MadeUpMachine(tmp_path)
    made_up.hal_error = ZeroDivisionError("what?")
    findings = await made_up.examine()
    assert findings["radio"].ok is False
    assert "ZeroDivisionError" in findings["radio"].detail
    assert "boot_id" in findings


async def test_radio_of_a_running_daemon_is_left_alone(tmp_path: Path) -> None:
    """Two programs on one radio would each see half of it."""
    made_up = MadeUpMachine(tmp_path)
    made_up.served = {tmp_path / "poses.sock"}
    made_up.hal_error = AssertionError("must not be opened")
    findings = await made_up.examine("master.toml")
    assert findings["radio"].outcome is Outcome.SKIPPED
    assert "runs here" in findings["daemon"].detail


async def test_radio_in_other_hands_is_named_and_not_opened(tmp_path: Path) -> None:
    """The other daemon on the same machine, or a ping in another window."""
    made_up = MadeUpMachine(tmp_path)
    made_up.holders["spidev0.0"] = "tsgt-master (process 77)"
    made_up.hal_error = AssertionError("must not be opened")
    found = (await made_up.examine())["radio"]
    assert found.ok is False
    assert "tsgt-master (process 77)" in found.detail


async def test_simulated_radio_is_skipped(tmp_path: Path) -> None:
    """There is nothing to look at in a demo."""
    made_up = MadeUpMachine(tmp_path)
    made_up.change("client.toml", 'kind = "sx127x"', 'kind = "simulated"\nair_socket = "air"\nname = "one"')
    findings = await made_up.examine()
    assert (findings["radio"].ok, findings["radio_devices"].ok) == (None, None)


async def test_limits_that_are_kept_are_well(tmp_path: Path) -> None:
    """500 kHz in Canada, and 7 with a tenth of the time in Europe."""
    made_up = MadeUpMachine(tmp_path)
    assert (await made_up.examine("master.toml"))["limits"].outcome is Outcome.OK


async def test_limits_that_are_exceeded_are_noted_with_the_command_to_plan(tmp_path: Path) -> None:
    """The law of the place decides, not this program; but it says so."""
    made_up = MadeUpMachine(tmp_path)
    made_up.change("master.toml", "bandwidth_khz = 500.0", "bandwidth_khz = 250.0")
    found = (await made_up.examine("master.toml"))["limits"]
    assert found.outcome is Outcome.NOTE
    assert "tsgt radio plan --protocol classic --stations 3 --sf 9 --bandwidth-khz 250" in found.detail
    assert "--region CA915" in found.detail


async def test_radio_without_region_is_noted(tmp_path: Path) -> None:
    """Nobody knows then whether it is allowed."""
    made_up = MadeUpMachine(tmp_path)
    made_up.change("client.toml", 'region = "EU868"', "")
    assert (await made_up.examine())["limits"].outcome is Outcome.NOTE
