"""Target: the status socket of the service, with odd clients, and with odd services."""

import contextlib
import functools
import io
import json
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from numpy.random import Generator
from rich.console import Console

from imudrv.cli import main
from imudrv.errors import InputError
from imudrv.recording.reader import Recording
from imudrv.service.monitor import monitor
from imudrv.service.status_socket import StatusServer
from imudrv.terminal import OUR_FAULT

from .chain import CALIBRATION
from .properties import Cuts, Setup
from .random_input import mutated, pick
from .settings import changed

REPLIES: Final = (
    b"",
    b"{}",
    b"[" * 100_000,
    b"null",
    b'{"format": "imu50-status", "version": 1}',
    b"\xff" * 99,
)
SCENARIO: Final = {
    "format": "imu50-scenario",
    "version": 1,
    "seed": 5,
    "site": {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0},
    "motion": [{"rest": {"duration_s": 1.5}}],
}


@functools.cache
def status_text() -> str:
    """Return the last status of a short run of the service."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "unit.yaml").write_text(json.dumps(CALIBRATION))
        (Path(folder) / "rest.yaml").write_text(json.dumps(SCENARIO))
        run = "run --port sim://rest.yaml --profile imu50-rs422 --calibration unit.yaml --record run.mcap"
        command = [sys.executable, "-m", "imudrv", *run.split(), "--status", "status"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=100)
        *_, (_, status) = Recording(Path(folder) / "run.mcap").statuses()
    return json.dumps(status)


def make_status(rng: Generator) -> tuple[Setup, bytes]:
    """Return what a service answers: a status with changed values, a damaged one, or something else."""
    way = int(rng.integers(10))
    if way == 0:
        return None, pick(rng, REPLIES)
    status = json.loads(status_text())
    for _ in range(rng.integers(4)):
        status = changed(rng, status)
    data = json.dumps(status).encode() + b"\n"
    return None, mutated(rng, data, REPLIES[:2]) if way < 4 else data


def check_status(_: Setup, data: bytes, __: Cuts) -> None:
    """Check that the server serves after odd clients, and that commands show the answer or refuse it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "status"
        server = StatusServer(path, lambda: data)
        server.start()
        try:
            with socket.socket(socket.AF_UNIX) as client, contextlib.suppress(BrokenPipeError):
                client.connect(str(path))
                client.sendall(data[:1000])
            for arguments in (["status"], ["status", "--json"]):
                printed = io.StringIO()
                with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
                    code = main([*arguments, "--status", str(path)])
                assert code != OUR_FAULT, printed.getvalue()
            with contextlib.suppress(InputError):
                monitor(path, Console(file=io.StringIO()), "en")
        finally:
            server.close()
