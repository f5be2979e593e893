"""Two services and two subscribers over Zenoh, one of which stops for some seconds."""

import os
import signal
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np

from imudrv.units import NS

from .checks import TIMEOUT_S, Check, measured, wait_until
from .data import RATE_HZ, SERIAL, write_scenario
from .processes import Child, Service, Stage, free_port

STALL_S: Final = 3.0
SETTLED: Final = 500
"""Samples at the start that are not counted into the latency."""
_UNITS: Final = ("a", "b")


def subscribers(folder: Path, seconds: float) -> list[Check]:
    """Play two units at 1 kHz, each into UDP and Zenoh, and beside them a third one twice into UDP.

    Parameters
    ----------
    folder : Path
        Where everything is written.
    seconds : float
        Duration; a subscriber is stopped for `STALL_S` of it, or for a quarter of it if that is less.
    """
    key, stall_s = f"imu50/soak-{os.getpid()}", min(STALL_S, seconds / 4.0)
    samples = round(RATE_HZ * seconds)
    whole = f"{samples} samples by the counter = {samples} good; 0 duplicate, 0 restarts of the unit"
    with ExitStack() as closing:
        stages = {name: closing.enter_context(_stage(folder / name, seconds)) for name in (*_UNITS, "udp")}
        running, stopped = (
            closing.enter_context(Stage(folder)).imudrv("listening", "receive", f"zenoh://{key}")
            for _ in range(2)
        )
        udp = {name: f"udp://127.0.0.1:{free_port()}" for name in stages}
        listeners = [
            stages["a"].listener(url, f"{name}.npy")
            for name, url in (("zenoh", f"zenoh://{key}/a"), ("udp", udp["a"]))
        ]
        units: list[Child] = []
        services: dict[str, Service] = {}
        for name, stage in stages.items():
            second = f"zenoh://{key}/{name}" if name in _UNITS else f"udp://127.0.0.1:{free_port()}"
            unit, services[name] = stage.unit_and_service(SERIAL, "1", "--out", udp[name], "--out", second)
            units.append(unit)
        time.sleep(seconds / 3.0)
        stopped.process.send_signal(signal.SIGSTOP)
        time.sleep(stall_s)
        stopped.process.send_signal(signal.SIGCONT)
        for unit in units:
            unit.wait(TIMEOUT_S + 2.0 * seconds)
        states = {
            name: service.await_status(lambda status: status["port"]["state"] == "lost", "end of the unit")
            for name, service in services.items()
        }
        codes = [service.stop() for service in services.values()]
        seen = [
            _last_reports(subscriber, [f"{key}/{name}" for name in _UNITS])
            for subscriber in (running, stopped)
        ]
        for listener in listeners:
            listener.stop()
    dropped = [states[name]["sinks"][1]["dropped"] for name in _UNITS]
    loops = [status["latency"] for status in states.values()]
    return [
        Check(
            f"a subscriber gets all {samples:,} samples of both services",
            "; ".join(seen[0]),
            all(whole in report for report in seen[0]),
        ),
        Check(
            f"so does one that is stopped for {stall_s:g} s",
            "; ".join(seen[1]),
            all(whole in report for report in seen[1]),
        ),
        Check(
            "both get the status of the services",
            "port lost at the end",
            all("fail: port lost" in report for reports in seen for report in reports),
        ),
        Check("the services drop nothing", f"{dropped}", dropped == [0, 0]),
        Check("the services end with exit code 0", f"{codes}", codes == [0, 0, 0]),
        measured(
            "latency of the loop, of the services with Zenoh and of the one with UDP instead",
            ", ".join(
                f"{name[:-2]} {' '.join(f'{loop[name] * 1e3:.3f}' for loop in loops)} ms"
                for name in ("p50_s", "p99_s")
            ),
        ),
        measured(
            "from the end of a sample to the receiver, Zenoh and UDP of one service",
            ", ".join(
                f"{name} {zenoh * 1e3:.2f} and {udp * 1e3:.2f} ms, {zenoh / udp:.1f} times"
                for name, (zenoh, udp) in _quantiles_s(folder / "a").items()
            ),
        ),
    ]


def _stage(folder: Path, seconds: float) -> Stage:
    folder.mkdir()
    write_scenario(folder, seconds)
    return Stage(folder)


def _last_reports(subscriber: Child, keys: list[str]) -> list[str]:
    """Return what a subscriber reports of each unit after its end."""
    for key in keys:
        subscriber.await_line(f"{key}: end: ")
    printed = len(subscriber.lines)
    wait_until(lambda: len(subscriber.lines) >= printed + 2 * len(keys), "reports of a subscriber")
    return [subscriber.line_with(f"{key}: ") for key in keys]


def _quantiles_s(folder: Path) -> dict[str, list[float]]:
    """Return median and 99th percentile of the time from sample to arrival, for each output."""
    latencies = [
        np.load(folder / f"{name}.npy.times.npy") - np.load(folder / f"{name}.npy")["t_ns"]
        for name in ("zenoh", "udp")
    ]
    return {
        name: [float(np.quantile(latency[SETTLED:], q)) * NS for latency in latencies]
        for name, q in (("p50", 0.5), ("p99", 0.99))
    }
