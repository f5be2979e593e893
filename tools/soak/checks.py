"""What an endurance test checks, and how it prints."""

import time
from collections.abc import Callable
from typing import Final, NamedTuple

TIMEOUT_S: Final = 300.0
"""Generous: it only ends a test that hangs."""


class StepError(Exception):
    """A step of the test failed, so that nothing can be checked."""


class Check(NamedTuple):
    """One requirement.

    Parameters
    ----------
    requirement, found : str
        In words and numbers.
    passed : bool
        Whether what was found meets the requirement.
    on_machine : bool
        A time, a load or a size: it depends on the machine and its other work.
    """

    requirement: str
    found: str
    passed: bool
    on_machine: bool = False

    def __str__(self) -> str:
        """One line."""
        return f"  {'ok    ' if self.passed else 'FAILED'} {self.requirement}: {self.found}"


def measured(requirement: str, found: str, passed: bool = True) -> Check:
    """Return the check of a time, a load or a size; without `passed` it is only printed."""
    return Check(requirement, found, bool(passed), on_machine=True)


def wait_until(condition: Callable[[], object], what: str) -> None:
    """Wait until a condition is true.

    Raises
    ------
    StepError
        It is still false after `TIMEOUT_S`.
    """
    end = time.monotonic() + TIMEOUT_S
    while not condition():
        if time.monotonic() > end:
            raise StepError(f"no {what} within {TIMEOUT_S:.0f} s")
        time.sleep(0.02)
