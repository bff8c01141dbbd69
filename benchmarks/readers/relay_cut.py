"""A reader on another computer whose cable is cut for a minute: nothing lost, nothing twice, gaps told. Needs root.

python benchmarks/run.py relay_cut [--cut-s 60] [--hold-s 120]
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import asdict
from pathlib import Path

from harness.readers.cable_cut import cut_cable
from harness.readers.network import missing


def main() -> str | None:
    """Print what the reader got."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cut-s", type=float, default=60.0, help="how long the cable is cut")
    parser.add_argument("--hold-s", type=float, default=120.0, help="for how long the relay holds lines")
    options = parser.parse_args()
    if reason := missing():
        return reason
    with tempfile.TemporaryDirectory() as folder:
        outcome = cut_cable(Path(folder), options.cut_s, options.hold_s)
    for name, value in asdict(outcome).items():
        print(f"{name:20} {value:.3f}" if isinstance(value, float) else f"{name:20} {value}")
    return None
