"""The master on the robot: daemon, publisher, stream server, replay.

In: link events of the sub-rooms `classic` (the paper's polling protocol) and `superframe` (TDMA), which use the radio;
what `monitors` finds.
Out: records, in one order, to the stream's socket and to the recording. `daemon` puts the parts together.
Nothing is exported: the command line imports `daemon`, `replay` and `stream_server` themselves.
"""
