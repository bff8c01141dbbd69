"""Checks of the daemons' network, and of what the master starts and calls: commands of geofences and alarms, webhook."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from tsgt.doctor.computer import hides, is_installed
from tsgt.doctor.finding import failed, note, ok

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tsgt.config import AlarmsConfig, GeofenceConfig, TcpAddress
    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine

_CLIENT_DROP_IN = "/etc/systemd/system/tsgt-client.service.d/network-instrument.conf"
_BUNDLE = "(in a clone, or in /usr/share/doc/tsgt)"
_DROP_IN = (
    f"sudo systemctl edit tsgt-master, and add the lines of docs/how-to/send-alarms.md {_BUNDLE}, step 2"
)


def check_geofence_commands(
    machine: Machine, fences: Sequence[GeofenceConfig], service: Mapping[str, str] | None
) -> list[Finding]:
    """Check that the commands of the geofences can be started. None configured: no finding."""
    commands = {fence.name: fence.command for fence in fences if fence.command}
    problems = {name: _why_not_started(machine, command, service) for name, command in commands.items()}
    wrong = [f"geofence {name}: {problem}" for name, problem in problems.items() if problem]
    programs = ", ".join(sorted({command[0] for command in commands.values()}))
    if wrong:
        return [failed("geofence_command", "; ".join(wrong))]
    return [ok("geofence_command", f"can be started: {programs}")] if commands else []


def check_alarms(
    machine: Machine, config: AlarmsConfig | None, service: Mapping[str, str] | None
) -> list[Finding]:
    """Check that the command of the alarms can be started, and that the service may reach the web server."""
    found: list[Finding] = []
    if config is not None and config.command:
        problem = _why_not_started(machine, config.command, service)
        found.append(
            failed("alarms_command", problem)
            if problem
            else ok("alarms_command", f"can be started: {config.command[0]}")
        )
    if config is not None and config.webhook is not None:
        found.append(_check_webhook(machine, config.webhook, service))
    return found


def check_instrument_network(address: TcpAddress, service: Mapping[str, str] | None) -> Finding:
    """Check that the service may connect to an instrument in the network."""
    if service is not None and is_installed(service) and (denied := _denied_network(service)):
        return failed(
            "instrument_network",
            f"the sandbox of the service denies the network ({denied}): sudo install -D -m 644"
            f" configs/systemd/network-instrument.conf {_CLIENT_DROP_IN} {_BUNDLE}, then sudo systemctl daemon-reload",
        )
    return ok("instrument_network", f"the client may connect to {address}")


def _why_not_started(machine: Machine, command: Sequence[str], service: Mapping[str, str] | None) -> str:
    """Return why the daemon cannot start a command; empty if it can."""
    program = command[0]
    found = machine.which(program)
    if found is None:
        return f"the program {program} does not exist or is not executable"
    if hides(service, Path(found)):
        return f"the sandbox of the service hides {found}: put it under /usr/local/bin"
    return ""


def _check_webhook(machine: Machine, url: str, service: Mapping[str, str] | None) -> Finding:
    """Connect to the web server, without a request: nobody gets an alarm. Its path and query are secrets."""
    host = urlsplit(url).hostname or ""
    if service is not None and is_installed(service) and (denied := _denied_network(service)):
        return failed(
            "alarms_webhook", f"the sandbox of the service denies the network ({denied}): {_DROP_IN}"
        )
    if problem := machine.reach(url):
        return note("alarms_webhook", f"{host}: {problem}; alarms are lost while it is not reached")
    text = f"{host} is reached"
    if urlsplit(url).scheme == "http":
        return note(
            "alarms_webhook",
            f"{text}, without encryption: everybody on the way can read the address and alarms",
        )
    return ok("alarms_webhook", f"{text}, and its certificate is valid; nothing was sent")


def _denied_network(service: Mapping[str, str]) -> str:
    """Return the setting of the unit that keeps it from the internet; empty for none."""
    if service.get("PrivateNetwork") == "yes":
        return "PrivateNetwork=yes"
    families = service.get("RestrictAddressFamilies", "").split()
    if families and not families[0].startswith("~") and not {"AF_INET", "AF_INET6"} & set(families):
        return f"RestrictAddressFamilies={' '.join(families)}"
    everything = {"any", "0.0.0.0/0", "::/0"}
    denied = everything & set(service.get("IPAddressDeny", "").split())
    local = {"localhost", "127.0.0.0/8", "::1/128"}
    if denied and not set(service.get("IPAddressAllow", "").split()) - local:
        return "IPAddressDeny=any"
    return ""
