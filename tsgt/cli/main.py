"""The command ``tsgt``: its sub-commands, loaded when called, and how errors become exit codes.

Exit codes: 0 done, 1 failed with one line that says why, 2 usage or configuration, 3 ran but a check failed.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import NoReturn

import click

import tsgt
from tsgt.errors import ConfigError, TsgtError
from tsgt.log import configure_logging

# Where each command lives. A command's module is imported only when it is called or asked for help, so that
# `tsgt listen` on a small computer does not load scipy.
COMMANDS = {
    "analyse": "tsgt.cli.analyse.group:analyse",
    "atmosphere": "tsgt.cli.atmosphere:atmosphere",
    "calibrate": "tsgt.cli.calibrate.group:calibrate",
    "config": "tsgt.cli.config:config",
    "demo": "tsgt.cli.simulate.demo:demo",
    "doctor": "tsgt.cli.doctor:doctor",
    "evaluate": "tsgt.cli.desk.evaluate:evaluate",
    "export": "tsgt.cli.exporting:export",
    "import": "tsgt.cli.importing:import_group",
    "listen": "tsgt.cli.live:listen",
    "merge": "tsgt.cli.merge:merge",
    "process": "tsgt.cli.desk.process:process",
    "radio": "tsgt.cli.radio.group:radio",
    "replay": "tsgt.cli.live:replay",
    "status": "tsgt.cli.status:status",
    "simulate": "tsgt.cli.simulate.command:simulate_command",
}


class LazyGroup(click.Group):
    """A group whose commands are imported by name when they are needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 (click's signature)
        """Names of all commands, sorted."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 (as above)
        """Import one command; None where there is none of that name."""
        target = COMMANDS.get(cmd_name)
        if target is None:
            return None
        module, attribute = target.split(":")
        command = getattr(importlib.import_module(module), attribute)
        assert isinstance(command, click.Command)  # noqa: S101 (our own table)
        return command


HELP_OPTIONS = {"help_option_names": ["-h", "--help"]}


@click.group(cls=LazyGroup, context_settings=HELP_OPTIONS)
@click.version_option(tsgt.__version__, prog_name="tsgt")
def cli() -> None:
    """Outdoor 6-DOF reference poses for robots, from robotic total stations.

    Results go to stdout, logs to stderr. Exit codes: 0 done, 1 failed (one line says why), 2 usage or
    configuration, 3 ran but a check failed.
    """


def run(command: click.Command, arguments: list[str] | None = None) -> NoReturn:
    """Run a command and end the process with the exit code that its outcome deserves."""
    configure_logging()
    try:
        result = command.main(args=arguments, standalone_mode=False)
    except click.exceptions.Abort:
        click.echo("stopped", err=True)
        sys.exit(130)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except ConfigError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)
    except TsgtError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(1)
    except BrokenPipeError:
        # The reader of our output went away (`tsgt ... | head`); Python must not complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        if error.strerror is None:
            raise
        click.echo(f"error: {error.filename or 'the output cannot be written'}: {error.strerror}", err=True)
        sys.exit(1)
    sys.exit(result if isinstance(result, int) else 0)


def main() -> NoReturn:
    """Entry point of the script ``tsgt``."""
    run(cli)
