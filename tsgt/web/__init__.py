"""The operator's page: a process of its own that reads the stream and serves it to browsers; read-only.

In: the lines of the stream (`source`), or a recording (`recorded`, `replay`). Out: messages for the page (`live`, `messages`), five a
second, over HTTP (`server`, with the limits of `connections` and the rules of `access`). What the page shows is decided in
`mission`, which is sans-I/O; `page` holds the files that the browser gets, `foxglove` serves the Foxglove app.

The face exports nothing: the server needs aiohttp, the rest does not. No file here needs numpy.
"""
