"""The master's side of the paper's polling protocol.

In: the radio's packets. Out: link events with measurements on the master's clock. `link` ties the parts together:
`scheduler` chooses transactions, `transport` runs them, `ingest` validates and stamps the replies.
"""

from tsgt.master.classic.ingest import DUPLICATE_WINDOW, UNTIMED_SIGMA_NS
from tsgt.master.classic.link import ClassicLink
from tsgt.master.classic.transport import Transport, next_packet

__all__ = ["DUPLICATE_WINDOW", "UNTIMED_SIGMA_NS", "ClassicLink", "Transport", "next_packet"]
