"""Print the poses of the stream, with Python's standard library only.

Usage: ``python follow_stream.py [/run/tsgt/poses.sock]``. The fields are documented in docs/reference/stream.md.
"""

from __future__ import annotations

import json
import socket
import sys


def follow(path: str) -> None:
    """Print valid poses, the reasons of invalid ones, and events, until the stream ends."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.connect(path)
        for line in connection.makefile("r", encoding="utf-8"):
            record = json.loads(line)
            if record["type"] == "hello" and record["protocol"] != 1:
                sys.exit(
                    f"the stream has protocol version {record['protocol']}, this program supports version 1"
                )
            if record["type"] == "setup":
                names = ", ".join(
                    f"station {station['id']} at {station['position_m']}" for station in record["stations"]
                )
                print(f"poses of {record['child_frame']} in {record['frame']}; {names}", flush=True)
            if record["type"] == "event":
                print(f"event: {record['message']}", flush=True)
            # Ignore all other types, also those of later versions.
            if record["type"] != "pose":
                continue
            # Each pose is streamed again a second and a few seconds later, smoothed; this program uses the prediction.
            if record["kind"] == "smoothed":
                continue
            if not record["valid"]:
                print(f"no pose: {record['reason']}", flush=True)
                continue
            x, y, z = record["position_m"]
            sigma_x_m = record["covariance"][0] ** 0.5
            print(
                f"{record['stamp_ns']} ns: {x:.3f} {y:.3f} {z:.3f} m, sigma of x {sigma_x_m:.4f} m",
                flush=True,
            )


if __name__ == "__main__":
    follow(sys.argv[1] if len(sys.argv) > 1 else "/run/tsgt/poses.sock")
