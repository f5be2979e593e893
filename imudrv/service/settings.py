"""Settings of the live service: from a file, from the command line, or from both."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field as Key

from imudrv.errors import InputError
from imudrv.files.model import Model
from imudrv.files.settings_file import parse, read
from imudrv.imu.rate_filter import RateFilterName

Text = Annotated[str, Key(min_length=1, max_length=4096)]


class Settings(Model):
    """Settings of `imudrv run`.

    Paths in the file are relative to the folder in which the service is started. `unit`: serial number of the
    connected unit; a calibration of another one is refused. `record` may be a folder: each run then creates a
    file named by its start time; `sync_s` has the disk keep it at least that often; `pack` compresses and
    indexes it at the end of the run. `status`: the socket that reports the status. `realtime` requests
    SCHED_FIFO and locked memory.
    """

    format: Literal["imu50-service"] = "imu50-service"
    version: Literal[1] = 1
    port: Text
    profile: Text
    calibration: Text
    unit: Text | None = None
    outputs: Annotated[tuple[Text, ...], Key(max_length=16)] = ()
    record: Text | None = None
    sync_s: Annotated[float, Key(gt=0, le=3600, allow_inf_nan=False)] | None = None
    pack: bool = True
    rate_filter: RateFilterName = "causal"
    status: Text | None = None
    realtime: bool = False


def load(path: Path | None, given: dict[str, Any]) -> Settings:
    """Return the settings of a file, of the command line, or of both.

    Parameters
    ----------
    path : Path or None
        Settings file.
    given : dict
        Values of the command line; None: not given. They override the file.

    Returns
    -------
    Settings

    Raises
    ------
    InputError
        The file has faults, or a required value is missing in both.
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
