"""What the live service is told: its settings file, and the same from the command line."""

from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field as Key

from imudrv.errors import InputError
from imudrv.files.model import Model
from imudrv.files.settings_file import parse, read
from imudrv.imu.rate_filter import RateFilterName

Text = Annotated[str, Key(min_length=1, max_length=4096)]


FORMAT: Final = "imu50-service"


class Settings(Model):
    """Settings of `imudrv run`.

    Paths in the file are taken from where the service is started. `unit`: serial number of the connected
    unit; a calibration of another one is refused. `record` may be a folder: each run then makes a file of its
    own, named by its time. `status`: the socket that tells the status. `realtime` asks for SCHED_FIFO and
    locked memory.
    """

    format: Literal["imu50-service"] = "imu50-service"
    version: Literal[1] = 1
    port: Text
    profile: Text
    calibration: Text
    unit: Text | None = None
    outputs: Annotated[tuple[Text, ...], Key(max_length=16)] = ()
    record: Text | None = None
    rate_filter: RateFilterName = "causal"
    status: Text | None = None
    realtime: bool = False


def load(path: Path | None, given: dict[str, Any]) -> Settings:
    """Settings of a file, of the command line, or of both.

    Parameters
    ----------
    path : Path or None
        The settings file.
    given : dict
        What the command line says; None: not given. It goes before the file.

    Returns
    -------
    Settings

    Raises
    ------
    InputError
        The file has faults, or something is missing in both.
    """
    given = {name: value for name, value in given.items() if value is not None}
    if path is not None:
        settings = read(path, Settings)
        return parse({**settings.model_dump(mode="json", exclude_none=True), **given}, Settings, str(path))
    for name in ("port", "profile", "calibration"):
        if name not in given:
            raise InputError(
                f"expected a settings file, or --port, --profile and --calibration; got no --{name}"
            )
    return parse(given, Settings, "command line")
