"""The command ``tsgt``: its sub-commands, imported on use, and the mapping from errors to exit codes.

Exit codes: 0 done, 1 failed with one line that says why, 2 usage or configuration, 3 ran but a check failed.
"""

from __future__ import annotations

import importlib
import io
import os
import sys
from typing import Any, NoReturn

import click

import tsgt
from tsgt.errors import ConfigError, TsgtError
from tsgt.log import configure_logging

GROUPS: dict[str, dict[str, tuple[str, str]]] = {
    "Field": {
        "setup": ("setup.group:setup", "Set up this machine as a station or as the master."),
        "doctor": ("doctor:doctor", "Check that this machine is ready for the field."),
        "config": ("config:config", "Check configuration and set-up files."),
        "calibrate": (
            "calibrate.group:calibrate",
            "Calibrate station frames, prism layout, latencies and IMU.",
        ),
        "status": ("live.status:status", "Show the status of the daemon on this machine."),
        "listen": ("live.listen:listen", "Print the pose stream as text."),
        "relay": ("live.relay:relay", "Serve the pose stream to other computers."),
        "web": ("live.web:web", "Serve the operator's page to browsers."),
        "imu": ("imu:imu", "Read an IMU for the master."),
        "atmosphere": ("atmosphere:atmosphere", "Set temperature and pressure of the instrument."),
    },
    "Desk": {
        "import": ("convert.importing:import_group", "Convert other formats to a recording."),
        "merge": ("convert.merge:merge", "Add the stations' journals to a recording."),
        "process": ("desk.process:process", "Compute poses from a recording."),
        "evaluate": ("desk.evaluate:evaluate", "Assess the accuracy of a recording."),
        "compare": ("desk.compare:compare", "Compare estimates of other programs with the reference."),
        "export": ("convert.exporting:export", "Convert a recording to TUM, CSV or MCAP."),
    },
    "Planning": {
        "analyse": ("analyse.group:analyse", "Study layouts, noise and GNSS receivers."),
        "radio": ("radio.group:radio", "Plan and test the radio channel."),
    },
    "Development": {
        "demo": ("simulate.demo:demo", "Run simulated stations and a master in real time."),
        "rehearse": ("simulate.rehearse:rehearse", "Rehearse a day in the field, indoors."),
        "simulate": ("simulate.command:simulate_command", "Simulate a mission in virtual time."),
        "replay": ("live.replay:replay", "Stream a recording again."),
    },
}
"""By heading of ``tsgt --help``: each command, where it is defined in this package, and its summary.

A module is imported only when its command is called, so that ``tsgt listen`` does not load scipy.
"""

COMMANDS = {name: entry for commands in GROUPS.values() for name, entry in commands.items()}


class LazyGroup(click.Group):
    """A group that imports a command by name when it is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 (click's signature)
        """Return the names of all commands, sorted."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 (as above)
        """Import a command; None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        module, attribute = COMMANDS[cmd_name][0].split(":")
        command = getattr(importlib.import_module(f"tsgt.cli.{module}"), attribute)
        assert isinstance(command, click.Command)  # noqa: S101 (our own table)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 (as above)
        """Write the commands by group, without importing them."""
        for heading, commands in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl([(name, summary) for name, (_, summary) in commands.items()])


HELP_OPTIONS: dict[str, Any] = {"help_option_names": ["-h", "--help"], "show_default": True}


@click.group(cls=LazyGroup, context_settings=HELP_OPTIONS)
@click.version_option(tsgt.__version__, prog_name="tsgt")
def cli() -> None:
    """Compute outdoor 6-DOF reference poses for robots from robotic total stations.

    Results go to stdout, logs to stderr. Exit codes: 0 done, 1 failed (one line says why), 2 usage or
    configuration, 3 ran but a check failed.
    """


def run(command: click.Command, arguments: list[str] | None = None) -> NoReturn:
    """Run a command and exit with the code of its outcome."""
    configure_logging()
    try:
        result = command.main(args=arguments, standalone_mode=False)
    except click.exceptions.Abort:
        click.echo("stopped", err=True)
        sys.exit(130)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except TsgtError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2 if isinstance(error, ConfigError) else 1)
    except MemoryError:
        click.echo("error: the memory is not sufficient for this input", err=True)
        sys.exit(1)
    except ValueError as error:
        if type(error).__name__ != "LinAlgError":  # of numpy, which most commands do not load
            raise
        click.echo(
            f"error: numerical failure ({error}): check the input for impossible sigmas, coordinates or distances",
            err=True,
        )
        sys.exit(1)
    except BrokenPipeError:
        # The reader of our output has ended (`tsgt ... | head`); Python would complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        if error.strerror is None:
            raise
        click.echo(f"error: {error.filename or 'cannot write the output'}: {error.strerror}", err=True)
        sys.exit(1)
    sys.exit(result if isinstance(result, int) else 0)


def main() -> NoReturn:
    """Entry point of the script ``tsgt``."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(
            errors="surrogateescape"
        )  # Names of files need not be text in the locale's encoding
    run(cli)
