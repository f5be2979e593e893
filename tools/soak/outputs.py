"""Every kind of output at once, for a long time: UDP, eight TCP clients, a serial line and a recording."""

import os
import pty
import socket
import threading
import tty
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np

from imudrv.recording.reader import Recording
from imudrv.wire.datagram import DATAGRAM, SIZE

from .checks import TIMEOUT_S, Check, measured, wait_until
from .data import SERIAL, last_status, write_scenario
from .processes import Stage, free_port
from .usage import UsageMonitor, memory_checks

CLIENTS: Final = 8
CPU_PERCENT: Final = 15.0
SETTLED_S: Final = 60.0


class Reader(threading.Thread):
    """Reads datagrams from a descriptor and counts samples until it is closed."""

    def __init__(self, name: str, fd: int) -> None:
        super().__init__(daemon=True)
        self.name, self._fd = name, fd
        self.first = self.next = -1
        self.samples = self.breaks = 0
        self.start()

    def run(self) -> None:
        """Read."""
        rest = b""
        for data in self._pieces():
            rest += data
            whole = len(rest) // SIZE * SIZE
            counters = np.frombuffer(rest[:whole], DATAGRAM)["counter"].astype(np.int64)
            rest = rest[whole:]
            if len(counters):
                self.first = self.first if self.samples else int(counters[0])
                expected = np.concatenate([[self.next if self.samples else self.first], counters[:-1] + 1])
                self.breaks += int(np.count_nonzero(counters != expected))
                self.samples, self.next = self.samples + len(counters), int(counters[-1]) + 1

    def _pieces(self) -> Iterator[bytes]:
        try:
            while data := os.read(self._fd, 1 << 16):
                yield data
        except OSError:
            return  # closed by the service

    def __str__(self) -> str:
        """What came."""
        return f"{self.name} {self.samples} from {self.first}, {self.breaks} breaks"


def outputs(folder: Path, minutes: float) -> list[Check]:
    """Play a unit at 1 kHz into all outputs and count what each receives."""
    seconds = 60.0 * minutes
    samples = write_scenario(folder, seconds)
    with ExitStack() as closing, Stage(folder) as stage:
        inlet = closing.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        inlet.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        inlet.bind(("127.0.0.1", 0))
        master, slave = pty.openpty()
        closing.callback(os.close, master)
        closing.callback(os.close, slave)
        tty.setraw(slave)
        port = free_port()
        udp = f"udp://127.0.0.1:{inlet.getsockname()[1]}"
        outs = [
            word
            for url in (udp, f"tcp://127.0.0.1:{port}", f"serial://{os.ttyname(slave)}")
            for word in ("--out", url)
        ]
        unit, service = stage.unit_and_service(SERIAL, "1", *outs, "--record", "run.mcap")
        clients = [
            closing.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(CLIENTS)
        ]
        readers = [Reader("udp", inlet.fileno()), Reader("serial", master)]
        readers += [Reader("tcp", client.fileno()) for client in clients]
        monitor = UsageMonitor(service.process.pid)
        unit.wait(TIMEOUT_S + 2.0 * seconds)
        usage = monitor.stop()
        service.await_port("lost", "silent")  # all that was sent has been read
        wait_until(lambda: all(reader.next == samples for reader in readers), "last sample at every output")
        code = service.stop()
    counts, status = last_status(Recording(folder / "run.mcap"))
    recorded = sum(len(piece) for piece in Recording(folder / "run.mcap").increments())
    percent = 100.0 * (usage[-1].cpu_s - usage[0].cpu_s) / (usage[-1].at_s - usage[0].at_s)
    latency = (status["latency"][name] * 1e3 for name in ("p50_s", "p99_s", "p999_s", "max_s"))
    return [
        Check(
            f"each output receives all of {samples:,} samples since it was there, in order",
            "; ".join(map(str, readers)),
            all(r.breaks == 0 and r.next - r.first == r.samples for r in readers) and readers[0].first == 0,
        ),
        Check("the service ends with exit code 0", f"exit code {code}", code == 0),
        Check("the counts add up", str(counts), counts.closes and counts.good == samples),
        Check("the recording has all of them", f"{recorded:,}", recorded == samples),
        measured("the unit", unit.lines[-1].strip()),
        measured(f"CPU <= {CPU_PERCENT:g} % of a core", f"{percent:.1f} %", percent <= CPU_PERCENT),
        measured(
            "latency from read to socket, p50 p99 p99.9 max", " ".join(f"{x:.2f}" for x in latency) + " ms"
        ),
        *memory_checks(usage, min(SETTLED_S, seconds / 2.0)),
    ]
