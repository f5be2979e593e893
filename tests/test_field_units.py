"""Captures in the wire formats of 24 units of other makers, each against its truth, offline and live.

The captures lie beside the project; their README says what each holds and what was done to it. What is
expected here follows from that text, not from the profiles.
"""

import os
import tty
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Final, NamedTuple

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from imudrv import load_profile
from imudrv.capture import Capture
from imudrv.cli import main
from imudrv.diagnosis import decode_traffic
from imudrv.errors import InputError
from imudrv.imu.sequence import SampleCounts, SequenceTracker
from imudrv.ports import Arrival, Port, open_port
from imudrv.records import EXTENDED, Flag, Reason, Records
from imudrv.service.status import UnitStatus
from imudrv.wire.candump import CandumpDecoder
from imudrv.wire.decoder import FrameDecoder

DEG: Final = np.pi / 180
G: Final = 9.80665
ROUNDING: Final = 4 * np.finfo(np.float64).eps
"""Scale in SI units, number times scale, times interval: three roundings in the driver and three here."""

VALID, MISSING, LONG = Flag.VALID, Flag.VALID | Flag.MISSING_BEFORE, Flag.VALID | Flag.LONG_INTERVAL
UNKNOWN, BY_TIME = Flag.GAP_LENGTH_UNKNOWN, Flag.GAP_BY_HOST_TIME
NOT_WHOLE: Final = (0, 100, 200)
"""Samples that a serial capture does not hold whole."""


class Sensor(NamedTuple):
    """What the columns of a sensor are: increments, rates or totals of so many bits."""

    si_per_count: float = 1.0
    is_rate: bool = False
    total_bits: int = 0
    zero: int = 0
    signs: tuple[int, int, int] = (1, 1, 1)
    z_per_count: float = 0.0  # if another one


class Unit(NamedTuple):
    """What a capture holds, by its README; the defaults are those of a serial unit with a wide counter."""

    hz: int
    gyro: Sensor
    accelerometer: Sensor
    frame: int = 0  # bytes of the message that the turned bit is in, which is also cut off at the beginning
    lacks: tuple[int, ...] = NOT_WHOLE
    step: int = 1  # of the counter; 0: samples are numbered from 0
    flags: dict[int, int] = {101: MISSING, 201: MISSING}  # by sample; VALID elsewhere  # noqa: RUF012
    counts: tuple[int, int, int] = (1, 1, 0)  # damaged, missing, torn
    status: tuple[tuple[str, int, int], ...] = ()  # column, bits dropped at its low end, place in the word
    temperatures: tuple[tuple[str, float], ...] = ()


def rate(si_per_count: float = 1.0, **more: float) -> Sensor:
    return Sensor(si_per_count, is_rate=True)._replace(**more)


NO_SENSOR: Final = Sensor()
WIDE: Final = (("status", 0, 0),)
AT_UNKNOWN: Final = {101: MISSING | UNKNOWN, 201: MISSING | UNKNOWN}
"""A counter of 7 or 8 bits, and no time of arrival in the capture."""
STIM_STATUS: Final = (("status_gyro", 0, 0), ("status_accelerometer", 0, 8))
TAMAGAWA_ACCELERATION: Final = rate(100 / 32768)
OPENIMU: Final = 1 / 128 * DEG

UNITS: Final = {
    "stim300-91": Unit(1000, Sensor(2**-21 * DEG), Sensor(2**-22), 28, flags=AT_UNKNOWN, status=STIM_STATUS),
    "stim300-91-totals": Unit(
        1000,
        Sensor(2**-21 * DEG, total_bits=24),
        Sensor(2**-22, total_bits=24),
        28,
        flags={101: LONG | UNKNOWN, 201: LONG | UNKNOWN},
        status=STIM_STATUS,
    ),
    "kvh1775": Unit(
        1000, Sensor(), Sensor(), 36, flags=AT_UNKNOWN, status=WIDE, temperatures=(("temperature", 1.0),)
    ),
    # Nothing in the bytes shows that sample 100 is missing; a damaged message and junk might have been one.
    "hg4930": Unit(
        100,
        Sensor(1.164153e-10),
        Sensor(2.270937e-9),
        20,
        lacks=(100,),
        step=0,
        flags={200: MISSING | UNKNOWN, 300: MISSING | UNKNOWN},
        counts=(0, 0, 0),
        status=(("status_14", 2, 0), ("status_15", 0, 6), ("status_17", 0, 14)),
        temperatures=(("temperature", 1.0),),
    ),
    "exail-asterix": Unit(
        500,
        Sensor(0.00153 / 3600 * DEG, total_bits=32),
        NO_SENSOR,
        26,
        flags={101: LONG, 201: LONG},
        status=WIDE,
    ),
    "fog-fg333": Unit(200, rate(1 / 3e6 * DEG), NO_SENSOR, 19, flags=AT_UNKNOWN, status=WIDE),
    # The README gives no scale: these are the placeholders of the profile.
    "epson-g370-sum": Unit(1000, Sensor(1e-9 * DEG), Sensor(1e-9), 36, status=WIDE),
    "epson-g370-nosum": Unit(
        1000,
        Sensor(1e-9 * DEG),
        Sensor(1e-9),
        34,
        lacks=(0, 100),
        flags={101: MISSING},
        counts=(0, 1, 0),
        status=WIDE,
    ),
    "mip-gx5": Unit(500, Sensor(), Sensor(G), 48, step=0, status=WIDE),
    "vectornav": Unit(400, Sensor(DEG), Sensor(), 44, step=0),
    "xsens-fp1220": Unit(400, rate(2**-20), rate(2**-20), 47, status=WIDE),
    "novatel-rawimusx": Unit(
        200, Sensor(1e-9, signs=(1, -1, 1)), Sensor(1e-9, signs=(1, -1, 1)), 56, step=0, status=WIDE
    ),
    "sbg-imu-short": Unit(
        200, rate(2**-26), rate(2**-20), 41, step=0, status=WIDE, temperatures=(("temperature", 1 / 256),)
    ),
    "ilabs-ga-200": Unit(
        200,
        rate(1e-5 * DEG),
        rate(1e-6 * G),
        40,
        step=10,
        status=WIDE,
        temperatures=(("temperature", 0.1),),
    ),
    "ilabs-ga-2000": Unit(
        2000, rate(1e-5 * DEG), rate(1e-6 * G), 40, status=WIDE, temperatures=(("temperature", 0.1),)
    ),
    "aceinna-s1": Unit(
        100,
        rate(1260 / 65536 * DEG),
        rate(20 / 65536 * G),
        31,
        status=WIDE,
        temperatures=tuple((f"temperature_{part}", 200 / 65536) for part in ("x", "y", "z", "board")),
    ),
    "openimu-z1": Unit(100, rate(DEG), rate(), 47, step=0),
    "hipnuc": Unit(400, rate(DEG), rate(G), 82, step=0, status=WIDE, temperatures=(("temperature", 1.0),)),
    "fdilink": Unit(
        200,
        rate(),
        rate(),
        64,
        flags=AT_UNKNOWN,
        temperatures=(("temperature", 1.0), ("temperature_pressure", 1.0)),
    ),
    # Sample 100 cannot be missed in the bytes; before 300 there is junk, which might have been one.
    "witmotion": Unit(
        100,
        rate(2000 / 32768 * DEG),
        rate(16 / 32768 * G),
        11,
        step=0,
        flags={201: MISSING | UNKNOWN, 300: MISSING | UNKNOWN},
        counts=(0, 0, 1),
        temperatures=(("temperature", 0.01),),
    ),
    "tamagawa-serial": Unit(200, rate(200 / 32768 * DEG), TAMAGAWA_ACCELERATION, 30, status=WIDE),
    "tamagawa-fog-serial": Unit(
        200,
        rate(200 / 32768 * DEG, z_per_count=200 / 2**31 * DEG),
        TAMAGAWA_ACCELERATION,
        32,
        status=WIDE,
    ),
    # The times of CAN logs are known, and show how many samples are missing.
    "openimu-j1939": Unit(
        100,
        rate(OPENIMU, zero=32000),
        rate(0.01, zero=32000),
        lacks=(100, 200),
        step=0,
        flags={101: MISSING | BY_TIME, 201: MISSING | BY_TIME},
        counts=(0, 1, 1),
    ),
    "bosch-mm7": Unit(
        100,
        rate(0.005 * DEG, zero=0x8000),
        rate(0.0001274 * G, zero=0x8000),
        lacks=(100, 200),
        flags={101: MISSING | BY_TIME, 201: MISSING | BY_TIME},
        counts=(0, 1, 1),
    ),
}
BY_ARRIVAL: Final = frozenset(
    ["stim300-91", "stim300-91-totals", "kvh1775", "fog-fg333", "fdilink", "hg4930", "witmotion"]
)
"""Units whose numbers wrap within a second, or without any: live the host's clock decides on their gaps."""


def capture_path(data: Path, name: str) -> Path:
    folder = data / "field" / "units"
    return next(path for path in (folder / f"{name}.raw", folder / f"{name}.log") if path.exists())


def truth_of(data: Path, name: str) -> Records:
    path = data / "field" / "units" / f"{name}.truth.csv"
    truth: Records = np.genfromtxt(path, delimiter=",", names=True, dtype=np.float64)
    assert truth["index"].tolist() == list(range(400))
    if name == "epson-g370-nosum":
        truth["gz"][200] = int(truth["gz"][200]) ^ 0x10 << 8  # the turned bit, which no check finds
    return truth


def increments(
    truth: Records, letter: str, sensor: Sensor, is_float: bool, unit: Unit
) -> NDArray[np.float64]:
    """Increments of all samples, rad or m/s; NaN for an axis that the unit lacks; totals begin with 0."""
    out = np.full((len(truth), 3), np.nan)
    for k, axis in enumerate("xyz"):
        if letter + axis not in (truth.dtype.names or ()):
            continue
        numbers = truth[letter + axis]
        if is_float:
            numbers = numbers.astype(np.float32).astype(np.float64)
        if sensor.total_bits:
            half = 1 << (sensor.total_bits - 1)
            numbers = (np.diff(numbers, prepend=numbers[0]) + half) % (2 * half) - half
        scale = sensor.z_per_count if axis == "z" and sensor.z_per_count else sensor.si_per_count
        out[:, k] = sensor.signs[k] * (numbers - sensor.zero) * scale / (unit.hz if sensor.is_rate else 1)
    return out


def expected_rows(data: Path, name: str) -> dict[str, NDArray[np.generic]]:
    """Return the columns of `imudrv decode` that the truth and the README ask for."""
    unit, truth = UNITS[name], truth_of(data, name)
    whole = np.array([n for n in range(400) if n not in unit.lacks])
    is_float = any(n.is_float for m in load_profile(name).messages for n in m.fields if n.axis)
    both = [
        increments(truth, *which, is_float, unit) for which in (("g", unit.gyro), ("a", unit.accelerometer))
    ]
    intervals = np.full(len(whole), 1_000_000_000 // unit.hz)
    if unit.gyro.total_bits:
        # The first total is the reference of the next; over a gap the next one holds both increments.
        for values in both:
            for lost in (100, 200):
                values[lost + 1] += values[lost]
        intervals[np.isin(whole, (101, 201))] *= 2
        whole, intervals = whole[1:], intervals[1:]
    status = np.zeros(400, np.int64)
    for column, dropped, place in unit.status:
        status |= truth[column].astype(np.int64) >> dropped << place
    return {
        "counter": _numbers(name, unit, whole),
        "interval_ns": intervals,
        "gyro": both[0][whole],
        "accelerometer": both[1][whole],
        "temperature_degc": np.stack(
            [truth[column][whole] * scale for column, scale in unit.temperatures] or [np.zeros(0)], axis=-1
        ).reshape(len(whole), -1),
        "status": status[whole],
        "flags": np.array([unit.flags.get(n, int(VALID)) for n in whole.tolist()]),
    }


def _numbers(name: str, unit: Unit, whole: NDArray[np.int64]) -> NDArray[np.int64]:
    if unit.step:
        return whole * unit.step
    if name == "hg4930":
        return np.arange(len(whole))  # the missing one does not show
    if name == "witmotion":
        return np.arange(len(whole)) + (whole > 200)  # only the torn one shows
    return whole - whole[0]


@pytest.mark.parametrize("name", UNITS)
def test_a_capture_decodes_to_its_truth(name: str, data: Path, tmp_path: Path) -> None:
    path = tmp_path / "rows.npz"
    assert main(["decode", str(capture_path(data, name)), "--profile", name, "-o", str(path)]) == 0
    expected = expected_rows(data, name)
    with np.load(path) as rows:
        assert set(rows) == set(expected)
        for column, values in expected.items():
            if values.dtype.kind == "f":
                np.testing.assert_allclose(rows[column], values, rtol=ROUNDING, atol=0, err_msg=column)
            else:
                np.testing.assert_array_equal(rows[column], values, err_msg=column)


@pytest.mark.parametrize("name", UNITS)
def test_losses_of_a_capture_are_exactly_those_made(name: str, data: Path) -> None:
    unit = UNITS[name]
    capture = Capture(capture_path(data, name), name)
    rows = sum(len(samples) for samples in capture.pulses())
    counts = capture.tracker.counts
    assert rows == counts.good == len(expected_rows(data, name)["counter"])
    assert (counts.damaged, counts.missing, counts.torn) == unit.counts
    assert counts.reference == (1 if unit.gyro.total_bits else 0)
    assert (counts.duplicate, counts.out_of_order, counts.invalid_counter, counts.restarts) == (0, 0, 0, 0)
    assert counts.recovered == (2 if unit.gyro.total_bits else 0)
    assert counts.unknown_gaps == sum(flags & UNKNOWN != 0 for flags in unit.flags.values())
    assert counts.closes
    rejected = {reason: (runs.runs, runs.length) for reason, runs in capture.rejected.items()}
    assert rejected == _rejected(name, unit)


def _rejected(name: str, unit: Unit) -> dict[Reason, tuple[int, int]]:
    """Rejected runs and bytes, or messages on CAN."""
    if not unit.frame:
        return {Reason.TORN: (1, 1) if name == "openimu-j1939" else (2, 2)}
    found = {Reason.NO_SYNC: (2, unit.frame - 5 + 7)}  # what the cut left of its frame, and the junk
    if name != "epson-g370-nosum":
        found[Reason.CHECK_FAILED] = (1, unit.frame)
    if name == "witmotion":
        found[Reason.TORN] = (2, 2 * unit.frame)  # the rate of sample 0, the acceleration of sample 200
    return found


def test_every_unit_with_a_capture_is_described(data: Path) -> None:
    captures = {
        path.name.removesuffix(".truth.csv") for path in (data / "field" / "units").glob("*.truth.csv")
    }
    assert captures == set(UNITS)


def test_bits_that_mean_good_when_set_are_named_when_they_are_clear() -> None:
    layout = load_profile("kvh1775").layout()
    assert UnitStatus.of(0x77, layout) == UnitStatus(0x77, [], [])
    assert UnitStatus.of(0x75, layout) == UnitStatus(0x75, ["gyro Y invalid"], ["gyro Y invalid"])


@pytest.mark.parametrize("name", UNITS)
def test_a_healthy_unit_has_no_bit_to_report(name: str, data: Path) -> None:
    path = capture_path(data, name)
    content = _messages(path) if path.suffix == ".log" else path.read_bytes()
    traffic = decode_traffic(load_profile(name), content)
    assert traffic.fits
    assert traffic.set_bits == ()


@pytest.mark.parametrize("name", UNITS)
def test_the_profile_of_a_capture_is_found(name: str, data: Path) -> None:
    if name.startswith("stim300-91"):
        # Increments and totals have the same layout.
        with pytest.raises(InputError, match="fits stim300-91 and stim300-91-totals equally well"):
            Capture(capture_path(data, name))
        return
    assert Capture(capture_path(data, name)).profile.name == name


@pytest.mark.parametrize(("name", "frames", "missing"), [("hole127", 1473, 127), ("hole200", 1400, 200)])
def test_a_hole_before_an_8_bit_counter_costs_no_good_frame(
    name: str, frames: int, missing: int, data: Path
) -> None:
    capture = Capture(data / "field" / "logs" / f"{name}.raw", "stim300-91")
    rows = np.concatenate(list(capture.pulses()))
    counts = capture.tracker.counts
    assert (counts.good, counts.missing, counts.expected, counts.unknown_gaps) == (frames, missing, 1600, 1)
    assert (counts.duplicate, counts.damaged, counts.invalid_counter) == (0, 0, 0)
    kept = np.r_[:500, 500 + missing : 1600]
    assert rows["counter"].tolist() == kept.tolist()
    flags = np.where(kept == 500 + missing, MISSING | UNKNOWN, VALID)
    assert rows["flags"].tolist() == flags.tolist()
    truth = np.genfromtxt(data / "field" / "logs" / "hole.truth.csv", delimiter=",", names=True)
    for letter, sensor, scale in (("g", "gyro", 2**-21 * DEG), ("a", "accelerometer", 2**-22)):
        values = np.stack([truth[letter + axis] for axis in "xyz"], axis=-1)[kept] * scale
        np.testing.assert_allclose(rows[sensor], values, rtol=ROUNDING, atol=0)


@pytest.fixture
def live(data: Path) -> Callable[[str], tuple[Records, Records, SampleCounts]]:
    """Decodes a capture that comes through a real port; returns frames, samples and counts.

    CAN messages get back the times that they have in their log: this test sends them all at once.
    """

    def decode(name: str) -> tuple[Records, Records, SampleCounts]:
        profile = load_profile(name)
        path = capture_path(data, name)
        arrivals = _through_can(path, name) if path.suffix == ".log" else _through_pty(path, name)
        layout = profile.layout()
        decoder, tracker = FrameDecoder(layout), SequenceTracker(layout)
        frames = [decoder.feed(arrival.data, arrival.t_ns) for arrival in arrivals]
        samples = [tracker.feed(some) for some in frames]
        return np.concatenate(frames), np.concatenate(samples), tracker.counts

    return decode


def _through_pty(path: Path, name: str) -> list[Arrival]:
    content = path.read_bytes()
    master, slave = os.openpty()
    tty.setraw(slave)
    port = open_port(os.ttyname(slave), load_profile(name))
    writer = Thread(target=_write, args=(master, content))
    writer.start()
    try:
        return _read(port, len(content))
    finally:
        writer.join()
        port.close()
        os.close(master)
        os.close(slave)


def _write(master: int, content: bytes) -> None:
    """Write pieces that begin and end anywhere in a frame."""
    for start in range(0, len(content), 997):
        piece = memoryview(content)[start : start + 997]
        while piece:
            piece = piece[os.write(master, piece) :]


def _messages(path: Path) -> Records:
    log = CandumpDecoder()
    return np.concatenate([log.feed(path.read_bytes())[0], log.close()[0]])


def _through_can(path: Path, name: str) -> list[Arrival]:
    messages = _messages(path)
    port = open_port(f"can://virtual/{name}", load_profile(name))
    try:
        with can.Bus(name, "virtual", ignore_config=True) as unit:
            for message in messages:
                identifier = int(message["id"])
                unit.send(
                    can.Message(
                        arbitration_id=identifier & ~EXTENDED,
                        is_extended_id=bool(identifier & EXTENDED),
                        data=message["data"][: message["length"]].tobytes(),
                    )
                )
        received = np.concatenate([arrival.data for arrival in _read(port, len(messages))])
    finally:
        port.close()
    received["t_ns"] = messages["t_ns"]
    return [Arrival(0, received[:500]), Arrival(0, received[500:])]


def _read(port: Port, count: int) -> list[Arrival]:
    found: list[Arrival] = []
    silent = 0
    while sum(len(arrival.data) for arrival in found) < count:
        arrival = port.read(0.2)
        silent = 0 if len(arrival.data) else silent + 1
        assert silent < 100, "nothing comes any more"
        found.append(arrival)
    return found


@pytest.mark.parametrize("name", UNITS)
def test_a_live_unit_gives_what_its_capture_gives(
    name: str, data: Path, live: Callable[[str], tuple[Records, Records, SampleCounts]]
) -> None:
    capture = Capture(capture_path(data, name), name)
    offline = np.concatenate(list(capture.pulses()))
    frames, samples, counts = live(name)
    assert counts.closes
    assert (counts.good, counts.duplicate, counts.restarts) == (len(offline), 0, 0)
    # The test sends as fast as it can: where the host's clock numbers samples, only what they hold counts.
    by_arrival = (
        {"counter", "elapsed_ns", "interval_ns", "flags", "arrival_ns"} if name in BY_ARRIVAL else set()
    )
    for column in set(offline.dtype.names or ()) - by_arrival - {"arrival_ns"}:
        np.testing.assert_array_equal(samples[column], offline[column], err_msg=column)
    assert np.all(np.diff(frames["t_ns"]) >= 0)
    assert frames["t_ns"][0] > 0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", sorted(BY_ARRIVAL))
def test_times_of_arrival_settle_the_gaps_that_the_bytes_leave_open(name: str, seed: int, data: Path) -> None:
    unit, layout = UNITS[name], load_profile(name).layout()
    content = capture_path(data, name).read_bytes()
    whole = np.array([n for n in range(400) if n not in unit.lacks])
    offsets = FrameDecoder(layout).feed(content)["offset"]
    ends = np.r_[offsets[1:], len(content)]
    random = np.random.default_rng(seed)
    decoder, tracker = FrameDecoder(layout), SequenceTracker(layout)
    read = frames = 0
    now_s = 5.0
    while frames < len(whole):
        # A reader that wakes about once a sample, at most every 4 ms, and stalls at times.
        now_s += max(1 / unit.hz, 0.004) * random.uniform(0.5, 1.5)
        now_s += random.uniform(0.03, 0.13) * (random.random() < 0.02)
        now_s = min(now_s, 5.0 + 400 / unit.hz)
        sent = int(np.searchsorted(5.0 + (whole + 1) / unit.hz, now_s, side="right"))
        if sent > frames:
            tracker.feed(decoder.feed(content[read : ends[sent - 1]], round(now_s * 1e9)))
            read, frames = int(ends[sent - 1]), sent
    counts = tracker.counts
    assert counts.closes
    # Sample 100 is missing: hg4930 and witmotion have no number that would show it.
    assert counts.expected == whole[-1] - whole[0] + 1
    assert (counts.missing, counts.unknown_gaps, counts.duplicate) == (1, 0, 0)
