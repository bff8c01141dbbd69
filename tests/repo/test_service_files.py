"""The unit files and udev rules: what systemd makes of them, and whether they fit the program."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from tsgt.config import ClientConfig, JournalConfig, RecordingConfig, StreamConfig

ROOT = Path(__file__).parents[2]
SERVICES = sorted((ROOT / "configs" / "systemd").glob("*.service"))
WEB = ROOT / "configs" / "systemd" / "tsgt-web.service"
RELAY = ROOT / "configs" / "systemd" / "tsgt-relay.service"
UNITS = [unit for unit in SERVICES if unit not in (WEB, RELAY)]
"""Those of the daemons."""
DROP_IN = ROOT / "configs" / "systemd" / "real-time.conf"
RULES = ROOT / "configs" / "udev" / "60-tsgt.rules"

LARGEST_EXPOSURE = 1.0
"""Of 10, where 0 is best."""

LARGEST_EXPOSURE_ON_NETWORK = 1.2
"""Of the page and the relay, which listen on the network."""

SYSTEMD_ANALYZE = shutil.which("systemd-analyze") or ""
needs_systemd = pytest.mark.skipif(not SYSTEMD_ANALYZE, reason="systemd-analyze is not installed")
each_service = pytest.mark.parametrize("unit", SERVICES, ids=lambda path: path.stem)
each_unit = pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.stem)


class Lines(configparser.RawConfigParser):
    """Unit files with keys as they are; of a key given twice the last one is seen."""

    def __init__(self, path: Path) -> None:
        super().__init__(strict=False)
        self.read(path)

    def optionxform(self, optionstr: str) -> str:
        """Keep upper and lower case."""
        return optionstr


@pytest.fixture
def runnable(unit: Path, tmp_path: Path) -> Path:
    """Return a copy of the unit whose program exists here; systemd checks that it does."""
    copy = tmp_path / unit.name
    copy.write_text(re.sub(r"^ExecStart=\S+", "ExecStart=/bin/true", unit.read_text(), flags=re.MULTILINE))
    return copy


def test_there_is_a_unit_for_each_daemon() -> None:
    """Every script that is a daemon has its unit, which starts it from the folder that the guide installs to."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    daemons = sorted(name for name in scripts if name.startswith("tsgt-"))
    assert [unit.stem for unit in UNITS] == daemons
    for unit in UNITS:
        kind = unit.stem.removeprefix("tsgt-")
        started = Lines(unit)["Service"]["ExecStart"]
        assert started == f"/opt/tsgt/bin/{unit.stem} --config /etc/tsgt/{kind}.toml"


@needs_systemd
@each_service
def test_systemd_finds_nothing_wrong(unit: Path, runnable: Path) -> None:
    """`systemd-analyze verify` accepts the unit without a word."""
    assert unit.name == runnable.name
    done = subprocess.run(
        [SYSTEMD_ANALYZE, "verify", "--man=no", str(runnable)], capture_output=True, text=True, check=False
    )
    # Other units of this machine may have faults of their own.
    own = [line for line in done.stderr.splitlines() if unit.name in line]
    assert (done.returncode, own) == (0, [])


@needs_systemd
@each_unit
def test_systemd_takes_the_real_time_priority(unit: Path, runnable: Path) -> None:
    """The drop-in fits both units: systemd reads it without a word, and with another policy it would complain."""
    folder = runnable.with_name(f"{unit.name}.d")
    folder.mkdir()
    said = []
    for text in (DROP_IN.read_text(), DROP_IN.read_text().replace("fifo", "first")):
        (folder / DROP_IN.name).write_text(text)
        done = subprocess.run(
            [SYSTEMD_ANALYZE, "verify", "--man=no", str(runnable)],
            capture_output=True,
            text=True,
            check=False,
        )
        said.append([line for line in done.stderr.splitlines() if unit.name in line])
    assert said[0] == []
    assert "first" in said[1][0]


def test_real_time_priority_is_below_that_of_interrupts() -> None:
    """The kernel's interrupt threads, which have 50, must not wait for a daemon that waits for them."""
    service = Lines(DROP_IN)["Service"]
    assert service["CPUSchedulingPolicy"] == "fifo"
    assert 0 < int(service["CPUSchedulingPriority"]) < 50


@needs_systemd
@each_service
def test_exposure_is_small(unit: Path, runnable: Path) -> None:
    """`systemd-analyze security` rates the unit as safe."""
    assert unit.name == runnable.name
    done = subprocess.run(
        [SYSTEMD_ANALYZE, "security", "--offline=true", "--no-pager", str(runnable)],
        capture_output=True,
        text=True,
        check=False,
    )
    if "unrecognized option" in done.stderr or "Unknown" in done.stderr:
        pytest.skip("this systemd-analyze cannot judge a file")
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert found is not None, done.stderr
    assert float(found.group(1)) <= (LARGEST_EXPOSURE if unit in UNITS else LARGEST_EXPOSURE_ON_NETWORK)


@each_service
def test_restarts_for_ever_and_is_watched(unit: Path) -> None:
    """Whatever happens, the service comes back; and one that hangs is ended."""
    lines = Lines(unit)
    assert lines["Unit"]["StartLimitIntervalSec"] == "0"
    service = lines["Service"]
    assert (service["Type"], service["Restart"]) == ("notify", "always")
    assert 0 < int(service["WatchdogSec"]) <= 60
    assert 0 < int(service["RestartSec"]) <= 5


@each_unit
def test_folders_are_those_of_the_configuration(unit: Path) -> None:
    """The defaults of the configuration lie in the folders that systemd makes for the service."""
    service = Lines(unit)["Service"]
    assert (
        JournalConfig().directory
        == RecordingConfig().directory
        == Path("/var/lib") / service["StateDirectory"]
    )
    run = Path("/run") / service["RuntimeDirectory"]
    assert {StreamConfig().socket.parent, ClientConfig.model_fields["status_socket"].default.parent} == {run}
    assert service["RuntimeDirectoryPreserve"] == "yes"


@each_unit
def test_folders_are_for_the_group_only(unit: Path) -> None:
    """Whoever may open the folder of the sockets could lock it, and keep a daemon from starting."""
    service = Lines(unit)["Service"]
    assert service["StateDirectoryMode"] == service["RuntimeDirectoryMode"] == "0750"


@pytest.mark.parametrize("unit", [WEB, RELAY], ids=lambda path: path.stem)
def test_page_and_relay_cannot_harm_the_daemons(unit: Path) -> None:
    """Another user, no address but loopback, nothing writable, and the last in line for processor and memory."""
    service = Lines(unit)["Service"]
    assert service["ExecStart"].startswith(f"/opt/tsgt/bin/tsgt {unit.stem.removeprefix('tsgt-')}")
    assert service.get("DynamicUser") == "yes" or service.get("User") == "tsgt-relay"
    assert (service["IPAddressDeny"], service["IPAddressAllow"]) == ("any", "localhost")
    assert not {"StateDirectory", "RuntimeDirectory", "ReadWritePaths"} & set(service)
    assert int(service["Nice"]) > 0
    assert int(service["OOMScoreAdjust"]) > 0


def test_units_differ_only_in_names() -> None:
    """What is shut away from one daemon is shut away from the other; only the master has files to read again."""
    bodies = {
        unit.stem: [
            line
            for line in unit.read_text().splitlines()
            if line and not line.startswith(("#", "Desc", "ExecReload"))
        ]
        for unit in UNITS
    }
    plain = [
        [line.replace(name.removeprefix("tsgt-"), "KIND") for line in body] for name, body in bodies.items()
    ]
    assert plain[0] == plain[1]


def test_the_guide_names_the_files_that_exist() -> None:
    """What the installation guide tells to copy is there."""
    guide = (ROOT / "docs" / "how-to" / "install-for-the-field.md").read_text()
    for kind in ("client", "master"):
        for name in re.findall(r"configs/[^\s`]+", guide):
            assert (ROOT / name.replace("KIND", kind)).exists(), name


def test_udev_rules_are_well_formed() -> None:
    """Each rule is a list of keys, operators and quoted values, and changes something."""
    pair = r'[A-Z]+(?:\{\w+\})?(?:==|!=|\+=|:=|=)"[^"]*"'
    rules = [line for line in RULES.read_text().splitlines() if line and not line.startswith("#")]
    assert rules
    for rule in rules:
        assert re.fullmatch(rf"{pair}(?:, {pair})*", rule), rule
        assert re.search(r'[A-Z}]="', rule), rule


def test_udev_accepts_the_rules() -> None:
    """`udevadm verify` finds nothing wrong, where it is new enough to know that command."""
    udevadm = shutil.which("udevadm")
    if udevadm is None:
        pytest.skip("udevadm is not installed")
    if subprocess.run([udevadm, "verify", "--help"], capture_output=True, check=False).returncode:
        pytest.skip("this udevadm cannot verify")
    done = subprocess.run([udevadm, "verify", str(RULES)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
