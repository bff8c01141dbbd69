"""Posts one alarm to a web server: a program of its own, ``python -m tsgt.master.webhook``, which the master may kill.

In: one JSON object on stdin with ``url`` and ``body``, so that neither is in the list of processes. Out: exit code 0 if the
server has accepted it, else 1 with the reason on stdout. Redirects are not followed and proxies are not used: an alarm
goes where the configuration says, or nowhere.
"""

from __future__ import annotations

import http.client
import json
import ssl
import sys
from urllib.parse import urlsplit

import tsgt

TIMEOUT_S = 5.0  # of each step: connection, request, response


def main() -> int:
    """Post what stdin says; return the exit code."""
    request = json.loads(sys.stdin.buffer.read())
    problem = post(request["url"], request["body"].encode())
    if problem:
        print(problem)  # noqa: T201 (the reason for the master)
    return 1 if problem else 0


def post(url: str, body: bytes, timeout_s: float = TIMEOUT_S) -> str:
    """Post JSON to an address; return what went wrong, or an empty string."""
    parts = urlsplit(url)
    host = parts.hostname or ""
    connection = (
        http.client.HTTPSConnection(host, parts.port, timeout=timeout_s, context=ssl.create_default_context())
        if parts.scheme == "https"
        else http.client.HTTPConnection(host, parts.port, timeout=timeout_s)
    )
    target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    headers = {
        "Content-Type": "application/json",
        "User-Agent": f"tsgt/{tsgt.__version__}",
        "Connection": "close",
    }
    try:
        connection.request("POST", target, body, headers)
        response = connection.getresponse()
    except TimeoutError:
        return f"{host} has not responded within {timeout_s:g} s"
    except (OSError, http.client.HTTPException) as error:
        return f"{host} cannot be reached ({str(error) or type(error).__name__})"
    finally:
        connection.close()
    if response.status // 100 == 2:
        return ""
    if response.status // 100 == 3:
        return f"{host} redirects ({response.status}), which is not followed: give the final address"
    return f"{host} answers {response.status} {response.reason}"


if __name__ == "__main__":
    sys.exit(main())
