"""The live stream for the Foxglove app, over its WebSocket protocol, on the address and with the access rules of the page.

In: the lines of the stream and the views of the page (`feed`). Out: messages of Foxglove's own types (`messages`, `scene`) on channels
(`channels`), to each app those that it has subscribed to (`server`). The library foxglove-sdk encodes the messages; its server is not
used, because it has no access code and lets any web page that the operator has open read along.
"""

from tsgt.web.foxglove.feed import Feed
from tsgt.web.foxglove.server import FoxgloveServer

__all__ = ["Feed", "FoxgloveServer"]
