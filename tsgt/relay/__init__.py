"""The stream for other computers: authenticated, read-only, with resumption after a lost connection.

In: the master's UNIX socket, as any other reader has it, so that the relay cannot harm the master. Out: the same lines over
TCP, numbered and tagged, to readers that have the key (`tsgt.client` and docs/reference/relay.md have the protocol).
`buffer` and `admission` are sans-I/O.
"""

from tsgt.relay.program import run_relay

__all__ = ["run_relay"]
