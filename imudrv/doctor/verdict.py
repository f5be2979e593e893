"""Result of one step of an examination."""

from enum import Enum
from typing import NamedTuple


class Verdict(Enum):
    """How a step came out."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


class Finding(NamedTuple):
    """One step of the examination.

    Parameters
    ----------
    name : str
        What was looked at.
    verdict : Verdict
        `WARN` works, but not well; `FAIL` must be mended.
    found : str
        What was found.
    fix : str
        What to do, empty where nothing is to be done.
    """

    name: str
    verdict: Verdict
    found: str
    fix: str = ""

    def __str__(self) -> str:
        """One line, and one for what to do."""
        fix = f"\n        -> {self.fix}" if self.fix else ""
        return f"{self.verdict.value:>4}  {self.name}: {self.found}{fix}"
