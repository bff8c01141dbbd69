"""Installs the program in a guest as docs/how-to/install-for-the-field.md says, and what stands at the far ends of its wires."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from vm.guest import ADAPTER_PORT
from vm.image import INSIDE, ROOT

if TYPE_CHECKING:
    from vm.guest import Guest

PACKAGE = ("pyproject.toml", "README.md", "LICENSE", "tsgt")
"""What a wheel is built from."""

FAR_ENDS = """\
[Unit]
Description=Far ends of the wires
[Service]
ExecStartPre=/usr/sbin/modprobe sxmock count=4
ExecStart=/opt/tsgt/bin/python /usr/local/lib/far_ends.py
StandardOutput=file:/run/far_ends.log
StandardError=file:/run/far_ends.log
[Install]
WantedBy=multi-user.target
"""


PSEUDO_TERMINAL = "/run/instrument.tty"
"""A second instrument, behind no adapter."""


def build_wheel(folder: Path, *, version: str | None = None) -> Path:
    """Return a wheel of this source tree, perhaps with another version number."""
    with tempfile.TemporaryDirectory() as copy:
        for name in PACKAGE:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, Path(copy, name), ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, copy)
        if version is not None:
            face = Path(copy, "tsgt", "__init__.py")
            face.write_text(re.sub(r'__version__ = ".*"', f'__version__ = "{version}"', face.read_text()))
        pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps"]
        subprocess.run([*pip, "--wheel-dir", folder, copy], check=True)
    (wheel,) = folder.glob("tsgt-*.whl")
    return wheel


def install_program(guest: Guest, wheel: Path) -> None:
    """Install tsgt in /opt/tsgt; the image has what it depends on."""
    guest.push(wheel, f"/root/{wheel.name}")
    guest.output(
        f"/opt/tsgt/bin/pip install --quiet --no-index --no-deps --force-reinstall /root/{wheel.name}", 120
    )


def start_far_ends(guest: Guest) -> None:
    """Start what stands at the far ends, now and at each boot."""
    guest.push(INSIDE / "far_ends.py", "/usr/local/lib/far_ends.py")
    guest.push(FAR_ENDS.encode(), "/etc/systemd/system/far-ends.service")
    guest.output("systemctl daemon-reload && systemctl enable --now far-ends")
    guest.wait("grep ready /run/far_ends.log", 60)


def install_services(guest: Guest) -> None:
    """Do steps 1, 3 and 4 of the guide for both daemons, with the examples' configurations and the units unchanged."""
    guest.output(
        "for group in spi gpio dialout; do groupadd --force --system $group; done; "
        "useradd --system --user-group --groups spi,gpio,dialout --home-dir /var/lib/tsgt --no-create-home "
        "--shell /usr/sbin/nologin tsgt"
    )
    for name in ("tsgt-client.service", "tsgt-master.service"):
        guest.push(ROOT / "configs" / "systemd" / name, f"/etc/systemd/system/{name}")
    guest.push(ROOT / "configs" / "udev" / "60-tsgt.rules", "/etc/udev/rules.d/60-tsgt.rules")
    guest.push(client_config().encode(), "/etc/tsgt/client.toml")
    guest.push(master_config().encode(), "/etc/tsgt/master.toml")
    for name in ("station_frames.example.toml", "prism_layout.example.toml"):
        guest.push(ROOT / "configs" / name, f"/etc/tsgt/{name}")
    guest.output(
        "/opt/tsgt/bin/tsgt radio key /root/mission.key && "
        "install -o tsgt -g tsgt -m 600 /root/mission.key /etc/tsgt/radio.key && rm /root/mission.key"
    )
    # The recordings have a disk of their own, whose power is cut, and which fills up.
    guest.output(
        "mkdir -p /var/lib/tsgt && echo 'LABEL=data /var/lib/tsgt ext4 defaults 0 2' >> /etc/fstab && "
        "mount /var/lib/tsgt && chown tsgt:tsgt /var/lib/tsgt"
    )
    guest.output("udevadm control --reload && udevadm trigger && systemctl daemon-reload")


def wait_for_measurements(guest: Guest, count: int = 3, timeout_s: float = 60) -> None:
    """Wait until the master has recorded some further measurements."""
    recorded = 'cat /var/lib/tsgt/master-*.jsonl | grep -c \'"type":"measurement"\''
    before = int(guest.run(recorded).out)
    guest.wait(f"[ $({recorded}) -ge {before + count} ]", timeout_s)


def client_config(port: str = ADAPTER_PORT) -> str:
    """Return the example's configuration of a client with a port of the guest."""
    return _changed("client.example.toml", {"port": f'"{port}"'})


def master_config() -> str:
    """Return the example's configuration of a master at the second bus; of its three stations one exists."""
    text = _changed("master.example.toml", {"spi_bus": "1"})
    return text.replace("[radio.wiring]", '[radio.wiring]\ngpio_chip = "/dev/gpiochip1"')


def _changed(name: str, values: dict[str, str]) -> str:
    """Return an example's configuration with other values of some keys, each of which it must have once."""
    lines = (ROOT / "configs" / name).read_text().splitlines()
    for key, value in values.items():
        (number,) = (n for n, line in enumerate(lines) if line.startswith(f"{key} = "))
        lines[number] = f"{key} = {value}"
    return "\n".join(lines) + "\n"
