"""The report of ``tsgt evaluate``; drawing is slow, so one report serves many tests."""

from __future__ import annotations

import contextlib
import errno
import html
import io
import itertools
import json
import os
import re
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import pytest
from harness.drives.scene import at_rest, driving
from harness.files.authors_files import CONSTANTS, write_prisms, write_targets, write_tracks
from harness.inertial.imu_recording import imu_recording, shaken_drive, write

from tsgt.analysis.evaluation import inter_prism, read_tum
from tsgt.analysis.formats import read_stationary_intervals
from tsgt.analysis.report import (
    Findings,
    collect_findings,
    map_figure,
    report_numbers,
    report_sections,
    verdicts,
)
from tsgt.analysis.report.page import Headline
from tsgt.analysis.smoothing import smooth_recording
from tsgt.cli.desk.report import assess, write_page
from tsgt.cli.main import cli, run
from tsgt.errors import OutputFileError
from tsgt.estimation import build_tracks
from tsgt.recording import load_recording

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from harness.drives.scene import Motion
    from harness.files.cli import Tsgt

FIGURES = {
    "calibration",
    "distances",
    "distances_over_time",
    "errors_by_motion",
    "errors_by_two",
    "estimators_apart",
    "gaps",
    "held_out",
    "map",
    "perturbation",
    "residuals",
    "trajectory",
}


FIXED_NUMBERS = {"0", "0.27", "1", "2", "3", "6", "20", "95", "95.4"}
"""Numbers in sentences: seconds of a gap and of a stationary interval, per second, percent, and expected values."""


class Made(NamedTuple):
    """A report, and the output of the command."""

    recording: Path
    folder: Path
    out: str


def stop_and_go(time_s: float) -> Motion:
    """Remain stationary for 5 s, then drive a bend."""
    return driving(max(0.0, time_s - 5.0))


def called(*arguments: object) -> str:
    """Run ``tsgt`` successfully and return its output."""
    with contextlib.redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit) as ending:
        run(cli, [str(argument) for argument in arguments])
    assert ending.value.code == 0
    return printed.getvalue()


def recorded(folder: Path, motion: Callable[[float], Motion] = stop_and_go, *, keep: str = "123") -> Path:
    """Import a simulated drive of ten seconds, and keep only the measurements of some stations."""
    path = folder / "drive.jsonl"
    tracks = write_tracks(folder, motion)
    importing = ["import", "rts", "--tracks", *tracks, "--prisms", write_prisms(folder)]
    called(*importing, "--targets", write_targets(folder), *CONSTANTS, "--output", path)
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if str(json.loads(line).get("station", keep))[0] in keep]
    path.write_text("".join(kept), encoding="utf-8")
    return path


def findings(recording: Path, **options: Any) -> Findings:
    """Collect the findings of a report without drawing it."""
    options = {"reference": None, "with_held_out": False, **options}
    return collect_findings(load_recording(recording), recording, **options)


def report_text(found: Findings) -> str:
    """Everything that a report says in sentences."""
    return "\n".join(
        [f"{v.text} {v.repair}" for v in verdicts(found)]
        + [text for section in report_sections(found) for text in section.text]
    )


def drawn(found: Findings, folder: Path, *names: str) -> set[str]:
    """Draw the named figures of a report; return the names of all."""
    plots = {plot.name: plot for section in report_sections(found) for plot in section.plots}
    path_map = map_figure(found)
    plots |= {} if path_map is None else {path_map.name: path_map}
    for name in names:
        plots[name].write([folder / f"{name}.png"])
    return set(plots)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Make one whole report."""
    folder = tmp_path_factory.mktemp("whole")
    recording = recorded(folder)
    return Made(
        recording, folder / "report", called("evaluate", recording, "--report", folder / "report", "--json")
    )


@pytest.mark.slow
def test_page_embeds_all_figures(made: Made) -> None:
    """Each figure is also a PNG and a PDF file, and the page loads nothing else."""
    page = page_of(made)
    assert {path.stem for path in made.folder.glob("*.png")} == FIGURES
    assert {path.stem for path in made.folder.glob("*.pdf")} == FIGURES
    assert page.count('src="data:image/png;base64,') == len(FIGURES)
    assert page.count('srcset="data:image/png;base64,') == len(FIGURES)
    assert not re.search(r'(src|srcset|href)="(?!data:|#)', page)
    assert not re.search(r"https?:|url\(|@import", re.sub('base64,[^"]*', "", page))


@pytest.mark.slow
def test_page_starts_with_what_to_trust_and_the_map(made: Made) -> None:
    """Then the sections, each of which the navigation names."""
    page = page_of(made)
    places = [
        page.index(text) for text in ("<h1>", "What to trust", "What to do", 'alt="Map', "<nav", 'id="s1"')
    ]
    assert places == sorted(places)
    assert re.findall(r'<a href="#s\d+">(.*?)</a>', page) == re.findall(r'<h2 id="s\d+">(.*?)</h2>', page)


@pytest.mark.slow
def test_page_is_accessible(made: Made) -> None:
    """It has a language, headings without a skipped level, an alternative text for each image, and tables that can scroll."""
    page = page_of(made)
    assert '<html lang="en">' in page
    levels = [int(level) for level in re.findall(r"<h(\d)", page)]
    assert levels[0] == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))
    alternatives = re.findall(r'<img alt="([^"]*)"', page)
    assert len(set(alternatives)) == len(FIGURES)
    assert all(" " in text for text in alternatives)
    assert page.count("<table aria-labelledby") == page.count(
        '<div class="scroll" role="region" tabindex="0"'
    )


@pytest.mark.slow
def test_page_names_what_is_unknown(made: Made) -> None:
    """An import has no radio, no delays and no timestamp bounds: no zero and no NaN stands for them."""
    page = page_of(made)
    text = re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL)
    assert "Unknown, because it was not recorded: delay median / 95 % (s), signal RSSI" in text
    assert not re.search(r"\bnan\b", text, flags=re.IGNORECASE)
    assert json.loads(made.out)["stations"]["1"]["delay_median_s"] is None


@pytest.mark.slow
def test_json_agrees_with_report_and_evaluate(made: Made) -> None:
    """Equal keys have equal values; report.json holds what is printed."""
    printed = json.loads(made.out)
    assert json.loads((made.folder / "report.json").read_text(encoding="utf-8")) == printed
    evaluated = json.loads(called("evaluate", made.recording, "--no-held-out", "--json"))
    assert {key: printed[key] for key in evaluated} == evaluated
    assert printed["stations"]["1"]["measurements"] == 25
    assert set(printed["held_out_mm"]) == {"linear", "continuous"}


@pytest.mark.slow
def test_every_number_of_the_page_is_in_the_json(made: Made) -> None:
    """It covers key figures, tables and sentences, with their rounding."""
    page = page_of(made)
    printed = json.loads(made.out)
    listed = {
        plain(text) for text in re.findall(r"<li>(.*?)</li>", page.split("<figure>", 1)[0], flags=re.DOTALL)
    }
    for verdict in printed["verdicts"]:
        assert verdict["text"].replace("`", "") in {text.removeprefix("Do not trust: ") for text in listed}
        assert not verdict["repair"] or verdict["repair"].replace("`", "") in listed
    known = [v for number in numbers_in(printed) for v in (number, 100 * number)]
    # The table of the set-up is in mm, mrad, ms and ppm.
    known += [factor * v for v in numbers_in(printed["refinement"]) for factor in (1e3, 1e6)]
    shown = re.findall(r"<(?:td|dd|p)>(.*?)</", page.split("About this recording</h2>")[0], flags=re.DOTALL)
    checked = 0
    for text in map(html.unescape, shown):
        for word in re.findall(r"(?<![\w.:-])[-+]?\d+(?:\.\d+)?(?![\w:-])", text):
            digits = len(word.partition(".")[2])
            assert word in FIXED_NUMBERS or any(f"{v:.{digits}f}" == word for v in known), (word, text)
            checked += 1
    assert checked > 100


def page_of(made: Made) -> str:
    """Return the page."""
    return (made.folder / "report.html").read_text(encoding="utf-8")


def plain(text: str) -> str:
    """Return the text of a piece of HTML."""
    return html.unescape(re.sub("<[^>]*>", "", text)).strip()


def numbers_in(value: Any) -> Iterator[float]:
    """Return all numbers of a JSON value and of its keys."""
    if isinstance(value, dict):
        yield from (float(key) for key in value if key.isdigit())
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from numbers_in(item)
    elif isinstance(value, int | float):
        yield float(value)


@pytest.mark.slow
def test_report_of_one_station(tsgt: Tsgt, tmp_path: Path) -> None:
    """There are no poses and no distances; the data of the station is shown."""
    recording = recorded(tmp_path, keep="1")
    outcome = tsgt("evaluate", recording, "--report", tmp_path / "report")
    assert outcome.code == 3
    assert "do not trust: No poses by continuous and linear: prism 2 has no usable measurement" in outcome.out
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "no usable measurement of prism 2 and prism 3" in page
    assert {path.stem for path in (tmp_path / "report").glob("*.png")} == {*("calibration", "gaps")}


@pytest.mark.slow
def test_report_of_two_measured_prisms_has_their_distance(tmp_path: Path) -> None:
    """A prism that was not measured does not hide the distance between the others."""
    found = findings(recorded(tmp_path, keep="12"))
    assert found.inter_prism is not None
    assert [pair.name for pair in found.inter_prism.dynamic] == ["1-2"]
    assert "Prism 3 has no usable measurement; distances are those between the others." in report_text(found)


@pytest.mark.slow
def test_report_without_stationary_interval(tmp_path: Path) -> None:
    """The figure of stationary distances says so."""
    found = findings(recorded(tmp_path, driving))
    assert "never stationary" in report_text(found)
    assert "The robot never stood still for 3 s or more" in report_text(found)
    drawn(found, tmp_path, "distances", "distances_over_time")


@pytest.mark.slow
def test_report_of_a_stationary_robot(tmp_path: Path) -> None:
    """Its errors are plotted against almost no motion, or not at all."""
    found = findings(recorded(tmp_path, at_rest))
    drawn(found, tmp_path, "map", "trajectory", "estimators_apart")
    assert "never stationary" not in report_text(found)


@pytest.mark.slow
def test_report_with_a_reference_of_another_day(tmp_path: Path) -> None:
    """Both time spans are named."""
    reference = tmp_path / "other.tum"
    reference.write_text("1600000000 0 0 0 0 0 0 1\n1600000100 0 0 0 0 0 0 1\n", encoding="utf-8")
    found = findings(recorded(tmp_path), reference=read_tum(reference))
    assert "nothing was compared" in report_text(found)
    assert "it covers 2020-09-13" in report_text(found)
    assert report_numbers(found)["compared"] == 0


@pytest.mark.slow
def test_odometry_defines_the_stationary_intervals(tmp_path: Path) -> None:
    """Stationary distances come from its intervals."""
    odometry = tmp_path / "odometry.csv"
    odometry.write_text("".join(f"{1_700_000_000.05 + i / 10},0,0\n" for i in range(41)), encoding="utf-8")
    found = report_numbers(findings(recorded(tmp_path), stationary_ns=read_stationary_intervals(odometry)))
    assert found["still_s"] == pytest.approx(4.0)
    assert found["inter_prism_static_mm"]["1-2"]["valid"] == 10


@pytest.mark.slow
def test_odometry_of_another_day_is_not_used(tmp_path: Path) -> None:
    """The report says that it does not cover the drive."""
    other_day = (1_600_000_000_000_000_000, 1_600_000_100_000_000_000)
    found = findings(recorded(tmp_path), stationary_ns=[other_day])
    assert (
        "According to the odometry, the robot was stationary before or after this recording only"
        in report_text(found)
    )
    assert "stationary from 2020-09-13" in report_text(found)
    assert report_numbers(found)["still_s"] == 0.0


def test_short_recording_gets_no_good_verdict(tmp_path: Path) -> None:
    """A few residuals do not determine noise and motion."""
    recording = recorded(tmp_path)
    lines = recording.read_text(encoding="utf-8").splitlines(keepends=True)
    late_ns = 1_700_000_003_000_000_000
    kept = [line for line in lines if json.loads(line).get("stamp_ns", 0) < late_ns or "sequence" not in line]
    recording.write_text("".join(kept), encoding="utf-8")
    said = report_text(findings(recording))
    assert "too few measurements to estimate motion prior and noise scale" in said
    assert "consistent with their noise" not in said


def test_stations_without_common_time_have_no_motion(tmp_path: Path) -> None:
    """Stationary intervals are unknown then, and the report states none."""
    recording = recorded(tmp_path, at_rest)
    lines = recording.read_text(encoding="utf-8").splitlines(keepends=True)
    begins_s = {1: 0, 2: 3, 3: 6}
    kept = [
        line
        for line in lines
        for record in (json.loads(line),)
        if record.get("type") != "measurement"
        or begins_s[record["station"]]
        <= (record["stamp_ns"] - 1_700_000_000_000_000_000) / 1e9
        < begins_s[record["station"]] + 3
    ]
    recording.write_text("".join(kept), encoding="utf-8")
    said = report_text(findings(recording))
    assert "At no time were all prisms measured without a gap" in said
    assert "never stationary" not in said


@pytest.fixture
def reported(monkeypatch: pytest.MonkeyPatch) -> list[Findings]:
    """Collect findings instead of drawing them."""
    found: list[Findings] = []

    def write(findings: Findings, folder: Path, *, on_progress: object) -> None:  # noqa: ARG001 (as the original)
        found.append(findings)

    monkeypatch.setattr("tsgt.cli.desk.report.write_report", write)
    return found


def short_drive(folder: Path) -> Path:
    """Import the driving of a few seconds."""
    path = folder / "drive.jsonl"
    sources = ("--tracks", *write_tracks(folder, duration_s=6.0), "--prisms", write_prisms(folder))
    called("import", "rts", *sources, "--output", path)
    return path


def test_report_without_poses_ends_with_the_error(
    tsgt: Tsgt, tmp_path: Path, reported: list[Findings]
) -> None:
    """The same as without a report; the report is written nevertheless."""
    arguments = ("evaluate", recorded(tmp_path, keep="1"))
    plain, outcome = tsgt(*arguments), tsgt(*arguments, "--report", tmp_path / "report")
    assert (plain.code, outcome.code) == (1, 3)
    assert outcome.err == plain.err
    assert reported
    assert "report.html" in outcome.out


REFERENCES = {
    "other": "1600000000 0 0 0 0 0 0 1\n1600000100 0 0 0 0 0 0 1\n",
    "line": "".join(f"{1_699_999_997 + i} {i} 0 0 0 0 0 1\n" for i in range(17)),
}


@pytest.mark.parametrize(
    ("name", "verdict"),
    [
        ("other", "do not trust: No valid pose of continuous is within the time of the reference"),
        ("line", "take care: The poses are not aligned with the reference: "),
    ],
)
def test_report_without_the_comparison_ends_with_the_error(
    tsgt: Tsgt, tmp_path: Path, reported: list[Findings], name: str, verdict: str
) -> None:
    """The same as without a report; a verdict says it as well."""
    reference = tmp_path / f"{name}.tum"
    reference.write_text(REFERENCES[name], encoding="utf-8")
    given = ("--no-held-out", "--refine", "off", "--reference", reference, "--align", "rigid")
    arguments = ("evaluate", short_drive(tmp_path), *given)
    plain, outcome = tsgt(*arguments), tsgt(*arguments, "--report", tmp_path / "report")
    assert (plain.code, outcome.code) == (1, 3)
    assert outcome.err == plain.err
    assert reported
    assert verdict in outcome.out


def test_single_prism_has_the_same_verdict_with_and_without_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has no distances, which is no reason for distrust."""
    path = tmp_path / "field.jsonl"
    recording = imu_recording(shaken_drive(12.0), stations=1)
    write(path, recording)
    smoothed = smooth_recording(recording, path=path, refine="off")
    monkeypatch.setattr("tsgt.analysis.report.findings.smooth_recording", lambda *_, **__: smoothed)
    found = collect_findings(recording, path, reference=None, with_held_out=False)
    distances = inter_prism(recording.parameters, build_tracks(recording.parameters, recording.measurements))
    plain = assess(recording, path, smoothed, distances, {}, found.diagnosis)
    assert plain == verdicts(found)
    assert "take care: No inter-prism distances: the robot has a single prism." in [
        f"{each.level}: {each.text}" for each in plain
    ]


def test_odometry_needs_a_report(tsgt: Tsgt, tmp_path: Path) -> None:
    """--odometry without --report is a usage error."""
    outcome = tsgt("evaluate", tmp_path / "drive.jsonl", "--odometry", tmp_path / "odometry.csv")
    assert outcome.code == 2
    assert "--odometry needs --report" in outcome.err


def test_recording_without_measurements_has_no_report(tsgt: Tsgt, tmp_path: Path) -> None:
    """No folder is created."""
    outcome = tsgt("evaluate", recorded(tmp_path, keep="9"), "--report", tmp_path / "report")
    assert outcome.code == 1
    assert "holds no measurements" in outcome.err
    assert not (tmp_path / "report").exists()


@pytest.mark.parametrize("command", ["evaluate", "compare"])
@pytest.mark.parametrize("name", ["report.json", "report.html"])
def test_report_does_not_replace_an_input(tsgt: Tsgt, tmp_path: Path, command: str, name: str) -> None:
    """A file in the folder with the name of one of the report's is refused before any work."""
    given = tmp_path / name
    given.write_text("x", encoding="utf-8")
    rest = [tmp_path / "estimate.tum"] if command == "compare" else []
    outcome = tsgt(command, given, *rest, "--report", tmp_path)
    assert (outcome.code, "would replace its own input" in outcome.err) == (2, True)
    assert given.read_text(encoding="utf-8") == "x"


def test_failing_report_keeps_the_previous_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Page and numbers are replaced by complete ones only."""
    (tmp_path / "report.html").write_text("before", encoding="utf-8")

    def full(_: int) -> NoReturn:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputFileError, match="No space left"):
        write_page(tmp_path, "title", Headline((), (), (), ()), None, [], {})
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == "before"


def test_report_needs_a_writable_folder(tsgt: Tsgt, tmp_path: Path) -> None:
    """A file with the name of the folder is an error."""
    (tmp_path / "taken").write_text("x", encoding="utf-8")
    outcome = tsgt("evaluate", recorded(tmp_path, keep="1"), "--report", tmp_path / "taken")
    assert outcome.code == 1
    assert "taken" in outcome.err
