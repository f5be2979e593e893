"""Result of one step of an examination."""

from enum import Enum
from typing import NamedTuple


class Verdict(Enum):
    """Result of a step."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


class Finding(NamedTuple):
    """Finding of one step of the examination.

    Parameters
    ----------
    name : str
        What was examined.
    verdict : Verdict
        `WARN`: it works, but not well; `FAIL`: it must be fixed.
    found : str
        What was found.
    fix : str
        What to do; empty if nothing.
    """

    name: str
    verdict: Verdict
    found: str
    fix: str = ""

    def __str__(self) -> str:
        """One line, and a second one with the fix."""
        fix = f"\n        -> {self.fix}" if self.fix else ""
        return f"{self.verdict.value:>4}  {self.name}: {self.found}{fix}"
