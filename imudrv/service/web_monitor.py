"""Live view of a running service in a browser."""

import json
import secrets
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np

from imudrv.errors import InputError
from imudrv.messages import LANGUAGES, page_labels
from imudrv.service.monitor import problems, rows
from imudrv.service.status import Status
from imudrv.service.status_socket import ask
from imudrv.units import DEG, NS
from imudrv.web.server import PageServer

ADDRESS: Final = "127.0.0.1:8651"
"""Default address: this machine only."""

PERIOD_S: Final = 0.25
"""Interval of the frames, s."""


def serve(path: Path, address: str, say: Callable[[str], None], language: str) -> None:
    """Serve the page until Ctrl-C; wait for a service that has ended to start again.

    Parameters
    ----------
    path : Path
        Status socket of the service.
    address : str
        See `PageServer`.
    say : callable
        Receives the address for the browser.
    language : str
        Language of the page at first.

    Raises
    ------
    InputError
        No service runs when the monitor starts, or the address cannot be used.
    """
    ask(path)
    page = resources.files(__package__).joinpath("page")
    with closing(PageServer(page, address, secrets.token_urlsafe(16), lambda _: None)) as server:
        server.keep("hello", json.dumps({"kind": "hello", "language": language, "labels": page_labels()}))
        say(f"page for browsers: {server.url}")
        while True:
            if server.viewers:
                server.publish(json.dumps(_frame(path)))
            time.sleep(PERIOD_S)


def octaves(histogram: Sequence[tuple[int, int]]) -> list[tuple[float, int]]:
    """Return a histogram of latencies in bins of a factor of two: upper edge, us, and number of samples."""
    counts: dict[int, int] = {}
    for upper_ns, count in histogram:
        k = upper_ns.bit_length()
        counts[k] = counts.get(k, 0) + count
    if not counts:
        return []
    return [((1 << k) * 1e-3, counts.get(k, 0)) for k in range(min(counts), max(counts) + 1)]


def _frame(path: Path) -> dict[str, Any]:
    try:
        status = Status.from_json(ask(path))
    except InputError as error:
        return {"kind": "gone", "text": str(error)}
    last, seconds = status.last, max(status.last.interval_ns * NS, 1e-9)
    return {
        "kind": "status",
        "health": status.health,
        "problems": {name: problems(status, name) for name in LANGUAGES},
        "rows": {name: list(rows(status, name)) for name in LANGUAGES},
        "latency": octaves(status.latency.histogram),
        "rate": float(np.linalg.norm(last.dtheta_b)) / seconds / DEG,
        "force": float(np.linalg.norm(last.dv_b)) / seconds,
        "events": status.events[-5:],
    }
