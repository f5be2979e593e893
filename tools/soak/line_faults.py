"""One scenario with every fault of the line: the same counts offline, live and from the recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from imudrv import profiles
from imudrv.capture import Capture
from imudrv.imu.sequence import SampleCounts
from imudrv.recording.reader import Recording
from imudrv.sim.scenario import MessageRates, StreamRates

from .checks import Check
from .data import last_status, write_scenario
from .processes import Stage, run_ok

RATES: Final = {
    "stream": dict.fromkeys(StreamRates.model_fields, 0.01),
    "can": dict.fromkeys(MessageRates.model_fields, 0.01),
}


def line_faults(folder: Path, seconds: float, names: Sequence[str] = profiles.OWN) -> list[Check]:
    """Play the faults through each profile."""
    unit_faults = {
        "silences": [{"at_s": 0.3 * seconds, "duration_s": 0.1 * seconds}],
        "counter_jumps": [{"at_s": 0.5 * seconds, "by": 40}, {"at_s": 0.7 * seconds, "by": -300}],
    }
    write_scenario(folder, seconds, {**RATES, **unit_faults})
    checks = [check for name in names for check in _three_ways(folder, name)]
    write_scenario(folder, seconds, unit_faults)
    sums = set()
    for name in names:
        counts, _ = _decode(_capture(folder, name), name)
        lost = counts.missing + counts.damaged + counts.torn
        sums.add((counts.expected, counts.good + counts.reference, lost, counts.restarts))
    return [
        *checks,
        Check(
            f"without faults of the line {len(names)} profiles have the same counts",
            " and ".join("{} = {} good or reference + {} lost, {} restarts".format(*each) for each in sums),
            len(sums) == 1,
        ),
    ]


def _three_ways(folder: Path, name: str) -> list[Check]:
    """Compare the counts of ``scenario.yaml`` decoded from its capture, live, and from the recording."""
    offline, rejected = _decode(_capture(folder, name), name)
    recording = folder / f"{name}.mcap"
    is_can = profiles.load(name).layout().can
    with Stage(folder) as stage:
        # A bus does not wait for its readers, so it plays in real time.
        unit, service = stage.unit_and_service(name, "1" if is_can else "max", "--record", recording)
        unit.wait()
        service.await_port("lost", "silent")
        service.stop()
    live, status = last_status(Recording(recording))
    again = _decode(recording, name)
    live_rejected = {reason: tuple(counts.values()) for reason, counts in status["rejected"].items()}
    return [
        Check(f"{name}: the counts add up", str(offline), offline.closes and offline.lost > 0),
        Check(
            f"{name}: `imudrv run` on a {'bus' if is_can else 'pty'} has the same counts",
            "identical" if live == offline else str(live),
            live == offline,
        ),
        Check(
            f"{name}: the same rejects, runs and length by reason",
            ", ".join(f"{reason} {runs} {length}" for reason, (runs, length) in rejected.items()),
            live_rejected == rejected,
        ),
        Check(
            f"{name}: the decoded recording has the same counts",
            "identical" if again == (offline, rejected) else str(again[0]),
            again == (offline, rejected),
        ),
    ]


def _capture(folder: Path, name: str) -> Path:
    """Play ``scenario.yaml`` into a capture."""
    path = folder / f"{name}.capture"
    run_ok("sim", folder / "scenario.yaml", "--profile", name, "-o", path)
    return path


def _decode(path: Path, name: str) -> tuple[SampleCounts, dict[str, tuple[int, int]]]:
    """Decode a file as `imudrv decode` does; return sample counts, and runs and length by reason."""
    capture = Capture(path, profiles.load(name))
    for _ in capture.pulses(lambda _: None):
        pass
    rejected = sorted(capture.rejected.items())
    return capture.tracker.counts, {
        reason.name.lower(): (entry.runs, entry.length) for reason, entry in rejected
    }
