"""Recordings of a session: one of each attempt at a run, or one of all rests and the motions between."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields

import numpy as np

from calib.bench.entries import AcceptedRest, AcceptedStep
from calib.bench.queue_sink import QueueReader, ServiceEndedError
from calib.bench.result import uncovered, uncovered_rests
from calib.bench.session import Session
from calib.bench.state import RECORDING_SUFFIX, Attempt, SessionState
from calib.messages import Message, message
from calib.procedure.events import Accepted, Entered, NavigationLog, RestAccepted
from calib.procedure.schema import Run
from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.recording.pack import pack
from imudrv.service.loop import Service


class SessionRecordings:
    """Begins and ends recordings, and files accepted steps.

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
        self._is_of_rests = not session.procedure().runs
        self._current = ""

    def begin(self, entered: Entered) -> None:
        """Begin the recording of an attempt, or of all rests.

        Parameters
        ----------
        entered : Entered
            The unit is to be placed from this sample on; the service's history may reach back so far.

        Raises
        ------
        ServiceEndedError
            The service has ended.
        """
        if self._is_of_rests:
            name = self._current or self._session.next_recording()
        else:
            name = f"run-{entered.step_id}-{entered.attempt}"
        if name == self._current:
            return
        self.end()
        begun = self._service.record(self._session.folder / f"{name}{RECORDING_SUFFIX}", entered.counter)
        self._queue.wait(begun)
        if begun.cancelled():
            raise ServiceEndedError
        self._current = name

    def end(self) -> None:
        """End the current recording, if there is one, and record its hash."""
        if self._current:
            self._queue.wait(self._service.record(None))
            self.record_closed()

    def end_of_attempt(self) -> None:
        """End the recording of an attempt; that of all rests goes on."""
        if not self._is_of_rests:
            self.end()

    def accept(self, accepted: RestAccepted) -> None:
        """Write an accepted rest to the journal."""
        recording = f"{self._current}{RECORDING_SUFFIX}"
        self._session.append(AcceptedRest(**vars(accepted), recording=recording))

    def end_of_rests(self) -> list[tuple[str, Message]]:
        """End the recording of all rests; return those that it does not cover, and why."""
        if not self._is_of_rests or not self._current:
            return []
        name = f"{self._current}{RECORDING_SUFFIX}"
        self.end()
        return uncovered_steps(self._session, name)

    def record_closed(self) -> None:
        """Pack the current recording, which the service has closed, and record its hash."""
        name, self._current = self._current, ""
        if name:
            path = self._session.folder / f"{name}{RECORDING_SUFFIX}"
            with suppress(InputError):  # no room, or a damaged file: it stays as it was written
                pack(path, path)
            self._session.record_file(path.name)

    def file(
        self, run: Run, accepted: Accepted, log: NavigationLog, degc: Mapping[str, float | None]
    ) -> Message | None:
        """End the recording of an accepted attempt, check it, and write the attempt to the journal.

        Parameters
        ----------
        run : Run
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
        path = session.folder / f"{name}{RECORDING_SUFFIX}"
        try:
            missing = uncovered(
                Attempt(run, path, accepted.first_counter, accepted.last_counter, accepted.samples)
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


def uncovered_steps(session: SessionState, recording: str) -> list[tuple[str, Message]]:
    """Return the accepted rests that their recording does not cover, and why.

    Parameters
    ----------
    session : SessionState
        The session.
    recording : str
        Name of a recording that is closed, or was cut.
    """
    rests = [a for a in session.accepted.values() if isinstance(a, AcceptedRest) and a.recording == recording]
    if not rests:
        return []
    try:
        lacking = uncovered_rests(session.path(recording), rests)
    except InputError as error:
        return [(rest.step_id, message("recording_unreadable", why=str(error))) for rest in rests]
    return [(step_id, message("recording_lacks", what=what)) for step_id, what in lacking.items()]
