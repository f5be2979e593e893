"""The live service: connects port, decoding, compensation, sinks and recording.

One thread reads, stamps, decodes, compensates and publishes, driven by samples and not by a timer. What the
system has held back arrives as one batch and is processed as one. Everything else is done between two reads:
four times a second, since Python's code leaves cold caches to the sample after it; eight times while a file
is written, and more often while an output is behind.

A port with a descriptor is served by a kernel (`imudrv.service.serve`), which returns for all that is not a
read, its samples and their datagrams. Other ports are read by Python. Both use the kernels of `imudrv.chain`.
"""

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, nullcontext
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from signal import SIGINT, SIGTERM
from typing import Final

import numpy as np

from imudrv import profiles, system
from imudrv.calibration import coefficients
from imudrv.chain import Chain, Output
from imudrv.diagnosis import LineState
from imudrv.errors import InputError
from imudrv.files.atomic import remove_left_over
from imudrv.hostclock import now_ns
from imudrv.imu.compensation import LEAVES_OUT_SKEW
from imudrv.ports import PortEndedError
from imudrv.recording.pack import pack
from imudrv.records import INCREMENTS, PULSES, Arrival, Source
from imudrv.service.calibration_watch import CalibrationWatch
from imudrv.service.clock_watch import ClockWatch
from imudrv.service.events import EventLog
from imudrv.service.latency import Latency, count_latency
from imudrv.service.port import PortSupervisor
from imudrv.service.recordings import Recordings
from imudrv.service.runtime import SignalFlags, SystemdNotifier, ask_realtime, frozen_gc
from imudrv.service.serve import DescriptorLoop, Served, Why
from imudrv.service.settings import Settings
from imudrv.service.status import (
    IncrementStatus,
    RejectedStatus,
    SampleStatus,
    Status,
    UnitStatus,
    temperatures,
)
from imudrv.service.status_socket import StatusServer, default_status_path
from imudrv.service.warm_up import warm_up
from imudrv.signals import SIGHUP
from imudrv.sinks import open_sink
from imudrv.sinks.base import HOUSEKEEPING_NS, ON_DISK_NS, Batch, Sink
from imudrv.sinks.history import History
from imudrv.sinks.recorder import Recorder
from imudrv.units import NS, NS_PER_S

POLL_NS: Final = NS_PER_S // 50
"""Time between two rounds of housekeeping while an output has samples queued, and the longest wait of Python
for data."""


class Service:
    """The service between a unit and the programs that navigate with it.

    Parameters
    ----------
    settings : Settings
        Settings of `imudrv run`.
    say : callable
        Called with the line of each event; must not block.
    sinks : sequence of Sink
        Sinks in addition to those of the settings.
    warn : callable, optional
        Called instead of `say` with each event that is a failure.
    in_real_time : bool
        False for a simulated unit at a hardware port, whose rate depends on its speed and is not checked.
    history : History, optional
        Filled by the loop, for recordings that begin in the past.
    signals : SignalFlags, optional
        Those of a caller that handles signals before `run` does.
    notices : callable, optional
        Returns further warnings for the status, a sentence each.
    clock : callable, optional
        Returns the time on the scale of the arrivals, ns.
    clock_watch : ClockWatch, optional
        Watch of the host's real-time clock.

    Raises
    ------
    InputError
        A setting is wrong, as far as that can be checked before the unit is connected.
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
        clock: Callable[[], int] = now_ns,
        clock_watch: ClockWatch | None = None,
    ) -> None:
        self._settings, self._clock = settings, clock
        self._in_real_time = in_real_time
        self._clock_watch = clock_watch or ClockWatch()
        self._version = version("imu50")  # reads files: not in the loop
        self._profile_file = profiles.load_file(settings.profile)
        self._profile = self._profile_file.model
        self._layout = self._profile.layout()
        self._recordings = Recordings(self._create_recorder, history)
        self._sinks = list(sinks)
        self._events = EventLog(say, warn or say, self._pass_on, clock)
        self._calibration = CalibrationWatch(
            Path(settings.calibration), settings.unit, self._layout, self._events
        )
        self._port = PortSupervisor(settings.port, self._profile, in_real_time, self._events, clock)
        self._chain = Chain(
            self._profile,
            coefficients(self._calibration.current.model),
            settings.rate_filter,
            self._port.source,
        )
        self._latency = Latency(self._layout.interval_ns)
        is_direct = system.IS_AVAILABLE and clock is now_ns and clock_watch is None
        self._descriptor_loop = (
            DescriptorLoop(self._chain, self._latency, in_real_time) if is_direct else None
        )
        self._signals = signals or SignalFlags()
        self._manager = SystemdNotifier()
        self._notices: list[str] = []
        self._more_notices = notices
        self._started_ns = self._rated_ns = clock()
        self._next_poll_ns = 0
        self._samples = self._rated_samples = self._rated_lost = 0
        self._rate_hz, self._lost_last_s = 0.0, 0
        self._last_pulses = np.zeros(1, PULSES)
        self._last_increments = np.zeros(1, INCREMENTS)
        with ExitStack() as undo:
            if self._descriptor_loop is not None:
                undo.callback(self._descriptor_loop.close)
            for sink in sinks:
                undo.callback(sink.close)
            for url in settings.outputs:
                sink = open_sink(url, self._layout)
                undo.callback(sink.close)
                self._sinks.append(sink)
            status_path = Path(settings.status) if settings.status else default_status_path()
            status_server = StatusServer(status_path, self._status_line)
            undo.callback(status_server.close)
            if settings.record:
                self._recordings.begin(Path(settings.record))
            self._open = undo.pop_all()
        self._latest = self._snapshot(self._started_ns)
        status_server.start()

    def run(self) -> None:
        """Serve until SIGTERM, Ctrl-C, or the end of a replay."""
        if self._settings.realtime and (refusal := ask_realtime()):
            self._notices.append(refusal)
            self._events.failure(refusal)
        is_direct = self._descriptor_loop is not None and self._port.source is Source.HARDWARE
        warm_up(self._profile, self._calibration.current.model, self._settings.rate_filter, is_direct)
        with (
            self._signals.caught(SIGTERM, SIGINT, SIGHUP),
            self._descriptor_loop.pipe.woken_by_signals() if self._descriptor_loop else nullcontext(),
            frozen_gc(),
        ):
            try:
                self._publish_status(self._clock())
                self._manager.notify("READY=1")
                sha256 = self._calibration.current.sha256
                self._events.event(f"serving {self._settings.port}, calibration {sha256[:12]}")
                if self._chain.leaves_out_skew:
                    self._events.event(LEAVES_OUT_SKEW)
                while not self._signals.stop and self.step():
                    pass
            finally:
                self._manager.notify("STOPPING=1")
                recorded = self.close()
        if recorded is not None and self._settings.pack and self._settings.record:
            self._pack(recorded)

    def _pack(self, path: Path) -> None:
        """Pack the recording of this run; whatever ends it, the recording stays as it was written."""
        before = path.stat().st_size
        try:
            pack(path, path)
        except InputError as error:
            self._events.failure(f"{path}: is complete, but could not be packed: {error}")
        except KeyboardInterrupt:
            self._events.failure(
                f"{path}: is complete, but packing was interrupted; imudrv pack does it later"
            )
        else:
            self._events.event(f"packed {path}: {path.stat().st_size} bytes, was {before}")

    def step(self) -> bool:
        """Read once, publish, and do the housekeeping if it is due.

        Returns
        -------
        bool
            False once a replay or a simulation is complete.
        """
        self._recordings.switch()
        arrival = None
        if not self._serve():
            try:
                arrival = self._port.read(POLL_NS * NS)
            except PortEndedError:
                return False
        if step := self._clock_watch.poll():
            self._events.offset_ns = self._clock_watch.timebase.offset_ns
            self._events.event(step)
        if arrival is not None:
            if self._port.source is not Source.REPLAY:
                arrival = Arrival(arrival.t_ns, arrival.data, self._clock_watch.timebase)
            self._process(arrival)
        now = self._clock()
        if now >= self._next_poll_ns:
            self._poll(now)
            is_behind = any(sink.state.queued for sink in self._sinks)
            self._next_poll_ns = now + (POLL_NS if is_behind else self._patience_ns)
        return True

    def close(self) -> Path | None:
        """Publish the samples that are held back, and close everything; `run` does it.

        Returns
        -------
        Path or None
            The recording, if there is one and it is complete.
        """
        self._publish(self._chain.close(), self._clock())
        self._port.close()
        self._events.event(f"end: {self._chain.tracker.counts}")
        self._publish_status(self._clock())
        recorded = self._recordings.close()
        self._open.close()
        return recorded

    def stop(self) -> None:
        """End `run`, as SIGTERM does; for any thread."""
        self._signals.stop = True
        self._wake()

    @property
    def port_state(self) -> LineState:
        """State of the line to the unit; for any thread."""
        return self._port.state

    @property
    def status(self) -> Status:
        """Status as last published; for any thread."""
        return self._latest()

    def record(self, path: Path | None, since: int | None = None) -> Future[None]:
        """Record into another file, or stop recording; for any thread.

        Parameters
        ----------
        path : Path or None
            A file that does not exist yet, or a folder; None stops recording.
        since : int, optional
            Counter of the sample to begin with, as far back as the history reaches; by default the recording
            begins with the next read. The recording before is not shortened: both then contain the samples
            from there to the switch.

        Returns
        -------
        Future
            Done when the recording before is closed; has the `InputError` if the new one cannot be created.
            Cancelled if the service ends first, which closes the recording before as well.
        """
        done = self._recordings.request(path, since)
        self._wake()
        return done

    @property
    def _patience_ns(self) -> int:
        patience_ns = [sink.patience_ns for sink in self._sinks if sink.patience_ns]
        return min([ON_DISK_NS if self._recordings.are_on else HOUSEKEEPING_NS, *patience_ns])

    def _wake(self) -> None:
        if self._descriptor_loop is not None:
            self._descriptor_loop.pipe.wake()

    def _serve(self) -> bool:
        """Let the kernel serve the port, if it can; return whether Python need not read it now."""
        descriptor = self._port.descriptor
        if self._descriptor_loop is None or descriptor is None or self._chain.is_exchanging:
            return False
        clocks = self._clock_watch
        self._chain.clock.follow(clocks.timebase)
        outlets = [sink.outlets() for sink in self._sinks]
        served = self._descriptor_loop.run(
            descriptor,
            self._next_poll_ns,
            clocks,
            [outlet for some in outlets for outlet in some],
            not all(sink.patience_ns for sink in self._sinks),
        )
        if len(served.reads):
            self._take(served, [len(some) for some in outlets])
        if served.error:
            self._port.failed(served.error)
        if served.why is Why.OUTLET:
            self._next_poll_ns = 0  # soon again, if it is behind now
        return served.why is not Why.CLOCKS

    def _take(self, served: Served, outlets: Sequence[int]) -> None:
        """Publish and record what the kernel has read; `outlets`: their number, for each sink."""
        batch = Batch(*served.output)
        if len(batch.pulses) or len(batch.increments):
            written = iter(served.written)
            for sink, count in zip(self._sinks, outlets, strict=True):
                sink.written(batch, list(islice(written, count)))
            self._count(batch)
        self._recordings.served(served, self._clock_watch.timebase)
        self._port.decoded(served.data, len(batch.pulses))

    def _process(self, arrival: Arrival) -> None:
        read_ns = arrival.t_ns
        if not self._in_real_time:
            arrival = arrival._replace(t_ns=0)  # when it came has nothing to do with its samples
        self._recordings.arrived(arrival)
        self._chain.clock.follow(arrival.timebase)
        output = self._chain.feed(arrival.data, arrival.t_ns)
        self._publish(output, read_ns)
        self._port.decoded(arrival.data, len(output.pulses))

    def _publish(self, output: Output, arrival_ns: int) -> None:
        batch = Batch(*output)
        if not len(batch.pulses) and not len(batch.increments):
            return
        for sink in self._sinks:
            sink.publish(batch)
        if len(batch.increments) and self._port.source is not Source.REPLAY:
            count_latency(self._clock() - arrival_ns, len(batch.increments), self._latency.state)
        self._count(batch)
        self._recordings.publish(batch)

    def _count(self, batch: Batch) -> None:
        if len(batch.pulses):
            self._samples += len(batch.pulses)
            self._last_pulses = batch.pulses
        if len(batch.increments):
            self._last_increments = batch.increments

    def _poll(self, now: int) -> None:
        for sink in self._sinks:
            sink.poll()
        if displaced := self._recordings.poll():
            self._events.failure(displaced)
        self._port.check_line(now)
        # At a wrong rate they do not cover the interval that they name.
        self._chain.allow_valid(self._port.state.name != "wrong rate")
        self._manager.feed_watchdog(now)
        if self._events.is_new or now - self._rated_ns >= NS_PER_S:
            self._check_calibration(now)
            self._publish_status(now)

    def _check_calibration(self, now: int) -> None:
        if reload := self._signals.reload:
            self._signals.reload = False  # before the file is read: a later signal has it read again
        if (new := self._calibration.poll(reload)) is not None:
            self._chain.replace_calibration(coefficients(new.model))
            self._recordings.calibration(now, new.content)
            self._events.event(f"calibration replaced: {new.sha256[:12]}")

    def _publish_status(self, now: int) -> None:
        """Publish the status: once a second, and after each event."""
        self._events.is_new = False
        if now - self._rated_ns >= NS_PER_S:
            self._measure_rate(now)
        self._latest = latest = self._snapshot(now)
        self._recordings.status(lambda: latest().to_json())
        for sink in self._sinks:
            sink.status(lambda: latest().to_json())

    def _pass_on(self, t_ns: int, text: str) -> None:
        """Record an event, and hand it to the sinks."""
        self._recordings.event(t_ns, text)
        for sink in self._sinks:
            sink.event(t_ns + self._events.offset_ns, text)

    def _status_line(self) -> bytes:
        return json.dumps(self._latest().to_json()).encode() + b"\n"

    def _measure_rate(self, now: int) -> None:
        counts = self._chain.tracker.counts
        self._rate_hz = (self._samples - self._rated_samples) / ((now - self._rated_ns) * NS)
        self._lost_last_s = counts.lost - self._rated_lost
        self._rated_samples, self._rated_lost, self._rated_ns = self._samples, counts.lost, now
        self._port.check_rate(counts.expected, self._lost_last_s, now)

    def _snapshot(self, now: int) -> Callable[[], Status]:
        """Note the present state; return what makes the status of it, in any thread."""
        calibration, chain = self._calibration, self._chain
        pulses, increments = self._last_pulses[-1], self._last_increments[-1]
        status_word, latency, counts = int(pulses["status"]), self._latency.copy(), chain.tracker.counts
        started_ns, rate_hz, lost_last_s = self._started_ns, self._rate_hz, self._lost_last_s
        t_ns, unit = now + self._clock_watch.timebase.offset_ns, calibration.current.model.serial_number
        port, calibration_status = self._port.status, calibration.status
        refused = [calibration.refused] if calibration.refused else []
        rejected = [(reason, entry.runs, entry.length) for reason, entry in chain.decoder.rejected.items()]
        clock, recording, events = chain.clock.report, self._recordings.state, self._events.lines
        sinks = [sink.state for sink in self._sinks]
        notices = [*self._notices, *refused, *self._more_notices()]

        @cache
        def status() -> Status:
            return Status(
                software=self._version,
                pid=os.getpid(),
                t_ns=t_ns,
                uptime_s=(now - started_ns) * NS,
                port=port,
                profile=self._profile.name,
                unit=unit,
                calibration=calibration_status,
                rate_hz=rate_hz,
                nominal_rate_hz=self._profile.rate_hz,
                samples=SampleStatus(**vars(counts), lost_last_s=lost_last_s),
                rejected={
                    reason.name.lower(): RejectedStatus(runs, length)
                    for reason, runs, length in sorted(rejected)
                },
                clock=clock,
                latency=latency.report,
                temperature_degc=temperatures(pulses, self._layout),
                unit_status=UnitStatus.of(status_word, self._layout),
                sinks=sinks,
                recording=recording,
                last=IncrementStatus.of(increments),
                notices=notices,
                events=events,
            )

        return status

    def _create_recorder(self, path: Path) -> Recorder:
        if path.is_dir():
            path = path / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{os.getpid()}.mcap"
        remove_left_over(path.parent)  # of a run that was killed while it packed its recording
        return Recorder(
            path,
            layout=self._layout,
            profile=self._profile_file.content,
            calibration=self._calibration.current.content,
            source=self._port.source,
            port=self._settings.port,
            unit=self._calibration.current.model.serial_number,
            sync_s=self._settings.sync_s,
        )
