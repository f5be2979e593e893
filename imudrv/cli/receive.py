"""Command `imudrv receive`."""

import argparse
import time
from dataclasses import dataclass, field
from typing import Any, Final

from imudrv.receiver import Ordering, receive
from imudrv.streams import EVENTS, STATUS, Watch
from imudrv.terminal import say
from imudrv.url import split

EXAMPLE: Final = "'zenoh://imu50/**'"

_PERIOD_S: Final = 1.0
_POLL_S: Final = 0.02
_MOST_UNITS: Final = 1000
_MOST_REASONS: Final = 3
_LONGEST: Final = 300


@dataclass
class _Unit:
    """What came from one unit."""

    ordering: Ordering = field(default_factory=Ordering)
    health: str = ""

    def __str__(self) -> str:
        return f"{self.ordering.counts}{self.health}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = (
        "udp://[HOST]:PORT, tcp://HOST:PORT, serial://PATH, or zenoh://KEY for all units under a key, with "
        "their health and events"
    )
    parser.add_argument("url", help=text)
    text = "end after this time (default: with Ctrl-C)"
    parser.add_argument("--seconds", type=float, default=float("inf"), metavar="S", help=text)


def run(arguments: argparse.Namespace) -> None:
    """Print each second, and at the end, how many samples came from each unit, and how many were lost."""
    ends_at = time.monotonic() + arguments.seconds
    if arguments.url.startswith("zenoh:"):
        watch = Watch(split(arguments.url, ("zenoh",)))
        say(f"{arguments.url}: listening")
        _watch(watch, ends_at)
        return
    with receive(arguments.url, timeout_s=_PERIOD_S) as receiver:
        while time.monotonic() < ends_at and receiver.is_open:
            until = time.monotonic() + _PERIOD_S
            for _ in receiver:
                if time.monotonic() >= until:
                    break
            say(f"{arguments.url}: {receiver.counts}")


def _watch(watch: Watch, ends_at: float) -> None:
    units: dict[str, _Unit] = {}
    next_s = time.monotonic() + _PERIOD_S
    try:
        while time.monotonic() < ends_at:
            time.sleep(_POLL_S)
            _take(watch, units)
            if time.monotonic() >= next_s:
                next_s = time.monotonic() + _PERIOD_S
                _print(units)
    finally:
        _take(watch, units)
        watch.close()
        _print(units)


def _take(watch: Watch, units: dict[str, _Unit]) -> None:
    """Count the samples that have arrived, note the health, print events."""
    for heard in watch.take():
        if heard.unit not in units:
            if len(units) == _MOST_UNITS:
                continue
            units[heard.unit] = _Unit()
            if len(units) == _MOST_UNITS:
                say(f"{_MOST_UNITS} units: further ones are left out")
        if heard.kind == EVENTS:
            say(f"{heard.unit}: {_line(heard.document().get('text'))}")
        elif heard.kind == STATUS:
            units[heard.unit].health = _health(heard.document())
        else:
            units[heard.unit].ordering.feed(heard.data)


def _health(status: dict[str, Any]) -> str:
    reasons = status.get("reasons")
    words = [_line(reason) for reason in reasons[:_MOST_REASONS]] if isinstance(reasons, list) else []
    return f"; {_line(status.get('health'))}" + (f": {'; '.join(words)}" if words else "")


def _line(value: object) -> str:
    """Return what another program has sent as one line."""
    return " ".join(str(value).split())[:_LONGEST]


def _print(units: dict[str, _Unit]) -> None:
    for key, unit in sorted(units.items()):
        say(f"{key}: {unit}")
