#!/usr/bin/env python3
"""Latency of the loop of a session while browsers look at its page, compared with that while nobody does.

    tools/run python tools/bench_viewers.py [--viewers N] [--rounds N] [--seconds N]

One run of `calib run --rehearse --web` waits for its first key; its unit sends 1 kHz on a pty. Windows with
and without viewers alternate, so that other load of the machine affects both; each viewer reads every frame,
in a process of its own, as a browser does. The latencies are the service's own, from its status socket.
"""

import argparse
import asyncio
import json
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Final

import aiohttp
import numpy as np

from imudrv.service.endpoint import default_folder
from imudrv.service.status_socket import ask

QUANTILES: Final = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}
SETTLE_S: Final = 1.0


def look(url: str, end: Event) -> None:
    """Read frames of a page until the end."""

    async def read() -> int:
        base, _, query = url.partition("/?")
        frames = 0
        headers = {"Origin": base}
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{base}/ws?{query}", headers=headers, compress=15) as page,
        ):
            while not end.is_set():
                frames += "view" in (await page.receive_str())[:20]
        return frames

    if not asyncio.run(read()):
        sys.exit("a viewer got no frame")


def quantiles_us(counts: Counter[int]) -> dict[str, float]:
    """Return quantiles of a histogram of latencies, us."""
    edges = np.array(sorted(counts))
    passed = np.cumsum([counts[edge] for edge in edges.tolist()])
    return {name: edges[np.searchsorted(passed, q * passed[-1])] * 1e-3 for name, q in QUANTILES.items()}


def window(status: Path, seconds: float) -> Counter[int]:
    """Return the histogram of the latencies in some seconds."""

    def histogram() -> Counter[int]:
        return Counter({int(edge): int(n) for edge, n in ask(status)["latency"]["histogram"]})

    before = histogram()
    time.sleep(seconds)
    return histogram() - before


def looked_at(url: str, viewers: int, status: Path, seconds: float) -> Counter[int]:
    """Return the histogram of a window with viewers."""
    end = multiprocessing.Event()
    processes = [multiprocessing.Process(target=look, args=(url, end)) for _ in range(viewers)]
    for process in processes:
        process.start()
    time.sleep(SETTLE_S)
    counts = window(status, seconds)
    end.set()
    for process in processes:
        process.join()
        if process.exitcode:
            sys.exit("a viewer failed")
    return counts


def main() -> None:
    """Measure in turn, and print the medians of the quantiles and their ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--viewers", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    command = [sys.executable, "-m", "calib", "run", "--rehearse", "--web", "127.0.0.1:0", "--session", "s"]
    with tempfile.TemporaryDirectory() as folder:
        session = subprocess.Popen(
            command,
            cwd=folder,
            env={**os.environ, "LC_ALL": "C.UTF-8"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            assert session.stdout is not None
            lines = iter(session.stdout)
            url = next(found[0] for line in lines if (found := re.search(r"http://\S+", line)))
            next(line for line in lines if "PRESS ENTER" in line)
            status = default_folder() / f"imu50-calib-{session.pid}.sock"
            alone, watched = [], []
            for _ in range(options.rounds):
                alone.append(quantiles_us(window(status, options.seconds)))
                watched.append(quantiles_us(looked_at(url, options.viewers, status, options.seconds)))
        finally:
            session.kill()
            session.communicate()
    result = {}
    for name in QUANTILES:
        without, with_viewers = (float(np.median([one[name] for one in all_])) for all_ in (alone, watched))
        ratio = float(np.median([b[name] / a[name] for a, b in zip(alone, watched, strict=True)]))
        result[name] = {"alone_us": without, "watched_us": with_viewers, "ratio": round(ratio, 3)}
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
