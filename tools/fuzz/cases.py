"""Cases: making, checking, and reducing those that fail."""

import itertools
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator

from imudrv.records import MESSAGE

from .any_profile import check_any_profile, make_any_profile
from .can import check_can, make_can
from .candump import check_candump, make_candump
from .chain import check_chain, make_chain
from .datagram import check_datagram, make_datagram
from .journal import check_journal, make_journal
from .logs import check_log, make_log
from .properties import Cuts, Setup
from .random_input import random_cuts
from .recordings import check_recording, make_recording
from .settings import check_yaml, make_yaml
from .status import check_status, make_status
from .stream import check_stream, make_stream
from .urls import check_port_url, make_url

SHRINK_S: Final = 60.0
"""Time for reducing a failure."""


@dataclass
class Target:
    """What is tested, and the totals so far."""

    name: str
    make: Callable[[Generator], tuple[Setup, bytes]]
    check: Callable[[Setup, bytes, Cuts], None]
    unit: int = 1  # bytes of an element of the input
    cases: int = 0
    size: int = 0


TARGETS: Final = (
    Target("stream", make_stream, check_stream),
    Target("candump", make_candump, check_candump),
    Target("can", make_can, check_can, MESSAGE.itemsize),
    Target("datagram", make_datagram, check_datagram),
    Target("yaml", make_yaml, check_yaml),
    Target("chain", make_chain, check_chain),
    Target("profiles", make_any_profile, check_any_profile),
    Target("recording", make_recording, check_recording),
    Target("log", make_log, check_log),
    Target("url", make_url, check_port_url),
    Target("journal", make_journal, check_journal),
    Target("status", make_status, check_status),
)


@dataclass
class Case:
    """One input of a target."""

    target: Target
    seed: int
    number: int
    setup: Setup = None
    data: bytes = b""
    cuts: Cuts = ()

    def run(self) -> None:
        """Generate the input and check it."""
        index = [t.name for t in TARGETS].index(self.target.name)
        rng = np.random.default_rng([self.seed, index, self.number])
        self.setup, self.data = self.target.make(rng)
        self.cuts = random_cuts(rng, len(self.data))
        self.target.check(self.setup, self.data, self.cuts)
        self.target.cases += 1
        self.target.size += len(self.data)

    def shrink(self, error: Exception) -> Exception:
        """Remove cuts and parts of the input, large ones first, that the failure does not need."""

        def attempt(data: bytes, cuts: Cuts) -> bool:
            nonlocal error
            try:
                self.target.check(self.setup, data, cuts)
            except Exception as other:
                if type(other) is type(error):
                    error, self.data, self.cuts = other, data, cuts
                    return True
            return False

        unit, end = self.target.unit, time.monotonic() + SHRINK_S
        attempt(self.data, ())
        for step in (unit << k for k in reversed(range((len(self.data) // unit).bit_length()))):
            at = 0
            while at < len(self.data) and time.monotonic() < end:
                at += 0 if attempt(self.data[:at] + self.data[at + step :], self.cuts) else step
        for cut in itertools.takewhile(lambda _: time.monotonic() < end, self.cuts):
            attempt(self.data, [c for c in self.cuts if c != cut])
        return error

    def reproduction(self) -> str:
        """Write the input to a file; return how to reproduce the failure."""
        name, check = self.target.name, self.target.check
        path = Path(tempfile.gettempdir()) / f"fuzz-{name}-{self.seed}-{self.number}.bin"
        path.write_bytes(self.data)
        data = f"Path({str(path)!r}).read_bytes()" if len(self.data) > 500 else repr(self.data)
        return (
            f"run: python -m tools.fuzz --only {name} --seed {self.seed} --first {self.number} --cases 1\n"
            f"input, {len(self.data)} bytes: {path}\n"
            f"call: {check.__module__}.{check.__name__}({self.setup!r}, {data}, {list(self.cuts)})"
        )
