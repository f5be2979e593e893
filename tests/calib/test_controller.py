"""Controller of a session, with samples from a queue instead of a unit."""

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from threading import Thread
from time import sleep
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rich.console import Console

from calib.bench import completion
from calib.bench import controller as controllers
from calib.bench.controller import SessionController
from calib.bench.entries import (
    AcceptedStep,
    EmbeddedFile,
    Entry,
    FileRecorded,
    ServiceMessage,
    UnitDetected,
    to_json,
)
from calib.bench.keys import Keyboard
from calib.bench.queue_sink import QueueSink
from calib.bench.result import Result
from calib.bench.screen import OperatorScreen, plain
from calib.bench.session import Session
from calib.bench.technician import BENCH, Mistake, technician_scenario
from calib.bench.verify import verify
from calib.messages import Message, english
from calib.procedure.events import Accepted, Entered, Phase, Rejected, View
from calib.procedure.plan import steps_left
from calib.procedure.schema import Procedure
from imudrv import profiles
from imudrv.calibration import coefficients, write_calibration
from imudrv.diagnosis import LineState
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.imu.compensation import Compensator
from imudrv.imu.sequence import SequenceTracker
from imudrv.recording.reader import Recording
from imudrv.records import Arrival, Source
from imudrv.service.loop import Service
from imudrv.service.settings import Settings
from imudrv.sim.scenario import NOMINAL, Rest, Scenario, Segment
from imudrv.sim.unit import simulate
from imudrv.sinks.base import Batch
from imudrv.sinks.history import MAX_BYTES, History
from imudrv.sinks.recorder import Recorder
from imudrv.wire.datagram import encode
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.encode import StreamEncoder

LAYOUT = profiles.load("imu50-rs422").layout()
ONE = """
format: imu50-procedure
version: 1
name: one
align_s: 30
rest_s: 4
poses: [{id: z-up, up: +Z, east: +X, turn_deg: 180}]
"""
PROCEDURE = settings_file.parse_text(ONE.encode(), Procedure, "one.yaml")


class Line:
    """Stand-in for the service, whose unit has already sent everything: records from the history."""

    def __init__(self, history: History) -> None:
        self.stopped = False
        self.states: list[LineState] = []
        self.dropped = range(0)
        self._history = history
        self._encoder = StreamEncoder(LAYOUT)

    @property
    def port_state(self) -> LineState:
        """Next state at each call; without a fault at the end."""
        return self.states.pop(0) if self.states else LineState("streaming")

    def publish(self, batch: Batch) -> None:
        wire = self._encoder.encode(batch.pulses).tobytes()
        self._history.arrived(Arrival(int(batch.pulses["elapsed_ns"][-1]), wire))
        self._history.publish(batch)

    def record(self, path: Path | None, since: int = 0) -> Future[None]:
        if path is not None:
            recorder = Recorder(
                path,
                layout=LAYOUT,
                profile=profiles.content("imu50-rs422"),
                calibration=None,
                source=Source.SIMULATOR,
                port="nowhere",
                unit="nominal",
            )
            recorder.catch_up([m for m in self._history.since(since) if m.first not in self.dropped])
            recorder.close()
            self.dropped = range(0)
        done: Future[None] = Future()
        done.set_result(None)
        return done

    def stop(self) -> None:
        self.stopped = True


class Typed(Keyboard):
    """Keyboard that answers what the screen shows."""

    def __init__(self, press: Callable[[str], str] = lambda _: "") -> None:
        super().__init__()
        self.press = press
        self.seen = ""

    def read(self) -> str:
        return self.press(self.seen)


class Shown(OperatorScreen):
    """Screen that the keyboard reads at once."""

    def __init__(self, keys: Typed) -> None:
        self.text = StringIO()
        super().__init__(Console(file=self.text, width=200))
        self._typed = keys

    def show(self, view: View, question: Message | None = None) -> None:
        super().show(view, question)
        while not self.is_idle:
            sleep(0.001)
        self._typed.seen = plain(view, question)


def performed(scenario: Scenario) -> list[Batch]:
    """Samples of a scenario, in pieces of a fifth of a second."""
    compensator = Compensator(coefficients(NOMINAL.model_copy(update={"size_effect": None})), LAYOUT)
    made = []
    for chunk in simulate(scenario, LAYOUT):
        for begin in range(0, len(chunk.pulses), 200):
            pulses = chunk.pulses[begin : begin + 200]
            increments = compensator.feed(pulses)
            made.append(Batch(pulses, increments, encode(increments, Source.SIMULATOR)))
    return made


@pytest.fixture(scope="module")
def batches() -> list[Batch]:
    return performed(technician_scenario(PROCEDURE, calibration=NOMINAL))


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    settings_file.write(tmp_path / "site.yaml", BENCH)
    session = Session.create(
        tmp_path / "session",
        procedure=EmbeddedFile.of("one.yaml", ONE.encode()),
        calibration=tmp_path / "unit.yaml",
        site=EmbeddedFile.of("site.yaml", (tmp_path / "site.yaml").read_bytes()),
        profile="imu50-rs422",
        port="nowhere",
    )
    yield session
    session.close()


def conducted(
    session: Session,
    items: list[Batch | str],
    keys: Typed | None = None,
    *,
    hands_free: bool = True,
    accepts: bool = True,
    stopped: bool = True,
    history_bytes: int = MAX_BYTES,
    dropped: range = range(0),
    port_states: Sequence[LineState] = (),
) -> tuple[SessionController, str]:
    """Run the controller over items; `stopped`: the service ended before they were taken.

    All items have passed before the controller begins: it is as late as possible. `dropped`: samples that the
    first recording lacks.
    """
    tap, line, keys = QueueSink(None), Line(History(history_bytes)), keys or Typed()
    line.dropped = dropped
    line.states += port_states
    for item in items:
        if isinstance(item, str):
            tap.put_message(item)
        else:
            tap.publish(item)
            line.publish(item)
    tap.close()
    tap.is_closed = stopped
    screen = Shown(keys)
    conduct = SessionController(
        session,
        LAYOUT,
        line,  # type: ignore[arg-type]
        tap,
        screen,
        keys,
        hands_free=hands_free,
        accepts=accepts,
        begin=lambda _: None,
    )
    conduct.run()
    assert line.stopped
    return conduct, screen.text.getvalue()


def events(session: Session) -> list[str]:
    return [to_json(entry)["event"] for entry in session.entries]


def rejected(session: Session) -> Rejected:
    """The only rejection."""
    (entry,) = (entry for entry in session.entries if isinstance(entry, Rejected))
    return entry


def phases(session: Session, phase: Phase) -> list[Entered]:
    return [entry for entry in session.entries if isinstance(entry, Entered) and entry.phase is phase]


def test_a_step_is_accepted_once_its_files_are_in(session: Session, batches: list[Batch]) -> None:
    conducted(session, list(batches))
    (accepted,) = session.accepted.values()
    assert accepted.recording == "run-z-up-1.mcap"
    assert accepted.temperature_degc["gyro"] == 35.0
    at = events(session).index("accepted")
    assert [entry.name for entry in session.entries[at - 2 : at] if isinstance(entry, FileRecorded)] == [
        "run-z-up-1.mcap",
        "run-z-up-1.npz",
    ]
    with np.load(session.folder / "run-z-up-1.npz") as log:
        assert log["H"].shape == (len(log["counter"]), 3, 9)
    assert events(session).index("finished") > at
    assert verify(session.folder).faults == ()


def test_with_an_operator_nothing_continues_without_a_key(session: Session, batches: list[Batch]) -> None:
    _, text = conducted(session, list(batches), hands_free=False)
    assert "PRESS ENTER" in text
    assert "align" not in text
    assert session.accepted == {}


def test_the_operators_key_confirms(
    session: Session, batches: list[Batch], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controllers, "REDRAW_S", 0.0)
    keys = Typed(lambda seen: "\n" if "PRESS ENTER" in seen else "")
    conducted(session, list(batches), keys, hands_free=False)
    assert list(session.accepted) == ["z-up"]


def test_an_aborted_session_can_be_resumed(
    session: Session, batches: list[Batch], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controllers, "REDRAW_S", 0.0)
    keys = Typed(lambda seen: "y" if "[y/n]" in seen else "q" if "align" in seen else "")
    conduct, text = conducted(session, list(batches), keys)
    assert "End the session? Accepted steps are kept. [y/n]" in text
    assert conduct.error is None
    assert conduct.outcome == ()
    assert sorted(events(session)[-2:]) == ["aborted", "file"]
    assert session.next_attempt("z-up") == 2
    assert not session.is_over


def test_messages_of_the_service_about_the_port_are_shown_and_journaled(
    session: Session, batches: list[Batch], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controllers, "REDRAW_S", 0.0)
    lost = "port lost: the other end has gone"
    states = [LineState("streaming")] * 51 + [LineState("lost", "the other end has gone")]
    _, text = conducted(session, [*batches[:50], lost], port_states=states)
    assert f"! {lost}" in text
    assert [entry.text for entry in session.entries if isinstance(entry, ServiceMessage)] == [lost]
    assert "!" not in text.splitlines()[-1]


def test_a_line_that_has_ended_is_no_fault_while_its_samples_wait(
    session: Session, batches: list[Batch], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controllers, "REDRAW_S", 0.0)
    ended = LineState("lost", "the simulated unit has ended")
    _, text = conducted(session, list(batches), port_states=[LineState("streaming"), *[ended] * 9999])
    assert "GOOD: STEP 1 OF 1 DONE" in text
    assert "NO DATA" not in text


def test_nothing_is_accepted_while_the_rate_of_the_unit_is_not_that_of_its_profile(
    session: Session, batches: list[Batch], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controllers, "REDRAW_S", 0.0)
    wrong = LineState("wrong rate", "expected 1000 samples/s, the unit counts 500.0")
    _, text = conducted(session, [*batches], port_states=[wrong] * 10 * len(batches))
    assert "preflight: WRONG RATE: CHECK THE PROFILE | " in text
    assert "! port wrong rate: expected 1000 samples/s, the unit counts 500.0" in text
    assert not session.accepted


def test_a_mistake_is_journaled_with_its_reasons_and_its_recording_is_kept(session: Session) -> None:
    scenario = technician_scenario(PROCEDURE, [Mistake("z-up", "short")], calibration=NOMINAL)
    _, text = conducted(session, performed(scenario))
    rejection = rejected(session)
    assert "turned 150" in english(rejection.reasons[0])
    assert "turned 150" in text
    assert session.accepted["z-up"].recording == "run-z-up-2.mcap"
    before = session.entries[session.entries.index(rejection) - 1]
    assert isinstance(before, FileRecorded)
    assert before.name == "run-z-up-1.mcap"  # it ends with the verdict
    assert "run-z-up-2.mcap" in session.files


# A worker that is late


def test_a_recording_begins_where_the_engine_asked_for_the_unit_to_be_placed(
    session: Session, batches: list[Batch]
) -> None:
    conducted(session, list(batches))
    placed = phases(session, Phase.PLACE)[0]
    recording = Recording(session.folder / "run-z-up-1.mcap")
    decoder, tracker = FrameDecoder(LAYOUT), SequenceTracker(LAYOUT)
    pulses = tracker.feed(decoder.feed(b"".join(bytes(a.data) for a in recording.arrivals())))
    published = np.concatenate(list(recording.increments()))["counter"]
    # two batches of 200 samples in front of that one
    assert placed.counter - 600 < pulses["counter"][0] <= placed.counter
    assert (np.diff(pulses["counter"]) == 1).all()
    assert np.array_equal(published, pulses["counter"])
    with recording.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.chunk_indexes, "it is packed before its hash enters the journal"


@pytest.mark.parametrize("history_bytes", [1 << 20, 4 << 20])
def test_a_step_is_repeated_with_the_reason_if_the_history_is_too_short(
    session: Session, batches: list[Batch], history_bytes: int
) -> None:
    _, text = conducted(session, list(batches), history_bytes=history_bytes)
    assert session.accepted == {}
    (reason,) = map(english, rejected(session).reasons)
    assert re.match(r"its recording does not cover counters \d+\.\.\d+: this computer", reason)
    assert reason in text
    assert "GOOD" not in text
    assert [entry.attempt for entry in phases(session, Phase.PLACE)] == [1, 2]
    assert "run-z-up-1.mcap" in session.files
    assert verify(session.folder).faults == ()


def test_a_step_with_a_gap_in_its_recording_is_repeated_and_then_accepted(session: Session) -> None:
    pose = ONE[ONE.index("{id") : ONE.index("]")]
    twice = ONE.replace(pose, f"{pose}, {pose.replace('z-up', 'again')}")
    procedure = settings_file.parse_text(twice.encode(), Procedure, "twice.yaml")
    batches = performed(technician_scenario(procedure, calibration=NOMINAL))
    aligning = int(batches[250].pulses["counter"][0])
    conducted(session, list(batches), dropped=range(aligning, aligning + 200))
    assert f"does not cover counters {aligning}..{aligning + 199}" in english(rejected(session).reasons[0])
    assert session.accepted["z-up"].recording == "run-z-up-2.mcap"
    assert verify(session.folder).faults == ()


def test_a_key_refers_to_the_view_that_the_operator_sees(
    session: Session, batches: list[Batch], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controllers, "REDRAW_S", 0.0)
    monkeypatch.setattr(Shown, "show", lambda *_: None)  # the terminal is stopped
    conducted(session, list(batches), Typed(lambda _: "\n"), hands_free=False)
    assert phases(session, Phase.SETTLE) == []


def test_recordings_are_complete_even_if_the_worker_is_late_by_a_whole_step(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = technician_scenario(PROCEDURE, calibration=NOMINAL)
    stays = Segment(rest=Rest(duration_s=1000.0))
    settings_file.write(
        tmp_path / "technician.yaml", done.model_copy(update={"motion": (*done.motion, stays)})
    )
    settings = Settings(
        port=f"sim://{tmp_path / 'technician.yaml'}?speed=20",
        profile="imu50-rs422",
        calibration=str(session.folder / "working.yaml"),
        status=str(tmp_path / "socket"),
    )
    append, tap, keys = session.append, QueueSink(None), Typed()

    def delayed_append(entry: Entry) -> None:
        append(entry)
        is_preflight = isinstance(entry, Entered) and entry.phase is Phase.PREFLIGHT
        while is_preflight and tap.state.queued < 70_000:  # its alignment is over
            sleep(0.01)

    monkeypatch.setattr(session, "append", delayed_append)
    service = Service(settings, lambda _: None, [tap], history=History())
    conduct = SessionController(
        session, LAYOUT, service, tap, Shown(keys), keys, hands_free=True, accepts=True, begin=lambda _: None
    )
    worker = Thread(target=conduct.run)
    worker.start()
    service.run()
    tap.close()
    worker.join()
    assert "Z up alone is not enough" in str(conduct.error)
    assert list(session.accepted) == ["z-up"]
    assert verify(session.folder).faults == ()


# Resumed


def accepted_at(session: Session, degc: float) -> None:
    verdict = Accepted(
        "another", 1, 0, 1, 180.0, 3.0, 110.0, 0.1, 30.0, 4.0, 0.001, 0.05, 1.0, (0.0, 0.0, 0.0)
    )
    step = AcceptedStep(**vars(verdict), recording="run-another-1.mcap", temperature_degc={"gyro": degc})
    session.append(step)


def test_at_another_temperature_a_session_is_not_resumed(session: Session, batches: list[Batch]) -> None:
    accepted_at(session, 20.0)
    conduct, _ = conducted(session, list(batches[:10]))
    assert isinstance(conduct.error, InputError)
    assert "cannot be resumed now: gyro: expected 20.0 degC within 5 K" in str(conduct.error)


@pytest.mark.parametrize(("newest", "restarted"), [(-1, False), (10**9, True)])
def test_a_restart_of_the_unit_between_steps_is_noted(
    session: Session, batches: list[Batch], newest: int, restarted: bool
) -> None:
    accepted_at(session, 35.0)
    session.append(Entered(Phase.PLACE, "another", 1, newest))
    conducted(session, list(batches[:10]))
    (detected,) = (entry for entry in session.entries if isinstance(entry, UnitDetected))
    assert detected.restarted is restarted


# The decision


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A result without recordings."""

    nothing: Any = SimpleNamespace(arms=None, created=datetime(2026, 1, 1, tzinfo=UTC))
    monkeypatch.setattr(completion, "compute", lambda _: Result(nothing, NOMINAL))
    monkeypatch.setattr(controllers, "summarise", lambda *_: None)


def test_a_result_that_is_rejected_changes_nothing(
    session: Session, batches: list[Batch], found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = session.plan.certificate.path.read_bytes()
    monkeypatch.setattr(controllers, "decide_alone", lambda _: False)
    conduct, _ = conducted(session, list(batches), stopped=False)
    assert [line.key for line in conduct.outcome] == ["result_rejected"]
    assert session.is_over
    assert session.plan.certificate.path.read_bytes() == before


def test_without_a_person_nothing_is_accepted(session: Session, batches: list[Batch], found: None) -> None:
    before = session.plan.certificate.path.read_bytes()
    conduct, text = conducted(session, list(batches), stopped=False, accepts=False)
    assert conduct.error is None
    assert conduct.is_undecided
    assert "nobody was there to accept the result: resume the session at a terminal" in text
    assert "decision" not in events(session)
    assert session.plan.certificate.path.read_bytes() == before


def test_the_report_is_there_and_named_once_the_result_is_accepted(
    session: Session, batches: list[Batch], found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controllers, "REDRAW_S", 0.0)
    monkeypatch.setattr(controllers, "decide_alone", lambda _: True)
    monkeypatch.setattr(completion, "certificate_documents", lambda *given: {"en": given[2].verified.key})
    monkeypatch.setattr(completion, "as_html", lambda text, **_: text)
    monkeypatch.setattr(completion, "convert", lambda *_: None)
    keys = Typed(lambda seen: "y" if "[y/n]" in seen else "q" if "Y up" in seen else "")
    conduct, text = conducted(session, list(batches), keys, stopped=False)
    assert conduct.error is None
    assert conduct.outcome == ()  # the verification was aborted
    assert f"active certificate: {session.plan.certificate.path}" in text
    assert f"report: {session.folder / 'report.html'}" in text
    assert (session.folder / "report.html").read_text() == "verification_due"


def test_nothing_is_decided_after_ctrl_c(session: Session, batches: list[Batch], found: None) -> None:
    before = session.plan.certificate.path.read_bytes()
    conduct, _ = conducted(session, list(batches), stopped=True)
    assert conduct.error is None
    assert conduct.outcome == ()
    assert "certificate.yaml" in session.files
    assert "decision" not in events(session)
    assert session.plan.certificate.path.read_bytes() == before


def test_an_active_certificate_that_was_changed_meanwhile_is_not_overwritten(
    session: Session, batches: list[Batch], found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controllers, "decide_alone", lambda _: True)
    active = session.plan.certificate.path
    active.write_text(active.read_text() + "# by hand\n")
    conduct, _ = conducted(session, list(batches), stopped=False)
    assert isinstance(conduct.error, InputError)
    assert "it was changed meanwhile" in str(conduct.error)
    assert active.read_text().endswith("# by hand\n")


def test_the_remaining_steps_keep_all_their_settings() -> None:
    text = ONE.replace(
        "poses: [", "poses: [{id: a, up: +X, east: +Y, turn_deg: -180, align_s: 40, repeats: 2}, "
    )
    procedure = settings_file.parse_text(text.encode(), Procedure, "two.yaml")
    assert steps_left(procedure, ["a-1"]).steps == procedure.steps[1:]
