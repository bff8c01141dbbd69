"""The stream on another computer through ``ssh -L``, as the guide has it: two network namespaces."""

from __future__ import annotations

import getpass
import itertools
import re
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from harness.readers.network import (
    FOLLOW,
    PERIOD_NS,
    ROBOT_ADDRESS,
    Followed,
    Master,
    missing,
    network,
)

ROOT = Path(__file__).parents[3]
GUIDE = ROOT / "docs" / "how-to" / "use-poses-on-another-computer.md"
SSHD, SSH, KEYGEN = (
    shutil.which(name, path="/usr/sbin:/usr/bin") or "" for name in ("sshd", "ssh", "ssh-keygen")
)
REASON = missing() if SSHD and SSH and KEYGEN else "sshd is not installed (openssh-server)"
pytestmark = pytest.mark.skipif(bool(REASON), reason=REASON)

CONFIG = """
Port 22
ListenAddress {address}
HostKey {folder}/host_key
AuthorizedKeysFile {folder}/login_key.pub
PidFile none
StrictModes no
UsePAM no
PermitRootLogin prohibit-password
PasswordAuthentication no
KbdInteractiveAuthentication no
AllowStreamLocalForwarding local
ClientAliveInterval 1
ClientAliveCountMax 2
"""


def test_stream_through_ssh(tmp_path: Path) -> None:
    """Poses arrive; after a cut cable ssh ends, is started again, and the reader goes on with a gap."""
    for name in ("host_key", "login_key"):
        subprocess.run([KEYGEN, "-q", "-t", "ed25519", "-N", "", "-f", tmp_path / name], check=True)
    (tmp_path / "sshd_config").write_text(CONFIG.format(address=ROBOT_ADDRESS, folder=tmp_path))
    Path("/run/sshd").mkdir(exist_ok=True)
    remote, local = tmp_path / "robot.sock", tmp_path / "here.sock"
    command = re.search(r"^ +(ssh -N (?:.*\\\n)*.*)$", GUIDE.read_text(), flags=re.MULTILINE)
    assert command is not None
    arguments = shlex.split(command[1].replace("\\\n", " "))
    assert arguments[-1] == "pi@192.168.1.10"
    sockets = "/tmp/poses.sock:/run/tsgt/poses.sock"
    assert sockets in arguments
    options = [f"{local}:{remote}" if argument == sockets else argument for argument in arguments[1:-1]]
    test_only = f"-i {tmp_path}/login_key -o StrictHostKeyChecking=no -o UserKnownHostsFile=/dev/null -o LogLevel=ERROR -F none"
    ssh = [SSH, *test_only.split(), *options, f"{getpass.getuser()}@{ROBOT_ADDRESS}"]
    again = ["sh", "-c", f"while true; do {shlex.join(ssh)}; sleep 1; done"]
    with (
        network() as pair,
        Master(remote).running(),
        pair.start(pair.robot, [SSHD, "-D", "-e", "-f", str(tmp_path / "sshd_config")], tmp_path, "sshd"),
        pair.start(pair.reader, again, tmp_path, "ssh"),
        pair.start(pair.reader, [sys.executable, "-c", FOLLOW, str(local), ""], tmp_path, "reader") as reader,
    ):
        reader.wait_for_lines(40)
        pair.cable(plugged=False)
        time.sleep(12)
        pair.cable(plugged=True)
        reader.wait_for_lines(reader.lines() + 40)
    found = Followed.read(reader.output)
    assert found.gaps == [None]
    assert found.greetings == 2
    steps = [after - before for before, after in itertools.pairwise(found.stamps_ns)]
    assert sum(step != PERIOD_NS for step in steps) == 1
    assert max(steps) > 8_000_000_000
