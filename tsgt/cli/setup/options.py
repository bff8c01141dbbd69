"""Options that a station and a master have in common, and how questions are asked."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from tsgt.cli.setup.session import Session, this_system

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.setup import Role, WiringSearch


class SpiDevice(click.ParamType[str]):
    """Name of an SPI device, also with its folder: ``/dev/spidev0.0``."""

    name = "spi device"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the name without the folder."""
        found = re.fullmatch(r"(?:/dev/)?(spidev[0-9]{1,3}\.[0-9]{1,3})", str(value))
        if found is None:
            self.fail(f"{value!r} is no SPI device such as spidev0.1", param, ctx)
        return found[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Common:
    """Options of both machines; ``antenna_gain_dbi``: None if not given."""

    root: Path
    yes: bool
    dry_run: bool
    as_json: bool
    antenna_gain_dbi: float | None
    licence: str | None
    replace_config: bool
    replace_key: bool
    search: WiringSearch

    def session(self, role: Role) -> Session:
        """Begin a setup."""
        return Session(
            system=this_system(self.root),
            role=role,
            ask=not self.yes and not self.as_json and sys.stdin.isatty(),
            dry_run=self.dry_run,
            quiet=self.as_json,
        )


def require_answers(session: Session, known: dict[str, object]) -> None:
    """Raise a usage error, before anything is changed, for options whose values are neither ``known`` nor can be asked for."""
    missing = [option for option, value in known.items() if value is None]
    if missing and not session.ask:
        raise click.UsageError(f"{', '.join(missing)}: needed with --yes, with --json, or without a terminal")


def answer(session: Session, given: Any, option: str, question: str, kind: Any, default: Any = None) -> Any:
    """Return the value of an option, or what the operator answers, or the default; a usage error without any."""
    if given is not None:
        return given
    if session.ask:
        return click.prompt(question, type=kind, default=default)
    if default is None:
        raise click.UsageError(f"{option} is needed: {question[:1].lower()}{question[1:]}")
    return default
