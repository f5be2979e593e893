"""Base of the models of settings files, and the types they share: time, vectors, matrices."""

from datetime import UTC, datetime
from typing import Annotated, TypeAlias, TypeVar

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict


class Model(BaseModel):
    """A section of a settings file; frozen.

    Unknown keys, NaN and infinity are refused, and text or true/false instead of a number.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    @classmethod
    def current(cls, document: object) -> object:
        """Return a document of an earlier version of the format in the words of this one."""
        return document

    @classmethod
    def advice_for_key(cls, path: str) -> str:
        """Return what to write in place of an unknown key, whose path is joined by dots; empty: not known."""
        return ""

    @classmethod
    def advice_for_value(cls, path: str, value: object) -> str:
        """Return what to write in place of a value that a key cannot have; empty: not known."""
        return ""


def _utc(time: datetime) -> datetime:
    if not 2000 <= time.year < 3000:
        raise ValueError(f"expected a date from the year 2000 on, got {time.isoformat()}")
    return time.astimezone(UTC)


UtcTime: TypeAlias = Annotated[AwareDatetime, AfterValidator(_utc)]
"""A time with its zone, kept in UTC."""

Vector3: TypeAlias = tuple[float, float, float]
Matrix3: TypeAlias = tuple[Vector3, Vector3, Vector3]
"""Three rows."""

M = TypeVar("M", bound=Model)
