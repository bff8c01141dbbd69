"""``tsgt calibrate collect`` and ``check`` over the simulated channel: both protocols, and the authors' nodes."""

from __future__ import annotations

import asyncio
import hashlib
import json
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, NoReturn

import numpy as np
import pytest
from harness.drives.scene import FRAMES
from harness.hardware.radios import PAPER
from harness.missions.field import TRUE, SceneInstrument, Station, field_of
from harness.radio.client import client_config

from tsgt.analysis.calibration import TargetCollection, check_station, same_face_points
from tsgt.analysis.formats import read_partial_target_file, read_target_file
from tsgt.cli.calibrate.check import measure_again, print_check
from tsgt.cli.calibrate.collect import collect_targets
from tsgt.cli.calibrate.session import TargetSession, target_session
from tsgt.config import JournalConfig, SuperframeConfig, SuperframeMasterConfig
from tsgt.errors import InputFileError, RadioError, TsgtError
from tsgt.geometry import cartesian_to_polar, invert, transform_points
from tsgt.model import Status
from tsgt.simulation.lora import radio_opener
from tsgt.station import ClientDependencies, run_client

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path

    from harness.files.cli import Tsgt
    from harness.missions.field import Field

    from tsgt.radio import RadioOpener
    from tsgt.station import Reading

KEY = hashlib.sha256(b"a key").digest()
TARGETS = np.array([[20.0, 3.0, 0.5], [5.0, 18.0, -0.5], [-14.0, 9.0, 1.0], [-8.0, -16.0, 0.2]])
STATIONS = (1, 2, 3)


class AimedInstrument(SceneInstrument):
    """An instrument that measures the target it is aimed at without error.

    Attributes
    ----------
    target
        Which, from 1.
    T
        Where its tripod stands.
    face
        In which it measures.
    """

    target = 1
    T = np.eye(4)
    face = 1

    async def measure(self) -> Reading:
        """Measure the target in five seconds."""
        reading = await super().measure()
        await asyncio.sleep(3.0)
        h, z, d = cartesian_to_polar(transform_points(invert(self.T), TARGETS[self.target - 1]))
        if self.face == 2:
            h, z = (h + np.pi) % (2 * np.pi), 2 * np.pi - z
        return replace(
            reading,
            prism=None,
            horizontal_angle_rad=float(h),
            zenith_angle_rad=float(z),
            slope_distance_m=float(d) if self.status.usable else None,
        )


class Script:
    """An operator who aims as asked, gives the replies of a list, then presses Enter."""

    def __init__(self, instruments: dict[int, AimedInstrument], *answers: str | None) -> None:
        self.instruments = instruments
        self.answers = list(answers)
        self.questions: list[str] = []
        self.said: list[str] = []

    async def ask(self, question: str) -> str | None:
        """Aim and reply."""
        self.questions.append(question)
        words = question.replace(",", " ").replace(":", " ").split()
        if words[0] == "station":
            self.instruments[int(words[1])].target = int(words[3])
        return self.answers.pop(0) if self.answers else ""

    def say(self, text: str) -> None:
        """Store the text."""
        self.said.append(text)


Speaks = Literal["classic", "authors", "superframe"]
"""Our client in either protocol, or a node of the authors."""

BOTH: tuple[Speaks, ...] = ("classic", "superframe")


class SuperframeClient(Station):
    """A station with the client's daemon."""

    folder: Path

    async def _run(self) -> None:
        config = client_config(self.folder, station=self.number, prism=self.number)
        config = config.model_copy(
            update={
                "protocol": SuperframeConfig(kind="superframe"),
                "journal": JournalConfig(directory=self.folder / f"journals{self.number}"),
                "status_socket": self.folder / f"client{self.number}.sock",
            }
        )
        rng = np.random.default_rng((self.number, self._starts))
        await run_client(
            config,
            PAPER,
            ClientDependencies(
                instrument=self.instrument,
                open_radio=radio_opener(self.air, f"station-{self.number}", self.clock, rng, PAPER),
                clock=self.clock,
                key=KEY,
                random_bits=lambda bits: int(rng.integers(1 << bits)),
                boot="one",
            ),
        )


@asynccontextmanager
async def aimed(
    folder: Path, speaks: Speaks = "classic"
) -> AsyncGenerator[tuple[Field, dict[int, AimedInstrument]]]:
    """Stations with instruments that can be aimed."""
    async with field_of(folder, authors=speaks == "authors") as field:
        instruments = {}
        for number, station in field.stations.items():
            await station.kill()
            instruments[number] = AimedInstrument(field.scene, number, station.clock)
            instruments[number].T = FRAMES[number - 1]
            if speaks == "superframe":
                client = SuperframeClient(number, field.air, field.scene, authors=False, clock=station.clock)
                client.folder = folder
                field.stations[number] = client
            field.stations[number].instrument = instruments[number]
            field.stations[number].start()
        await asyncio.sleep(1.0)
        yield field, instruments


@asynccontextmanager
async def session(
    field: Field, script: Script, open_radio: RadioOpener | None = None
) -> AsyncGenerator[TargetSession]:
    """Open the master's radio for targets."""
    config = field.config()
    if isinstance(field.stations[1], SuperframeClient):
        key_file = field.folder / "mission.key"
        key_file.write_text(KEY.hex() + "\n")
        key_file.chmod(0o600)
        protocol = SuperframeMasterConfig(kind="superframe", key_file=key_file)
        config = config.model_copy(update={"protocol": protocol})
    async with target_session(
        config, field.folder / "master.toml", TRUE, script.say, open_radio or field.open_radio()
    ) as opened:
        yield opened


async def collected(
    field: Field, script: Script, path: Path, *, targets: int = 4, repeats: int = 1
) -> TargetCollection:
    """Collect as the command does."""
    collection = TargetCollection(path, STATIONS, range(1, targets + 1), repeats=repeats)
    collection.resume()
    async with session(field, script) as stations:
        await collect_targets(collection, stations, script, constant_m=0.01)
    return collection


@pytest.mark.slow
@pytest.mark.parametrize("speaks", ["classic", "authors", "superframe"])
async def test_collected_targets_solve_the_frames(tmp_path: Path, speaks: Speaks) -> None:
    """All stations measure all targets, the file solves to the true frames, and all stations track again."""
    path = tmp_path / "targets.csv"
    async with aimed(tmp_path, speaks) as (field, instruments):
        script = Script(instruments)
        collection = await collected(field, script, path)
        assert not [tool for tool in instruments.values() if tool.direct_mode]
    asked = [question.split(":")[0] for question in script.questions[:-1]]
    assert asked == [f"station {s}, target {t}" for s in STATIONS for t in (1, 2, 3, 4)]
    assert script.questions[-1].startswith("all targets are measured or skipped")
    file = read_target_file(path)
    assert {s: list(seen) for s, seen in file.measurements.items()} == {s: [1, 2, 3, 4] for s in STATIONS}
    assert file.measurements[2][1][0].constant_m == 0.01
    # The constant is part of the file; the instruments here need none, so distances are 10 mm long.
    for station in (2, 3):
        solved = collection.solution(station)
        assert not isinstance(solved, str)
        assert np.linalg.norm(solved.frames[station].T[:3, 3] - FRAMES[station - 1][:3, 3]) < 0.01


@pytest.mark.parametrize("speaks", BOTH)
async def test_failed_measurement_is_reported_and_requested_again(tmp_path: Path, speaks: Speaks) -> None:
    """The report has the instrument's status and what to do about it."""
    async with aimed(tmp_path, speaks) as (field, instruments):
        instruments[1].status = Status.TILT
        script = Script(instruments, "", "q")
        collection = await collected(field, script, tmp_path / "targets.csv")
    assert "failed: station 1: the instrument is not level" in "\n".join(script.said)
    assert [question[:19] for question in script.questions] == ["station 1, target 1"] * 2
    assert collection.count(1, 1) == 0


@pytest.mark.slow
@pytest.mark.parametrize("speaks", BOTH)
async def test_station_without_response_is_named(tmp_path: Path, speaks: Speaks) -> None:
    """The session continues; at the end the station is reported as possibly not tracking."""
    async with aimed(tmp_path, speaks) as (field, instruments):
        await field.stations[1].kill()
        script = Script(instruments, "", "q")
        await collected(field, script, tmp_path / "targets.csv")
    assert "failed: station 1 does not respond; check that its client runs" in script.said[1]
    assert script.said[-1].startswith("note: station 1 has not returned to tracking: it does not respond")


@pytest.mark.parametrize("speaks", BOTH)
async def test_restarted_station_measures_the_target(tmp_path: Path, speaks: Speaks) -> None:
    """A client tracks its prism after a restart; the response must not be the prism."""
    async with aimed(tmp_path, speaks) as (field, instruments):
        script = Script(instruments)
        collection = TargetCollection(tmp_path / "targets.csv", [1], [1, 2])
        async with session(field, script) as stations:
            first = await stations.measure(1, constant_m=0.0)
            await field.stations[1].kill()
            field.stations[1].start()
            await asyncio.sleep(2.0)
            second = await stations.measure(1, constant_m=0.0)
    assert second.slope_distance_m == pytest.approx(first.slope_distance_m)
    assert collection.count(1, 1) == 0


async def test_measurements_are_not_acknowledged(tmp_path: Path) -> None:
    """Superframe stations keep their measurements for a master that records them."""
    async with aimed(tmp_path, "superframe") as (field, instruments):
        script = Script(instruments)
        async with session(field, script) as stations:
            await asyncio.sleep(8.0)
            await stations.measure(1, constant_m=0.0)
        reader, writer = await asyncio.open_unix_connection(tmp_path / "client2.sock")
        status = json.loads(await reader.read())
        writer.close()
    assert status["joined"]
    assert status["queued"] == status["measurements"] > 20


class BrokenRadio:
    """A radio whose chip does not respond any more."""

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> NoReturn:
        """Fail."""
        raise RadioError(f"no answer to {len(payload)} bytes for {at_ns}")


@pytest.mark.parametrize("speaks", BOTH)
async def test_radio_failure_ends_the_session_at_once(tmp_path: Path, speaks: Speaks) -> None:
    """The stations that may not be tracking are named."""

    @asynccontextmanager
    async def open_radio() -> AsyncGenerator[Any]:
        yield BrokenRadio()

    async with aimed(tmp_path, speaks) as (field, instruments):
        script, began_s = Script(instruments), asyncio.get_running_loop().time()
        with pytest.raises(RadioError, match="no answer"):
            async with session(field, script, open_radio) as stations:
                await stations.measure(1, constant_m=0.0)
        assert asyncio.get_running_loop().time() - began_s < 1.0
    assert script.said[-1].startswith(
        "note: station 1 has not returned to tracking: the radio failed (no answer"
    )


async def test_keys_skip_repeat_and_reject(tmp_path: Path) -> None:
    """Skipped targets are asked for by the next run, any target can be repeated, unknown keys are rejected."""
    async with aimed(tmp_path) as (field, instruments):
        script = Script(instruments, "r", "", "s", "", "r", "", "x", "r 1 1", "", "r 9", "q")
        collection = await collected(field, script, tmp_path / "targets.csv")
    numbers = [question.split(":")[0] for question in script.questions]
    assert numbers == [f"station 1, target {t}" for t in (1, 1, 2, 3, 4, 3, 4, 4, 1, 4, 4)]
    assert [collection.count(1, t) for t in (1, 2, 3, 4)] == [1, 0, 1, 0]
    assert script.said[0] == "which one? Type r, station and target, for example r 2 5"
    assert "unknown key 'x'" in script.said
    assert "station 1 has not measured target 9 yet" in script.said


async def test_skipped_target_that_is_repeated_is_asked_for(tmp_path: Path) -> None:
    """The next measurement is of the target that the operator was told to aim at."""
    async with aimed(tmp_path) as (field, instruments):
        script = Script(instruments, "", "s", "r 1 1", "", "q")
        collection = await collected(field, script, tmp_path / "targets.csv", repeats=2)
    assert [question.split(":")[0] for question in script.questions][3] == "station 1, target 1"
    assert [collection.count(1, t) for t in (1, 2)] == [1, 0]


@pytest.mark.parametrize("speaks", BOTH)
@pytest.mark.parametrize("stop", ["q", None, "cancel"])
@pytest.mark.slow
async def test_collection_continues_where_it_stopped(
    tmp_path: Path, stop: str | None, speaks: Speaks
) -> None:
    """After q, the end of the input and Ctrl-C the file holds all measurements and the stations track."""
    path = tmp_path / "targets.csv"
    async with aimed(tmp_path, speaks) as (field, instruments):
        if stop == "cancel":
            task = asyncio.create_task(collected(field, Script(instruments), path))
            await asyncio.sleep(
                13.0 if speaks == "classic" else 17.0
            )  # in the middle of the third measurement
            task.cancel()
            await asyncio.wait([task])
            assert task.cancelled()
        else:
            await collected(field, Script(instruments, "", "", stop), path)
        assert list(read_partial_target_file(path).measurements[1]) == [1, 2]
        assert not instruments[1].direct_mode
        path.write_text("# foil on the wall\n" + path.read_text())
        script = Script(instruments)
        await collected(field, script, path)
    assert script.questions[0].startswith("station 1, target 3:")
    assert path.read_text().startswith("# foil on the wall\n")
    assert list(read_target_file(path).measurements[3]) == [1, 2, 3, 4]


async def test_repeats_ask_for_each_target_again(tmp_path: Path) -> None:
    """With two repeats every target is asked for twice."""
    async with aimed(tmp_path) as (field, instruments):
        script = Script(instruments, "", "", "", "q")
        collection = await collected(field, script, tmp_path / "targets.csv", repeats=2)
    assert [collection.count(1, t) for t in (1, 2)] == [2, 1]


async def test_progress_shows_counts_and_residuals(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Residuals appear as soon as three targets are common."""
    async with aimed(tmp_path) as (field, instruments):
        await collected(
            field, Script(instruments, "", "", "", "s", "", "", "", "q"), tmp_path / "targets.csv"
        )
    out = capsys.readouterr().out.splitlines()
    assert any("got 2 (1, 2); measure more of them" in line for line in out)
    header, *rows, verdict = out[-6:]
    assert header.split("  ")[0] == "target"
    assert "residual of 2, mm" in header
    assert rows[0].split() == ["1", "1", "1", "-", "0.2"]
    assert rows[3].split() == ["4", "X", "-", "-"]
    assert verdict.startswith("station 2: rms 0.4 mm")


def test_file_with_a_byte_order_mark_is_continued(tmp_path: Path) -> None:
    """Spreadsheets write one."""
    path = tmp_path / "targets.csv"
    collection = TargetCollection(path, STATIONS, [1, 2, 3])
    path.write_text("\ufeff" + collection.text(), encoding="utf-8")
    collection.resume()


@pytest.mark.parametrize("text", ["station,target\n", "junk", ""])
def test_other_file_is_not_overwritten(tmp_path: Path, text: str) -> None:
    """Nor are files with a header that the program has not written."""
    path = tmp_path / "targets.csv"
    path.write_text(text)
    with pytest.raises(InputFileError, match="was not written by tsgt calibrate collect"):
        TargetCollection(path, STATIONS, [1, 2, 3]).resume()


async def test_running_master_is_an_error(tmp_path: Path) -> None:
    """The master owns the radio; the error says how to stop it."""
    async with aimed(tmp_path) as (field, instruments):
        server = await asyncio.start_unix_server(lambda _, w: w.close(), field.config().stream.socket)
        async with server:
            with pytest.raises(TsgtError, match="systemctl stop tsgt-master"):
                async with session(field, Script(instruments)):
                    pass


@pytest.mark.parametrize(("moved_m", "code"), [(0.0, 0), (0.02, 3)])
async def test_moved_tripod_is_detected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], moved_m: float, code: int
) -> None:
    """Station 2 has moved by 20 mm, the others have not."""
    path = tmp_path / "targets.csv"
    async with aimed(tmp_path) as (field, instruments):
        script = Script(instruments)
        await collected(field, script, path)
        T = instruments[2].T.copy()
        T[0, 3] += moved_m
        instruments[2].T = T
        before = read_partial_target_file(path).measurements
        async with session(field, script) as stations:
            cells = [(s, t) for s in STATIONS for t in (1, 2, 3)]
            now = await measure_again(cells, before, stations, script, constant_m=0.0)
    capsys.readouterr()
    results = {s: check_station(*same_face_points(path, before[s], now[s], 0.0, "{}")) for s in now}
    assert print_check(results, as_json=True) == code
    printed = json.loads(capsys.readouterr().out)["stations"]
    assert [printed[s]["ok"] for s in ("1", "2", "3")] == [True, code == 0, True]
    assert printed["2"]["moved_mm"] == pytest.approx(1e3 * moved_m, abs=0.1)
    assert printed["2"]["moved_mrad"] == pytest.approx(0.0, abs=0.01)


async def test_check_result_omits_skipped_targets(tmp_path: Path) -> None:
    """Skipped and remaining targets are not in the result."""
    path = tmp_path / "targets.csv"
    async with aimed(tmp_path) as (field, instruments):
        await collected(field, Script(instruments), path)
        before = read_partial_target_file(path).measurements
        script = Script(instruments, "s", "z", "", "q")
        async with session(field, script) as stations:
            now = await measure_again([(1, 1), (1, 2), (2, 1)], before, stations, script, constant_m=0.0)
    assert {s: list(seen) for s, seen in now.items()} == {1: [2]}


async def test_check_asks_for_the_face_that_was_measured_before(tmp_path: Path) -> None:
    """Index error and collimation have the opposite effect in the other face and would look like a movement."""
    path = tmp_path / "targets.csv"
    async with aimed(tmp_path) as (field, instruments):
        await collected(field, Script(instruments), path)
        before = read_partial_target_file(path).measurements
        instruments[1].face = 2
        script = Script(instruments, "", "q")
        async with session(field, script) as stations:
            now = await measure_again([(1, 1)], before, stations, script, constant_m=0.0)
    assert now == {}
    assert any("target 1 of station 1 was measured in face 1 only" in text for text in script.said)


@pytest.mark.parametrize("corrected", [True, False])
async def test_check_compares_distances_as_they_were_collected(tmp_path: Path, *, corrected: bool) -> None:
    """Corrected for the air by the configuration, or not, as in a file of an earlier version."""
    path = tmp_path / "targets.csv"
    async with aimed(tmp_path) as (field, instruments):
        field.atmospheric_ppm = 300.0 if corrected else 0.0
        await collected(field, Script(instruments), path)
        field.atmospheric_ppm = 300.0
        before = read_partial_target_file(path).measurements
        async with session(field, Script(instruments)) as stations:
            now = await measure_again([(1, 1)], before, stations, Script(instruments), constant_m=0.0)
    (sight,) = now[1][1]
    assert sight.atmospheric_ppm == before[1][1][0].atmospheric_ppm == (300.0 if corrected else 0.0)
    assert sight.distance_m(0.0) == pytest.approx(before[1][1][0].distance_m(0.0), abs=1e-3)


def _master_config(folder: Path) -> Path:
    config = folder / "master.toml"
    config.write_text(
        'kind = "master"\n[setup]\nstation_frames = "a"\nprism_layout = "b"\n'
        "[[stations]]\nstation = 1\nprism = 1\nprism_constant_mm = 0.0\n"
        '[radio]\nkind = "simulated"\nair_socket = "air.sock"\nname = "master"\nfrequency_mhz = 905.0\n'
        'spreading_factor = 9\n[protocol]\nkind = "classic"\n[stream]\nsocket = "poses.sock"\n'
    )
    return config


def test_inconsistent_repeats_are_reported_before_anybody_aims(tsgt: Tsgt, tmp_path: Path) -> None:
    """A round of sights would be lost; targets that are not checked do not matter."""
    config, targets = _master_config(tmp_path), tmp_path / "targets.csv"
    targets.write_text(
        "station,target,horizontal_angle_rad,zenith_angle_rad,slope_distance_m,constant_mm\n"
        "1,1,0.1,1.5,20.0,0\n1,2,0.9,1.5,20.0,0\n1,2,0.9,1.5,20.2,0\n"
    )
    common = ("calibrate", "check", "--config", config, "--targets", targets)
    done = tsgt(*common)
    assert (done.code, "target 2 of station 1: this measurement is" in done.err) == (1, True)
    # Its simulated radio has no air server.
    done = tsgt(*common, "--target", 1)
    assert (done.code, "stop it first" in done.err) == (1, True)


def test_check_of_unknown_target_or_station_is_rejected(tsgt: Tsgt, tmp_path: Path) -> None:
    """The target has not been measured before, or the station is not configured."""
    config, targets = _master_config(tmp_path), tmp_path / "targets.csv"
    targets.write_text(
        "station,target,horizontal_angle_rad,zenith_angle_rad,slope_distance_m,constant_mm\n1,1,0.1,1.5,20.0,0\n"
    )
    common = ("calibrate", "check", "--config", config, "--targets", targets)
    done = tsgt(*common, "--target", 7)
    assert (done.code, "holds no target 7" in done.err) == (1, True)
    done = tsgt(*common, "--station", 4)
    assert (done.code, "no station 4" in done.err) == (2, True)
    # Its simulated radio has no air server.
    done = tsgt(*common)
    assert (done.code, "stop it first" in done.err) == (1, True)
    done = tsgt(
        "calibrate",
        "collect",
        "--config",
        config,
        "--target-constant-mm",
        0,
        "--output",
        tmp_path / "no" / "targets.csv",
    )
    assert (done.code, "No such" in done.err) == (1, True)
