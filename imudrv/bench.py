"""Who calibrates, where and with what: the bench file, for certificates."""

from typing import Annotated, Final, Literal

from pydantic import AfterValidator
from pydantic import Field as Key

from imudrv.files.model import Model

BENCH_FILE: Final = "bench.yaml"
"""Name in the user's configuration."""


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError(f"expected printable text in one line, got {text[:60]!r}")
    return text


Text = Annotated[str, Key(max_length=200), AfterValidator(_printable)]


class UnitKind(Model):
    """Maker and type of the units that are calibrated."""

    maker: Text = ""
    type: Text = ""


class Instrument(Model):
    """An instrument, or a survey, with its certificate; `valid_until` as ``2027-01-31``, in quotes."""

    name: Text
    serial_number: Text = ""
    certificate: Text = ""
    valid_until: Annotated[str, Key(pattern=r"^\d{4}-\d{2}-\d{2}$")] | None = None


class Bench(Model):
    """The bench; what is absent is left blank in certificates, and named."""

    format: Literal["imu50-bench"] = "imu50-bench"
    version: Literal[1] = 1
    bench: Text = ""
    laboratory: Text = ""
    address: Text = ""
    customer: Text = ""
    operator: Text = ""
    authorised_by: Text = ""
    unit: UnitKind = UnitKind()
    instruments: Annotated[tuple[Instrument, ...], Key(max_length=50)] = ()
