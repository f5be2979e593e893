"""Live view of a running service in a browser."""

import json
import secrets
import time
from collections.abc import Callable
from contextlib import closing
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np

from imudrv.errors import InputError
from imudrv.service.monitor import rows
from imudrv.service.status import Status
from imudrv.service.status_socket import ask
from imudrv.units import DEG, NS
from imudrv.web.server import PageServer

ADDRESS: Final = "127.0.0.1:8651"
"""Default address: this machine only."""

PERIOD_S: Final = 0.25
"""Interval of the frames, s."""


def serve(path: Path, address: str, say: Callable[[str], None]) -> None:
    """Serve the page until Ctrl-C; wait for a service that has ended to start again.

    Parameters
    ----------
    path : Path
        Status socket of the service.
    address : str
        See `PageServer`.
    say : callable
        Receives the address for the browser.

    Raises
    ------
    InputError
        No service runs when the monitor starts, or the address cannot be used.
    """
    ask(path)
    page = resources.files(__package__).joinpath("page")
    files = {file.name: file for file in page.iterdir() if file.is_file()}
    with closing(PageServer(files, address, secrets.token_urlsafe(16), lambda _: None)) as server:
        say(f"page for browsers: {server.url}")
        while True:
            if server.viewers:
                server.publish(json.dumps(_frame(path)))
            time.sleep(PERIOD_S)


def _frame(path: Path) -> dict[str, Any]:
    try:
        status = Status.from_json(ask(path))
    except InputError as error:
        return {"kind": "gone", "text": str(error)}
    last, seconds = status.last, max(status.last.interval_ns * NS, 1e-9)
    return {
        "kind": "status",
        "health": status.health,
        "reasons": status.reasons,
        "rows": list(rows(status)),
        "latency_us": [round(s * 1e6, 1) for s in status.latency[:4]],
        "rate": float(np.linalg.norm(last.dtheta_b)) / seconds / DEG,
        "force": float(np.linalg.norm(last.dv_b)) / seconds,
        "events": status.events[-5:],
    }
