"""The system that is set up: a machine, or a folder with its root file system; steps, and how they are carried out."""

from __future__ import annotations

import os
import secrets
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from tsgt.errors import TsgtError
from tsgt.recording import sync_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_ROOT = Path("/")


class SetupError(TsgtError):
    """A change of the system that failed."""


class Ran(NamedTuple):
    """Exit code and output of a command."""

    code: int
    output: str


@dataclass(frozen=True, slots=True, kw_only=True)
class System:
    """A machine, or an image of one.

    Attributes
    ----------
    root
        Folder of its root file system; ``/`` is the running machine, any other folder an image without devices and services.
    uid
        User id of this process.
    operator
        User who called ``sudo``; None: nobody but root.
    python
        Version of the Python that runs this.
    run
        Runs a command and returns its exit code and output; 127 if it does not exist.
    change_owner
        As :func:`os.chown`.
    """

    root: Path = _ROOT
    uid: int
    operator: str | None = None
    python: tuple[int, int]
    run: Callable[[Sequence[str]], Ran]
    change_owner: Callable[[Path, int, int], None] = os.chown
    live: bool = True

    def path(self, name: str) -> Path:
        """Return the path of a file of the system, given by its absolute name there."""
        return self.root / name.lstrip("/")

    def read(self, name: str) -> str | None:
        """Return the text of a file; None if it does not exist or cannot be read."""
        try:
            return self.path(name).read_text(encoding="utf-8", errors="replace")
        except OSError:
            return None

    def user_id(self, name: str) -> tuple[int, int] | None:
        """Return user id and group id of a user of the system."""
        for fields in self._entries("/etc/passwd"):
            if fields[0] == name and len(fields) > 3:
                return int(fields[2]), int(fields[3])
        return None

    def group_members(self, name: str) -> set[str] | None:
        """Return the members of a group, without those who have it as primary group; None without such a group."""
        for fields in self._entries("/etc/group"):
            if fields[0] == name:
                return set(fields[3].split(",")) - {""} if len(fields) > 3 else set()
        return None

    def _entries(self, name: str) -> list[list[str]]:
        return [line.split(":") for line in (self.read(name) or "").splitlines() if ":" in line]


def _make_folder(folder: Path) -> None:
    """Make a folder that everybody may enter, whatever the umask of the caller, which sudo keeps."""
    if not folder.exists():
        _make_folder(folder.parent)
        folder.mkdir()
        folder.chmod(0o755)


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoveFile:
    """Remove a file."""

    name: str

    def __str__(self) -> str:
        return f"remove {self.name}"

    def carry_out(self, system: System) -> None:
        """Remove it; raises SetupError."""
        try:
            system.path(self.name).unlink()
        except OSError as error:
            raise SetupError(f"{self.name} cannot be removed: {error.strerror}") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class WriteFile:
    """Write a file completely or not at all.

    ``mode``: None keeps what the file system gives, as a boot partition knows no modes. ``owner``: a user of the system.
    """

    name: str
    text: str
    mode: int | None = 0o644
    owner: str = "root"

    def __str__(self) -> str:
        return f"write {self.name}"

    def carry_out(self, system: System) -> None:
        """Write it; raises SetupError."""
        path = system.path(self.name)
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
        try:
            _make_folder(path.parent)
            descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(self.text)
                file.flush()
                if self.mode is not None:
                    owner = (0, 0) if self.owner == "root" else system.user_id(self.owner)
                    if owner is None:
                        raise SetupError(f"{self.name}: there is no user {self.owner}")
                    os.fchmod(file.fileno(), self.mode)
                    system.change_owner(temporary, *owner)
                os.fsync(file.fileno())
            temporary.replace(path)
            sync_folder(path)
        except OSError as error:
            raise SetupError(f"{self.name} cannot be written: {error.strerror}") from error
        finally:
            temporary.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class RunCommand:
    """Run a command of the system.

    ``live``: only on the running machine, not for an image. ``required``: whether a failure ends the setup. ``failure``:
    what to say then; empty: the last line of its output.
    """

    arguments: tuple[str, ...]
    live: bool = False
    required: bool = True
    failure: str = ""

    def __str__(self) -> str:
        return f"run {' '.join(self.arguments)}"

    def carry_out(self, system: System) -> None:
        """Run it; raises SetupError if it fails."""
        if self.live and not system.live:
            return
        ran = system.run(self.arguments)
        if ran.code != 0 and self.required:
            said = ran.output.strip().splitlines()[-1:] or [f"exit code {ran.code}"]
            raise SetupError(self.failure or f"{' '.join(self.arguments)}: {said[0]}")


Change = WriteFile | RemoveFile | RunCommand


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A step of the setup: what was found, and what has to be changed.

    Attributes
    ----------
    name
        Name, as in ``--json``.
    ok
        Whether the setup may go on; otherwise ``detail`` says what to do.
    detail
        One line for the operator.
    changes
        What has to be done; nothing: it is right already.
    """

    name: str
    ok: bool = True
    detail: str
    changes: tuple[Change, ...] = field(default=())


def carry_out(system: System, step: Step) -> None:
    """Make the changes of a step, in their order; raises SetupError at the first that fails."""
    for change in step.changes:
        change.carry_out(system)
