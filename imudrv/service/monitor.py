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
from imudrv.messages import catalogue, joined, named
from imudrv.service.status import Status
from imudrv.service.status_socket import ask
from imudrv.units import MM, URAD
from imudrv.wording import Count

PERIOD_S: Final = 0.5

_COLOURS: Final = {"ok": "green", "warn": "yellow", "fail": "red"}

_LOSSES: Final = ("damaged", "torn", "missing", "out_of_order", "duplicate", "invalid_counter", "restarts")

_LONGEST: Final = 24
"""Most characters of an output's name."""

Row: TypeAlias = tuple[str, str, str]
"""Name, text and style."""


def monitor(path: Path, console: Console, language: str) -> None:
    """Show the status until Ctrl-C; wait for a service that has ended to start again.

    Parameters
    ----------
    path : Path
        Socket of the service.
    console : Console
        Output. If it is not a terminal, the status is shown once.
    language : str
        One of `imudrv.messages.LANGUAGES`.

    Raises
    ------
    InputError
        No service runs when the monitor starts.
    """
    shown = view(Status.from_json(ask(path)), language)
    if not console.is_terminal:
        console.print(shown)
        return
    with Live(shown, console=console, auto_refresh=False, screen=True) as live:
        while True:
            time.sleep(PERIOD_S)
            try:
                live.update(view(Status.from_json(ask(path)), language), refresh=True)
            except InputError as error:
                live.update(
                    Panel(Text(str(error), "red"), title=catalogue(language)["page_no_service"]), refresh=True
                )


def view(status: Status, language: str = "en") -> RenderableType:
    """Return the screen of a status; it fits 80 columns and 24 lines.

    Parameters
    ----------
    status : Status
        Status of a service.
    language : str
        Language; events are shown as they were logged, in English.

    Returns
    -------
    renderable
    """
    health = Text(f" {status.health.upper()} ", f"bold white on {_COLOURS[status.health]}")
    health.append("  " + problems(status, language), "default on default")
    table = Table.grid(padding=(0, 2), expand=True)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(ratio=1)
    for name, text, style in rows(status, language):
        table.add_row(name, Text(text, style, overflow="ellipsis"))
    events = Text("\n".join(status.events[-3:]), "dim", overflow="ellipsis", no_wrap=True)
    return Group(health, table, events)


def problems(status: Status, language: str) -> str:
    """Return the reasons of the health in one of the languages, or that there are none."""
    texts = catalogue(language)
    return texts["semicolon"].join(status.reasons(language)) or texts["no_problems"]


def rows(status: Status, language: str) -> Iterator[Row]:
    """Return the rows of a status in one of the languages."""
    sections = _line_rows, _time_rows, _unit_rows, _output_rows, _sample_rows
    return chain.from_iterable(section(status, language) for section in sections)


def _line_rows(status: Status, language: str) -> Iterator[Row]:
    port, samples, texts = status.port, status.samples, catalogue(language)
    unit = {"unit": status.unit, "profile": status.profile, "calibration": status.calibration.sha256[:12]}
    yield texts["unit"], texts["unit_value"].format(**unit), ""
    opened = {
        "url": port.url,
        "state": named(texts, "port", port.state),
        "reconnects": port.reconnects,
    }
    yield texts["port"], texts["port_value"].format(**opened), ""
    rate = {"rate_hz": status.rate_hz, "nominal_rate_hz": status.nominal_rate_hz, "good": samples.good}
    yield texts["rate"], texts["rate_value"].format(**rate), ""
    counts = {name: getattr(samples, name) for name in _LOSSES}
    losses = joined((f"{count} {texts[name]}" for name, count in counts.items() if count), language)
    yield texts["losses"], losses or texts["none"], "yellow" if losses else ""
    if status.rejected:
        counted = ((entry.runs, named(texts, "rejected", name)) for name, entry in status.rejected.items())
        rejected = (f"{runs} {reason}" for runs, reason in counted)
        yield texts["rejected"], joined(rejected, language), "yellow"


def _time_rows(status: Status, language: str) -> Iterator[Row]:
    clock, latency, texts = status.clock, status.latency, catalogue(language)
    model = {
        "locked": texts["locked" if clock.locked else "not_locked"],
        "skew": texts["unknown"] if clock.skew_ppm is None else f"{clock.skew_ppm:+.2f} ppm",
        "worst_s": clock.worst_s,
    }
    steps = texts["clock_steps"].format(steps=Count(clock.steps)) if clock.steps else ""
    yield texts["clock"], texts["clock_value"].format(**model) + steps, ""
    names = [f"<{edge * 1e3:g}" for edge in STALL_EDGES_S] + [f">={STALL_EDGES_S[-1] * 1e3:g}"]
    stalls = [f"{n} {name}" for name, n in zip(names, clock.stalls, strict=True) if n]
    yield texts["stalls"], f"{joined(stalls, language)} ms" if stalls else texts["none"], ""
    quantiles = zip(("p50", "p99", "p99.9", "max"), latency[:4], strict=True)
    text = joined((f"{name} {seconds * 1e6:.0f}" for name, seconds in quantiles), language)
    yield texts["latency"], texts["latency_value"].format(quantiles=text, late=latency.late), ""


def _unit_rows(status: Status, language: str) -> Iterator[Row]:
    texts = catalogue(language)
    degc = (f"{name} {'?' if t is None else f'{t:.2f}'}" for name, t in status.temperature_degc.items())
    yield texts["temperatures"], joined(degc, language) or texts["none_sent"], ""
    bits = joined(status.unit_status.bits, language)
    yield texts["status_bits"], bits or texts["clear"], "red" if status.unit_status.faults else ""


def _output_rows(status: Status, language: str) -> Iterator[Row]:
    texts = catalogue(language)
    for sink in [*status.sinks, *([status.recording] if status.recording else [])]:
        values = sink._asdict() | {"state": named(texts, "output", sink.state)}
        yield _shortened(sink.url), texts["output_value"].format(**values), "" if sink.healthy else "red"


def _shortened(name: str) -> str:
    return name if len(name) <= _LONGEST else f"...{name[3 - _LONGEST :]}"


def _sample_rows(status: Status, language: str) -> Iterator[Row]:
    last = status.last
    yield catalogue(language)["counter"], f"{last.counter}  {' '.join(last.flags)}", ""
    yield "dtheta_b", "  ".join(f"{x / URAD:+.2f}" for x in last.dtheta_b) + " urad", ""
    yield "dv_b", "  ".join(f"{x / MM:+.3f}" for x in last.dv_b) + " mm/s", ""
