"""Configurations as ``tsgt setup`` writes them: the answers, and comments that say what else can be set. Sans-I/O."""

from __future__ import annotations

import hashlib
import json
import re
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from tsgt.setup.answers import MasterAnswers, RadioAnswers, StationAnswers

_MARK: Final = "# Checksum of what setup wrote: "


def client_text(answers: StationAnswers) -> str:
    """Return the configuration of a station."""
    constant_mm = answers.prism_constant_mm
    constant = "" if constant_mm is None else f"prism_constant_mm = {constant_mm!r}\n"
    return _sealed(f"""\
# The client of one total station, as `tsgt setup station` wrote it. All keys: docs/reference/configuration.md.
# Edit it freely, and check it with `sudo -u tsgt tsgt config check /etc/tsgt/client.toml`. Setup never replaces an edited
# file unless asked to.
{_MARK}

kind = "client"
station = {answers.station}                     # as in the master's configuration
prism = {answers.prism}                       # tracked after the start; the master can select another one
status_socket = "/run/tsgt/client.sock"   # for `tsgt status`

[instrument]
kind = "leica"                  # a Leica total station that speaks GeoCOM; "bridge" for a program of yours
port = {_quoted(answers.port)}
baud = {answers.baud}                   # as set in the instrument; other rates are tried if it does not respond
checksum = {_boolean(answers.checksum)}
# Reflector on the robot: round, mini, tape, 360, mini_360, mini_zero, grz121, mpr122, or user for any other, which needs
# prism_constant_mm as well. The instrument adds its constant, so the master's prism_constant_mm is 0.
prism_type = {_quoted(answers.prism_type)}
{constant}search_window_deg = 40.0        # width of the search window for a lost prism; 360: all around
search_height_deg = 15.0
target = "foil"                 # type of targets of `tsgt calibrate collect`: foil or prism

# [instrument.atmosphere]       # without this table the instrument keeps its setting
# temperature_c = 20.0          # in the shade; `tsgt atmosphere 24.5 978` changes it while the client runs
# pressure_hpa = 1013.25        # at the instrument

{_radio_text(answers.radio)}
[protocol]
kind = "superframe"
key_file = "radio.key"          # the key of the mission

[journal]
directory = "/var/lib/tsgt"     # every measurement is written here before it is transmitted
fsync_interval_s = 1.0          # maximum loss after a power cut
""")


def master_text(answers: MasterAnswers) -> str:
    """Return the configuration of a master."""
    stations = "".join(
        f"\n[[stations]]\nstation = {number}\nprism = {number}\nprism_constant_mm = 0.0   # what the instrument does not add itself: 0 for a Leica\n"
        for number in range(1, answers.stations + 1)
    )
    return _sealed(f"""\
# The master on the robot, as `tsgt setup master` wrote it. All keys: docs/reference/configuration.md.
# Edit it freely, and check it with `sudo -u tsgt tsgt config check /etc/tsgt/master.toml`. Setup never replaces an edited
# file unless asked to.
{_MARK}

kind = "master"

[setup]                         # written by the calibration of the day, into the folder of this file
station_frames = "station_frames.toml"    # by `tsgt calibrate targets`
prism_layout = "prism_layout.toml"        # by `tsgt calibrate prisms`

{_radio_text(answers.radio)}
[protocol]
kind = "superframe"
key_file = "radio.key"          # the key of the mission; `sudo tsgt setup mission` shows it for further stations

[pipeline]
estimator = "continuous"        # one smooth trajectory; "linear" interpolates linearly, as in the paper
rate_hz = 20.0                  # poses per second

[reference_point]               # frame on the robot whose pose is streamed
name = "robot"
position_m = [0.0, 0.0, 0.0]
orientation_xyzw = [0.0, 0.0, 0.0, 1.0]

[stream]
socket = "/run/tsgt/poses.sock"

[recording]
directory = "/var/lib/tsgt"
fsync_interval_s = 1.0          # maximum loss after a power cut
{stations}""")


def sealed_by_setup(text: str) -> bool:
    """Whether a configuration is as setup wrote it."""
    found = re.search(rf"^{re.escape(_MARK)}(\w+)$", text, re.MULTILINE)
    return found is not None and _check_sum(text) == found[1]


def _sealed(text: str) -> str:
    return text.replace(f"{_MARK}\n", f"{_MARK}{_check_sum(text)}\n")


def content_lines(text: str) -> list[str]:
    """Return the lines of a configuration but for the checksum."""
    return [line for line in text.splitlines() if not line.startswith(_MARK)]


def _check_sum(text: str) -> str:
    return hashlib.sha256("\n".join(content_lines(text)).encode()).hexdigest()[:16]


def _radio_text(radio: RadioAnswers) -> str:
    wiring = radio.wiring
    region = f"region = {_quoted(radio.region)}\n" if radio.region else ""
    power = (
        f"power_dbm = {radio.power_dbm}\n"
        if radio.power_dbm is not None
        else "# power_dbm = 10              # default: the most that the region allows with this antenna, at most 17\n"
    )
    licence = (
        f"licence = {_quoted(radio.licence)}\n"
        if radio.licence is not None
        else '# licence = "..."             # number or text of a radio licence: lifts the limits of the region\n'
    )
    chip = f"gpio_chip = {_quoted(wiring.gpio_chip)}\n" if wiring.gpio_chip else ""
    return f"""\
[radio]                         # all radios of a mission need the same settings, except for the power
kind = "sx127x"
frequency_mhz = {radio.frequency_mhz!r}
spreading_factor = {radio.spreading_factor}
bandwidth_khz = {radio.bandwidth_khz!r}
coding_rate = {radio.coding_rate}
preamble_symbols = {radio.preamble_symbols}
sync_word = 0x{radio.sync_word:02x}
{region}antenna_gain_dbi = {radio.antenna_gain_dbi!r}         # of this antenna, less the loss of its cable; 2.15: a dipole
{power}{licence}
[radio.wiring]                  # BCM numbers, found by asking the chip
backend = {_quoted(wiring.backend)}
spi_bus = {wiring.spi_bus}
spi_device = {wiring.spi_device}
spi_hz = {wiring.spi_hz}
reset_pin = {wiring.reset_pin}
dio0_pin = {wiring.dio0_pin}
nss_pin = {wiring.nss_pin}                    # chip select; -1: the SPI driver of the kernel
{chip}"""


def _quoted(text: str) -> str:
    return json.dumps(text)


def _boolean(value: bool) -> str:  # noqa: FBT001 (a value of the file)
    return "true" if value else "false"
