"""The Debian package: what its scripts remove and leave, and that what setup installs is in the wheel."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "packaging" / "debian"
FILES = ROOT / "tsgt" / "setup" / "files"


def call(script: str, *arguments: str, root: Path) -> None:
    """Run a script of the package for the system in a folder, as ``dpkg --root`` does."""
    environment = {**os.environ, "DPKG_ROOT": str(root)}
    subprocess.run(["/bin/sh", str(SCRIPTS / script), *arguments], env=environment, check=True)


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """Return a system with an environment, an enabled service, a configuration and a recording."""
    for name in (
        "opt/.tsgt/aB3dE6/bin/tsgt",
        "etc/tsgt/client.toml",
        "var/lib/tsgt/station1.jsonl",
        "opt/tsgt-master/file",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "opt/tsgt").symlink_to("/opt/.tsgt/aB3dE6")
    wants = tmp_path / "etc/systemd/system/multi-user.target.wants"
    wants.mkdir(parents=True)
    (wants / "tsgt-client.service").symlink_to("/usr/lib/systemd/system/tsgt-client.service")
    return tmp_path


def names(root: Path) -> list[str]:
    """Return the names of all files and links of a system."""
    return sorted(
        str(path.relative_to(root)) for path in root.rglob("*") if path.is_file() or path.is_symlink()
    )


def test_removal_leaves_configuration_and_recordings(installed: Path) -> None:
    """Program and service are gone."""
    call("prerm", "remove", root=installed)
    call("postrm", "remove", root=installed)
    assert names(installed) == ["etc/tsgt/client.toml", "opt/tsgt-master/file", "var/lib/tsgt/station1.jsonl"]


def test_purge_leaves_recordings_alone(installed: Path) -> None:
    """They cannot be made again."""
    call("prerm", "remove", root=installed)
    call("postrm", "purge", root=installed)
    assert names(installed) == ["opt/tsgt-master/file", "var/lib/tsgt/station1.jsonl"]


def test_purge_leaves_nothing_without_recordings(installed: Path) -> None:
    """Not even their folder."""
    (installed / "var/lib/tsgt/station1.jsonl").unlink()
    call("prerm", "remove", root=installed)
    call("postrm", "purge", root=installed)
    assert names(installed) == ["opt/tsgt-master/file"]
    assert not (installed / "var/lib/tsgt").exists()


def test_upgrade_leaves_all_until_the_new_environment_is_ready(installed: Path) -> None:
    """The daemons run on meanwhile."""
    before = names(installed)
    call("prerm", "upgrade", "0.2.0", root=installed)
    call("postrm", "upgrade", "0.2.0", root=installed)
    assert names(installed) == before


@pytest.mark.parametrize("script", ["preinst", "postinst", "prerm", "postrm"])
def test_scripts_are_well_formed(script: str) -> None:
    """By the shell's own parser."""
    subprocess.run(["/bin/sh", "-n", str(SCRIPTS / script)], check=True)


@pytest.mark.parametrize(
    ("version", "code"), [("3.10", 1), ("3.11", 0), ("3.12", 1), ("3.13", 0), ("3.14", 1)]
)
def test_python_without_wheels_is_refused_before_anything_is_unpacked(
    tmp_path: Path, version: str, code: int
) -> None:
    """Those of the bundle are for the Pythons of Debian 12 and 13; a refusal later leaves half an installation."""
    python = tmp_path / "python3"
    found = tuple(map(int, version.split(".")))
    pretend = f"import sys; sys.version_info = {(*found, 0)}; exec(sys.stdin.read())"
    python.write_text(f"#!/bin/sh\nexec {sys.executable} -c '{pretend}'\n")
    python.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    ran = subprocess.run(["/bin/sh", str(SCRIPTS / "preinst"), "install"], env=environment, check=False)
    assert ran.returncode == code
    wheels = (ROOT / "packaging" / "bundle.py").read_text()
    assert (f'"{version}"' in wheels) == (code == 0)


def test_files_of_setup_are_in_the_wheel() -> None:
    """A machine has no clone to copy units and rules from."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    patterns = project["tool"]["setuptools"]["package-data"]["tsgt"]
    packed = {path for pattern in patterns for path in (ROOT / "tsgt").glob(pattern)}
    assert {path for path in FILES.rglob("*") if path.is_file()} <= packed


def test_bundle_has_the_extras_of_the_project() -> None:
    """Those that it names exist."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    postinst = (SCRIPTS / "postinst").read_text()
    assert {"pi5", "web"} <= set(project["optional-dependencies"])
    assert "'tsgt[pi5,web]'" in postinst
