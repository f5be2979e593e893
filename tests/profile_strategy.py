"""Random valid profiles for hypothesis."""

from collections.abc import Sequence
from typing import Any, TypeVar

from hypothesis import strategies as st

from tools.fuzz import documents

T = TypeVar("T")


class _Drawn:
    """Choices that hypothesis makes, and simplifies when a test fails."""

    def __init__(self, draw: st.DrawFn) -> None:
        self._draw = draw

    def pick(self, choices: Sequence[T]) -> T:
        return self._draw(st.sampled_from(choices))

    def integer(self, lowest: int, highest: int) -> int:
        return self._draw(st.integers(lowest, highest))


@st.composite
def profiles(draw: st.DrawFn) -> dict[str, Any]:
    """A document of a valid profile of any kind that the format can describe."""
    return documents.profile(_Drawn(draw))
