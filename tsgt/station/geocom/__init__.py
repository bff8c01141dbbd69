"""GeoCOM, Leica's remote procedure calls over a serial line: codec, return codes, framing (sans-I/O), and the connection.

In: an opener of the serial port, a procedure and its parameters. Out: replies with return code, values and the times of
request and arrival. The connection repeats, resynchronises and aborts.
"""

from tsgt.station.geocom.codec import Parameter, Rpc
from tsgt.station.geocom.codes import Outcome, ReturnCode, name_of, outcome_of
from tsgt.station.geocom.connection import GeoComConnection, Reply, connect

__all__ = [
    "GeoComConnection",
    "Outcome",
    "Parameter",
    "Reply",
    "ReturnCode",
    "Rpc",
    "connect",
    "name_of",
    "outcome_of",
]
