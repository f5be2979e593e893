"""Command `imudrv receive`."""

import argparse
import time
from typing import Final

from imudrv.receiver import Ordering, receive
from imudrv.streams import Watch
from imudrv.terminal import say
from imudrv.url import split

EXAMPLE: Final = "'zenoh://imu50/**'"

_PERIOD_S: Final = 1.0
_POLL_S: Final = 0.02


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = (
        "udp://[HOST]:PORT, tcp://HOST:PORT, serial://PATH, or zenoh://KEY; * and ** in a key: several units"
    )
    parser.add_argument("url", help=text)
    text = "end after this time (default: with Ctrl-C)"
    parser.add_argument("--seconds", type=float, default=float("inf"), metavar="S", help=text)


def run(arguments: argparse.Namespace) -> None:
    """Print each second, and at the end, how many samples came from each unit, and how many were lost."""
    ends_at = time.monotonic() + arguments.seconds
    units: dict[str, Ordering] = {}
    if arguments.url.startswith("zenoh:"):
        watch = Watch(split(arguments.url, ("zenoh",)))
        try:
            _watch(watch, units, ends_at)
        finally:
            watch.close()
            _print(units)
        return
    with receive(arguments.url, timeout_s=_PERIOD_S) as receiver:
        while time.monotonic() < ends_at and receiver.is_open:
            until = time.monotonic() + _PERIOD_S
            for _ in receiver:
                if time.monotonic() >= until:
                    break
            say(f"{arguments.url}: {receiver.counts}")


def _watch(watch: Watch, units: dict[str, Ordering], ends_at: float) -> None:
    next_s = time.monotonic() + _PERIOD_S
    while time.monotonic() < ends_at:
        time.sleep(_POLL_S)
        for key, datagrams in watch.take():
            units.setdefault(key, Ordering()).feed(datagrams)
        if time.monotonic() >= next_s:
            next_s += _PERIOD_S
            _print(units)


def _print(units: dict[str, Ordering]) -> None:
    for key, ordering in sorted(units.items()):
        say(f"{key}: {ordering.counts}")
