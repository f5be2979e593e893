"""Run a bench session: feed the procedure, write journal and recordings, drive the screen (own thread).

The service reads the unit in the main thread, as it does in production. One of its sinks is the `QueueSink`,
from which `SessionController` takes samples: it feeds the engine, journals its events, begins and ends
recordings, shows the view and reads keys. Engine and session do not know each other.

The worker may be late, by seconds on a loaded machine or a slow disk, and the evidence is right all the same:

- A recording begins at the sample at which the engine asked for the unit to be placed, however late the
  worker comes to that event: the service keeps the last minutes of the line (`imudrv.sinks.history`).
- A step is accepted, shown as good and journaled only after its recording has been closed, decoded and found
  to hold every sample of the evidence. Otherwise the step is rejected with that reason and asked again.
- The worker never waits for the terminal: a `OperatorScreen` writes in a thread of its own.

A session goes through stages: the steps, the result, the decision, the verification. Each leaves its line in
the journal, so that a session that is resumed goes on behind the last.
"""

import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from dataclasses import asdict, fields
from queue import Empty
from typing import Final

import numpy as np

from calib.bench.evidence import Attempt, ResidualVelocity, Result, residual_velocity, uncovered
from calib.bench.journal import Entry
from calib.bench.keys import Keyboard
from calib.bench.queue_sink import QueueSink
from calib.bench.screen import OperatorScreen, with_port_state
from calib.bench.session import REPORT, RESULT, Session
from calib.certificate import write
from calib.lever_arms.gauge import convert
from calib.procedure.engine import Engine
from calib.procedure.events import Aborted, Accepted, Conditions, Entered, Event, Finished, Phase, Rejected
from calib.procedure.messages import english
from calib.procedure.plan import steps_left, verification
from calib.procedure.schema import VERIFICATION, Procedure
from calib.reports.identification import arms_text, report_html, verdict
from imudrv.calibration import Calibration, read_calibration, write_calibration
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.files.atomic import atomic_write
from imudrv.records import INCREMENTS, Records
from imudrv.service.loop import Service
from imudrv.sinks.base import Batch
from imudrv.units import NS_PER_S
from imudrv.wire.layout import Layout

SHOWN_S: Final = 0.2
"""The screen is drawn anew this often, and keys are read."""


ABORT: Final = "q once more: abort, keep what is accepted. Any other key: go on"


CLOSED_S: Final = 10.0
"""Longest wait for a recording to be closed once the service has ended."""


class _StoppedError(Exception):
    """The service has ended before the session."""


class SessionController:
    """The worker: leads a session to its end, or as far as it gets.

    Parameters
    ----------
    session : Session
        Open.
    procedure : Procedure
        Of the session.
    layout : Layout
        Of the unit.
    service : Service
        That reads it.
    tap : Tap
        One of the service's sinks.
    screen, keys
        Of the operator.
    hands_free : bool
        Nobody presses keys.
    begin : callable
        Told the procedure, of which each step is wanted, before its samples are: a rehearsal begins then.

    Attributes
    ----------
    error : BaseException or None
        What went wrong.
    outcome : str
        What has come out, in plain words; empty: the session is not at its end.
    """

    def __init__(
        self,
        session: Session,
        procedure: Procedure,
        layout: Layout,
        service: Service,
        tap: QueueSink,
        screen: OperatorScreen,
        keys: Keyboard,
        *,
        hands_free: bool,
        begin: Callable[[Procedure], None],
    ) -> None:
        self.error: BaseException | None = None
        self.outcome = ""
        self._session, self._procedure, self._layout = session, procedure, layout
        self._steps = {step.id: step for step in (*procedure.steps, *verification(procedure).steps)}
        self._service, self._tap, self._screen, self._keys = service, tap, screen, keys
        self._hands_free, self._begin = hands_free, begin
        self._is_new_to_unit = True
        self._backlog: deque[Batch] = deque()
        self._recording = ""
        self._has_ended = False
        self._conditions = Conditions()
        self._told_ns = 0

    def run(self) -> None:
        """Work, in a thread of its own."""
        try:
            with self._keys:
                self._stages()
        except _StoppedError:
            pass
        except BaseException as error:
            self.error = error
        finally:
            self._tap.release()
            self._service.stop()
            self._screen.close()

    def _stages(self) -> None:
        session = self._session
        if session.entry("finished") is None:
            last = self._through(self._procedure)
            if isinstance(last, Aborted):
                return
            if last.reasons:
                raise InputError(
                    "\n  ".join(
                        [
                            "too few steps are accepted; resume for those that were skipped:",
                            *map(english, last.reasons),
                        ]
                    )
                )
            session.append(_entry(last))
        self._screen.print("The lever arms are computed from the recordings ...")
        result = self._result()
        if self._tap.is_closed:
            raise _StoppedError  # nothing is decided behind a Ctrl-C
        decision = session.entry("decision")
        if decision is None:
            decision = {"event": "decision", "accepted": self._decided(result)}
            session.append(decision)
        if not decision["accepted"]:
            self.outcome = f"turned down; {session.plan.certificate} stays as it was"
            return
        self._activate(result.certificate)
        last = self._through(verification(self._procedure))
        if isinstance(last, Aborted):
            return
        left = self._left(result.certificate) if VERIFICATION in last.accepted else None
        if session.entry("end") is None:
            self._write_report(result, left)
            session.append({"event": "end", "velocity_left_m_s": None if left is None else left._asdict()})
        self.outcome = "\n".join(
            [
                f"active certificate: {session.plan.certificate}",
                f"verification: {left or 'skipped'}",
                f"report: {session.folder / REPORT}",
            ]
        )

    # Steps

    def _through(self, procedure: Procedure) -> Finished | Aborted:
        """Lead through the steps that are not accepted yet; all evidence is filed when it returns."""
        session = self._session
        ids = {step.id for step in procedure.steps}
        accepted = {name: _accepted(entry) for name, entry in session.accepted.items() if name in ids}
        engine = Engine(
            procedure,
            session.site(),
            session.calibration(),
            interval_ns=self._layout.interval_ns,
            hands_free=self._hands_free,
            accepted=accepted,
            attempts={name: session.attempt(name) - 1 for name in ids},
        )
        last = self._happened(engine, engine.feed(np.zeros(0, INCREMENTS)))
        if last is None:
            self._begin(steps_left(procedure, accepted))
        try:
            shown_s = 0.0
            while last is None:
                batch = self._next()
                events = () if batch is None else self._sampled(engine, batch)
                is_due = time.monotonic() - shown_s >= SHOWN_S
                if is_due and (shown := self._screen.shown) and (action := self._keys.action(shown)):
                    events += engine.handle(action)
                last = self._happened(engine, events)
                if events or is_due:
                    shown_s = time.monotonic()
                    view = with_port_state(engine.view, self._service.port_state)
                    self._screen.show(view, ABORT if self._keys.asks else "")
        except _StoppedError:
            self._enter_recording()  # the service has closed it
            raise
        self._end_recording()
        return last

    def _next(self) -> Batch | None:
        """Samples, kept or new; None: there is something else to do."""
        return self._backlog.popleft() if self._backlog else self._take()

    def _take(self) -> Batch | None:
        if self._has_ended:
            raise _StoppedError
        try:
            item = self._tap.take(SHOWN_S)
        except Empty:
            return None
        if isinstance(item, Batch):
            return item
        if item is None:
            self._has_ended = True
            raise _StoppedError
        self._session.append({"event": "service", "text": item})
        return None

    def _wait(self, done: Future[None]) -> None:
        """Wait until the service has done something or has ended; samples that come meanwhile are kept."""
        try:
            while not done.done():
                if batch := self._take():
                    self._backlog.append(batch)
        except _StoppedError:
            wait([done], CLOSED_S)
        if done.done() and not done.cancelled():
            done.result()

    def _sampled(self, engine: Engine, batch: Batch) -> tuple[Event, ...]:
        events: tuple[Event, ...] = ()
        if len(batch.pulses):
            newest = batch.pulses[-1]
            conditions = _conditions(newest, self._layout)
            since_ns = int(newest["elapsed_ns"]) - self._told_ns
            if conditions.bits != self._conditions.bits or not 0 <= since_ns < NS_PER_S:
                self._conditions, self._told_ns = conditions, int(newest["elapsed_ns"])
                if self._is_new_to_unit:
                    self._is_new_to_unit = False
                    self._recognise(int(newest["counter"]))
                events = engine.update_status(conditions)
        return events + engine.feed(batch.increments)

    def _recognise(self, counter: int) -> None:
        """Whether the unit, heard for the first time in this process, may go on where the session was."""
        session = self._session
        session.require_temperature(self._conditions.temperature_degc)
        newest = max((entry.get("counter", -1) for entry in session.entries), default=-1)
        session.append(
            {
                "event": "heard",
                "counter": counter,
                "restarted": counter < newest,
                "temperature_degc": dict(self._conditions.temperature_degc),
            }
        )

    def _happened(self, engine: Engine, events: Sequence[Event]) -> Finished | Aborted | None:
        last: Finished | Aborted | None = None
        waiting = deque(events)
        while waiting:
            event = waiting.popleft()
            if isinstance(event, Accepted):
                if reason := self._filed(engine, event):
                    waiting += engine.reject(event.step_id, reason)
                continue
            if isinstance(event, Finished | Aborted):
                last = event
            if isinstance(event, Rejected):
                self._end_recording()
                last = None
            if isinstance(event, Entered) and event.phase is Phase.PLACE:
                self._begin_recording(f"run-{event.step_id}-{event.attempt}", event.counter)
            if not isinstance(event, Finished):
                self._session.append(_entry(event))
        return last

    # Recordings

    def _begin_recording(self, name: str, since: int) -> None:
        if name == self._recording:
            return
        self._end_recording()
        begun = self._service.record(self._session.folder / f"{name}.mcap", since)
        self._wait(begun)
        if begun.cancelled():
            raise _StoppedError
        self._recording = name

    def _end_recording(self) -> None:
        if self._recording:
            self._wait(self._service.record(None))
            self._enter_recording()

    def _enter_recording(self) -> None:
        name, self._recording = self._recording, ""
        if name:
            self._session.enter(f"{name}.mcap")

    def _filed(self, engine: Engine, event: Accepted) -> str:
        """File an accepted attempt: recording, log, then the line that makes it count; or say why not."""
        session, name = self._session, self._recording
        self._end_recording()
        attempt = Attempt(
            self._steps[event.step_id],
            session.folder / f"{name}.mcap",
            event.first_counter,
            event.last_counter,
            event.samples,
        )
        try:
            lacks = uncovered(attempt)
        except InputError as error:
            return str(error)
        if lacks:
            return f"{lacks}: this computer, or its disk, was held up for too long"
        log = next(log for log in reversed(engine.runs) if log.step_id == event.step_id)
        with atomic_write(session.folder / f"{name}.npz") as archive:
            np.savez(archive, **{f.name: getattr(log, f.name) for f in fields(log)})
        session.enter(f"{name}.npz")
        degc = dict(self._conditions.temperature_degc)
        session.append({**_entry(event), "recording": f"{name}.mcap", "temperature_degc": degc})
        return ""

    # After the steps

    def _result(self) -> Result:
        session = self._session
        result = session.identify()
        path = session.folder / RESULT
        if RESULT in session.files:
            return result._replace(certificate=read_calibration(path))
        path.unlink(missing_ok=True)  # of a process that was killed before it entered it
        write_calibration(path, result.certificate)
        session.enter(RESULT)
        return result

    def _decided(self, result: Result) -> bool:
        self._screen.print(_summary(result))
        if self._hands_free:
            return all(mark != "bad" for mark, _ in verdict(result.findings))
        self._screen.print(f"Accept it as the certificate of unit {self._session.plan.unit}? [y/n]")
        while not self._screen.is_idle:
            self._take()
        self._keys.read()  # what was typed before the question is no answer to it
        answer = ""
        while not answer:
            self._take()
            answer = next((key for key in self._keys.read() if key in "yn"), "")
        return answer == "y"

    def _activate(self, certificate: Calibration) -> None:
        """Make it the active one, unless it is already."""
        session = self._session
        active = session.plan.certificate
        digest = atomic.sha256(active)
        if digest == session.plan.certificate_sha256:
            write(active, certificate)
        elif digest != session.files[RESULT]:
            raise InputError(
                f"{active}: expected the certificate that the session began with, it was changed meanwhile; "
                f"it stays so, the result is in {session.folder / RESULT}"
            )

    def _left(self, certificate: Calibration) -> ResidualVelocity:
        """Velocity left by the verification rotation."""
        session, procedure = self._session, verification(self._procedure)
        attempt = session.attempt_at(procedure.steps[0])
        return residual_velocity(procedure, attempt, certificate, session.site())

    def _write_report(self, result: Result, left: ResidualVelocity | None) -> None:
        findings = result.findings
        html = report_html(findings, (findings.arms, convert(findings.arms, "x")))
        words = "was skipped" if left is None else f"with the new certificate: {left}"
        section = f"<section>\n<h2>Verification</h2>\n<p>One more rotation {words}.</p>\n</section>"
        with atomic_write(self._session.folder / REPORT) as file:
            file.write(html.replace("</section>", f"</section>\n{section}", 1).encode())  # behind the result
        self._session.enter(REPORT)


def _summary(result: Result) -> str:
    """What the operator has to know to decide."""
    verdicts = [f"{mark}: {text}" for mark, text in verdict(result.findings)]
    return "\n".join([arms_text(result.findings.arms), *verdicts])


def _entry(event: Event) -> Entry:
    return {"event": type(event).__name__.lower(), **asdict(event)}


def _accepted(entry: Entry) -> Accepted:
    values = {f.name: entry[f.name] for f in fields(Accepted) if f.name in entry}
    return Accepted(**{**values, "v_n": tuple(values["v_n"])})


def _conditions(pulses: Records, layout: Layout) -> Conditions:
    """What a sample tells beside its pulses."""

    def names(word: int) -> tuple[str, ...]:
        return tuple(name for bit, name in layout.status_names if word >> bit & 1)

    word = int(pulses["status"])
    degc = zip(layout.temperature_names, pulses["temperature_degc"].tolist(), strict=False)
    return Conditions(
        names(word), names(word & layout.status.fault), {name: t if t == t else None for name, t in degc}
    )
