"""The live service: the only wiring of ports, decoding, compensation, sinks and recording.

One thread reads, stamps, decodes, compensates and publishes, driven by samples and never by a timer. What the
system held back arrives as one batch and is handled as one. Whatever else has to be done is done between two
reads, twenty times a second, in microseconds.
"""

import json
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGTERM
from threading import Thread
from typing import Final

import numpy as np

from imudrv import profiles
from imudrv.calibration import Calibration, coefficients, read_calibration_file
from imudrv.diagnosis import LineState, LineWatch
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.hostclock import now_ns
from imudrv.imu.rate_filter import rate_filter
from imudrv.pipeline import Pipeline, PipelineOutput
from imudrv.ports import Port, PortEndedError, PortLostError, check_url, open_port
from imudrv.profiles.schema import Profile
from imudrv.records import INCREMENTS, PULSES, Flag, Source
from imudrv.service.latency import Latency
from imudrv.service.runtime import SignalFlags, SystemdNotifier, ask_realtime, frozen_gc
from imudrv.service.settings import Settings
from imudrv.service.status import Status, health
from imudrv.service.status_socket import StatusServer, default_status_path
from imudrv.sinks import open_sink
from imudrv.sinks.base import Batch, Sink
from imudrv.sinks.history import History
from imudrv.sinks.recorder import Recorder
from imudrv.units import NS, NS_PER_S
from imudrv.wire.datagram import encode
from imudrv.wire.encode import CanEncoder, StreamEncoder

POLL_NS: Final = NS_PER_S // 50
"""Time between two rounds of housekeeping, and the longest wait for data."""


BACK_OFF_S: Final = (0.1, 0.2, 0.4, 0.8)
"""Waits between attempts to open a port again; the last one for ever."""


_WARM_UP: Final = 300


_SHOWN_EVENTS: Final = 20


class Service:
    """The service between a unit and those who navigate with it.

    Parameters
    ----------
    settings : Settings
        What to do.
    say : callable
        Told each event in a line; must not block.
    sinks : sequence of Sink
        More ways out than the settings have.
    warn : callable, optional
        Called instead of `say` with each event that is a failure.
    in_real_time : bool
        False for a simulated unit at a port, whose rate depends on its speed and is not judged.
    history : History, optional
        Filled by the loop, for recordings that begin in the past.
    signals : Signals, optional
        Given by a caller that handles some signals before `run` does.
    notices : callable, optional
        Returns further warnings for the status, a sentence each.

    Raises
    ------
    InputError
        Something in the settings cannot be: all that can be told before the unit is there is told now.
    """

    def __init__(
        self,
        settings: Settings,
        say: Callable[[str], None],
        sinks: Sequence[Sink] = (),
        *,
        warn: Callable[[str], None] | None = None,
        in_real_time: bool = True,
        history: History | None = None,
        signals: SignalFlags | None = None,
        notices: Callable[[], list[str]] = list,
    ) -> None:
        self._settings = settings
        self._say, self._warn = say, warn or say
        self._more_notices = notices
        self._profile_file = profiles.load_file(settings.profile)
        self._profile = self._profile_file.model
        self._layout = self._profile.layout()
        self._calibration_path = Path(settings.calibration)
        self._calibration_seen = atomic.change_mark(self._calibration_path)
        self._calibration = read_calibration_file(self._calibration_path, settings.unit)
        self._calibration_refused = ""
        self._exchanges = 0
        check_url(settings.port, self._profile)
        self._rates = rate_filter(settings.rate_filter, self._layout.interval_ns)
        self._pipeline = Pipeline(self._profile, coefficients(self._calibration.model), self._rates)
        self._latency = Latency(self._layout.interval_ns)
        self._signals = signals or SignalFlags()
        self._history = history
        self._switches: deque[tuple[Path | None, int | None, Future[None]]] = deque()
        self._has_ended = False
        self._manager = SystemdNotifier()
        self._notices: list[str] = []
        self._events: list[str] = []
        self._port: Port | None = None
        self._port_state, self._reconnects = LineState("connecting"), 0
        scheme = settings.port.partition(":")[0]
        self._source = {"sim": Source.SIMULATOR, "replay": Source.REPLAY}.get(scheme, Source.HARDWARE)
        self._in_real_time = in_real_time and self._source is Source.HARDWARE
        self._began_ns = now_ns()
        self._watch = LineWatch(self._profile, self._in_real_time, self._began_ns)
        self._samples = self._samples_told = self._lost_told = 0
        self._told_ns = self._began_ns
        self._is_news = False
        self._rate_hz, self._lost_last_s = 0.0, 0
        self._last_pulses = np.zeros(1, PULSES)
        self._last_increments = np.zeros(1, INCREMENTS)
        self._line = b""
        with ExitStack() as undo:
            self._sinks = list(sinks)
            for sink in sinks:
                undo.callback(sink.close)
            for url in settings.outputs:
                sink = open_sink(url, self._layout)
                undo.callback(sink.close)
                self._sinks.append(sink)
            self._status_server = StatusServer(
                Path(settings.status) if settings.status else default_status_path()
            )
            undo.callback(self._status_server.close)
            self._recorder = self._open_recorder(Path(settings.record)) if settings.record else None
            self._open = undo.pop_all()

    def run(self) -> None:
        """Serve until SIGTERM, Ctrl-C, or the end of a replay."""
        if self._settings.realtime and (refusal := ask_realtime()):
            self._notices.append(refusal)
            self._failure(refusal)
        warm_up(self._profile, self._calibration.model, self._settings)
        with self._signals.caught(SIGTERM, SIGINT, SIGHUP), frozen_gc():
            try:
                self._refresh(now_ns())
                self._manager.tell("READY=1")
                self._event(f"serving {self._settings.port}, calibration {self._calibration.sha256[:12]}")
                self._serve()
            finally:
                self._manager.tell("STOPPING=1")
                self._finish()

    def stop(self) -> None:
        """End `run`, as SIGTERM does; for any thread."""
        self._signals.stop = True

    @property
    def port_state(self) -> LineState:
        """State of the line to the unit; for any thread."""
        return self._port_state

    def record(self, path: Path | None, since: int | None = None) -> Future[None]:
        """Record into another file, or into none; for any thread.

        Parameters
        ----------
        path : Path or None
            There must be no such file yet.
        since : int, optional
            Counter of the sample to begin with, as far back as the history reaches; not given: the next read.
            The recording before is not shortened: both then have what came meanwhile.

        Returns
        -------
        Future
            Done when the recording before is closed; the `InputError` where the new one cannot be made.
            Cancelled when the service ends first: the recording before is closed then, too.
        """
        done: Future[None] = Future()
        self._switches.append((path, since, done))
        if self._has_ended:
            done.cancel()
        return done

    def _serve(self) -> None:
        attempt, next_attempt_ns, next_poll_ns = 0, 0, 0
        while not self._signals.stop:
            if self._switches:
                self._switch_recording()
            now = now_ns()
            if self._port is None and now >= next_attempt_ns:
                if self._connect():
                    attempt = 0
                else:
                    wait_s = BACK_OFF_S[min(attempt, len(BACK_OFF_S) - 1)]
                    attempt, next_attempt_ns = attempt + 1, now_ns() + round(wait_s * NS_PER_S)
            if self._port is None:
                time.sleep(POLL_NS * NS)
            else:
                try:
                    arrival = self._port.read(POLL_NS * NS)
                except PortLostError as lost:
                    self._lose(str(lost))
                    attempt, next_attempt_ns = 0, 0
                except PortEndedError:
                    self._port_state = LineState("ended")
                    return
                else:
                    if len(arrival.data):
                        if self._recorder is not None:
                            self._recorder.arrived(arrival)
                        if self._history is not None:
                            self._history.arrived(arrival)
                        sampled = self._pipeline.feed(arrival.data, arrival.t_ns)
                        self._publish(sampled, arrival.t_ns)
                        self._watch.arrived(len(arrival.data), len(sampled.pulses), now_ns())
            now = now_ns()
            if now >= next_poll_ns:
                next_poll_ns = now + POLL_NS
                self._poll(now)

    def _publish(self, sampled: PipelineOutput, arrival_ns: int) -> None:
        pulses, increments = sampled
        if len(pulses):
            self._samples += len(pulses)
            self._last_pulses = pulses
        elif not len(increments):
            return
        batch = Batch(pulses, increments, encode(increments, self._source))
        for sink in self._sinks:
            sink.publish(batch)
        if self._history is not None:
            self._history.publish(batch)
        if not len(increments):
            return
        if self._source is not Source.REPLAY:
            self._latency.add(now_ns() - arrival_ns, len(increments))
        self._last_increments = increments
        if self._recorder is not None:
            self._recorder.publish(batch)

    # The port

    def _connect(self) -> bool:
        try:
            self._port = open_port(self._settings.port, self._profile)
        except PortLostError as lost:
            if str(lost) != self._port_state.trouble:
                self._failure(f"port not there: {lost}")
            self._port_state = self._port_state._replace(trouble=str(lost))
            return False
        if self._port_state.name == "lost":
            self._reconnects += 1
            self._event("port is back")
        self._port_state = LineState("streaming")
        self._watch = LineWatch(self._profile, self._in_real_time, now_ns())
        return True

    def _lose(self, why: str) -> None:
        assert self._port is not None
        self._port.close()
        self._port = None
        self._port_state = LineState("lost", why)
        self._failure(str(self._port_state))

    def _look_at_port(self, now: int) -> None:
        before, self._port_state = self._port_state, self._watch.state(now)
        if self._port_state == before:
            return
        if self._port_state.trouble:
            self._failure(str(self._port_state))
        else:
            self._event("the rate is right again" if before.name == "streaming" else "the unit is back")

    # Housekeeping

    def _poll(self, now: int) -> None:
        for sink in self._sinks:
            sink.poll()
        if self._recorder is not None:
            self._recorder.poll()
        if self._port is not None:
            self._look_at_port(now)
        self._manager.alive(now)
        if self._is_news or now - self._told_ns >= NS_PER_S:
            self._look_at_calibration()
            self._refresh(now)
        self._status_server.poll(self._line)

    def _refresh(self, now: int) -> None:
        """Make the status anew: once a second, and when there is news."""
        self._is_news = False
        seconds = (now - self._told_ns) * NS
        if seconds >= 1.0:
            counts = self._pipeline.tracker.counts
            self._rate_hz = (self._samples - self._samples_told) / seconds
            self._lost_last_s = counts.lost - self._lost_told
            self._samples_told, self._lost_told, self._told_ns = self._samples, counts.lost, now
            if self._port is not None:
                self._watch.counted(counts.expected, now)
        status = self.status(now)
        self._line = json.dumps(status).encode() + b"\n"
        if self._recorder is not None:
            self._recorder.status(status)

    def _look_at_calibration(self) -> None:
        mark = atomic.change_mark(self._calibration_path)
        if not self._signals.reload and mark == self._calibration_seen:
            return
        self._signals.reload = False
        self._calibration_seen = mark
        try:
            calibration = read_calibration_file(self._calibration_path, self._settings.unit)
        except InputError as error:
            self._calibration_refused = str(error)
            self._failure(f"calibration refused, the old one stays: {error}")
            return
        self._calibration_refused = ""
        if calibration.sha256 == self._calibration.sha256:
            return
        self._calibration = calibration
        self._exchanges += 1
        self._pipeline.exchange(coefficients(calibration.model))
        if self._recorder is not None:
            self._recorder.calibration(now_ns(), calibration.content)
        if self._history is not None:
            self._history.clear()  # a recording begins with one calibration
        self._event(f"calibration exchanged: {calibration.sha256[:12]}")

    def _failure(self, text: str) -> None:
        self._event(text, self._warn)

    def _event(self, text: str, say: Callable[[str], None] | None = None) -> None:
        now = now_ns()
        self._events = [*self._events[1 - _SHOWN_EVENTS :], f"{_utc(now)} {text}"]
        self._is_news = True
        (say or self._say)(self._events[-1])
        if self._recorder is not None:
            self._recorder.event(now, text)

    def _switch_recording(self) -> None:
        path, since, done = self._switches.popleft()
        before, self._recorder = self._recorder, None
        if path is not None:
            try:
                self._recorder = self._open_recorder(path)
            except InputError as error:
                done.set_exception(error)
            else:
                if since is not None and self._history is not None:
                    self._recorder.catch_up(self._history.since(since))

        def close() -> None:
            if before is not None:
                before.close()
            if not done.done():
                done.set_result(None)

        # It waits for the disk, which the loop must not.
        Thread(target=close, name="recording's end", daemon=True).start()

    def _open_recorder(self, path: Path) -> Recorder:
        if path.is_dir():
            path = path / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{os.getpid()}.mcap"
        return Recorder(
            path,
            layout=self._layout,
            profile=self._profile_file.content,
            calibration=self._calibration.content,
            source=self._source,
            port=self._settings.port,
            unit=self._calibration.model.serial_number,
        )

    def _finish(self) -> None:
        """Hand on what is held back, and let go of everything."""
        self._publish(self._pipeline.close(), now_ns())
        if self._port is not None:
            self._port.close()
        self._event(f"end: {self._pipeline.tracker.counts}")
        self._refresh(now_ns())
        if self._recorder is not None:
            self._recorder.close()
        self._has_ended = True
        while self._switches:
            self._switches.popleft()[-1].cancel()
        self._open.close()

    # What it tells

    def status(self, now: int) -> Status:
        """Give the status.

        Parameters
        ----------
        now : int
            Host time, ns.

        Returns
        -------
        dict
            Text, numbers, lists and mappings; `health` and `reasons` judge the rest.
        """
        counts = self._pipeline.tracker.counts
        pulses, increments = self._last_pulses[-1], self._last_increments[-1]
        clock, latency = self._pipeline.clock.report, self._latency.report
        bits = [name for bit, name in self._layout.status_names if int(pulses["status"]) >> bit & 1]
        fault = int(pulses["status"]) & self._layout.status.fault
        faults = [name for bit, name in self._layout.status_names if fault >> bit & 1]
        status: Status = {
            "format": "imu50-status",
            "version": 1,
            "software": version("imu50"),
            "pid": os.getpid(),
            "t_ns": now,
            "uptime_s": (now - self._began_ns) * NS,
            "port": {
                "url": self._settings.port,
                "state": self._port_state.name,
                "trouble": self._port_state.trouble,
                "reconnects": self._reconnects,
                "source": self._source.name.lower(),
            },
            "profile": self._profile.name,
            "unit": self._calibration.model.serial_number,
            "calibration": {
                "path": str(self._calibration_path),
                "sha256": self._calibration.sha256,
                "exchanges": self._exchanges,
                "refused": self._calibration_refused,
            },
            "rate_hz": self._rate_hz,
            "nominal_rate_hz": self._profile.sample_rate_hz,
            "samples": {
                **vars(counts),
                "lost": counts.lost,
                "lost_last_s": self._lost_last_s,
                "closes": counts.closes,
            },
            "rejected": {
                reason.name.lower(): {"runs": r.runs, "length": r.length}
                for reason, r in sorted(self._pipeline.decoder.rejected.items())
            },
            "clock": clock._asdict(),
            "latency": latency._asdict(),
            "temperature_degc": {
                name: round(float(t), 3) if np.isfinite(t) else None
                for name, t in zip(self._layout.temperature_names, pulses["temperature_degc"], strict=False)
            },
            "unit_status": {"word": int(pulses["status"]), "bits": bits, "faults": faults},
            "sinks": [sink.state._asdict() for sink in self._sinks],
            "recording": self._recorder.state._asdict() if self._recorder is not None else None,
            "last": {
                "counter": int(increments["counter"]),
                "t_ns": int(increments["t_ns"]),
                "interval_ns": int(increments["interval_ns"]),
                "dtheta_b": increments["dtheta_b"].tolist(),
                "dv_b": increments["dv_b"].tolist(),
                "flags": [flag.name for flag in Flag if flag & int(increments["flags"])],
            },
            "notices": [
                *self._notices,
                *([self._calibration_refused] if self._calibration_refused else []),
                *self._more_notices(),
            ],
            "events": self._events,
        }
        status["health"], status["reasons"] = health(status)
        return status


def warm_up(profile: Profile, calibration: Calibration, settings: Settings) -> None:
    """Take made-up samples through every stage: nothing is to be compiled or loaded while the unit talks."""
    layout = profile.layout()
    pulses = np.zeros(_WARM_UP, PULSES)
    pulses["counter"] = np.arange(_WARM_UP)
    pulses["temperature_degc"] = 35.0
    rates = rate_filter(settings.rate_filter, layout.interval_ns)
    pipeline = Pipeline(profile, coefficients(calibration), rates)
    wire = CanEncoder(layout).encode(pulses) if layout.can else StreamEncoder(layout).encode(pulses).tobytes()
    for at in range(0, len(wire), max(1, len(wire) // 50)):
        increments = pipeline.feed(wire[at : at + max(1, len(wire) // 50)], at).increments
        encode(increments, Source.SIMULATOR)
    pipeline.exchange(coefficients(calibration))
    pipeline.feed(wire, len(wire))
    pipeline.close()


def _utc(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns * NS, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
