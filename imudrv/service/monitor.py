"""A running service on the terminal, live."""

import time
from pathlib import Path
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from imudrv.errors import InputError
from imudrv.imu.clock import STALL_EDGES_S
from imudrv.service.status import Status
from imudrv.service.status_socket import ask

PERIOD_S: Final = 0.5


_COLOURS: Final = {"ok": "green", "warn": "yellow", "fail": "red"}


_LOSSES: Final = ("damaged", "torn", "missing", "out_of_order", "duplicate", "invalid_counter", "restarts")


def monitor(path: Path, console: Console) -> None:
    """Show the status until Ctrl-C; a service that goes away is waited for.

    Parameters
    ----------
    path : Path
        Its socket.
    console : Console
        Where to. Without a terminal the status is shown once.

    Raises
    ------
    InputError
        No service is there to begin with.
    """
    status = ask(path)
    if not console.is_terminal:
        console.print(view(status))
        return
    with Live(view(status), console=console, auto_refresh=False, screen=True) as live:
        while True:
            time.sleep(PERIOD_S)
            try:
                live.update(view(ask(path)), refresh=True)
            except InputError as gone:
                live.update(Panel(Text(str(gone), "red"), title="no service"), refresh=True)


def view(status: Status) -> RenderableType:
    """A status as a screen; fits 80 columns and 24 lines.

    Parameters
    ----------
    status : dict
        As of a service.

    Returns
    -------
    renderable
    """
    port, samples, clock, latency = (status[name] for name in ("port", "samples", "clock", "latency"))
    health = Text(f" {status['health'].upper()} ", f"bold white on {_COLOURS[status['health']]}")
    health.append("  " + "; ".join(status["reasons"] or ["all well"]), "default on default")
    table = Table.grid(padding=(0, 2), expand=True)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(ratio=1)

    def add(name: str, text: str, style: str = "") -> None:
        table.add_row(name, Text(text, style, overflow="ellipsis"))

    add("unit", f"{status['unit']}, {status['profile']}, calibration {status['calibration']['sha256'][:12]}")
    add("port", f"{port['url']}: {port['state']}, {port['reconnects']} reconnects")
    add("rate", f"{status['rate_hz']:.1f} of {status['nominal_rate_hz']:g} samples/s, {samples['good']} good")
    losses = [f"{samples[name]} {name.replace('_', ' ')}" for name in _LOSSES if samples[name]]
    add("losses", ", ".join(losses) or "none", "yellow" if losses else "")
    if rejected := [f"{r['runs']} {name.replace('_', ' ')}" for name, r in status["rejected"].items()]:
        add("no frames", ", ".join(rejected), "yellow")
    skew = "unknown" if clock["skew_ppm"] is None else f"{clock['skew_ppm']:+.2f} ppm"
    add(
        "clock",
        f"{'locked' if clock['locked'] else 'not locked'}, skew {skew}, worst {clock['worst_s']:.3f} s",
    )
    add("stalls", _stalls(clock["stalls"]))
    micro = {name: latency[name] * 1e6 for name in ("p50_s", "p99_s", "p999_s", "max_s")}
    add(
        "latency",
        f"p50 {micro['p50_s']:.0f}, p99 {micro['p99_s']:.0f}, p99.9 {micro['p999_s']:.0f}, "
        f"max {micro['max_s']:.0f} us; {latency['late']} late",
    )
    degc = ", ".join(
        f"{name} {'?' if t is None else f'{t:.2f}'}" for name, t in status["temperature_degc"].items()
    )
    add("degC", degc or "none sent")
    bits = status["unit_status"]["bits"]
    add("BIT", ", ".join(bits) or "clear", "red" if status["unit_status"]["faults"] else "")
    for sink in [*status["sinks"], *([status["recording"]] if status["recording"] else [])]:
        text = f"{sink['state']}, {sink['sent']} sent, {sink['dropped']} dropped, {sink['queued']} wait"
        add(Text(sink["url"]).plain[-24:], text, "" if sink["healthy"] else "red")
    last = status["last"]
    add("counter", f"{last['counter']}  {' '.join(last['flags'])}")
    add("dtheta_b", "  ".join(f"{x:+.3e}" for x in last["dtheta_b"]) + " rad")
    add("dv_b", "  ".join(f"{x:+.3e}" for x in last["dv_b"]) + " m/s")
    events = Text("\n".join(status["events"][-3:]), "dim", overflow="ellipsis", no_wrap=True)
    return Group(health, table, events)


def _stalls(counts: list[int]) -> str:
    names = [f"<{edge * 1e3:g}" for edge in STALL_EDGES_S] + [f">={STALL_EDGES_S[-1] * 1e3:g}"]
    return ", ".join(f"{n} {name}" for name, n in zip(names, counts, strict=True) if n) + " ms"
