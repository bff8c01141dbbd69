"""Compare estimates with reference poses in Python: ``compare_estimates.py REFERENCE ESTIMATE...``.

The same as ``tsgt compare REFERENCE ESTIMATE... --fit offset,extrinsic``, for a notebook. REFERENCE is a file of poses
(``tsgt process RECORDING --output poses.jsonl``).
"""

import sys
from pathlib import Path

import numpy as np

from tsgt.analysis.compare import FitSettings, compare_estimates
from tsgt.analysis.formats.trajectories import read_estimates, read_reference_poses

reference = read_reference_poses(Path(sys.argv[1]))
estimates = [each for path in sys.argv[2:] for each in read_estimates(Path(path))]
settings = FitSettings(parts=frozenset({"offset", "extrinsic", "frame"}), align="start")

for found in compare_estimates(reference, estimates, settings):
    relation, sigma_s = found.fit.relation, found.sigma("offset_s")[0]
    print(f"{found.name}: offset {1e3 * relation.offset_s:.2f} ms, sigma {1e3 * sigma_s:.2f} ms")
    print(f"  sensor at {np.round(relation.T_point_sensor[:3, 3], 3).tolist()} m from the reference point")
    print(
        f"  ATE {found.errors.ate.errors.position_mm.rms:.1f} mm, explained {found.errors.ate.explained.position_rms_mm:.1f} mm"
    )
    series = found.errors.series  # arrays over time, for figures of your own
    worst = int(np.argmax(series.position_m))
    print(f"  worst {1e3 * series.position_m[worst]:.1f} mm after {series.path_m[worst]:.1f} m")
