"""One run of ``tsgt setup``: carries out the steps in turn, prints a line for each, and remembers the results."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from tsgt.cli.output import CHECK_FAILED, print_json
from tsgt.setup import Ran, SetupError, Step, System, carry_out

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.setup import Role

_COMMAND_TIMEOUT_S = 120.0
_NAME_WIDTH = 15


class SetupStopped(Exception):  # noqa: N818 (not an error: the steps have said why)
    """The setup cannot go on after a step."""


@dataclass(kw_only=True)
class Session:
    """Progress of a setup.

    Attributes
    ----------
    ask
        Whether the operator is there to answer questions.
    dry_run
        Whether changes are only printed.
    quiet
        Whether the result is printed as JSON.
    """

    system: System
    role: Role
    ask: bool
    dry_run: bool
    quiet: bool
    steps: dict[str, dict[str, Any]] = field(default_factory=dict)
    doctor: dict[str, Any] | None = None

    @property
    def changed(self) -> bool:
        """Whether a step has changed something, or would have."""
        return any(step["changed"] for step in self.steps.values())

    @property
    def ok(self) -> bool:
        """Whether all steps succeeded."""
        return all(step["ok"] for step in self.steps.values())

    def do(self, step: Step) -> bool:
        """Carry out a step and report it; return whether it changed something, or would."""
        ok, detail = step.ok, step.detail
        if step.ok and not self.dry_run:
            try:
                carry_out(self.system, step)
            except SetupError as error:
                ok, detail = False, str(error)
        changes = [str(change) for change in step.changes]
        self.report(step.name, ok=ok, detail=detail, changes=changes)
        if not ok:
            raise SetupStopped
        return bool(changes)

    def report(self, name: str, *, ok: bool, detail: str, changes: Sequence[str] = ()) -> None:
        """Print the result of a step."""
        self.steps[name] = {"ok": ok, "detail": detail, "changed": bool(changes), "changes": list(changes)}
        if not ok:
            label = click.style("FAILED ", bold=True, reverse=True)
        else:
            label = "ok     " if not changes else "would  " if self.dry_run else "changed"
        self.say(f"{label} {name:{_NAME_WIDTH}}{detail}")
        if self.dry_run:
            for change in changes:
                self.say(f"{'':8}{'':{_NAME_WIDTH}}- {change}")

    def fail(self, name: str, detail: str) -> NoReturn:
        """Report a failed step, after which the setup cannot go on."""
        self.report(name, ok=False, detail=detail)
        raise SetupStopped

    def say(self, text: str = "") -> None:
        """Print a line, unless the result is printed as JSON."""
        if not self.quiet:
            click.echo(text)

    def finish(self) -> int:
        """Print the result, and return the exit code."""
        if self.quiet:
            print_json(
                {
                    "role": self.role.word,
                    "ok": self.ok,
                    "changed": self.changed,
                    "dry_run": self.dry_run,
                    "steps": self.steps,
                    "doctor": self.doctor,
                }
            )
        else:
            failed = [name for name, step in self.steps.items() if not step["ok"]]
            if failed:
                self.say(
                    f"\nNot finished: {', '.join(failed)}. Correct that, and call the same command again."
                )
            elif self.dry_run:
                self.say("\nNothing was changed." if self.changed else "\nNothing would be changed.")
            elif self.changed:
                self.say(f"\nThis machine is set up as a {self.role.word}.")
            else:
                self.say(f"\nNothing was changed: this machine was set up as a {self.role.word} already.")
        return 0 if self.ok else CHECK_FAILED


def this_system(root: Path) -> System:
    """Return the system that this program runs on, or the image in a folder."""
    operator = os.environ.get("SUDO_USER")
    live = root.resolve() == Path("/")
    return System(
        root=root,
        uid=os.geteuid(),
        operator=operator if live and operator not in (None, "root") else None,
        python=sys.version_info[:2],
        run=_run,
        change_owner=os.chown if os.geteuid() == 0 else _keep_owner,
        live=live,
    )


def _keep_owner(path: Path, uid: int, gid: int) -> None:
    """Leave a file of an image to the user who prepares it: only root can give files away."""


def _run(arguments: Sequence[str]) -> Ran:
    program = shutil.which(arguments[0])
    if program is None:
        return Ran(127, f"{arguments[0]}: no such program")
    try:
        done = subprocess.run(
            [program, *arguments[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            check=False,
            timeout=_COMMAND_TIMEOUT_S,
        )
    except (OSError, subprocess.SubprocessError) as error:
        return Ran(126, str(error))
    return Ran(done.returncode, done.stdout)
