"""Build the offline bundle: a Debian package per architecture, with tsgt and everything that it needs as wheels.

    python packaging/bundle.py [--output DIR] [--pythons 3.11,3.13] [ARCHITECTURE...]

An architecture is one of Debian's: arm64, a Raspberry Pi with a 64-bit system, or amd64, a PC. Installing the package makes
the Python environment /opt/tsgt from the wheels, without a network and without a compiler. Needs dpkg-deb, and the network
for the wheels of PyPI and for Debian's spidev, which has no wheels there.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import urllib.request
import zipfile
from base64 import urlsafe_b64encode
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
HERE = Path(__file__).parent
MIRROR = "http://deb.debian.org/debian/pool/main/s/spidev/"
EXTRAS = ("pi5", "web")
"""Those of tsgt that a machine in the field needs; gpiod is enough for every Pi."""
PYTHONS = ("3.11", "3.13")
"""Those of Debian and Raspberry Pi OS 12 (bookworm) and 13 (trixie)."""
GLIBC = (17, 24, 26, 27, 28, 31, 34, 35, 36)
"""Minor versions of the platform tags that fit Debian 12, which has glibc 2.36."""


@dataclass(frozen=True, slots=True)
class SpidevPackage:
    """A Debian package with spidev compiled for one Python."""

    name: str
    sha256: str


MACHINES = {"arm64": "aarch64", "amd64": "x86_64"}
"""The kernel's name of each architecture."""

SPIDEV = {
    ("arm64", "3.11"): SpidevPackage(
        "python3-spidev_3.6-1+b1_arm64.deb",
        "25e2183301814ef81718e8b8e02b50bae40fed2107bf08548f1e32150057f1bc",
    ),
    ("amd64", "3.11"): SpidevPackage(
        "python3-spidev_3.6-1+b1_amd64.deb",
        "377dae28429bfc2f38c20c7ebe11ab88d3b4be85db2108fe41691ffea40b6fcc",
    ),
    ("arm64", "3.13"): SpidevPackage(
        "python3-spidev_3.6-1+b6_arm64.deb",
        "eb65bc09fc45cc76a612d1581cd29a2084f9e4b90926a0b2257f6e216303c1f1",
    ),
    ("amd64", "3.13"): SpidevPackage(
        "python3-spidev_3.6-1+b5_amd64.deb",
        "91e6088ca391fb09a74eb4a1b999dc7e6035189ed3c534c304d6f9afcaf70df9",
    ),
}
"""Of Debian 12 and 13."""


def main() -> None:
    """Build the bundle of each architecture."""
    parser = argparse.ArgumentParser(description="Build the offline bundle.")
    parser.add_argument("architectures", nargs="*", default=["arm64", "amd64"], metavar="ARCHITECTURE")
    parser.add_argument("--output", type=Path, default=ROOT / "dist")
    parser.add_argument("--pythons", type=lambda text: text.split(","), default=list(PYTHONS))
    given = parser.parse_args()
    for architecture in given.architectures:
        if architecture not in MACHINES:
            parser.error(
                f"{architecture}: one of {', '.join(MACHINES)}; there are no wheels for 32-bit systems"
            )
    given.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        own = own_wheel(Path(folder))
        for architecture in given.architectures:
            package = build(Path(folder) / architecture, own, architecture, given.pythons, given.output)
            print(f"{package}  {package.stat().st_size / 1e6:.0f} MB", flush=True)


def own_wheel(folder: Path) -> Path:
    """Build the wheel of tsgt, without leaving anything in the clone."""
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "tsgt", source / "tsgt", ignore=shutil.ignore_patterns("__pycache__"))
    _pip("wheel", "--no-deps", "--wheel-dir", str(folder), str(source))
    (wheel,) = folder.glob("tsgt-*.whl")
    return wheel


def build(folder: Path, own: Path, architecture: str, pythons: list[str], output: Path) -> Path:
    """Build the package of one architecture."""
    wheels = folder / "usr/share/tsgt/wheels"
    wheels.mkdir(parents=True)
    shutil.copy(own, wheels)
    for python in pythons:
        _download(wheels, architecture, python)
        _spidev_wheel(wheels, architecture, python)
    (wheels / "pythons").write_text("".join(f"{python}\n" for python in pythons))
    _system_files(folder)
    control = folder / "DEBIAN"
    control.mkdir()
    version = own.name.split("-")[1]
    text = (HERE / "debian/control").read_text()
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) // 1024
    for old, new in {"VERSION": version, "ARCHITECTURE": architecture, "SIZE": str(size)}.items():
        text = text.replace(f"@{old}@", new)
    (control / "control").write_text(text)
    for script in ("preinst", "postinst", "prerm", "postrm"):
        target = control / script
        shutil.copy(HERE / "debian" / script, target)
        target.chmod(0o755)
    for path in folder.rglob("*"):
        if not path.is_symlink() and path.parent != control:
            path.chmod(0o755 if path.is_dir() else 0o644)
    package = output / f"tsgt_{version}_{architecture}.deb"
    # Wheels are compressed already.
    _call("dpkg-deb", "--root-owner-group", "-Znone", "--build", str(folder), str(package))
    return package


def _download(wheels: Path, architecture: str, python: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    needed = [*project["dependencies"], *(each for extra in EXTRAS for each in extras[extra])]
    machine = MACHINES[architecture]
    platforms = [f"manylinux_2_{minor}_{machine}" for minor in GLIBC] + [f"manylinux2014_{machine}"]
    _pip(
        "download",
        "--dest",
        str(wheels),
        "--only-binary=:all:",
        "--implementation=cp",
        f"--python-version={python}",
        *(f"--platform={platform}" for platform in platforms),
        "--constraint",
        str(ROOT / "constraints.txt"),
        "pip",
        *(each for each in needed if not each.startswith("spidev")),
    )


def _spidev_wheel(wheels: Path, architecture: str, python: str) -> None:
    """Make a wheel of what Debian compiled."""
    package = SPIDEV[architecture, python]
    with urllib.request.urlopen(MIRROR + package.name, timeout=60) as reply:  # noqa: S310 (a fixed address)
        content = reply.read()
    if hashlib.sha256(content).hexdigest() != package.sha256:
        raise SystemExit(f"{MIRROR}{package.name} is not the package that this script knows")
    version, tag = "3.6", f"cp{python.replace('.', '')}"
    wheel_tag = f"{tag}-{tag}-linux_{MACHINES[architecture]}"
    with tempfile.TemporaryDirectory() as folder:
        deb, tree = Path(folder) / package.name, Path(folder) / "tree"
        deb.write_bytes(content)
        _call("dpkg-deb", "-x", str(deb), str(tree))
        (library,) = tree.glob("usr/lib/python3/dist-packages/*.so")
        about = next(tree.glob("usr/lib/python3/dist-packages/*/PKG-INFO")).read_bytes()
        licence = (tree / "usr/share/doc/python3-spidev/copyright").read_bytes()
        info = f"spidev-{version}.dist-info"
        files = {
            library.name: library.read_bytes(),
            f"{info}/METADATA": about,
            f"{info}/WHEEL": f"Wheel-Version: 1.0\nGenerator: tsgt\nRoot-Is-Purelib: false\nTag: {wheel_tag}\n".encode(),
            f"{info}/licenses/copyright": licence,
        }
    record = [
        f"{name},sha256={urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b'=').decode()},{len(data)}\n"
        for name, data in files.items()
    ]
    files[f"{info}/RECORD"] = "".join([*record, f"{info}/RECORD,,\n"]).encode()
    with zipfile.ZipFile(wheels / f"spidev-{version}-{wheel_tag}.whl", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data)


def _system_files(folder: Path) -> None:
    """Put the program on the PATH, and the units, rules and pages where a package has them."""
    files = ROOT / "tsgt/setup/files"
    for kind, where in {
        "systemd": "usr/lib/systemd/system",
        "udev": "usr/lib/udev/rules.d",
        "sysusers": "usr/lib/sysusers.d",
        "journald": "usr/lib/systemd/journald.conf.d",
    }.items():
        target = folder / where
        target.mkdir(parents=True)
        for path in (files / kind).iterdir():
            if kind != "systemd" or path.suffix == ".service":  # the others are drop-ins for some machines
                shutil.copy(path, target)
    documents = folder / "usr/share/doc/tsgt"
    shutil.copytree(ROOT / "docs", documents / "docs", ignore=shutil.ignore_patterns("*.png", "*.svg"))
    shutil.copytree(ROOT / "configs", documents / "configs")
    shutil.copy(ROOT / "LICENSE", documents / "copyright")
    programs = folder / "usr/bin"
    programs.mkdir(parents=True)
    (programs / "tsgt").symlink_to("/opt/tsgt/bin/tsgt")


def _pip(*arguments: str) -> None:
    _call(sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", *arguments)


def _call(*command: str) -> None:
    done = subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
        text=True,
        env={**os.environ, "PIP_NO_INPUT": "1"},
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(command[:4])} failed:\n{done.stdout[-3000:]}")


if __name__ == "__main__":
    main()
