"""The virtual machines of these tests; `make test-vm` runs them, nothing else does."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from vm import installation
from vm.guest import Guest, State, kvm_works
from vm.image import CACHE, ROOT, Image, image, missing_tools

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the set-up, which needs no saved state: meanwhile another worker makes them."""
    items.sort(key=lambda item: item.path.stem != "test_setup")


@pytest.fixture(scope="session")
def bare_image() -> Image:
    """Return Debian with our kernel module, without tsgt."""
    if missing := missing_tools():
        pytest.skip(f"no virtual machine: {missing}")
    with _lock():
        return image()


@pytest.fixture(scope="session")
def kvm(bare_image: Image) -> bool:
    """Whether guests run with KVM, in real time."""
    return kvm_works(bare_image)


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the program of this source tree."""
    return installation.build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="session")
def run_folder() -> Path:
    """Return an empty folder for the disks of guests, on a file system that has direct I/O."""
    folder = CACHE / "run" / os.environ.get("PYTEST_XDIST_WORKER", "one")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


@pytest.fixture(scope="session")
def ready(bare_image: Image, kvm: bool, wheel: Path, run_folder: Path) -> State:  # noqa: FBT001 (a fixture)
    """Return a guest that has booted, with the program and both services installed, but not started."""

    def prepare(guest: Guest) -> None:
        guest.start()
        installation.install_program(guest, wheel)
        installation.install_services(guest)
        installation.start_far_ends(guest)

    return _saved("ready", bare_image, kvm, run_folder, prepare)


@pytest.fixture(scope="session")
def running(bare_image: Image, kvm: bool, ready: State, run_folder: Path) -> State:  # noqa: FBT001 (a fixture)
    """Return a guest whose services have started; the instrument's adapter is not plugged in, as it cannot be saved."""

    def prepare(guest: Guest) -> None:
        guest.start(ready)
        guest.output("systemctl enable --now tsgt-master tsgt-client", 120)
        guest.wait("systemctl show -P StatusText tsgt-client | grep 'master . s ago'", 60)

    return _saved("running", bare_image, kvm, run_folder, prepare)


@pytest.fixture(scope="session")
def streaming(bare_image: Image, kvm: bool, running: State, run_folder: Path) -> State:  # noqa: FBT001 (a fixture)
    """Return a guest that measures, with the instrument behind a pseudo-terminal, so that all of it can be saved."""

    def prepare(guest: Guest) -> None:
        guest.start(running)
        guest.push(installation.client_config(installation.PSEUDO_TERMINAL).encode(), "/etc/tsgt/client.toml")
        guest.output("systemctl restart tsgt-client", 60)
        installation.wait_for_measurements(guest)

    return _saved("streaming", bare_image, kvm, run_folder, prepare)


@pytest.fixture(scope="module")
def guest(
    bare_image: Image,
    kvm: bool,  # noqa: FBT001 (a fixture)
    ready: State,
    run_folder: Path,
    request: pytest.FixtureRequest,
) -> Iterator[Guest]:
    """Yield a guest with the program installed; each file of tests has its own."""
    with Guest(bare_image, run_folder / request.path.stem, kvm=kvm) as guest:
        guest.start(ready)
        yield guest


@pytest.fixture(scope="module")
def measuring(
    bare_image: Image,
    kvm: bool,  # noqa: FBT001 (a fixture)
    running: State,
    run_folder: Path,
    request: pytest.FixtureRequest,
) -> Iterator[Guest]:
    """Yield a guest whose client measures, and whose master records it; each file of tests has its own."""
    with Guest(bare_image, run_folder / request.path.stem, kvm=kvm) as guest:
        guest.start(running)
        guest.plug_adapter()
        installation.wait_for_measurements(guest)
        yield guest


def _saved(
    name: str,
    bare_image: Image,
    kvm: bool,  # noqa: FBT001 (private)
    run_folder: Path,
    prepare: Callable[[Guest], None],
) -> State:
    """Return a guest as ``prepare`` leaves it, kept in the cache until the program changes."""
    folder = CACHE / f"{name}-{_content_hash(bare_image, kvm)}"
    with _lock():
        if folder.exists():
            return State(folder)
        for old in CACHE.glob(f"{name}-*"):
            shutil.rmtree(old)
        with Guest(bare_image, run_folder / name, kvm=kvm) as guest:
            prepare(guest)
            saved = guest.save(run_folder / f"saved-{name}")
        saved.folder.rename(folder)
    return State(folder)


@contextmanager
def _lock() -> Iterator[None]:
    """Let one worker at a time make what is kept in the cache."""
    CACHE.mkdir(exist_ok=True)
    with (CACHE / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _content_hash(bare_image: Image, kvm: bool) -> str:  # noqa: FBT001 (private)
    content = hashlib.sha256(f"{bare_image.folder.name} {kvm}".encode())
    names = ("installation.py", "inside/far_ends.py")
    here = [Path(__file__).parent / name for name in names]
    program = [*(ROOT / "tsgt").rglob("*"), *(ROOT / "configs").rglob("*")]
    for path in [*here, ROOT / "pyproject.toml", *sorted(program)]:
        if path.is_file() and "__pycache__" not in path.parts:
            content.update(f"{path.relative_to(ROOT)}\0".encode() + path.read_bytes())
    return content.hexdigest()[:12]
