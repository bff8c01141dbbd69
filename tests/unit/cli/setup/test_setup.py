"""``tsgt setup``: a Pi from its first boot to running services, by a simulated chip and a simulated instrument."""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import replace
from functools import partialmethod
from importlib.resources import files
from typing import TYPE_CHECKING

import click
import pytest
from harness.hardware.fake_machine import ADAPTER
from harness.hardware.setup_system import PiToSetUp

from tsgt import service
from tsgt.cli import doctor
from tsgt.cli.setup import group, options, session
from tsgt.cli.setup.options import Common
from tsgt.config import ClientConfig, LeicaInstrumentConfig, MasterConfig, load
from tsgt.config.radio import HardwareRadioConfig
from tsgt.setup import Mission, WriteFile, encode_mission, hand_over_lines, key_step
from tsgt.simulation.kernel import run_virtual

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from harness.files.cli import Outcome, Tsgt

    from tsgt.cli.setup.session import Session
    from tsgt.setup import Role

KEY = hashlib.sha256(b"a key").digest()
MISSION = encode_mission(
    Mission(
        region="CA915",
        frequency_hz=905_000_000,
        bandwidth_hz=500_000,
        spreading_factor=9,
        coding_rate=6,
        preamble_symbols=8,
        sync_word=0x34,
        key=KEY,
    )
)
OTHER_MISSION = encode_mission(
    Mission(
        region="EU868",
        frequency_hz=869_850_000,
        bandwidth_hz=250_000,
        spreading_factor=9,
        coding_rate=6,
        preamble_symbols=8,
        sync_word=0x34,
        key=KEY[::-1],
    )
)
STATION = ("setup", "station", "--yes", "--station", 2, "--prism-type", "mini_360", "--mission", MISSION)
MASTER = ("setup", "master", "--yes", "--region", "CA915", "--stations", 3)

CLASSIC = """\
kind = "client"
station = 1
prism = 1

[instrument]
kind = "leica"
port = "/dev/ttyUSB0"
prism_type = "mini_360"

[radio]
kind = "sx127x"
frequency_mhz = 905.0
spreading_factor = 9
bandwidth_khz = 500.0
region = "CA915"

[protocol]
kind = "classic"

[journal]
directory = "/var/lib/tsgt"
"""


@pytest.fixture
def pi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PiToSetUp:
    """Return a Pi from the image writer, on which the command runs in virtual time."""
    made = PiToSetUp(tmp_path / "pi")
    monkeypatch.setattr(options, "this_system", lambda _root: made.system())
    monkeypatch.setattr(group, "this_system", lambda _root: made.system())
    monkeypatch.setattr(doctor, "this_machine", made.machine)
    monkeypatch.setattr(service, "run", run_virtual)
    return made


def client(pi: PiToSetUp) -> ClientConfig:
    """Return the configuration that was written."""
    return load(pi.root / "etc/tsgt/client.toml", ClientConfig)


def failed(done: Outcome) -> str:
    """Return the line of the step that failed."""
    assert done.code == 3, done
    (line,) = (line for line in done.out.splitlines() if line.startswith("FAILED"))
    return line


def test_station_is_ready_after_one_command(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """SPI on, user made, radio and instrument found, key and configuration in place, service started."""
    done = tsgt(*STATION)
    assert done.code == 0, done.out
    config = client(pi)
    assert (config.station, config.prism) == (2, 2)
    assert isinstance(config.instrument, LeicaInstrumentConfig)
    assert config.instrument.port == pi.root / "dev/serial/by-id" / ADAPTER
    assert isinstance(config.radio, HardwareRadioConfig)
    assert config.radio.wiring.nss_pin == 25
    assert (pi.root / "etc/tsgt/radio.key").read_text() == KEY.hex() + "\n"
    assert (pi.root / "etc/tsgt/radio.key").stat().st_mode & 0o777 == 0o600
    assert pi.active == {"tsgt-client.service"}
    assert not pi.ntp


def test_second_run_changes_nothing(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """Without any option: all answers are those of before."""
    tsgt(*STATION)
    before, pi.commands = pi.files(), []
    done = tsgt("setup", "station", "--yes")
    assert done.code == 0, done.out
    assert "Nothing was changed" in done.out
    assert (pi.files(), pi.commands) == (before, [])


@pytest.mark.usefixtures("pi")
def test_json_names_each_step(tsgt: Tsgt) -> None:
    """``ok``, ``detail`` and ``changed`` of each."""
    said = tsgt(*STATION, "--json").json()
    assert (said["ok"], said["changed"]) == (True, True)
    assert list(said["steps"]) == [
        *("system", "spi", "user", "mission", "radio", "instrument", "key", "configuration", "services"),
        *("journal", "clock", "doctor", "service"),
    ]
    assert all(step["ok"] and step["detail"] for step in said["steps"].values())
    assert tsgt("setup", "station", "--json").json()["changed"] is False


def test_dry_run_changes_nothing(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """It names every file and command, and needs no root."""
    before, pi.uid = pi.files(), 1000
    done = tsgt(*STATION, "--dry-run")
    assert done.code == 0, done.out
    assert (pi.files(), pi.commands) == (before, [])
    for change in ("write /boot/firmware/config.txt", "write /etc/tsgt/client.toml", "run systemctl enable"):
        assert change in done.out


@pytest.mark.parametrize("nss_pin", [25, -1])
def test_chip_select_is_found(tsgt: Tsgt, pi: PiToSetUp, nss_pin: int) -> None:
    """On the HAT's pin, or by the SPI controller."""
    pi.nss_pin = nss_pin
    assert tsgt(*STATION).code == 0
    radio = client(pi).radio
    assert isinstance(radio, HardwareRadioConfig)
    assert radio.wiring.nss_pin == nss_pin


@pytest.mark.parametrize(
    ("given", "expected"),
    [(("--reset-pin", 17), (17, 4)), (("--dio0-pin", 22), (27, 22)), (("--nss-pin", 25), (27, 4))],
)
def test_pin_that_is_given_changes_and_the_others_stay(
    tsgt: Tsgt, pi: PiToSetUp, given: tuple[object, ...], expected: tuple[int, int]
) -> None:
    """Also the default, where the configuration has another pin."""
    tsgt(*STATION, "--reset-pin", 27)
    pi.active.clear()
    done = tsgt("setup", "station", "--yes", *given)
    assert done.code == 0, done.out
    radio = client(pi).radio
    assert isinstance(radio, HardwareRadioConfig)
    assert (radio.wiring.reset_pin, radio.wiring.dio0_pin) == expected


@pytest.mark.usefixtures("pi")
def test_wiring_option_may_be_repeated_while_the_service_runs(tsgt: Tsgt) -> None:
    """It is in force; another one needs the radio."""
    assert tsgt(*STATION, "--reset-pin", 27).code == 0
    assert "Nothing was changed" in tsgt("setup", "station", "--yes", "--reset-pin", 27).out
    line = failed(tsgt("setup", "station", "--yes", "--reset-pin", 17))
    assert "sudo systemctl stop tsgt-client.service" in line


def test_spi_device_may_be_a_path(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """As `ls /dev/spidev*` prints it."""
    done = tsgt(*STATION, "--spi-device", "/dev/spidev0.0")
    assert done.code == 0, done.out
    assert isinstance(client(pi).radio, HardwareRadioConfig)


@pytest.mark.parametrize("given", ["spidev0", "/dev/ttyUSB0", "spidev0.x", "spidev1001.0", "spidev0.0 "])
def test_spi_device_of_another_name_is_a_usage_error(tsgt: Tsgt, pi: PiToSetUp, given: str) -> None:
    """Before anything is changed."""
    before = pi.files()
    done = tsgt(*STATION, "--spi-device", given)
    assert done.code == 2
    assert "spidev0.1" in done.err
    assert pi.files() == before


def test_baud_rate_of_the_instrument_is_found(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """Its name and serial number are printed."""
    pi.instruments[ADAPTER] = 19_200
    done = tsgt(*STATION)
    assert done.code == 0, done.out
    instrument = client(pi).instrument
    assert isinstance(instrument, LeicaInstrumentConfig)
    assert instrument.baud == 19_200
    assert "at 19200 baud" in done.out
    assert ", number " in done.out


def test_station_without_instrument_waits_for_it(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """It is found when the command is called again, while the service that waits for it runs."""
    pi.instruments[ADAPTER] = None
    line = failed(tsgt(*STATION))
    assert "--instrument none" in line
    assert tsgt(*STATION, "--instrument", "none").code == 0
    again = tsgt("setup", "station", "--yes")
    assert again.code == 0
    assert "none yet" in again.out
    pi.instruments[ADAPTER] = 115_200
    assert tsgt("setup", "station", "--yes").code == 0
    instrument = client(pi).instrument
    assert isinstance(instrument, LeicaInstrumentConfig)
    assert str(instrument.port).endswith(ADAPTER)


def test_two_instruments_need_a_choice(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """The message names both."""
    pi.plug_in("usb-other-port0", 115_200)
    line = failed(tsgt(*STATION))
    assert ADAPTER in line
    assert "usb-other-port0" in line
    other = pi.root / "dev/serial/by-id/usb-other-port0"
    assert tsgt(*STATION, "--instrument", other).code == 0


def test_instrument_in_the_network_is_let_through(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """The sandbox of the service denies the network otherwise."""
    pi.instruments["tcp://10.0.0.5:1212"] = 115_200
    assert tsgt(*STATION, "--instrument", "tcp://10.0.0.5:1212").code == 0
    instrument = client(pi).instrument
    assert isinstance(instrument, LeicaInstrumentConfig)
    assert str(instrument.port) == "tcp://10.0.0.5:1212"
    assert (pi.root / "etc/systemd/system/tsgt-client.service.d/network-instrument.conf").exists()


def test_instrument_on_a_cable_again_closes_the_network(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """The drop-in of setup goes; one that was edited stays."""
    pi.instruments["tcp://10.0.0.5:1212"] = 115_200
    drop_in = pi.root / "etc/systemd/system/tsgt-client.service.d/network-instrument.conf"
    assert tsgt(*STATION, "--instrument", "tcp://10.0.0.5:1212").code == 0
    content = drop_in.read_text()
    by_cable = ("--instrument", pi.root / "dev/serial/by-id" / ADAPTER)
    assert tsgt(*STATION, *by_cable).code == 0
    assert not drop_in.exists()
    drop_in.write_text(f"{content}# of somebody\n")
    assert tsgt(*STATION, *by_cable).code == 0
    assert drop_in.exists()


def network_drop_in(pi: PiToSetUp) -> Path:
    """Allow the service by hand to use the network, as docs/how-to/connect-an-instrument.md says; return the file."""
    content = (files("tsgt.setup") / "files/systemd/network-instrument.conf").read_text()
    return pi.write("etc/systemd/system/tsgt-client.service.d/network-instrument.conf", content)


def use_classic(path: Path, *, port: str | None = None) -> None:
    """Change the protocol of a configuration to the paper's, which setup does not write, and the port."""
    text = re.sub(r'kind = "superframe"\nkey_file = .*\n', 'kind = "classic"\n', path.read_text())
    path.write_text(text if port is None else re.sub(r"(?m)^port = .*$", f'port = "{port}"', text))


def test_network_stays_open_for_the_configuration_that_stays(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """One of a kind that setup does not write, whose instrument is in the network."""
    pi.instruments["tcp://10.0.0.5:1212"] = 115_200
    assert tsgt(*STATION).code == 0
    use_classic(pi.root / "etc/tsgt/client.toml", port="tcp://10.0.0.5:1212")
    drop_in = network_drop_in(pi)
    assert tsgt("setup", "station", "--yes").code == 0
    assert drop_in.exists()
    narrowed = edit(drop_in, "IPAddressAllow=any", "IPAddressAllow=10.0.0.5")
    assert tsgt("setup", "station", "--yes").code == 0
    assert drop_in.read_text() == narrowed


def test_network_stays_open_when_an_instrument_is_found_on_a_cable(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """But the edited configuration stays, whose instrument is in the network."""
    pi.instruments["tcp://10.0.0.5:1212"] = 115_200
    assert tsgt(*STATION, "--instrument", "tcp://10.0.0.5:1212").code == 0
    edit(pi.root / "etc/tsgt/client.toml", "search_window_deg = 40.0", "search_window_deg = 60.0")
    pi.active.clear()
    done = tsgt("setup", "station", "--yes")
    assert done.code == 0, done.out
    assert "+port" in done.out
    assert (pi.root / "etc/systemd/system/tsgt-client.service.d/network-instrument.conf").exists()


def test_network_of_a_bridge_is_left_as_it_is(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """Whether its program needs the network is the operator's knowledge."""
    assert tsgt(*STATION).code == 0
    use_bridge(pi.root / "etc/tsgt/client.toml")
    drop_in = network_drop_in(pi)
    tsgt("setup", "station", "--yes")
    assert drop_in.exists()


def test_folders_can_be_entered_whatever_the_umask(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """Sudo keeps the umask of who calls it, and the daemon has to read its configuration."""
    before = os.umask(0o077)
    try:
        assert tsgt(*STATION).code == 0
    finally:
        os.umask(before)
    assert (pi.root / "etc/tsgt").stat().st_mode & 0o777 == 0o755


def test_radio_that_does_not_respond_stops_the_setup(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """The message says where it was looked for; no configuration is written."""
    pi.nss_pin = None
    line = failed(tsgt(*STATION))
    assert line.startswith("FAILED  radio")
    assert "spidev0.0" in line
    assert not (pi.root / "etc/tsgt/client.toml").exists()


def test_spi_that_needs_a_reboot_says_so(tsgt: Tsgt, pi: PiToSetUp, monkeypatch: pytest.MonkeyPatch) -> None:
    """After it, the same command goes on."""
    monkeypatch.setattr("tsgt.cli.setup.common._SPI_WAIT_S", 0.0)
    pi.spi_at_boot = True
    assert "reboot" in failed(tsgt(*STATION))
    pi.boot()
    assert tsgt(*STATION).code == 0


def test_user_without_root_is_told_to_use_sudo(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """Before anything is changed."""
    before, pi.uid = pi.files(), 1000
    assert "sudo tsgt setup station" in failed(tsgt(*STATION))
    assert pi.files() == before


def test_damaged_mission_text_is_rejected(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """By its checksum, before any key is written."""
    damaged = MISSION.replace("/9/", "/8/", 1)
    done = tsgt("setup", "station", "--yes", "--station", 1, "--prism-type", "360", "--mission", damaged)
    assert "checksum" in failed(done)
    assert not (pi.root / "etc/tsgt/radio.key").exists()


def test_mission_may_be_a_file(tsgt: Tsgt, pi: PiToSetUp, tmp_path: Path) -> None:
    """As `tsgt setup mission` printed it: the first line counts."""
    (tmp_path / "mission.txt").write_text(MISSION + "\n")
    options = (*STATION[:-1], tmp_path / "mission.txt")
    assert tsgt(*options).code == 0
    assert (pi.root / "etc/tsgt/radio.key").exists()


def test_key_of_another_mission_stays(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """Unless it is asked for."""
    tsgt(*STATION)
    other = KEY[::-1].hex() + "\n"
    (pi.root / "etc/tsgt/radio.key").write_text(other)
    assert "--replace-key" in failed(tsgt(*STATION))
    assert (pi.root / "etc/tsgt/radio.key").read_text() == other
    assert tsgt(*STATION, "--replace-key").code == 0
    assert (pi.root / "etc/tsgt/radio.key").read_text() == KEY.hex() + "\n"


@pytest.mark.parametrize("text", ["abcd", KEY.hex() + "00", "no key", ""])
def test_mission_needs_a_whole_key(tsgt: Tsgt, pi: PiToSetUp, text: str) -> None:
    """As the daemons do."""
    assert tsgt(*MASTER).code == 0
    (pi.root / "etc/tsgt/radio.key").write_text(text + "\n")
    shown = tsgt("setup", "mission")
    assert shown.code in (1, 2)
    assert "radio.key: not a key" in shown.err


def test_edited_configuration_stays_and_differences_are_shown(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """Unless it is asked for; then the old one is kept beside it."""
    tsgt(*STATION)
    path = pi.root / "etc/tsgt/client.toml"
    edited = path.read_text().replace("search_window_deg = 40.0", "search_window_deg = 60.0")
    path.write_text(edited)
    done = tsgt("setup", "station", "--yes")
    assert done.code == 0
    assert "-search_window_deg = 60.0" in done.out
    assert path.read_text() == edited
    assert tsgt("setup", "station", "--yes", "--replace-config").code == 0
    assert "search_window_deg = 40.0" in path.read_text()
    assert path.with_name("client.toml.before-setup").read_text() == edited


def test_other_answers_replace_a_configuration_of_setup(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """One that nobody has edited; the service takes the new one."""
    tsgt(*STATION)
    pi.commands = []
    assert tsgt("setup", "station", "--yes", "--prism", 3).code == 0
    assert (client(pi).station, client(pi).prism) == (2, 3)
    assert pi.commands == ["systemctl restart tsgt-client.service"]


def test_interrupted_setup_restarts_the_service_in_the_next_run(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """It runs with the key and configuration of before until then."""
    tsgt(*STATION)
    pi.ntp, pi.interrupted_at = True, "timedatectl set-ntp false"
    assert tsgt("setup", "station", "--yes", "--replace-key", "--mission", OTHER_MISSION).code == 130
    assert client(pi).radio.region == "EU868"
    pi.commands = []
    done = tsgt("setup", "station", "--yes")
    assert done.code == 0, done.out
    assert pi.commands[-1] == "systemctl restart tsgt-client.service"
    pi.commands = []
    assert "Nothing was changed" in tsgt("setup", "station", "--yes").out
    assert pi.commands == []


def test_interrupted_setup_loads_the_unit_in_the_next_run(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """Systemd would start the service by the unit of before."""
    tsgt(*STATION)
    edit(pi.root / "etc/systemd/system/tsgt-client.service", "[Service]", "[Service]\nNice=1")
    pi.interrupted_at = "systemctl daemon-reload"
    assert tsgt("setup", "station", "--yes").code == 130
    pi.commands = []
    assert tsgt("setup", "station", "--yes").code == 0
    assert pi.commands == ["systemctl daemon-reload", "systemctl restart tsgt-client.service"]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("station", "--yes", "--mission", MISSION), "--station, --prism-type"),
        (("station", "--json", "--station", 1, "--prism-type", "360"), "--mission"),
        (("master", "--json"), "--region, --stations"),
        (("master", "--yes", "--stations", 3), "--region"),
        ((*STATION[1:], "--instrument", "tcp://10.0.0.5"), "--instrument tcp://10.0.0.5"),
    ],
)
def test_missing_and_impossible_answers_are_named_before_anything_is_changed(
    tsgt: Tsgt, pi: PiToSetUp, options: tuple[object, ...], named: str
) -> None:
    """A usage error, without a terminal to ask at."""
    before = pi.files()
    done = tsgt("setup", *options)
    assert done.code == 2
    assert f"Error: {named}" in done.err
    assert (pi.files(), pi.commands) == (before, [])


def test_master_makes_the_key_and_shows_the_text_for_its_stations(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """A station that is given this text has the same channel and key."""
    done = tsgt(*MASTER)
    assert done.code == 0, done.out
    (text,) = (line for line in done.out.splitlines() if line.startswith("TSGT1/"))
    config = load(pi.root / "etc/tsgt/master.toml", MasterConfig)
    assert [station.station for station in config.stations] == [1, 2, 3]
    key = (pi.root / "etc/tsgt/radio.key").read_text().strip()
    assert tsgt("setup", "mission", "--json").json() == {"mission": text}
    station = ("setup", "station", "--yes", "--station", 1, "--prism-type", "360", "--mission", text)
    assert tsgt(*station).code == 0
    assert (pi.root / "etc/tsgt/radio.key").read_text().strip() == key
    assert client(pi).radio.model_dump(exclude={"wiring"}) == config.radio.model_dump(exclude={"wiring"})


def test_second_run_of_the_master_keeps_the_key(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """And does not show it again."""
    tsgt(*MASTER)
    before = pi.files()
    done = tsgt("setup", "master", "--yes")
    assert done.code == 0
    assert "TSGT1" not in done.out
    assert pi.files() == before


def test_master_makes_a_new_key_on_request(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """On the same channel; the stations need the new text, which is shown."""
    tsgt(*MASTER)
    key, config = pi.root / "etc/tsgt/radio.key", pi.root / "etc/tsgt/master.toml"
    before, channel, pi.commands = key.read_text(), config.read_text(), []
    done = tsgt("setup", "master", "--yes", "--replace-key")
    assert done.code == 0, done.out
    assert key.read_text() != before
    assert config.read_text() == channel
    assert "all stations need the new text" in done.out
    assert tsgt("setup", "mission").out.strip() in done.out
    assert pi.commands == ["systemctl restart tsgt-master.service"]


def test_antenna_that_no_power_is_legal_with_is_refused(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """With settings that comply, before anything is written."""
    done = tsgt("setup", "master", "--yes", "--region", "EU433", "--stations", 3, "--antenna-gain-dbi", 9)
    assert "EU433" in failed(done)
    assert "attenuator" in failed(done)
    assert not (pi.root / "etc/tsgt/master.toml").exists()


def test_licence_lifts_the_limits_of_the_region(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """It stands in the configuration, also after the next run."""
    options = ("--region", "EU433", "--stations", 3, "--antenna-gain-dbi", 9, "--licence", "CEPT 4711")
    assert tsgt("setup", "master", "--yes", *options).code == 0
    assert tsgt("setup", "master", "--yes", "--stations", 2).code == 0
    config = load(pi.root / "etc/tsgt/master.toml", MasterConfig)
    assert (config.radio.licence, len(config.stations)) == ("CEPT 4711", 2)


def use_bridge(path: Path) -> None:
    """Change the instrument of a configuration to a program, which setup does not write."""
    before, after = path.read_text().split("[instrument]")
    bridge = '[instrument]\nkind = "bridge"\ncommand = ["true"]\n\n'
    path.write_text(before + bridge + after[after.index("[radio]") :])


def edit(path: Path, before: str, after: str) -> str:
    """Edit a configuration by hand; return the new text."""
    text = path.read_text().replace(before, after)
    assert after in text
    path.write_text(text)
    return text


def test_licence_and_power_of_another_region_are_not_kept(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """They would lift or break the law of the new country."""
    assert tsgt(*MASTER, "--licence", "RSS 4711").code == 0
    path = pi.root / "etc/tsgt/master.toml"
    edit(path, "# power_dbm = 10 ", "power_dbm = 17 ")
    again = ("setup", "master", "--yes", "--region", "EU868", "--replace-config")
    done = tsgt(*again)
    assert done.code == 0, done.out
    radio = load(path, MasterConfig).radio
    assert (radio.region, radio.licence, radio.power_dbm) == ("EU868", None, None)
    assert 'the licence "RSS 4711" is for the former channel' in done.out
    assert tsgt(*again, "--licence", "CEPT 1").code == 0
    assert load(path, MasterConfig).radio.licence == "CEPT 1"


def test_licence_of_another_mission_is_not_kept(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """A station that takes part in another mission, in another country."""
    assert tsgt(*STATION, "--licence", "RSS 4711").code == 0
    done = tsgt("setup", "station", "--yes", "--replace-key", "--mission", OTHER_MISSION)
    assert done.code == 0, done.out
    assert client(pi).radio.licence is None


def test_constant_of_a_user_defined_prism_is_kept(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """With another prism type it goes."""
    tsgt(*STATION)
    path = pi.root / "etc/tsgt/client.toml"
    edit(path, 'prism_type = "mini_360"', 'prism_type = "user"\nprism_constant_mm = 12.5')
    for given, expected in (((), ("user", 12.5)), (("--prism-type", "360"), ("360", None))):
        done = tsgt("setup", "station", "--yes", "--replace-config", *given)
        assert done.code == 0, done.out
        instrument = client(pi).instrument
        assert isinstance(instrument, LeicaInstrumentConfig)
        assert (instrument.prism_type, instrument.prism_constant_mm) == expected


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (("--station", 5), "station"),
        (("--prism", 5), "prism"),
        (("--prism-type", "360"), "prism_type"),
        (("--antenna-gain-dbi", 3), "antenna_gain_dbi"),
        (("--mission", OTHER_MISSION, "--replace-key"), "frequency_mhz"),
    ],
)
def test_option_that_an_edited_configuration_contradicts_fails(
    tsgt: Tsgt, pi: PiToSetUp, options: tuple[object, ...], what: str
) -> None:
    """It is not in force: the configuration stays, and so does the key."""
    tsgt(*STATION)
    edit(pi.root / "etc/tsgt/client.toml", "search_window_deg = 40.0", "search_window_deg = 60.0")
    before, pi.commands = pi.files(), []
    line = failed(tsgt("setup", "station", "--yes", *options))
    assert "configuration" in line
    assert what in line
    assert "--replace-config" in line
    assert (pi.files(), pi.commands) == (before, [])
    assert tsgt("setup", "station", "--yes", "--replace-config", *options).code == 0


def test_option_for_a_configuration_that_setup_does_not_write_fails(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """One with another kind of instrument, for example; without options the rest of the machine is set up."""
    tsgt(*STATION)
    use_bridge(pi.root / "etc/tsgt/client.toml")
    before = pi.files()
    line = failed(tsgt("setup", "station", "--yes", "--replace-key", "--mission", OTHER_MISSION))
    assert "--mission, --replace-key would not be in force" in line
    assert pi.files() == before
    done = tsgt("setup", "station", "--yes")
    assert "FAILED  configuration" not in done.out
    assert pi.files() == before


@pytest.mark.parametrize(
    "option",
    [
        ("--dio0-pin", 22),
        ("--nss-pin", 8),
        ("--reset-pin", 17),
        ("--spi-device", "spidev0.0"),
        ("--replace-key",),
    ],
)
def test_wiring_and_key_for_a_configuration_that_setup_does_not_write_fail(
    tsgt: Tsgt, pi: PiToSetUp, option: tuple[object, ...]
) -> None:
    """They would not be in force."""
    pi.write("etc/tsgt/client.toml", CLASSIC)
    assert f"{option[0]} would not be in force" in failed(tsgt("setup", "station", "--yes", *option))
    assert (pi.root / "etc/tsgt/client.toml").read_text() == CLASSIC


@pytest.mark.parametrize("role", [STATION, MASTER], ids=["station", "master"])
def test_configuration_without_a_key_needs_none(tsgt: Tsgt, pi: PiToSetUp, role: tuple[object, ...]) -> None:
    """The protocol of the paper has none."""
    tsgt(*role)
    (path,) = (pi.root / "etc/tsgt").glob("*.toml")
    use_classic(path)
    (pi.root / "etc/tsgt/radio.key").unlink()
    done = tsgt(*role[:2], "--yes")
    assert "ok      key            not used" in done.out
    assert done.out.splitlines()[-1].startswith("Nothing was changed")


def test_missing_key_of_a_configuration_that_stays_is_to_be_installed(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """A mission's text would not be in force there, and a master takes none."""
    tsgt(*STATION)
    use_bridge(pi.root / "etc/tsgt/client.toml")
    (pi.root / "etc/tsgt/radio.key").unlink()
    line = failed(tsgt("setup", "station", "--yes"))
    assert line.startswith("FAILED  key")
    assert "tsgt radio key" in line
    assert "--mission" not in line


def test_refused_configuration_leaves_the_key(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """Key and channel change together: with one of them the station could talk to neither mission."""
    tsgt(*STATION)
    before = pi.files()
    other = ("--mission", OTHER_MISSION, "--replace-key", "--antenna-gain-dbi", 40)
    assert "configuration" in failed(tsgt("setup", "station", "--yes", *other))
    assert pi.files() == before


def test_declined_replacement_is_no_success(
    tsgt: Tsgt, pi: PiToSetUp, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was asked for is not in force."""
    tsgt(*STATION)
    before = pi.files()
    monkeypatch.setattr(Common, "session", partialmethod(asking, Common.session))
    monkeypatch.setattr(click, "prompt", lambda _text, *, default, **_: default)
    monkeypatch.setattr(click, "confirm", lambda _text, **_: False)
    assert "stays as it was" in failed(tsgt("setup", "station", "--prism", 4))
    assert pi.files() == before


def asking(common: Common, session: Callable[[Common, Role], Session], role: Role) -> Session:
    """Begin a setup at a terminal."""
    return replace(session(common, role), ask=True)


def test_each_backup_of_an_edited_configuration_stays(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """A second replacement has a backup of its own."""
    tsgt(*STATION)
    path = pi.root / "etc/tsgt/client.toml"
    edited = []
    for window in ("60.0", "70.0"):
        edited.append(edit(path, "search_window_deg = 40.0", f"search_window_deg = {window}"))
        assert tsgt("setup", "station", "--yes", "--replace-config").code == 0
    kept = [path.with_name(f"client.toml.before-setup{suffix}").read_text() for suffix in ("", "-2")]
    assert kept == edited


def test_key_gets_its_owner_and_mode_back(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """After somebody has changed them; the daemon refuses such a key."""
    tsgt(*STATION)
    path = pi.root / "etc/tsgt/radio.key"
    path.chmod(0o644)
    done = tsgt("setup", "station", "--yes")
    assert done.code == 0, done.out
    assert path.stat().st_mode & 0o777 == 0o600


def test_key_of_another_owner_is_given_back(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """To the user of the service, also where no mission is named; not in an image that another user prepares."""
    tsgt(*STATION)
    passwd = pi.root / "etc/passwd"
    edit(passwd, f"tsgt:x:{os.getuid()}:", "tsgt:x:4711:")
    for key in (KEY, None):
        (change,) = key_step(pi.system(), key).changes
        assert isinstance(change, WriteFile)
        assert (change.owner, change.mode, change.text) == ("tsgt", 0o600, KEY.hex() + "\n")
    pi.uid = 1000
    assert not key_step(pi.system(), KEY).changes


def test_mission_may_be_typed_in_its_groups(tsgt: Tsgt, pi: PiToSetUp) -> None:
    """Of four characters, as it is shown to read out."""
    typed = " ".join(hand_over_lines(MISSION.lower()))
    done = tsgt(*STATION[:-1], f" {typed}")
    assert done.code == 0, done.out
    assert (pi.root / "etc/tsgt/radio.key").exists()


def test_folder_without_a_system_is_refused(
    tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A card that is not mounted: nothing is written there."""
    monkeypatch.setattr(options, "this_system", session.this_system)
    done = tsgt(*MASTER, "--root", tmp_path / "rootfs")
    assert "is the card mounted?" in failed(done)
    assert not (tmp_path / "rootfs").exists()
