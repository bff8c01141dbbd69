"""GeoCOM, Leica's remote procedure calls over a serial line: sans-I/O codec, return codes and framing, and the connection.

In: an opener of the serial port, a procedure and its parameters. Out: replies with return code, values and the times of
request and arrival. ``codec`` encodes and decodes lines, ``codes`` has the table of return codes, ``framing`` splits data into
lines, ``connection`` repeats, resynchronises and aborts.
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
