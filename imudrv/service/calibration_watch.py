"""Calibration file of a running service, read again whenever it changes."""

from pathlib import Path

from imudrv.calibration import Calibration, coefficients, read_calibration_file
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.files.settings_file import SettingsFile
from imudrv.imu.compensation import require_sensors
from imudrv.service.events import EventLog
from imudrv.service.status import CalibrationStatus
from imudrv.wire.layout import Layout


class CalibrationWatch:
    """The calibration in use, and its file.

    Parameters
    ----------
    path : Path
        Calibration file.
    unit : str or None
        Serial number of the connected unit; a calibration of another unit is refused. None: any unit.
    layout : Layout
        Layout of its profile; a calibration of other numbers than the unit sends is refused.
    events : EventLog
        Receives a refusal.

    Attributes
    ----------
    current : SettingsFile of Calibration
        The calibration in use.
    refused : str
        Why the file's present content is not used; empty if it is.

    Raises
    ------
    InputError
        The file cannot be used.
    """

    def __init__(self, path: Path, unit: str | None, layout: Layout, events: EventLog) -> None:
        self._path, self._unit, self._events = path, unit, events
        self._mark = atomic.change_mark(path)
        self._layout = layout
        self.current = self._read()
        self.refused = ""
        self._exchanges = 0

    @property
    def status(self) -> CalibrationStatus:
        """Current status of the calibration."""
        return CalibrationStatus(str(self._path), self.current.sha256, self._exchanges, self.refused)

    def _read(self) -> SettingsFile[Calibration]:
        found = read_calibration_file(self._path, self._unit)
        try:
            require_sensors(coefficients(found.model), self._layout)
        except InputError as error:
            raise InputError(f"{self._path}: {error}") from None
        return found

    def poll(self, reload: bool) -> SettingsFile[Calibration] | None:
        """Read the file again if it has changed.

        Parameters
        ----------
        reload : bool
            Read it even if it seems unchanged.

        Returns
        -------
        SettingsFile of Calibration or None
            The new calibration; None if the one in use stays.
        """
        mark = atomic.change_mark(self._path)
        if not reload and mark == self._mark:
            return None
        self._mark = mark
        try:
            found = self._read()
        except InputError as error:
            self.refused = str(error)
            self._events.failure(f"calibration refused, the previous one stays in use: {error}")
            return None
        self.refused = ""
        if found.sha256 == self.current.sha256:
            return None
        self.current = found
        self._exchanges += 1
        return found
