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
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Final

import aiohttp
import numpy as np

from imudrv.service.endpoint import default_folder
from imudrv.service.status_socket import ask

QUANTILES: Final = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}
SETTLE_S: Final = 1.0


class Viewers:
    """Processes that read every frame of a page while they are told to, as browsers do.

    Parameters
    ----------
    url : str
        Address of the page.
    count : int
        Number of viewers.
    """

    def __init__(self, url: str, count: int) -> None:
        self._watch, self._end = multiprocessing.Event(), multiprocessing.Event()
        self._frames = [multiprocessing.Value("l", 0) for _ in range(count)]
        self._processes = [
            multiprocessing.Process(target=self._run, args=(url, frames)) for frames in self._frames
        ]
        for process in self._processes:
            process.start()

    def begin(self) -> None:
        """Connect all, and wait until each has got a frame."""
        before = [frames.value for frames in self._frames]
        self._watch.set()
        while any(now.value <= then for now, then in zip(self._frames, before, strict=True)):
            time.sleep(SETTLE_S)

    def pause(self) -> None:
        """Disconnect all."""
        self._watch.clear()
        time.sleep(SETTLE_S)

    def close(self) -> None:
        """End the processes."""
        self._end.set()
        self._watch.set()
        for process in self._processes:
            process.terminate()
            process.join()

    def _run(self, url: str, frames: "Synchronized[int]") -> None:
        while self._watch.wait() and not self._end.is_set():
            asyncio.run(self._read(url, frames))

    async def _read(self, url: str, frames: "Synchronized[int]") -> None:
        base, _, query = url.partition("/?")
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{base}/ws?{query}", headers={"Origin": base}, compress=15) as page,
        ):
            while self._watch.is_set():
                frames.value += "view" in (await page.receive_str())[:20]


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


def main() -> None:
    """Measure in turn, and print the medians of the quantiles and their ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--viewers", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--seconds", type=float, default=4.0)
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
            viewers = Viewers(url, options.viewers)
            for _ in range(options.rounds):
                alone.append(quantiles_us(window(status, options.seconds)))
                viewers.begin()
                watched.append(quantiles_us(window(status, options.seconds)))
                viewers.pause()
            viewers.close()
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
