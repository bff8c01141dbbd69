"""The guest's disk: Debian, our kernel module, a Python environment with what tsgt depends on, but not tsgt itself.

It is kept in ``.vm-cache``, in a folder named by a hash of all that it is made of, so that a change of the program
does not build it again.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
CACHE = ROOT / ".vm-cache"
INSIDE = Path(__file__).parent / "inside"

SUITE = "trixie"
PYTHON = "3.13"
"""That of the suite."""
MIRROR = "http://deb.debian.org/debian"
PACKAGES = [
    "systemd-sysv",
    "udev",
    "dbus",
    "kmod",
    "procps",
    "e2fsprogs",
    "python3",
    "python3-venv",
    "gpiod",
    "initramfs-tools",
    "zstd",
    "linux-image-amd64",
]
FOR_BUILDING = ["linux-headers-amd64", "gcc", "make", "python3-dev"]
"""Removed when the image is complete."""
EXTRAS = ("pi5",)
"""Those of tsgt that the guest has; ``pi`` would add RPi.GPIO, which no kernel since 6.6 gives interrupts."""
SIZE = "3G"
_DEBIAN = f"{SUITE} {PACKAGES} {FOR_BUILDING}"

TOOLS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "qemu-img": "qemu-utils",
    "mmdebstrap": "mmdebstrap",
    "mke2fs": "e2fsprogs",
    "debugfs": "e2fsprogs",
    "e2fsck": "e2fsprogs",
}
"""Debian packages by what is called."""


@dataclass(frozen=True, slots=True)
class Image:
    """A disk that is never written, and what boots it."""

    folder: Path

    @property
    def disk(self) -> Path:
        """Root file system, raw."""
        return self.folder / "root.img"

    @property
    def kernel(self) -> Path:
        """Linux."""
        return self.folder / "vmlinuz"

    @property
    def initrd(self) -> Path:
        """Initial file system."""
        return self.folder / "initrd.img"


def missing_tools() -> str:
    """Return one line with what has to be installed, empty if nothing."""
    packages = sorted(
        {name for tool, name in TOOLS.items() if not shutil.which(tool, path=tool_environment()["PATH"])}
    )
    return f"sudo apt install {' '.join(packages)}" if packages else ""


def image() -> Image:
    """Return the image, after building it if there is none of this content (some minutes, from Debian and PyPI)."""
    debian = CACHE / f"debian-{_hash(_DEBIAN)}.tar"
    ready = Image(CACHE / f"image-{_hash(_DEBIAN, PYTHON, SIZE, *_requirements(), *map(_text, _sources()))}")
    if not ready.folder.exists():
        started = time.monotonic()
        print(f"building {ready.folder.name} in .vm-cache: some minutes", file=sys.stderr, flush=True)  # noqa: T201
        CACHE.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=CACHE, prefix="building-") as folder:
            if not debian.exists():
                _bootstrap(Path(folder)).rename(debian)
            _build(Path(folder), debian).rename(ready.folder)
        print(f"built in {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)  # noqa: T201
    return ready


def _requirements() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    return [*project["dependencies"], *(each for extra in EXTRAS for each in extras[extra])]


def _sources() -> list[Path]:
    names = ["sxmock.c", "Kbuild", "agent.py", "agent.service", "prepare.sh", "make_disk.sh"]
    return [ROOT / "constraints.txt", *(INSIDE / name for name in names)]


def _text(path: Path) -> str:
    return path.read_text()


def _hash(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:12]


def _bootstrap(folder: Path) -> Path:
    """Return an archive of a root directory with the packages."""
    tar = folder / "debian.tar"
    _call(
        "mmdebstrap",
        "--variant=minbase",
        f"--include={','.join(PACKAGES + FOR_BUILDING)}",
        "--aptopt=Acquire::Languages none",
        "--dpkgopt=force-unsafe-io",
        "--dpkgopt=path-exclude=/usr/share/doc/*",
        "--dpkgopt=path-exclude=/usr/share/man/*",
        "--dpkgopt=path-exclude=/usr/share/locale/*",
        SUITE,
        str(tar),
        MIRROR,
    )
    return tar


def _build(folder: Path, debian: Path) -> Path:
    """Return a folder with disk, kernel and initial file system."""
    copied = folder / "vm"
    _download_wheels(copied / "wheels")
    for path in _sources():
        shutil.copy(path, copied)
    (copied / "requirements.txt").write_text("\n".join(_requirements()))
    result = folder / "image"
    result.mkdir()
    # Files belong to root and others: without being root, in a user namespace as mmdebstrap makes it.
    helper = [] if os.geteuid() == 0 else ["mmdebstrap", "--unshare-helper"]
    purged = " ".join(FOR_BUILDING)
    _call(
        *helper,
        "unshare",
        "--mount",
        "sh",
        str(INSIDE / "make_disk.sh"),
        str(debian),
        SIZE,
        purged,
        cwd=folder,
    )
    return result


def _download_wheels(folder: Path) -> None:
    """Download what tsgt depends on, for the guest's Python. spidev has no wheels: it is built in the guest."""
    folder.mkdir(parents=True)
    pip = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--disable-pip-version-check",
        "--dest",
        str(folder),
    ]
    built = [each for each in _requirements() if each.startswith("spidev")]
    others = [each for each in _requirements() if each not in built]
    constraints = ["--constraint", str(ROOT / "constraints.txt")]
    _call(*pip, *constraints, "--only-binary=:all:", f"--python-version={PYTHON}", *others, "setuptools")
    _call(*pip, "--no-deps", "--no-binary=:all:", *built)


def _call(*command: str, cwd: Path | None = None) -> None:
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=cwd, check=False, env=tool_environment()
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{command[0]} failed:\n{done.stdout.decode(errors='replace')[-3000:]}")


def tool_environment() -> dict[str, str]:
    """Return an environment in which the tools of a file system are found by those who are not root."""
    return {**os.environ, "PATH": f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"}
