"""Who works on which bench: given once, kept beside the key of the bench, and recorded in every session."""

import platform
from typing import Annotated, Final, Literal, NamedTuple

from pydantic import AfterValidator
from pydantic import Field as Key

from calib.bench.entries import printable
from calib.signing.keys import key_path
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.files.model import Model

BENCH_FILE: Final = "bench.yaml"

Name = Annotated[str, Key(min_length=1, max_length=64), AfterValidator(printable)]


class BenchFile(Model):
    """Name of the bench and of its operator."""

    format: Literal["imu50-bench"] = "imu50-bench"
    version: Literal[1] = 1
    bench: Name | None = None
    operator: Name | None = None


class Identity(NamedTuple):
    """Bench, operator and computer of a session; empty where not known."""

    bench: str
    operator: str
    host: str


UNKNOWN: Final = Identity("", "", "")


def identity(bench: str | None, operator: str | None, *, keep: bool) -> Identity:
    """Return who works on which bench.

    Parameters
    ----------
    bench, operator : str or None
        As given now; None: as given last.
    keep : bool
        Keep what is given for later sessions.

    Returns
    -------
    Identity

    Raises
    ------
    InputError
        A name is empty or not printable, or the file has faults or cannot be written.
    """
    given = {name: text for name, text in (("bench", bench), ("operator", operator)) if text is not None}
    beside = key_path()
    path = None if beside is None else beside.with_name(BENCH_FILE)
    before = settings_file.read(path, BenchFile) if path is not None and path.exists() else BenchFile()
    now = settings_file.parse({**before.model_dump(), **given}, BenchFile, "command line")
    if keep and path is not None and now != before:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{path.parent}: cannot be created: {error.strerror or error}") from error
        settings_file.write(path, now)
    return Identity(now.bench or "", now.operator or "", platform.node()[:64])
