"""TODO face."""

from tsgt.station.geocom.codec import Parameter, Rpc
from tsgt.station.geocom.codes import ReturnCode, Verdict, name_of, verdict
from tsgt.station.geocom.connection import GeoComConnection, Reply, connect

__all__ = [
    "GeoComConnection",
    "Parameter",
    "Reply",
    "ReturnCode",
    "Rpc",
    "Verdict",
    "connect",
    "name_of",
    "verdict",
]
