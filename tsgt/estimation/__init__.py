"""TODO face."""

from tsgt.estimation.linear import Pipeline
from tsgt.estimation.live import Feed
from tsgt.estimation.observations import build_observations, instrument_time_sigma_s
from tsgt.estimation.pose_batch import Kind, PoseBatch, Reason
from tsgt.estimation.pose_output import ContinuousPoses, Seen
from tsgt.estimation.tracks import FARTHEST_M, Track, believable, build_tracks, measured_at_ns, usable

__all__ = [
    "FARTHEST_M",
    "ContinuousPoses",
    "Feed",
    "Kind",
    "Pipeline",
    "PoseBatch",
    "Reason",
    "Seen",
    "Track",
    "believable",
    "build_observations",
    "build_tracks",
    "instrument_time_sigma_s",
    "measured_at_ns",
    "usable",
]
