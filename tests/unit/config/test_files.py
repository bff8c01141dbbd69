"""Problems of configuration files: one line with file, key and value."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from tsgt.config import (
    MasterConfig,
    ScenarioConfig,
    json_schema,
    load,
    load_any,
    load_prism_layout,
    load_station_calibration,
)
from tsgt.errors import ConfigError
from tsgt.service import MAX_SOCKET_PATH_BYTES

EXAMPLES = Path(__file__).parents[3] / "configs"
MASTER = (EXAMPLES / "master.example.toml").read_text()
FRAMES = (EXAMPLES / "station_frames.example.toml").read_text()

PROBLEMS = {
    "unknown key near a known one": (
        ("queue_lines", "queue_line"),
        "stream.queue_line: unknown key; did you mean queue_lines?",
    ),
    "unknown key near no other": (
        ("[recording]", "[zzz]"),
        "zzz: unknown key; known keys: kind, setup, stations, radio, protocol, pipeline, reference_point, imu, odometry, frame_watch, geofences, alarms, stream",
    ),
    "unknown key inside a table in an array": (
        ("range_sigma_ppm", "range_sigma_pm"),
        "stations[#1].noise.range_sigma_pm: unknown key; did you mean range_sigma_ppm?",
    ),
    "missing key": (("prism_constant_mm = 0.0   #", "#"), "stations[#1].prism_constant_mm: missing key"),
    "number out of range": (
        ("rate_hz = 20.0", "rate_hz = -1"),
        "pipeline.rate_hz = -1: should be greater than or equal to 0.01",
    ),
    "delay below a nanosecond": (
        ("smoothed_delays_s = [1.0]", "smoothed_delays_s = [1e-10]"),
        "pipeline.smoothed_delays_s[#1] = 1e-10: should be greater than or equal to 0.001",
    ),
    "not a number": (
        ("rate_hz = 20.0", "rate_hz = nan"),
        "pipeline.rate_hz = NaN: should be a finite number",
    ),
    "text for a number": (
        ("rate_hz = 20.0", 'rate_hz = "20"'),
        'pipeline.rate_hz = "20": should be a valid number',
    ),
    "date for a number": (
        ("rate_hz = 20.0", "rate_hz = 2026-01-01"),
        'pipeline.rate_hz = "2026-01-01": should be a valid number',
    ),
    "truth value for a number": (
        ("station = 1", "station = true"),
        "stations[#1].station = true: should be a valid integer",
    ),
    "no such choice": (
        ('estimator = "continuous"', 'estimator = "cubic"'),
        "pipeline.estimator = \"cubic\": should be 'linear' or 'continuous'",
    ),
    "two stations of one number": (
        ("station = 2", "station = 1"),
        "stations: station 1 is given more than once",
    ),
    "unknown key in a table of several kinds": (
        ("spreading_factor", "spreadin_factor"),
        "radio.spreadin_factor: unknown key; did you mean spreading_factor?",
    ),
    "key of another kind of table": (
        ('kind = "sx127x"', 'kind = "simulated"'),
        "radio.wiring: unknown key; known keys: frequency_mhz,",
    ),
    "value in a table of several kinds": (
        ("reset_pin = 17", "reset_pin = -2"),
        "radio.wiring.reset_pin = -2: should be greater than or equal to 0",
    ),
    "unknown kind of table": (
        ('kind = "sx127x"', 'kind = "sx1262"'),
        'radio.kind = "sx1262": should be one of "sx127x", "simulated"',
    ),
    "no region": (
        ('region = "CA915"', "#"),
        'radio: a radio that transmits needs its region, such as region = "EU868", or licence = "..." elsewhere',
    ),
    "no kind of table": (('kind = "sx127x"', ""), "radio.kind: missing key"),
    "missing key in a table of several kinds": (
        ("frequency_mhz = 905.0", ""),
        "radio.frequency_mhz: missing key",
    ),
    "unknown kind": (
        ('"master"', '"slave"'),
        'kind = "slave": should be one of "client", "master", "station_frames", "prism_layout", "imu_mounting", "sensor_mounting", "scenario"',
    ),
    "kind that is no text": (('"master"', "[1]"), "kind = [1]: should be one of"),
    "no kind": (('kind = "master"', ""), "kind: missing key; one of"),
    "bad TOML": (
        ("[pipeline]", "[pipeline"),
        "not TOML: Expected ']' at the end of a table declaration (at line",
    ),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_problem_is_one_line_with_file_key_and_value(name: str, tmp_path: Path) -> None:
    """For each kind of mistake."""
    (good, bad), expected = PROBLEMS[name]
    path = tmp_path / "master.toml"
    assert good in MASTER
    path.write_text(MASTER.replace(good, bad, 1))
    with pytest.raises(ConfigError) as error:
        load(path, MasterConfig)
    assert str(error.value).startswith(f"{path}: {expected}")
    assert "\n" not in str(error.value)
    assert error.value.path == path


def test_error_has_the_key_as_data(tmp_path: Path) -> None:
    """Programs find the key in the error."""
    path = tmp_path / "master.toml"
    path.write_text(MASTER.replace("outage_limit_s = 1.0", "outage_limit_s = 0"))
    with pytest.raises(ConfigError) as error:
        load(path, MasterConfig)
    assert error.value.key == "pipeline.outage_limit_s"


def test_endless_file(tmp_path: Path) -> None:
    """Neither a device nor a large file in place of a configuration is read to its end, and a pipe does not block."""
    os.mkfifo(tmp_path / "pipe")
    for path in (Path("/dev/zero"), tmp_path / "pipe"):
        with pytest.raises(
            ConfigError, match=f"{path}: is a device or pipe, not a file; name a configuration"
        ):
            load(path, MasterConfig)
    large = tmp_path / "large"
    with large.open("wb") as file:
        file.truncate(10_000_000_000)
    with pytest.raises(ConfigError, match="large: larger than 4 MB; name a configuration"):
        load(large, MasterConfig)


def test_missing_file(tmp_path: Path) -> None:
    """The error names the file."""
    with pytest.raises(ConfigError, match=r"nowhere\.toml: no such file"):
        load(tmp_path / "nowhere.toml", MasterConfig)


def test_folder_instead_of_a_file(tmp_path: Path) -> None:
    """A folder is a configuration error."""
    with pytest.raises(ConfigError, match="Is a directory"):
        load_any(tmp_path)


def test_binary_file(tmp_path: Path) -> None:
    """A file that is not text is a configuration error."""
    path = tmp_path / "master.toml"
    path.write_bytes(b"kind = \xff")
    with pytest.raises(ConfigError, match=r"not UTF-8 text \(byte 7\)"):
        load(path, MasterConfig)


@pytest.mark.parametrize(
    "text",
    [
        "x = " + 5000 * "[",
        "x = " + 5000 * "9",
        "x = " + 5000 * "{a=",
        "x = 0x" + 5000 * "f",
        "kind = 0x" + 5000 * "f",
        "kind" + 3000 * ".a" + " = 1",
        'kind = "client"\nx' + 300 * ".a" + " = 1",
    ],
    ids=range(7),
)
def test_deep_nesting_and_huge_numbers(text: str, tmp_path: Path) -> None:
    """They are configuration errors."""
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"a\.toml: (not TOML|cannot be read): ") as error:
        load_any(path)
    assert len(str(error.value)) < len(str(path)) + 200


def test_byte_order_mark(tmp_path: Path) -> None:
    """Editors of Windows write one."""
    path = tmp_path / "a.toml"
    path.write_text('\ufeffkind = "nothing"', encoding="utf-8")
    with pytest.raises(ConfigError, match="kind"):
        load_any(path)


def test_file_of_another_kind(tmp_path: Path) -> None:
    """The error names the expected kind."""
    path = tmp_path / "scenario.toml"
    path.write_text('kind = "prism_layout"\n[prisms]\n')
    with pytest.raises(ConfigError, match='kind = "prism_layout", but kind "scenario" is expected'):
        load(path, ScenarioConfig)


def test_long_value_is_shortened(tmp_path: Path) -> None:
    """The line stays readable."""
    path = tmp_path / "master.toml"
    path.write_text(MASTER.replace("rate_hz = 20.0", f"rate_hz = {list(range(100))}"))
    with pytest.raises(ConfigError) as error:
        load(path, MasterConfig)
    assert len(str(error.value)) < 200


@pytest.mark.parametrize("key", ["x" * 3000, "a\\nb\\u001b[2J"], ids=["long", "of two lines"])
def test_unprintable_key_is_escaped(key: str, tmp_path: Path) -> None:
    """A long key is shortened."""
    path = tmp_path / "c.toml"
    path.write_text(f'kind = "prism_layout"\n"{key}" = 1\n')
    with pytest.raises(ConfigError) as caught:
        load_any(path)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < len(str(path)) + 200
    assert "unknown key" in message


@pytest.mark.parametrize("key", ["socket", "directory"])
def test_path_with_a_zero_byte_is_rejected(key: str, tmp_path: Path) -> None:
    """Opening it would raise ValueError."""
    path = tmp_path / "master.toml"
    path.write_text(re.sub(rf"(?m)^{key} = .*$", rf'{key} = "a\\u0000b"', MASTER))
    with pytest.raises(ConfigError, match=rf"{key}: a path cannot contain a zero byte$"):
        load(path, MasterConfig)


@pytest.mark.parametrize(
    ("name", "old", "new", "key"),
    [
        ("client", "spi_bus = 0", 'spi_bus = 0\ngpio_chip = "a\\u0000b"', "radio.wiring.gpio_chip"),
        ("master", "[recording]", '[imu]\ncommand = ["a\\u0000b"]\n\n[recording]', "imu.command[#1]"),
        (
            "master",
            "[recording]",
            '[alarms]\nsite = "a"\ncommand = ["a", "a\\u0000b"]\n\n[recording]',
            "alarms.command[#2]",
        ),
    ],
)
def test_name_with_a_zero_byte_is_rejected(name: str, old: str, new: str, key: str, tmp_path: Path) -> None:
    """The kernel takes none."""
    path = tmp_path / f"{name}.toml"
    text = (EXAMPLES / f"{name}.example.toml").read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError, match=rf"{re.escape(key)}: it cannot contain a zero byte"):
        load_any(path)


@pytest.mark.parametrize("kind", ["master", "client"])
def test_path_of_a_socket_is_limited(kind: str, tmp_path: Path) -> None:
    """To what the kernel takes, counted in bytes."""
    path = tmp_path / f"{kind}.toml"
    text = (EXAMPLES / f"{kind}.example.toml").read_text()
    default = "/run/tsgt/poses.sock" if kind == "master" else "/run/tsgt/client.sock"
    assert default in text
    longest = "/run/" + (MAX_SOCKET_PATH_BYTES - 5) * "x"
    path.write_text(text.replace(default, longest))
    load_any(path)
    path.write_text(text.replace(default, longest[:-1] + "é"))
    with pytest.raises(
        ConfigError, match=r"socket: the path of a UNIX socket has at most 107 bytes, not 108: /run/x+é$"
    ):
        load_any(path)


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    """An absolute path is unchanged."""
    path = tmp_path / "master.toml"
    path.write_text(MASTER)
    config = load(path, MasterConfig)
    assert config.setup.prism_layout == tmp_path / "prism_layout.example.toml"
    assert config.stream.socket == Path("/run/tsgt/poses.sock")


FRAME_PROBLEMS = {
    "scaled": (("0.9063077870366499, -0.42", "0.9163077870366499, -0.42"), "not a rotation: error"),
    "mirrored": (("[0.0, 0.0, 1.0, 0.1]", "[0.0, 0.0, -1.0, 0.1]"), "reflection"),
    "last row": (("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 0.0, 2.0]"), r"the last row of a rigid transform"),
    "short row": (
        ("[0.0, 0.0, 1.0, 0.1]", "[0.0, 0.0, 1.0]"),
        r"stations\.2\.T_station1_station\[#3\]\[#4\]: missing key",
    ),
    "number with leading zero": (("[stations.2]", "[stations.02]"), "should match pattern"),
    "number zero": (("[stations.2]", "[stations.0]"), "should match pattern"),
    "mistyped key": (("T_station1_station", "T_station_station1"), "did you mean T_station1_station"),
}


@pytest.mark.parametrize("name", FRAME_PROBLEMS)
def test_frame_that_is_not_rigid_is_rejected(name: str, tmp_path: Path) -> None:
    """The error names the station."""
    (good, bad), expected = FRAME_PROBLEMS[name]
    path = tmp_path / "frames.toml"
    path.write_text(FRAMES.replace(good, bad, 1))
    with pytest.raises(ConfigError, match=expected) as error:
        load_station_calibration(path)
    assert "stations." in str(error.value)


def test_frame_with_seven_digits_is_accepted(tmp_path: Path) -> None:
    """Rounding as in a report is tolerated."""
    path = tmp_path / "frames.toml"
    path.write_text(
        FRAMES.replace("0.9063077870366499", "0.9063078").replace("0.42261826174069944", "0.4226183")
    )
    assert load_station_calibration(path).stations[2].T_station1_station[0] == (
        0.9063078,
        -0.4226183,
        0.0,
        2.0,
    )


def test_layout_with_sigmas_is_accepted(tmp_path: Path) -> None:
    """Integers are valid numbers."""
    path = tmp_path / "layout.toml"
    path.write_text(
        'kind = "prism_layout"\n[prisms.7]\nposition_m = [1, 2.5, 0]\nsigma_m = [0.001, 0.001, 0.002]\n'
    )
    assert load_prism_layout(path).positions_m == {7: (1.0, 2.5, 0.0)}


SCENARIO_PROBLEMS = {
    "[motion]\ninterval_min_s = 9.0": "motion: interval_min_s is above interval_max_s",
    "[motion]\nspeed_weights = [1.0]": "motion: 4 speeds_mps, but 1 speed_weights",
    "[motion]\nspeed_weights = [0.0, 0.0, 0.0, 0.0]": "motion: all speed_weights are 0",
    "[motion]\nroute_m = [[0.0, 0.0, 0.0]]": "motion: route_m has one way point; a route has at least two",
    "[[occlusions]]\nrate_per_min = 1.0\nduration_min_s = 2.0\nduration_max_s = 1.0": (
        "occlusions[#1]: duration_min_s is above duration_max_s"
    ),
    "[[stations]]\nstation = 1\nprism = 9\nposition_m = [0.0, 0.0, 0.0]": "tracks prism 9, which has no position",
}


@pytest.mark.parametrize("text", SCENARIO_PROBLEMS)
def test_inconsistent_scenario_is_rejected(text: str, tmp_path: Path) -> None:
    """The error names the key."""
    path = tmp_path / "scenario.toml"
    path.write_text(f'kind = "scenario"\n{text}\n')
    with pytest.raises(ConfigError) as error:
        load(path, ScenarioConfig)
    assert SCENARIO_PROBLEMS[text] in str(error.value)


def test_every_key_is_described() -> None:
    """The schema describes each key of each kind of file."""
    for name, model in json_schema()["$defs"].items():
        for key, entry in model["properties"].items():
            # A table is described where it is defined.
            assert "description" in entry or "$ref" in entry, f"{name}.{key}"


def test_schema_of_one_kind_omits_the_others() -> None:
    """The schema of one kind does not mention the others."""
    assert "ScenarioConfig" not in json.dumps(json_schema("prism_layout"))
