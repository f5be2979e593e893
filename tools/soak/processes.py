"""The processes of a test: simulated unit, service, receiver, and commands."""

import io
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any, Final, TypeVar

from imudrv import cli, profiles
from imudrv.calibration import write_calibration
from imudrv.errors import InputError
from imudrv.service.status_socket import ask
from imudrv.sim.scenario import NOMINAL

from .checks import TIMEOUT_S, StepError, wait_until

BUS: Final = "can://udp_multicast/239.74.163.2"

Status = dict[str, Any]


class Child:
    """A Python process and the lines that it prints."""

    def __init__(self, folder: Path, *command: object) -> None:
        self._name = " ".join(map(str, command))
        self.process = subprocess.Popen(
            [sys.executable, *map(str, command)],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.lines: list[str] = []
        self._hung_up = threading.Event()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line)
            if self._hung_up.is_set():
                self.process.stdout.close()
                return

    def hang_up(self) -> None:
        """Close the pipe of what it prints, as `| head` does."""
        self._hung_up.set()

    def _failed(self, what: str) -> StepError:
        return StepError(f"{self._name}: {what}: {''.join(self.lines[-9:])}")

    def line_with(self, words: str) -> str:
        """Return the last line that contains these words; empty if there is none."""
        return next((line.strip() for line in reversed(self.lines) if words in line), "")

    def await_line(self, words: str) -> None:
        """Wait for a line that contains these words."""
        wait_until(
            lambda: self.line_with(words) or self.process.poll() is not None, f"{words!r} from {self._name}"
        )
        if not self.line_with(words):
            self._reader.join()
            raise self._failed("ended early")

    def wait(self, timeout_s: float = TIMEOUT_S) -> int:
        """Wait for the end; return the exit code."""
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise self._failed("does not end") from None
        self._reader.join()
        return code

    def stop(self, number: int = signal.SIGTERM, timeout_s: float = TIMEOUT_S) -> int:
        """Send a signal; return the exit code."""
        self.process.send_signal(number)
        return self.wait(timeout_s)

    def close(self) -> None:
        """Kill the process if it still runs."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join()
        if self.process.stdout is not None:
            self.process.stdout.close()


class Service(Child):
    """`imudrv run` with the nominal calibration; its kernels are compiled once it prints "serving"."""

    def __init__(self, folder: Path, port: str, profile: str, *options: object) -> None:
        write_calibration(folder / "unit.yaml", NOMINAL)
        self.socket = folder / "status.sock"
        common = ["--profile", profile, "--calibration", "unit.yaml", "--status", self.socket]
        super().__init__(folder, "-m", "imudrv", "run", "--port", port, *common, *options)

    def await_status(self, condition: Callable[[Status], object], what: str) -> Status:
        """Wait for a status that meets a condition, and return it."""
        status: Status = {}

        def is_met() -> object:
            nonlocal status
            if self.process.poll() is not None:
                raise self._failed("the service has ended")
            with suppress(InputError):  # the socket does not exist yet
                status = ask(self.socket)
            return status and condition(status)

        wait_until(is_met, what)
        return status

    def await_port(self, *states: str) -> None:
        """Wait until the port is in one of these states."""
        self.await_status(lambda status: status["port"]["state"] in states, f"port {' or '.join(states)}")


C = TypeVar("C", bound=Child)


class Stage(ExitStack):
    """The processes of a test in its folder; those still running at the end are killed."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder

    def unit(self, port: str, profile: str, speed: str, *options: object) -> Child:
        """Start a simulated unit that plays ``scenario.yaml``."""
        command = ["sim", "scenario.yaml", "--profile", profile, "--port", port, "--speed", speed, *options]
        return self.imudrv("plays on", *command)

    def service(self, port: str, profile: str, *options: object) -> Service:
        """Start the service."""
        return self._started(Service(self._folder, port, profile, *options), "serving")

    def unit_and_service(self, profile: str, speed: str, *options: object) -> tuple[Child, Service]:
        """Start both in the order in which no sample is lost: over a pty, or over a CAN bus by UDP."""
        if not profiles.load(profile).layout().can:
            unit = self.unit("pty", profile, speed, "--link", "unit")  # waits for its first reader
            return unit, self.service(str(self._folder / "unit"), profile, *options)
        port = f"{BUS}?port={free_port()}"
        service = self.service(port, profile, *options)
        service.await_port("silent")
        return self.unit(port, profile, speed), service

    def imudrv(self, words: str, *arguments: object) -> Child:
        """Start another command, and wait for these words of it."""
        return self._started(Child(self._folder, "-m", "imudrv", *arguments), words)

    def listener(self, url: str, name: str) -> Child:
        """Start a receiver that stores what it receives in a file."""
        return self._started(
            Child(self._folder, Path(__file__).with_name("listener.py"), url, name), "listening"
        )

    def _started(self, child: C, words: str) -> C:
        self.callback(child.close)
        child.await_line(words)
        return child


def run_imudrv(*arguments: object) -> tuple[int, str]:
    """Run an `imudrv` command in this process, which is faster; return exit code and output."""
    output = io.StringIO()
    with redirect_stdout(output), redirect_stderr(output):
        code = cli.main([str(argument) for argument in arguments])
    return code, output.getvalue()


def run_ok(*arguments: object) -> list[str]:
    """Run an `imudrv` command that must succeed; return its output lines."""
    code, output = run_imudrv(*arguments)
    if code:
        raise StepError(f"imudrv {' '.join(map(str, arguments))}: exit code {code}: {output}")
    return output.splitlines()


def free_port() -> int:
    """Return an unused UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])
