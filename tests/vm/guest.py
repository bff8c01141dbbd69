"""A virtual machine: start it, run commands in it, pull its plugs, kill it, save it and go on from there.

    with Guest(image(), folder) as guest:
        guest.start()
        assert guest.run("uname -r", timeout_s=10).code == 0

Without KVM the guest's time follows its instructions (one per nanosecond), so that the radio protocol keeps its times
however slow the host is: a second of a busy guest takes some ten seconds here. Timeouts are in the guest's time.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import socket
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Self

from vm.image import tool_environment

if TYPE_CHECKING:
    from pathlib import Path

    from vm.image import Image

BOOT_TIME = datetime(2026, 11, 20, 8, tzinfo=UTC)
"""Of the guest's clock when it is switched on."""

MEMORY_MIB = 1024
DATA_MIB = 128
SLOWDOWN = 40
"""Time of the host over time of the guest, at most; more is a hung guest."""
BOOT_S = 60
KVM_PROBE_S = 10
ADAPTER_PORT = "/dev/serial/by-id/usb-QEMU_QEMU_USB_SERIAL_VM0001-if00-port0"
"""Of the FTDI adapter; what is sent to it arrives at the guest's FAR_ADAPTER."""
FAR_ADAPTER = "/dev/virtio-ports/adapter"


class GuestError(Exception):
    """The virtual machine does not respond, or has ended."""


@dataclass(frozen=True, slots=True)
class Result:
    """Exit code of a command (124: timeout), and its output and errors."""

    code: int
    out: str


@dataclass(frozen=True, slots=True)
class State:
    """A paused machine in a folder: memory and disks."""

    folder: Path


class Guest:
    """One virtual machine; its disks are in ``folder``, which is empty or that of a guest before."""

    def __init__(self, image: Image, folder: Path, *, kvm: bool = False) -> None:
        self._image = image
        self.folder = folder
        self._kvm = kvm
        self._process: subprocess.Popen[bytes] | None = None
        self._agent: _Lines | None = None
        self._monitor: _Lines | None = None
        self._requests = 0
        folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Switch it off."""
        self.kill()

    # --- power ----------------------------------------------------------------------------------------------------

    def start(
        self, state: State | None = None, *, clock: datetime = BOOT_TIME, write_log: Path | None = None
    ) -> None:
        """Switch on, or go on from a state, and wait until commands can be run.

        ``write_log``: each write to the data disk is logged there (`vm.write_log`).
        """
        root, data = self.folder / "root.qcow2", self.folder / "data.img"
        if state is not None:
            root.unlink(missing_ok=True)
            _overlay(root, state.folder / "root.qcow2", "qcow2")
            _copy(state.folder / "data.img", data)
        elif not root.exists():
            _overlay(root, self._image.disk, "raw")
            _call("mke2fs", "-q", "-t", "ext4", "-L", "data", str(data), f"{DATA_MIB}M")
        self._launch(self._arguments(state, clock, write_log))
        if state is not None:
            self._continue()
        self._expect_up(BOOT_S if state is None else 10)

    def kill(self) -> None:
        """Cut the power: what had not reached a disk is lost."""
        for lines in (self._agent, self._monitor):
            if lines is not None:
                lines.close()
        self._agent = self._monitor = None
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def shut_down(self, timeout_s: float = 30) -> None:
        """Switch off in order."""
        assert self._process is not None, "the guest does not run"
        self.run("systemctl --no-block poweroff", timeout_s)
        self._process.wait(30 + timeout_s * SLOWDOWN)
        self.kill()

    def reboot(self) -> None:
        """Shut down and start again, in order."""
        before = self.output("cat /proc/sys/kernel/random/boot_id")
        self.run("systemctl --no-block reboot", timeout_s=20)
        deadline = time.monotonic() + BOOT_S * SLOWDOWN
        while time.monotonic() < deadline:
            self._expect_up(BOOT_S)
            if self.output("cat /proc/sys/kernel/random/boot_id") != before:
                return
            time.sleep(1)
        raise GuestError("no reboot")

    def save(self, folder: Path) -> State:
        """Pause the guest and save it; it has ended afterwards. The adapter must not be plugged in: QEMU cannot save it."""
        folder.mkdir(parents=True)
        self.command("stop")
        self.command("migrate", uri=f"exec:cat > {folder}/memory")
        deadline = time.monotonic() + 120
        while (status := self.command("query-migrate").get("status")) != "completed":
            if status == "failed" or time.monotonic() > deadline:
                raise GuestError(f"the machine cannot be saved: {status}")
            time.sleep(0.1)
        self.command("quit")
        assert self._process is not None
        self._process.wait(30)
        self.kill()
        shutil.move(self.folder / "root.qcow2", folder)
        shutil.move(self.folder / "data.img", folder)
        return State(folder)

    # --- what runs inside -----------------------------------------------------------------------------------------

    def run(self, command: str, timeout_s: float = 60) -> Result:
        """Run a command in the guest's bash as root."""
        answer = self._ask({"run": command, "timeout_s": timeout_s}, timeout_s)
        return Result(answer["code"], base64.b64decode(answer["out"]).decode(errors="replace"))

    def output(self, command: str, timeout_s: float = 60) -> str:
        """Return the output of a command that must succeed."""
        result = self.run(command, timeout_s)
        if result.code:
            raise GuestError(f"{command}: exit code {result.code}\n{result.out}")
        return result.out.strip()

    def wait(self, command: str, timeout_s: float = 60) -> str:
        """Repeat a command until it succeeds; return its output."""
        loop = f'until out=$({{ {command}; }} 2>&1); do last=$out; sleep 0.5; done; echo "$out"'
        result = self.run(loop, timeout_s)
        if result.code:
            last = self.run(command, timeout_s).out
            raise GuestError(f"not within {timeout_s:g} s: {command}\n{last}")
        return result.out.strip()

    def push(self, source: Path | bytes, path: str, *, mode: int = 0o644) -> None:
        """Write a file; its folder is made."""
        data = source if isinstance(source, bytes) else source.read_bytes()
        self._ask({"put": path, "data": base64.b64encode(data).decode(), "mode": mode}, 60)

    def pull(self, path: str) -> bytes:
        """Return a file's content."""
        answer = self._ask({"get": path}, 60)
        content = base64.b64decode(answer["out"])
        if answer["code"]:
            raise GuestError(content.decode())
        return content

    # --- plugs and QEMU -------------------------------------------------------------------------------------------

    def plug_adapter(self) -> None:
        """Plug in the FTDI adapter, always at the same USB port."""
        self.command(
            "device_add", driver="usb-serial", id="ftdi", bus="usb.0", port="1", chardev="near", serial="VM0001",
            **{"always-plugged": True},
        )  # fmt: skip

    def unplug_adapter(self) -> None:
        """Pull the FTDI adapter out."""
        self.command("device_del", id="ftdi")

    def command(self, name: str, **arguments: Any) -> Any:
        """Give QEMU a command of its machine protocol (QMP)."""
        if self._monitor is None:
            self._monitor = self._connect("monitor.sock")
            self._monitor.receive(30)  # greeting
            self.command("qmp_capabilities")
        self._monitor.send({"execute": name, "arguments": arguments})
        while True:
            answer = self._monitor.receive(60)
            if "error" in answer:
                raise GuestError(f"QEMU: {name}: {answer['error']['desc']}")
            if "return" in answer:
                return answer["return"]

    def console(self) -> str:
        """Return what the kernel has printed since the machine was switched on."""
        path = self.folder / "console.log"
        return path.read_text(errors="replace") if path.exists() else ""

    def _arguments(self, state: State | None, clock: datetime, write_log: Path | None) -> list[str]:
        root = {"driver": "qcow2", "node-name": "root", "file": _file("root.qcow2")}
        data: dict[str, Any] = {"driver": "raw", "node-name": "data", "file": _file("data.img", direct=True)}
        if write_log is not None:
            write_log.touch()
            data = {
                "driver": "blklogwrites",
                "node-name": "data",
                "file": _file("data.img"),
                "log": _file(str(write_log)),
                "log-super-update-interval": 1,
            }
        speed = ["-accel", "kvm", "-cpu", "host"] if self._kvm else _FOLLOW_INSTRUCTIONS
        return [
            *("-M", "q35", *speed, "-smp", "1", "-m", str(MEMORY_MIB), "-nodefaults", "-display", "none"),
            *("-kernel", str(self._image.kernel), "-initrd", str(self._image.initrd)),
            *("-append", "console=ttyS0 root=/dev/vda rw quiet panic=-1 net.ifnames=0 mitigations=off"),
            *("-rtc", f"base={clock:%Y-%m-%dT%H:%M:%S},clock=vm"),
            *("-blockdev", json.dumps(root), "-device", "virtio-blk-pci,drive=root"),
            *("-blockdev", json.dumps(data), "-device", "virtio-blk-pci,drive=data"),
            *("-serial", "file:console.log"),
            *("-qmp", "unix:monitor.sock,server=on,wait=off"),
            *("-device", "virtio-serial-pci"),
            *("-chardev", "socket,id=agent,path=agent.sock,server=on,wait=off"),
            *("-device", "virtserialport,chardev=agent,name=agent"),
            *("-chardev", "file,id=report,path=report.log,append=on"),
            *("-device", "virtserialport,chardev=report,name=report"),
            # The adapter's line leads back into the guest, where the instrument is simulated in the guest's time.
            *("-chardev", "socket,id=far,path=adapter.sock,server=on,wait=off"),
            *("-chardev", "socket,id=near,path=adapter.sock,reconnect=1"),
            *("-device", "virtserialport,chardev=far,name=adapter"),
            *("-device", "qemu-xhci,id=usb"),
            *(("-incoming", f"exec:cat {state.folder}/memory") if state is not None else ()),
        ]

    def _launch(self, arguments: list[str]) -> None:
        assert self._process is None, "the guest runs already"
        for name in ("agent.sock", "monitor.sock", "adapter.sock"):
            (self.folder / name).unlink(missing_ok=True)
        # It ends with this process, whatever ends that.
        prefix = ["setpriv", "--pdeathsig", "KILL", "nice", "-n", "5"]
        with (self.folder / "qemu.log").open("w") as log:
            self._process = subprocess.Popen(
                [*prefix, "qemu-system-x86_64", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=self.folder,  # paths of sockets are short
            )

    def _continue(self) -> None:
        """Go on when the memory is loaded: a saved machine was paused."""
        deadline = time.monotonic() + 120
        while self.command("query-status")["status"] == "inmigrate":
            if time.monotonic() > deadline:
                raise GuestError("the saved machine cannot be loaded")
            time.sleep(0.1)
        self.command("cont")

    def _expect_up(self, timeout_s: float) -> None:
        self._ask({"run": "true", "timeout_s": 5}, timeout_s)

    def _ask(self, request: dict[str, Any], timeout_s: float) -> Any:
        """Return the agent's answer."""
        if self._agent is None:
            self._agent = self._connect("agent.sock")
        self._requests += 1
        self._agent.send({"id": self._requests, **request})
        deadline = time.monotonic() + 30 + timeout_s * SLOWDOWN
        while True:
            answer = self._agent.receive(deadline - time.monotonic())
            if answer["id"] == self._requests:
                return answer

    def _connect(self, name: str) -> _Lines:
        assert self._process is not None, "the guest does not run"
        return _Lines(self.folder / name, self.check_runs)

    def check_runs(self) -> None:
        """Raise GuestError if QEMU has ended."""
        if self._process is None or self._process.poll() is not None:
            raise GuestError(f"QEMU has ended: {(self.folder / 'qemu.log').read_text()[-2000:]}")


class _Lines:
    """JSON lines over a UNIX socket of QEMU."""

    def __init__(self, path: Path, check: Any) -> None:
        self._check = check
        self._socket = socket.socket(socket.AF_UNIX)
        deadline = time.monotonic() + 30
        while True:
            with suppress(OSError):
                # The path of a socket is short; that of a test's folder may not be.
                folder = os.open(path.parent, os.O_PATH)
                try:
                    self._socket.connect(f"/proc/self/fd/{folder}/{path.name}")
                    return
                finally:
                    os.close(folder)
            check()
            if time.monotonic() > deadline:
                raise GuestError(f"no {path}")
            time.sleep(0.05)

    _pending = b""

    def send(self, message: object) -> None:
        self._socket.settimeout(60)
        self._socket.sendall(json.dumps(message).encode() + b"\n")

    def receive(self, timeout_s: float) -> Any:
        """Return the next message."""
        deadline = time.monotonic() + timeout_s
        while b"\n" not in self._pending:
            if time.monotonic() > deadline:
                raise GuestError("no answer")
            self._socket.settimeout(1)
            try:
                data = self._socket.recv(1 << 20)
            except TimeoutError:
                self._check()
                continue
            if not data:
                self._check()
                raise GuestError("QEMU closed the connection")
            self._pending += data
        line, self._pending = self._pending.split(b"\n", 1)
        return json.loads(line)

    def close(self) -> None:
        self._socket.close()


_FOLLOW_INSTRUCTIONS = [
    *("-accel", "tcg,thread=single", "-cpu", "Nehalem", "-icount", "shift=0,sleep=on"),
]


def _file(path: str, *, direct: bool = False) -> dict[str, Any]:
    cache = {"cache": {"direct": True}} if direct else {}
    return {"driver": "file", "filename": path, **cache}


def _overlay(path: Path, backing: Path, kind: str) -> None:
    _call("qemu-img", "create", "-q", "-f", "qcow2", "-b", str(backing.resolve()), "-F", kind, str(path))


def _copy(source: Path, target: Path) -> None:
    _call("cp", "--reflink=auto", "--sparse=always", str(source), str(target))


def _call(*command: str) -> None:
    done = subprocess.run(command, env=tool_environment(), capture_output=True, text=True, check=False)
    if done.returncode:
        raise GuestError(f"{command[0]}: {done.stderr}")


def kvm_works(image: Image) -> bool:
    """Whether a kernel gets anywhere with KVM: its device may exist where it does not work. Takes some seconds."""
    if not os.access("/dev/kvm", os.R_OK | os.W_OK):
        return False
    # Without a root file system it panics after a second, and ends.
    arguments = [
        "-M",
        "q35",
        "-accel",
        "kvm",
        "-cpu",
        "host",
        "-m",
        "256",
        "-nodefaults",
        "-display",
        "none",
        "-no-reboot",
    ]
    append = "console=ttyS0 panic=-1"
    command = [
        "qemu-system-x86_64",
        *arguments,
        "-kernel",
        str(image.kernel),
        "-append",
        append,
        "-serial",
        "stdio",
    ]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=KVM_PROBE_S, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return b"Linux version" in done.stdout
