"""Set-up files: what a calibration found, as TOML. ``tsgt.config`` reads them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.recording import write_atomically

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from tsgt.geometry import FloatArray
    from tsgt.model import TargetResidual


def write_station_frames(
    path: Path,
    frames: Mapping[int, FloatArray],
    rms_m: Mapping[int, float],
    *,
    comment: str,
    latencies_ms: Mapping[int, float] | None = None,
    targets: Mapping[int, Sequence[TargetResidual]] | None = None,
) -> None:
    """Write a file of kind ``station_frames``.

    Parameters
    ----------
    path
        The file; it appears as a whole or not at all.
    frames
        (4, 4) ``T_station1_station`` in m by station number.
    rms_m
        By how much a station's targets missed those of station 1, root mean square, in m; station 1 has none.
    comment
        Where the frames come from; one line on top of the file.
    latencies_ms
        From the measurement to its stamp by station number, where they were found too.
    targets
        How well the targets fit by station number, where the frames come from targets.

    Raises
    ------
    OutputFileError
        The file cannot be written.
    """
    tables = []
    for station, T in sorted(frames.items()):
        rows = ",\n".join(f"  {_numbers(row)}" for row in T)
        rms = f"rms_mm = {1e3 * rms_m[station]:.3f}\n" if station in rms_m else ""
        late = "" if latencies_ms is None else f"latency_ms = {latencies_ms[station]:.6f}\n"
        fits = "".join(_target(station, target) for target in (targets or {}).get(station, ()))
        tables.append(f"[stations.{station}]\nT_station1_station = [\n{rows},\n]\n{rms}{late}{fits}")
    _write(path, "station_frames", tables, comment)


def write_prism_layout(
    path: Path, positions_m: Mapping[int, FloatArray], sigmas_m: Mapping[int, FloatArray], *, comment: str
) -> None:
    """Write a file of kind ``prism_layout``.

    Parameters
    ----------
    path
        The file; it appears as a whole or not at all.
    positions_m
        (3,) position in the frame ``robot`` in m by prism number.
    sigmas_m
        (3,) one sigma of each coordinate in m by prism number.
    comment
        Where they come from; one line on top of the file.

    Raises
    ------
    OutputFileError
        The file cannot be written.
    """
    tables = [
        f"[prisms.{prism}]\nposition_m = {_numbers(position)}\nsigma_m = {_numbers(sigmas_m[prism])}\n"
        for prism, position in sorted(positions_m.items())
    ]
    _write(path, "prism_layout", tables, comment)


def _target(station: int, fit: TargetResidual) -> str:
    """Table of one target's fit, to the micrometre."""
    lengths_m = (("residual_mm", fit.residual_m), ("leave_one_out_mm", fit.leave_one_out_m))
    keys = "".join(f"{key} = {1e3 * value:.3f}\n" for key, value in lengths_m if value is not None)
    return f"[[stations.{station}.targets]]\ntarget = {fit.target}\n{keys}"


def _numbers(values: FloatArray) -> str:
    """Array of floats in the shortest form that reads back to the same bits."""
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _write(path: Path, kind: str, tables: Iterable[str], comment: str) -> None:
    # A file name may hold a line break; a comment must not.
    printable = "".join(character if character.isprintable() else "?" for character in comment)
    text = "\n".join([f'# {printable}\nkind = "{kind}"\n', *tables])
    with write_atomically(path) as file:
        file.write(text.encode())
