"""Recordings of the attempts of a session."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields

import numpy as np

from calib.bench.entries import AcceptedStep
from calib.bench.queue_sink import QueueReader, ServiceEndedError
from calib.bench.result import uncovered
from calib.bench.session import Session
from calib.bench.state import Attempt
from calib.messages import Message, message
from calib.procedure.events import Accepted, NavigationLog
from calib.procedure.schema import Step
from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.recording.pack import pack
from imudrv.service.loop import Service


class AttemptRecordings:
    """Begins and ends recordings, and files accepted attempts.

    Parameters
    ----------
    session : Session
        The session.
    service : Service
        Records the unit's wire data.
    queue : QueueReader
        Read while the service begins or ends a recording.
    """

    def __init__(self, session: Session, service: Service, queue: QueueReader) -> None:
        self._session, self._service, self._queue = session, service, queue
        self._current = ""

    def begin(self, name: str, since: int) -> None:
        """Begin a recording.

        Parameters
        ----------
        name : str
            File name without suffix; a recording of another name is ended first.
        since : int
            Counter of the sample to begin with, as far back as the service's history reaches.

        Raises
        ------
        ServiceEndedError
            The service has ended.
        """
        if name == self._current:
            return
        self.end()
        begun = self._service.record(self._session.folder / f"{name}.mcap", since)
        self._queue.wait(begun)
        if begun.cancelled():
            raise ServiceEndedError
        self._current = name

    def end(self) -> None:
        """End the current recording, if there is one, and record its hash."""
        if self._current:
            self._queue.wait(self._service.record(None))
            self.record_closed()

    def record_closed(self) -> None:
        """Pack the current recording, which the service has closed, and record its hash."""
        name, self._current = self._current, ""
        if name:
            path = self._session.folder / f"{name}.mcap"
            with suppress(InputError):  # no room, or a damaged file: it stays as it was written
                pack(path, path)
            self._session.record_file(path.name)

    def file(
        self, step: Step, accepted: Accepted, log: NavigationLog, degc: Mapping[str, float | None]
    ) -> Message | None:
        """End the recording of an accepted attempt, check it, and write the attempt to the journal.

        Parameters
        ----------
        step : Step
            The step.
        accepted : Accepted
            The engine's verdict.
        log : NavigationLog
            Velocity and H of the attempt.
        degc : mapping
            Temperature by channel, degrees Celsius.

        Returns
        -------
        Message or None
            Why the attempt cannot be accepted; None if it is.
        """
        session, name = self._session, self._current
        self.end()
        path = session.folder / f"{name}.mcap"
        try:
            missing = uncovered(
                Attempt(step, path, accepted.first_counter, accepted.last_counter, accepted.samples)
            )
        except InputError as error:
            return message("recording_unreadable", why=str(error))
        if missing:
            return message("recording_lacks", what=missing)
        with atomic_write(session.folder / f"{name}.npz") as archive:
            np.savez(archive, **{f.name: getattr(log, f.name) for f in fields(log)})
        session.record_file(f"{name}.npz")
        session.append(AcceptedStep(**vars(accepted), recording=path.name, temperature_degc=dict(degc)))
        return None
