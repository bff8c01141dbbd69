from __future__ import annotations

import os
import sys
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.pos_files import SECOND, Variant, write_pos

from tsgt.analysis.figures import draw_gnss
from tsgt.analysis.formats import PosFile, read_pos
from tsgt.analysis.gnss import common_interval, receiver_distances, receivers, utc_from_gps
from tsgt.errors import InputFileError, MissingExtraError, RecordingError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.gnss import DistanceSeries, Receiver

START = 1_653_499_242 * SECOND
TENTH = SECOND // 10


def way(times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return a robot's positions at 1 m/s, (N, 3), as east, north and up from the base."""
    time_s = (times_ns - START) / 1e9
    return np.column_stack([10 + 0.6 * time_s, 5 + 0.8 * time_s, np.full(len(time_s), 0.2)])


def epochs(count: int, step_ns: int = 2 * TENTH, delay_ns: int = 0) -> NDArray[np.int64]:
    """Return equally spaced times."""
    return START + delay_ns + step_ns * np.arange(count)


def receiver(
    folder: Path,
    name: str,
    times_ns: NDArray[np.int64],
    points_m: NDArray[np.float64],
    *,
    variant: Variant | None = None,
    quality: list[int] | None = None,
) -> PosFile:
    """Write and read a receiver's file."""
    return read_pos(write_pos(folder / f"{name}.pos", times_ns.tolist(), points_m, variant, quality=quality))


def two(
    folder: Path,
    *,
    offset_m: tuple[float, float, float] = (-0.8, 0.0, 0.1),
    count: int = 20,
    **second: object,
) -> tuple[Receiver, ...]:
    """Return two receivers on a driving robot, the second one ``offset_m`` from the first."""
    times_ns = epochs(count, **second)  # type: ignore[arg-type]  # step_ns, delay_ns
    return receivers(
        [
            receiver(folder, "front", epochs(count), way(epochs(count))),
            receiver(folder, "back", times_ns, way(times_ns) + offset_m),
        ]
    )


def test_leap_seconds_equal_the_time_zone_database() -> None:
    """Every leap second since 1980, at its second and not one earlier."""
    lines = resources.files("tzdata").joinpath("zoneinfo/leapseconds").read_text().splitlines()
    days = [line.split()[1:4] for line in lines if line.startswith("Leap")]
    months = {"Jun": "07", "Dec": "01"}
    starts = [
        np.datetime64(f"{int(year) + (month == 'Dec')}-{months[month]}-01", "s").astype(np.int64)
        for year, month, _ in days
    ]
    since_gps = [start for start in starts if start > 315_964_800]
    for ahead, start in enumerate(since_gps):
        last = (start - 1 + ahead) * SECOND  # the last second before the leap second
        found = utc_from_gps(np.array([last, last + SECOND, last + 2 * SECOND, last + 3 * SECOND]))
        assert (found // SECOND - start).tolist() == [-1, 0, 0, 1]
    assert len(since_gps) == 18


@pytest.mark.parametrize("system", ["GPST", "UTC", "JST"])
@pytest.mark.parametrize("week", [False, True])
def test_all_time_systems_give_the_same_time(tmp_path: Path, system: str, week: bool) -> None:  # noqa: FBT001 (a parameter of the test)
    """Unix time, with the 18 leap seconds of 2022."""
    variant = Variant(system=system, week=week)
    found = receivers([receiver(tmp_path, "a", epochs(3), way(epochs(3)), variant=variant)])
    assert found[0].times_ns.tolist() == epochs(3).tolist()


def test_all_coordinate_kinds_give_the_same_position(tmp_path: Path) -> None:
    """To RTKLIB's last digit: 0.1 mm in metres, 1e-9 degrees on the ground."""
    kinds = ["geodetic", "sexagesimal", "ecef", "baseline"]
    files = [
        receiver(tmp_path, kind, epochs(5), way(epochs(5)), variant=Variant(coordinates=kind))
        for kind in kinds
    ]
    found = receivers(files)
    for other in found:
        np.testing.assert_allclose(other.points_m, found[0].points_m, atol=4e-4)
    np.testing.assert_allclose(found[0].points_m, way(epochs(5)) - way(epochs(1)), atol=4e-4)


def test_local_coordinates_follow_the_ellipsoid(tmp_path: Path) -> None:
    """One second of arc along the equator and along a meridian at the pole, from WGS84's axes alone."""
    a_m, b_m = 6_378_137.0, 6_356_752.314245
    arc = np.radians(1 / 3600)
    equator = PosFile(
        path=tmp_path / "x.pos",
        time_system="UTC",
        times_ns=epochs(2),
        coordinates="geodetic",
        positions=np.array([[0.0, 0.0, 0.0], [0.0, arc, 0.0]]),
        quality=np.array([1, 1]),
        satellites=np.array([9, 9]),
        base=None,
    )
    (found,) = receivers([equator])
    np.testing.assert_allclose(found.points_m[1], [a_m * arc, 0, -a_m * arc**2 / 2], rtol=1e-6, atol=1e-9)
    pole = np.array([[np.pi / 2, 0.0, 0.0], [np.pi / 2 - arc, 0.0, 0.0]])
    (found,) = receivers([PosFile(**{n: getattr(equator, n) for n in _FIELDS} | {"positions": pole})])
    assert np.linalg.norm(found.points_m[1]) == pytest.approx(a_m**2 / b_m * arc, rel=1e-6)


_FIELDS = tuple(PosFile.__dataclass_fields__)


def test_epochs_without_a_position_are_ignored(tmp_path: Path) -> None:
    """RTKLIB writes the centre of the Earth there: two receivers would be 0 mm apart."""
    header = "\n".join(Variant().header())
    nothing = (
        "2022/05/25 17:21:00.000   90.000000000    0.000000000 -6378137.0000   5   0 " + "30.0 " * 6 + "0 0"
    )
    row = Variant().row(START + SECOND, np.array([1.0, 2.0, 3.0]))
    path = tmp_path / "a.pos"
    path.write_text(f"{header}\n{nothing}\n{row}", encoding="utf-8")
    (found,) = receivers([read_pos(path)])
    assert (len(found.times_ns), found.without_position) == (1, 1)


def test_file_without_any_position_is_rejected(tmp_path: Path) -> None:
    """The message names the reason."""
    file = receiver(tmp_path, "a", epochs(2), way(epochs(2)), quality=[0, 0])
    with pytest.raises(InputFileError, match="contains no valid position in any epoch"):
        receivers([file])


def test_distances_equal_those_on_the_robot(tmp_path: Path) -> None:
    """At common epochs nothing is interpolated, first and last epoch included."""
    (pair,) = receiver_distances(two(tmp_path), [0.8])
    assert len(pair.times_ns) == 20
    np.testing.assert_allclose(pair.distances_m, np.hypot(0.8, 0.1), atol=3e-4)
    np.testing.assert_allclose(pair.errors_m, np.hypot(0.8, 0.1) - 0.8, atol=3e-4)


def test_different_epochs_are_interpolated(tmp_path: Path) -> None:
    """At 1 m/s, epochs 8 ms apart would cause 8 mm."""
    (pair,) = receiver_distances(two(tmp_path, delay_ns=-8_000_000), [0.8])
    assert len(pair.times_ns) == 19
    assert pair.invalid_ns.tolist() == [epochs(20)[-1]]
    np.testing.assert_allclose(pair.distances_m, np.hypot(0.8, 0.1), atol=3e-4)


def test_outage_is_not_interpolated(tmp_path: Path) -> None:
    """Between positions more than 1 s apart there is no distance; at common epochs there is."""
    (pair,) = receiver_distances(two(tmp_path, count=25, step_ns=12 * TENTH))
    assert (np.diff(pair.times_ns) == 12 * TENTH).all()
    assert len(pair.times_ns) + len(pair.invalid_ns) == 25


def test_default_reference_is_the_median_of_fixed_distances(tmp_path: Path) -> None:
    """However many others there are; without fixed ones, of all."""
    times_ns = epochs(9)
    apart = np.where(np.arange(9) < 6, 2.8, 0.8)[:, None] * [1.0, 0.0, 0.0]
    quality = [2] * 6 + [1] * 3
    files = [
        receiver(tmp_path, "a", times_ns, way(times_ns)),
        receiver(tmp_path, "b", times_ns, way(times_ns) + apart, quality=quality),
    ]
    (pair,) = receiver_distances(receivers(files))
    assert pair.reference_m == pytest.approx(0.8, abs=3e-4)
    files[1] = receiver(tmp_path, "b", times_ns, way(times_ns) + apart, quality=[2] * 9)
    (pair,) = receiver_distances(receivers(files))
    assert pair.reference_m == pytest.approx(2.8, abs=3e-4)


def test_quality_is_that_of_the_worse_position(tmp_path: Path) -> None:
    """Single is worse than PPP, regardless of their numbers."""
    times_ns = epochs(4)
    files = [
        receiver(tmp_path, "a", times_ns, way(times_ns), quality=[1, 1, 6, 2]),
        receiver(tmp_path, "b", times_ns, way(times_ns), quality=[1, 2, 5, 6]),
    ]
    (pair,) = receiver_distances(receivers(files))
    assert pair.quality is not None
    assert pair.quality.tolist() == [1, 2, 5, 6]
    assert list(pair.by_quality()) == [1, 2, 6, 5]


def test_quality_includes_both_interpolation_neighbours(tmp_path: Path) -> None:
    """Both neighbours of the second receiver count."""
    later = epochs(4, delay_ns=TENTH)
    files = [
        receiver(tmp_path, "a", epochs(4), way(epochs(4))),
        receiver(tmp_path, "b", later, way(later), quality=[1, 1, 2, 1]),
    ]
    (pair,) = receiver_distances(receivers(files))
    assert pair.quality is not None
    assert pair.quality.tolist() == [1, 2, 2]


def test_receiver_names_are_unique(tmp_path: Path) -> None:
    """Files with the same name are distinguished by their folders."""
    files = []
    for name in ("front", "back"):
        (tmp_path / name).mkdir()
        files.append(receiver(tmp_path / name, "rover", epochs(2), way(epochs(2))))
    assert [each.name for each in receivers(files)] == ["front/rover", "back/rover"]


def test_bytes_of_names_that_are_not_utf8_are_replaced(tmp_path: Path) -> None:
    """The names are drawn and printed; a system with Latin-1 has written those of the files."""
    files = [receiver(tmp_path, os.fsdecode(name), epochs(2), way(epochs(2))) for name in (b"v\xe4", b"back")]
    assert [each.name for each in receivers(files)] == ["v\ufffd", "back"]


def test_both_are_cut_to_the_common_interval(tmp_path: Path) -> None:
    """So that the statistics cover the same part of the drive."""
    (pair,) = receiver_distances(two(tmp_path))
    later = shifted(pair, SECOND)
    (gnss,), (prisms,) = common_interval([pair], [later], tmp_path / "r.jsonl")
    assert (gnss.times_ns[0], gnss.times_ns[-1]) == (later.times_ns[0], pair.times_ns[-1])
    assert (prisms.times_ns[0], prisms.times_ns[-1]) == (later.times_ns[0], pair.times_ns[-1])


@pytest.mark.parametrize(
    ("shift_s", "message"), [(100, "begin 96.2 s after the end"), (-100, "end 96.2 s before the start")]
)
def test_series_without_overlap_are_rejected(tmp_path: Path, shift_s: int, message: str) -> None:
    """The message states the gap, which may be a clock error."""
    (pair,) = receiver_distances(two(tmp_path))
    with pytest.raises(RecordingError, match=message):
        common_interval([pair], [shifted(pair, shift_s * SECOND)], tmp_path / "r.jsonl")


def test_no_position_during_the_prism_measurements_is_rejected(tmp_path: Path) -> None:
    """The receivers have positions before and after only."""
    times_ns = np.concatenate([epochs(5), epochs(5, delay_ns=100 * SECOND)])
    files = [receiver(tmp_path, name, times_ns, way(times_ns)) for name in "ab"]
    (pair,) = receiver_distances(receivers(files))
    (prisms,) = receiver_distances(two(tmp_path))
    with pytest.raises(RecordingError, match="the receivers had no common positions"):
        common_interval([pair], [shifted(prisms, 50 * SECOND)], tmp_path / "r.jsonl")


def shifted(pair: DistanceSeries, by_ns: int) -> DistanceSeries:
    """Return distances shifted in time."""
    fields = {name: getattr(pair, name) for name in type(pair).__dataclass_fields__}
    return type(pair)(**(fields | {"times_ns": pair.times_ns + by_ns}))


def test_missing_pymap3d_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the command to install it."""
    file = receiver(tmp_path, "a", epochs(2), way(epochs(2)))
    monkeypatch.setitem(sys.modules, "pymap3d", None)
    with pytest.raises(MissingExtraError, match=r"need pymap3d.*pip install 'tsgt\[gnss\]'"):
        receivers([file])


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 200])
def test_figure_of_few_and_of_many_epochs(tmp_path: Path, count: int) -> None:
    """With prisms and without; also with a receiver that was off all the time."""
    found = two(tmp_path, count=count)
    pairs = receiver_distances(found)
    absent = found[0].between(0, 1)
    assert len(absent.times_ns) == 0
    draw_gnss([*found, absent], [*pairs, pairs[0].between(0, 1)], [], tmp_path / "alone.png")
    draw_gnss(found, pairs, pairs, tmp_path / "both.pdf")
    assert (tmp_path / "alone.png").stat().st_size > 10_000
    assert (tmp_path / "both.pdf").stat().st_size > 5_000
