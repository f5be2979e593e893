"""Run a bench session: feed the procedure, write journal and recordings, drive the screen (own thread).

The service reads the unit in the main thread, as in production. One of its sinks is the `QueueSink`, from
which `SessionController` takes samples: it feeds the engine, journals its events, begins and ends recordings,
shows the view and reads keys. Engine and session do not know each other.

The worker may be late, by seconds on a loaded machine or a slow disk; nothing of a recording is lost then:

- A recording begins at the sample at which the engine asked to place the unit, however late the worker
  handles that event: the service keeps the last minutes of wire data (`imudrv.sinks.history`).
- A step is accepted, shown as good and journaled only after its recording has been closed, decoded and found
  to contain every sample of the attempt. Otherwise the step is rejected with that reason and repeated.
- The worker never waits for the terminal: an `OperatorScreen` writes in a thread of its own.

The stages of a session are the steps, the result, the decision and the verification. Each is journaled, so
that a resumed session continues after the last one.
"""

import time
from collections import deque
from collections.abc import Callable, Sequence
from math import isnan
from typing import Final

import numpy as np

from calib.bench.completion import (
    accepted_result,
    activate,
    ask_operator,
    decide_alone,
    session_result,
    summarise,
    write_report,
)
from calib.bench.entries import Counted, Decision, ServiceMessage, SessionEnded, UnitDetected
from calib.bench.keys import Keyboard
from calib.bench.kinds import SessionResult
from calib.bench.queue_sink import QueueReader, QueueSink, ServiceEndedError
from calib.bench.recordings import SessionRecordings
from calib.bench.result import Result, residual_velocity
from calib.bench.resume import require_temperature
from calib.bench.screen import OperatorScreen, with_port_state
from calib.bench.session import Session
from calib.bench.state import REPORT
from calib.bench.web_console import PERIOD_S, WebConsole
from calib.messages import Message, english, message
from calib.procedure.engine import Engine
from calib.procedure.events import (
    Aborted,
    Accepted,
    Conditions,
    Entered,
    Event,
    Finished,
    Phase,
    Rejected,
    RestAccepted,
    View,
)
from calib.procedure.plan import all_steps, steps_left, verification
from calib.procedure.schema import VERIFICATION, Procedure, Run
from imudrv.errors import InputError
from imudrv.records import INCREMENTS, Records
from imudrv.service.loop import Service
from imudrv.sinks.base import Batch
from imudrv.units import NS_PER_S
from imudrv.wire.layout import Layout, SequenceKind

REDRAW_S: Final = 0.2
"""Interval at which the screen is redrawn and keys are read, s."""


class SessionController:
    """Worker that conducts a session to its end, or as far as possible.

    Parameters
    ----------
    session : Session
        The session, open.
    layout : Layout
        Wire layout of the unit.
    service : Service
        Reads the unit.
    queue : QueueSink
        One of the service's sinks.
    screen, keys
        The operator's terminal.
    hands_free : bool
        The steps need no keys.
    accepts : bool
        The result is accepted without a person, unless a verdict is bad.
    begin : callable
        Called with the procedure of the steps to do, before their samples are read; a rehearsal starts its
        unit then.
    watch : callable
        Called with each view; a simulated technician looks at it.
    web : WebConsole or None
        The operator's page, beside the terminal.

    Attributes
    ----------
    error : BaseException or None
        Error that ended the work.
    outcome : tuple of Message
        Summary for the operator; empty if the session is not at its end.
    is_undecided : bool
        The result waits for a person to accept or reject it.
    """

    def __init__(
        self,
        session: Session,
        layout: Layout,
        service: Service,
        queue: QueueSink,
        screen: OperatorScreen,
        keys: Keyboard,
        *,
        hands_free: bool,
        accepts: bool,
        begin: Callable[[Procedure], None],
        watch: Callable[[View], None] = lambda _: None,
        web: WebConsole | None = None,
    ) -> None:
        self.error: BaseException | None = None
        self.outcome: tuple[Message, ...] = ()
        self.is_undecided = False
        self._session, self._layout, self._service = session, layout, service
        self._procedure = procedure = session.procedure()
        self._runs = {step.id: step for step in all_steps(procedure) if isinstance(step, Run)}
        self._sink, self._screen, self._keys = queue, screen, keys
        self._queue = QueueReader(queue, lambda text: session.append(ServiceMessage(text)))
        self._recordings = SessionRecordings(session, service, self._queue)
        self._hands_free, self._accepts, self._begin = hands_free, accepts, begin
        self._watch, self._web = watch, web
        self._line = service.port_state
        self._is_unit_detected = False
        self._conditions = Conditions()
        self._conditions_ns = 0

    def run(self) -> None:
        """Conduct the session, in a thread of its own."""
        try:
            with self._keys:
                self._run_stages()
        except ServiceEndedError:
            pass
        except BaseException as error:
            self.error = error
        finally:
            self._sink.release()
            self._service.stop()
            self._screen.close()

    def _run_stages(self) -> None:
        session = self._session
        if session.stage(Finished) is None:
            last = self._run_steps(self._procedure)
            if isinstance(last, Aborted):
                return
            if last.reasons:
                raise InputError(f"no result: {'; '.join(map(english, last.reasons))}; resume the session")
            session.append(last)
        self._screen.say(message("computing"))
        result = session_result(session)
        if self._sink.is_closed:
            raise ServiceEndedError  # nothing is decided after Ctrl-C
        if not isinstance(result, Result) and session.stage(Decision) is None:
            write_report(session, result)  # there is one without a certificate, too
        if result.certificate is None:
            summarise(result, self._screen)
            session.end(Decision(False))
            report = str(session.folder / REPORT)
            self.outcome = (message("no_certificate"), message("report", path=report))
            return
        decision = self._decision(result)
        if decision is None:
            self.is_undecided = True
            self._screen.say(message("undecided"))
            return
        if not decision.accepted:
            path = str(session.plan.certificate.path)
            self.outcome = (message("result_rejected", path=path),)
            return
        activate(session)
        if not isinstance(result, Result):
            session.end(SessionEnded(None))
            self.outcome = accepted_result(session)
            return
        if REPORT not in session.files:
            write_report(session, result)
        for line in accepted_result(session):
            self._screen.say(line)
        last = self._run_steps(verification(self._procedure))
        if isinstance(last, Aborted):
            return
        residual = None
        if VERIFICATION in last.accepted:
            residual = residual_velocity(session, result.certificate)
        verified = message("verification_skipped") if residual is None else residual.message
        write_report(session, result, verified)
        session.end(SessionEnded(residual))
        self.outcome = (*accepted_result(session), message("verification", result=verified))

    def _decision(self, result: SessionResult) -> Decision | None:
        """Return the decision in the journal, or take it now; None: nobody is there."""
        decision = self._session.stage(Decision)
        if decision is None:
            summarise(result, self._screen)
            if self._accepts:
                decision = Decision(decide_alone(result))
            elif not self._keys.there and self._web is None:
                return None
            else:
                unit = self._session.plan.unit
                answer = ask_operator(result, unit, self._screen, self._keys, self._web, self._queue)
                decision = Decision(answer)
            if decision.accepted:
                self._session.append(decision)
        if not decision.accepted:
            self._session.end(decision)
        return decision

    def _run_steps(self, procedure: Procedure) -> Finished | Aborted:
        """Conduct the steps that are not accepted yet; on return all recordings are filed."""
        session = self._session
        ids = {step.id for step in procedure.steps}
        accepted = {name: step for name, step in session.accepted.items() if name in ids}
        engine = Engine(
            procedure,
            session.site(),
            session.calibration(),
            interval_ns=self._layout.interval_ns,
            hands_free=self._hands_free,
            accepted=accepted,
            attempts={name: session.next_attempt(name) - 1 for name in ids},
            rested_s=session.rested_s,
        )
        last = self._apply_events(engine, engine.feed(np.zeros(0, INCREMENTS)))
        if last is None:
            self._begin(steps_left(procedure, accepted))
        try:
            shown_s = web_s = 0.0
            while last is None:
                batch = self._queue.next()
                events = () if batch is None else self._feed(engine, batch)
                is_due = time.monotonic() - shown_s >= REDRAW_S
                if is_due and (shown := self._screen.shown) and (action := self._keys.action(shown)):
                    events += engine.handle(action)
                if self._web is not None and time.monotonic() - web_s >= PERIOD_S:
                    web_s = max(web_s + PERIOD_S, time.monotonic() - PERIOD_S)  # no frame is made up for
                    if chosen := self._web.action(engine.view):
                        events += engine.handle(chosen)
                    self._web.show(self._view(engine))
                last = self._apply_events(engine, events)
                if events or is_due:
                    shown_s = time.monotonic()
                    view = self._view(engine)
                    self._watch(view)
                    self._screen.show(view, self._keys.question)
        except ServiceEndedError:
            self._recordings.record_closed()
            raise
        self._recordings.end()
        if self._web is not None:
            self._web.show(engine.view)  # the newest one may have come between two frames
        return last

    def _view(self, engine: Engine) -> View:
        """Return the engine's view with the state of the line, both of the samples that it has been fed.

        The line may have ended while samples still wait: the engine then has data.
        """
        if not self._queue.has_samples:
            self._line = self._service.port_state
        return with_port_state(engine.view, self._line)

    def _feed(self, engine: Engine, batch: Batch) -> tuple[Event, ...]:
        """Feed samples to the engine; faults and temperatures once a second, or when the faults change."""
        if self._service.port_state.name == "wrong rate":
            return ()  # their intervals are wrong; afterwards the engine finds the gap
        events: tuple[Event, ...] = ()
        if len(batch.pulses):
            newest = batch.pulses[-1]
            conditions = _conditions(newest, self._layout)
            since_ns = int(newest["elapsed_ns"]) - self._conditions_ns
            is_due = not self._is_unit_detected or not 0 <= since_ns < NS_PER_S
            if is_due or conditions.faults != self._conditions.faults:
                self._conditions, self._conditions_ns = conditions, int(newest["elapsed_ns"])
                if not self._is_unit_detected:
                    self._is_unit_detected = True
                    self._check_unit(int(newest["counter"]) // self._layout.counter_step)
                events = engine.update_status(conditions)
        return events + engine.feed(batch.increments)

    def _check_unit(self, counter: int) -> None:
        """Check the temperature of the unit when its first data arrive, and note whether it has restarted.

        Samples of a unit without a counter are numbered from 0 by each process: that shows no restart.
        """
        session, degc = self._session, dict(self._conditions.temperature_degc)
        require_temperature(session, degc)
        newest = max((entry.counter for entry in session.entries if isinstance(entry, Counted)), default=-1)
        is_counted = self._layout.sequence.kind is SequenceKind.COUNTER
        session.append(UnitDetected(counter, is_counted and counter < newest, degc))

    def _apply_events(self, engine: Engine, events: Sequence[Event]) -> Finished | Aborted | None:
        """Journal events, begin and end recordings; return the event that ends the steps."""
        last: Finished | Aborted | None = None
        waiting = deque(events)
        while waiting:
            event = waiting.popleft()
            if isinstance(event, Accepted):
                if reason := self._file(engine, event):
                    waiting += engine.reject(event.step_id, reason)
            elif isinstance(event, RestAccepted):
                self._recordings.accept(event)
            elif isinstance(event, Finished):
                last = event  # journaled with the stage
                for step_id, reason in self._recordings.end_of_rests():
                    waiting += engine.reject(step_id, reason)
            else:
                if isinstance(event, Aborted):
                    last = event
                elif isinstance(event, Rejected):
                    self._recordings.end_of_attempt()
                    last = None
                elif isinstance(event, Entered) and event.phase is Phase.PLACE:
                    self._recordings.begin(event)
                self._session.append(event)
        return last

    def _file(self, engine: Engine, event: Accepted) -> Message | None:
        """File an accepted attempt; return why that is impossible."""
        log = next(log for log in reversed(engine.runs) if log.step_id == event.step_id)
        degc = self._conditions.temperature_degc
        return self._recordings.file(self._runs[event.step_id], event, log, degc)


def _conditions(pulses: Records, layout: Layout) -> Conditions:
    """Return faults and temperatures of a sample."""
    bits = layout.active_bits(int(pulses["status"]))
    degc = zip(layout.temperature_names, pulses["temperature_degc"].tolist(), strict=False)
    return Conditions(
        tuple(name for mask, name in bits.items() if mask & layout.status.fault),
        {name: None if isnan(t) else t for name, t in degc},
    )
