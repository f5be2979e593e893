"""Live view of a running service on the terminal."""

import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Final, TypeAlias

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

Row: TypeAlias = tuple[str, str, str]
"""Name, text and style."""


def monitor(path: Path, console: Console) -> None:
    """Show the status until Ctrl-C; wait for a service that has ended to start again.

    Parameters
    ----------
    path : Path
        Socket of the service.
    console : Console
        Output. If it is not a terminal, the status is shown once.

    Raises
    ------
    InputError
        No service runs when the monitor starts.
    """
    shown = view(Status.from_json(ask(path)))
    if not console.is_terminal:
        console.print(shown)
        return
    with Live(shown, console=console, auto_refresh=False, screen=True) as live:
        while True:
            time.sleep(PERIOD_S)
            try:
                live.update(view(Status.from_json(ask(path))), refresh=True)
            except InputError as error:
                live.update(Panel(Text(str(error), "red"), title="no service"), refresh=True)


def view(status: Status) -> RenderableType:
    """Return the screen of a status; it fits 80 columns and 24 lines.

    Parameters
    ----------
    status : Status
        Status of a service.

    Returns
    -------
    renderable
    """
    health = Text(f" {status.health.upper()} ", f"bold white on {_COLOURS[status.health]}")
    health.append("  " + "; ".join(status.reasons or ["no problems"]), "default on default")
    table = Table.grid(padding=(0, 2), expand=True)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(ratio=1)
    for name, text, style in rows(status):
        table.add_row(name, Text(text, style, overflow="ellipsis"))
    events = Text("\n".join(status.events[-3:]), "dim", overflow="ellipsis", no_wrap=True)
    return Group(health, table, events)


def rows(status: Status) -> Iterator[Row]:
    """Return the rows of a status."""
    sections = _line_rows, _time_rows, _unit_rows, _output_rows, _sample_rows
    return chain.from_iterable(section(status) for section in sections)


def _line_rows(status: Status) -> Iterator[Row]:
    port, samples = status.port, status.samples
    yield "unit", f"{status.unit}, {status.profile}, calibration {status.calibration.sha256[:12]}", ""
    yield "port", f"{port.url}: {port.state}, {port.reconnects} reconnects", ""
    rate = f"{status.rate_hz:.1f} of {status.nominal_rate_hz:g} samples/s, {samples.good} good"
    yield "rate", rate, ""
    counts = {name.replace("_", " "): getattr(samples, name) for name in _LOSSES}
    losses = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    yield "losses", losses or "none", "yellow" if losses else ""
    if status.rejected:
        rejected = (f"{entry.runs} {name.replace('_', ' ')}" for name, entry in status.rejected.items())
        yield "rejected", ", ".join(rejected), "yellow"


def _time_rows(status: Status) -> Iterator[Row]:
    clock, latency = status.clock, status.latency
    locked = "locked" if clock.locked else "not locked"
    skew = "unknown" if clock.skew_ppm is None else f"{clock.skew_ppm:+.2f} ppm"
    steps = f", stepped {clock.steps} times" if clock.steps else ""
    yield "clock", f"{locked}, skew {skew}, worst {clock.worst_s:.3f} s{steps}", ""
    names = [f"<{edge * 1e3:g}" for edge in STALL_EDGES_S] + [f">={STALL_EDGES_S[-1] * 1e3:g}"]
    stalls = [f"{n} {name}" for name, n in zip(names, clock.stalls, strict=True) if n]
    yield "stalls", f"{', '.join(stalls)} ms" if stalls else "none", ""
    quantiles = zip(("p50", "p99", "p99.9", "max"), latency, strict=False)
    text = ", ".join(f"{name} {seconds * 1e6:.0f}" for name, seconds in quantiles)
    yield "latency", f"{text} us; {latency.late} late", ""


def _unit_rows(status: Status) -> Iterator[Row]:
    degc = (f"{name} {'?' if t is None else f'{t:.2f}'}" for name, t in status.temperature_degc.items())
    yield "degC", ", ".join(degc) or "none sent", ""
    yield "BIT", ", ".join(status.unit_status.bits) or "clear", "red" if status.unit_status.faults else ""


def _output_rows(status: Status) -> Iterator[Row]:
    for sink in [*status.sinks, *([status.recording] if status.recording else [])]:
        text = f"{sink.state}, {sink.sent} sent, {sink.dropped} dropped, {sink.queued} queued"
        yield sink.url[-24:], text, "" if sink.healthy else "red"


def _sample_rows(status: Status) -> Iterator[Row]:
    last = status.last
    yield "counter", f"{last.counter}  {' '.join(last.flags)}", ""
    yield "dtheta_b", "  ".join(f"{x:+.3e}" for x in last.dtheta_b) + " rad", ""
    yield "dv_b", "  ".join(f"{x:+.3e}" for x in last.dv_b) + " m/s", ""
