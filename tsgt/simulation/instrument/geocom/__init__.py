"""GeoCOM interpreter of the simulated total station, written from the manual, independently of the client.

In: bytes from the line. Out: response lines, after a processing time; movements and settings of the instrument model.
`server` frames and dispatches; the command tables are `setting_commands`, `measuring_commands` and `pointing_commands`.
"""

from tsgt.simulation.instrument.geocom.server import ForcedResponse, GeoComServer

__all__ = [
    "ForcedResponse",
    "GeoComServer",
]
