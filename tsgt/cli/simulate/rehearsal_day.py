"""The day that is rehearsed, step by step: what to do, how it shows that it is done, and how a script does it."""

from __future__ import annotations

import asyncio
import os
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import click

from tsgt.errors import TsgtError
from tsgt.simulation.rehearsal import MOVED_TRIPOD, TARGETS

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable
    from pathlib import Path

    from tsgt.cli.calibrate.operator import Terminal
    from tsgt.cli.simulate.rehearsal_watch import Accuracy, Watch
    from tsgt.simulation.rehearsal import Site

STEP_TIMEOUT_S = 180.0
"""Of a step that a script plays, besides the drive; people have all the time that they need."""

HIDDEN, EMPTY, MOVED = 3, 1, MOVED_TRIPOD.station
"""Stations whose prism is hidden, whose battery ends, and whose tripod is moved."""

MIN_POSES = 40
"""Valid ones that a drive has to have; at 20 Hz, with gaps on a busy computer."""

_POLL_S = 0.1
_ANSWER_DELAY_S = 0.4
"""The helper aims meanwhile."""


@dataclass(slots=True)
class Incident:
    """Something that went wrong on purpose; times in s of the site."""

    what: str
    began_s: float
    noticed_s: float | None = None
    how: str = ""
    ended_s: float | None = None

    def text(self) -> str:
        """Return a line."""
        if self.noticed_s is None:
            return f"{self.what}: NOT NOTICED"
        over = "not over" if self.ended_s is None else f"over after {self.ended_s - self.began_s:.0f} s"
        return f"{self.what}: noticed after {self.noticed_s - self.began_s:.1f} s ({self.how}), {over}"

    def json(self) -> dict[str, Any]:
        """Return the incident for ``--json``."""
        return {
            "what": self.what,
            "noticed_after_s": None if self.noticed_s is None else self.noticed_s - self.began_s,
            "how": self.how,
            "over_after_s": None if self.ended_s is None else self.ended_s - self.began_s,
        }


@dataclass(slots=True)
class Day:
    """The day so far.

    Attributes
    ----------
    operator
        Waits for Enter; None: the script plays.
    parts
        Accuracy by part of the day.
    """

    site: Site
    watch: Watch
    folder: Path
    operator: Terminal | None
    drive_s: float
    incidents: list[Incident] = field(default_factory=list)
    parts: dict[str, Accuracy] = field(default_factory=dict)
    step: int = 0

    async def play(self, incidents: frozenset[str]) -> None:
        """Play from the morning to the debriefing; raises TsgtError if a script cannot finish a step."""
        await self._morning()
        await self._calibrate()
        await self._apply()
        await self._drive()
        for name, incident in (
            ("prism", self._hidden_prism),
            ("battery", self._empty_battery),
            ("tripod", self._moved_tripod),
        ):
            if name in incidents:
                await incident()

    async def _morning(self) -> None:
        await self._step(
            "Before the calibration",
            "The stations are set up and track the robot, which stands. The master has no station frames yet.",
            "Look at: `tsgt status` (NOT CALIBRATED: no poses), `tsgt doctor master.toml` (station_frames is a note), and the",
            "page of `tsgt web` at http://127.0.0.1:8023 (NO POSE, and why). Raw measurements are recorded already.",
            done=lambda: all(self.watch.measuring(station) for station in self.site.instruments),
            script=lambda: self._run_all(("status",), ("doctor", "master.toml"), accepted={0, 3}),
            look=True,
            look_first=True,
        )

    async def _calibrate(self) -> None:
        await self._collect("targets.csv", "Measure the targets")

    async def _collect(self, file: str, title: str) -> None:
        stop = (
            "The command that measures targets needs the radio, so the master has to stop:",
            "    ./systemctl stop tsgt-master",
        )
        await self._step(
            title,
            *(stop if self.watch.connected else ("The master is still stopped.",)),
            f"    tsgt calibrate collect --config master.toml --target-count {TARGETS} --target-constant-mm 0 --output {file}",
            "A helper at each tripod aims at the target that the command asks for; give him a second, then press Enter.",
            f"When all {TARGETS} targets of all stations are measured, press Enter once more, and start the master again:",
            "    ./systemctl start tsgt-master",
            done=lambda: self._complete(file) and self.watch.connected,
            script=lambda: self._script_collect(file),
        )

    async def _apply(self) -> None:
        await self._solve("targets.csv", "Solve the station frames, and have the running master use them")

    async def _solve(self, file: str, title: str) -> None:
        after_s = self.site.now_s()
        await self._step(
            title,
            f"    tsgt calibrate targets {file} --apply master.toml",
            "Look at the residuals (1 to 3 mm) and at the checks. The event setup_applied follows, and poses begin.",
            done=lambda: (
                self.watch.event({"setup_applied"}, after_s) is not None
                and self.watch.valid_since(after_s) > 0
                and all(self.watch.measuring(station) for station in self.site.instruments)
            ),
            script=lambda: self._run_all(("calibrate", "targets", file, "--apply", "master.toml")),
        )

    async def _drive(self) -> None:
        self.site.start_driving()
        began_s = self.site.now_s()
        self.site.drain_battery(EMPTY)
        await self._step(
            "Drive",
            "The robot drives. Look at the page: verdict GOOD, the track on the map, residuals of some millimetres.",
            f"`tsgt status --watch` is the same for a terminal. The battery of station {EMPTY} is getting low: a warning follows.",
            done=lambda: (
                self.site.now_s() - began_s > self.drive_s and self.watch.valid_since(began_s) > MIN_POSES
            ),
            script=lambda: self._run_all(("status",), accepted={0, 3}),
        )
        self._end_part("drive", began_s)

    async def _hidden_prism(self) -> None:
        self.site.hide_prism(HIDDEN)
        incident = self._begin(f"line of sight of station {HIDDEN} blocked")
        await self._step(
            "Something is wrong: find out what",
            "Look at the page or at `tsgt status`. When you know which station it is, send its helper:",
            "    ./helper clear STATION",
            done=lambda: self._measures_again(incident, HIDDEN),
            script=lambda: self._when_noticed(incident, f"clear {HIDDEN}"),
            watch=lambda: self._notice_silence(incident, HIDDEN),
        )

    async def _empty_battery(self) -> None:
        self.site.switch_off(EMPTY)
        incident = self._begin(f"battery of station {EMPTY} empty")
        await self._step(
            "Another station fails",
            "Look at the page or at `tsgt status`: which one, and what does it say about its instrument? Then:",
            "    ./helper battery STATION",
            "The instrument starts in five seconds, and the client connects to it and finds the prism by itself.",
            done=lambda: self._measures_again(incident, EMPTY),
            script=lambda: self._when_noticed(incident, f"battery {EMPTY}"),
            watch=lambda: self._notice_silence(incident, EMPTY),
        )

    async def _moved_tripod(self) -> None:
        self.site.move_tripod()
        incident = self._begin(f"tripod of station {MOVED} moved by 144 mm")

        def notice() -> None:
            alarm = self.watch.event({"layout_residual_high"}, incident.began_s)
            if alarm is not None and incident.noticed_s is None:
                incident.noticed_s = self.watch.site_s(alarm.stamp_ns)
                incident.how = "event layout_residual_high"

        await self._step(
            "Somebody has lifted a tripod out of his way",
            "Drive on until the page says that the prisms disagree with their layout (event layout_residual_high).",
            done=lambda: incident.noticed_s is not None,
            watch=notice,
        )
        assert incident.noticed_s is not None  # noqa: S101 (the step is over)
        self._end_part("tripod moved, before the alarm", incident.began_s, incident.noticed_s)
        await self._step(
            "Which tripod?",
            "Measure the targets of the suspect again. The master has to stop for that:",
            "    ./systemctl stop tsgt-master",
            f"    tsgt calibrate check --config master.toml --targets targets.csv --station {MOVED}",
            "Exit code 3 and HAS MOVED: now it is certain.",
            done=lambda: any(self.folder.glob("recordings/*.json")),
            script=self._script_check,
            look=True,
        )
        await self._collect("targets-2.csv", "Measure all targets again")
        await self._solve("targets-2.csv", "Use the new frames")
        incident.ended_s = began_s = self.site.now_s()
        await self._step(
            "Drive on",
            "Poses are right again. Look at the residuals on the page.",
            done=lambda: (
                self.site.now_s() - began_s > self.drive_s and self.watch.valid_since(began_s) > MIN_POSES
            ),
        )
        self._end_part("after the second calibration", began_s)

    # --- Parts and incidents -----------------------------------------------------------------------------------

    def _begin(self, what: str) -> Incident:
        incident = Incident(what, self.site.now_s())
        self.incidents.append(incident)
        return incident

    def _end_part(self, name: str, from_s: float, to_s: float | None = None) -> None:
        self.parts[name] = self.watch.accuracy(from_s, self.site.now_s() if to_s is None else to_s)

    def _notice_silence(self, incident: Incident, station: int) -> None:
        if incident.noticed_s is None and self.watch.connected and not self.watch.measuring(station):
            incident.noticed_s = self.site.now_s()
            status = self.watch.status
            found = None if status is None else next((s for s in status.stations if s.id == station), None)
            said = None if found is None else found.action_required
            if found is not None and not said and found.status is not None and not found.status.usable:
                said = found.status.value.replace("_", " ")
            incident.how = f"status of station {station}: {said or 'no measurement'}"

    def _measures_again(self, incident: Incident, station: int) -> bool:
        if incident.noticed_s is None or not self.watch.measuring(station):
            return False
        incident.ended_s = self.site.now_s()
        return True

    def _complete(self, file: str) -> bool:
        path = self.folder / file
        if not path.exists():
            return False
        rows = [line for line in path.read_text().splitlines() if line and not line.startswith("#")]
        return len(rows) > TARGETS * len(self.site.instruments)

    # --- One step ------------------------------------------------------------------------------------------------

    async def _step(
        self,
        title: str,
        *lines: str,
        done: Callable[[], bool],
        script: Callable[[], Awaitable[None]] | None = None,
        watch: Callable[[], None] = lambda: None,
        look: bool = False,
        look_first: bool = False,
    ) -> None:
        """Say what to do; return when it is done and, with ``look``, the operator has pressed Enter.

        ``look_first``: a script begins when it is done.
        """
        self.step += 1
        click.echo(f"\n=== {self.step}. {title}", err=True)
        for line in lines:
            click.echo(line, err=True)

        async def until_done() -> None:
            while True:
                watch()
                if done():
                    return
                await asyncio.sleep(_POLL_S)

        waiting = asyncio.create_task(until_done())
        limit_s = STEP_TIMEOUT_S + self.drive_s
        try:
            if self.operator is not None:
                await waiting
                if look:
                    await self.operator.ask("Enter goes on")
            else:
                async with asyncio.timeout(limit_s):
                    if look_first:
                        await waiting
                    if script is not None:
                        await script()
                    await waiting
        except TimeoutError:
            raise TsgtError(
                f"step {self.step} ({title}) has not ended within {limit_s:g} s; see the logs in {self.folder}"
            ) from None
        finally:
            waiting.cancel()
        click.echo(f"    done at {self.site.now_s():.0f} s", err=True)

    # --- The script ----------------------------------------------------------------------------------------------

    async def _run_all(
        self, *commands: tuple[str, ...], accepted: Iterable[int] = (0,), answers: bool = False
    ) -> None:
        for command in commands:
            await self._run(*command, accepted=frozenset(accepted), answers=answers)

    async def _run(self, *arguments: str, accepted: frozenset[int], answers: bool) -> None:
        """Run a command of tsgt in the folder, as an operator does; ``answers``: press Enter at each question."""
        click.echo(f"$ tsgt {' '.join(arguments)}", err=True)
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "tsgt", *arguments),
            cwd=self.folder,
            env={**os.environ, "TSGT_SOCKET": str(self.watch.socket)},
            stdin=asyncio.subprocess.PIPE if answers else asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        assert process.stdout is not None  # noqa: S101 (a pipe)
        said = b""
        try:
            while part := await process.stdout.read(4096):
                said += part
                if answers and said.endswith(b"> ") and process.stdin is not None:
                    await asyncio.sleep(_ANSWER_DELAY_S)
                    process.stdin.write(b"\n")
            code = await process.wait()
        except asyncio.CancelledError:
            process.kill()
            raise
        for line in said.decode(errors="replace").splitlines():
            click.echo(f"  {line}", err=True)
        if code not in accepted:
            raise TsgtError(f"tsgt {' '.join(arguments)} has ended with {code}")

    async def _script_collect(self, file: str) -> None:
        await self.site.order("stop")
        count = ("--target-count", str(TARGETS), "--target-constant-mm", "0")
        command = ("calibrate", "collect", "--config", "master.toml", *count, "--output", file)
        await self._run_all(command, answers=True)
        await self.site.order("start")

    async def _script_check(self) -> None:
        await self.site.order("stop")
        command = ("calibrate", "check", "--config", "master.toml", "--targets", "targets.csv")
        await self._run_all((*command, "--station", str(MOVED)), accepted=(3,), answers=True)

    async def _when_noticed(self, incident: Incident, order: str) -> None:
        while incident.noticed_s is None:  # noqa: ASYNC110 (the step has a timeout)
            await asyncio.sleep(_POLL_S)
        click.echo(f"$ ./helper {order}", err=True)
        await self.site.order(order)
