"""The relation between an estimate and the reference, fitted jointly: clock, scale, extrinsic and frame, each with its uncertainty.

In: paired poses with the reference's covariance, and what is to be fitted. Out: ``Fit``. `initialisation` begins without a first guess;
`joint_fit` iterates over the equations of `drifting_frame` with error levels of `noise` and `reference_error`; `frame` places the frame
over a chosen part; `uncertainty` says what the motion determines; `fitting` puts them together.
"""

from tsgt.analysis.compare.alignment.fitting import fit, nested_fits
from tsgt.analysis.compare.alignment.initialisation import OffsetSearchError, overlap_s

__all__ = ["OffsetSearchError", "fit", "nested_fits", "overlap_s"]
