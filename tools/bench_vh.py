"""Time from the bytes of a unit to velocity and its measurement matrices, compared with C.

The program in C (`bench_vh.c`) does the same for this one unit and filter, without stages between which
records are stored, and is compiled here. Both must give the same numbers.
"""

import ctypes
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Final

import numpy as np
from bench_nav import LAYOUT, SCENARIO, Measure
from numpy.typing import NDArray

from imudrv.capture_files.source import CHUNK_BYTES
from imudrv.imu.coefficients import Coefficients, TemperatureTerms
from imudrv.imu.compensation import Compensator
from imudrv.imu.sequence import SequenceTracker
from imudrv.nav.attitude import quaternion_of_matrix
from imudrv.nav.mechanisation import MATRICES, Navigator
from imudrv.records import Records
from imudrv.sim.faults import StreamFaults
from imudrv.sim.scenario import Faults, StreamRates
from imudrv.sim.unit import simulate
from imudrv.units import ARCSEC, DEG_PER_H, PPM, UG
from imudrv.wire.encode import StreamEncoder
from imudrv.wire.stream import StreamDecoder

SOURCE: Final = Path(__file__).with_suffix(".c")
COMPILE: Final = ("-O3", "-march=native", "-shared", "-fPIC", "-lm")
REPEATS: Final = 10
"""200 s."""
DAMAGE: Final = StreamRates(bit_flips=4e-4, bytes_lost=2e-4, false_sync_between=2e-4, frame_lost=2e-4)
PLACE: Final = SCENARIO.site.place._replace(gravity_m_s2=None)
EVERY: Final = 1000
"""Samples per row of velocity and matrices."""
MISALIGNED: Final = np.array(
    [[0.9995, 0.0021, -0.0013], [-0.0008, 1.0004, 0.0017], [0.0011, -0.0019, 1.0002]]
)
CALIBRATION: Final = Coefficients(
    gyro_scale=np.full(3, 0.5) * ARCSEC,
    gyro_bias=np.array([0.3, -0.2, 0.1]) * DEG_PER_H,
    C_bg=MISALIGNED,
    accelerometer_scale=np.full(3, 2000.0),
    accelerometer_bias=np.array([80.0, -190.0, 40.0]) * UG,
    C_ba=MISALIGNED.T,
    r_b=np.array([[24.0, -11.0, -9.0], [-23.0, 29.0, -7.0], [-1.0, -18.0, 16.0]]) * 1e-3,
    temperature=TemperatureTerms(
        reference_degc=35.0,
        low_degc=10.0,
        high_degc=60.0,
        gyro_bias=np.array([0.01, -0.02, 0.03]) * DEG_PER_H,
        gyro_scale=np.array([2.0, -3.0, 4.0]) * PPM,
        accelerometer_bias=np.array([10.0, -20.0, 15.0]) * UG,
        accelerometer_scale=np.array([20.0, -30.0, 10.0]) * PPM,
    ),
)
UNIT: Final = np.dtype(
    [
        ("gyro_scale", np.float64, 3),
        ("gyro_bias", np.float64, 3),
        ("C_bg", np.float64, (3, 3)),
        ("accelerometer_scale", np.float64, 3),
        ("accelerometer_bias", np.float64, 3),
        ("C_ba", np.float64, (3, 3)),
        ("a_b", np.float64, (3, 3)),
        ("r_b", np.float64, (3, 3)),
        ("gyro_scale_per_k", np.float64, 3),
        ("gyro_bias_per_k", np.float64, 3),
        ("accelerometer_scale_per_k", np.float64, 3),
        ("accelerometer_bias_per_k", np.float64, 3),
        ("reference_degc", np.float64),
        ("low_degc", np.float64),
        ("high_degc", np.float64),
    ]
)
COUNTS: Final = ("good", "damaged", "missing", "out_of_order", "duplicate", "invalid_counter", "restarts")
FLAGS: Final = ("valid", "in_range", "without_arms")
RUN: Final = np.dtype(
    [
        ("q_nb", np.float64, 4),
        ("v_n", np.float64, 3),
        ("position", np.float64, 3),
        *((name, MATRICES[name]) for name in ("H", "B", "P", "Q")),
        *((name, np.int64) for name in (*COUNTS, *FLAGS)),
    ]
)
"""`struct unit` and `struct run` of the program."""


def vh(rounds: int) -> list[Measure]:
    """Measure both in turn, by the time of the processor that they take.

    Parameters
    ----------
    rounds : int
        Number of rounds; the best counts.

    Returns
    -------
    list of Measure
    """
    data, q_nb = _capture()
    with tempfile.TemporaryDirectory() as folder:
        program = Program(Path(folder), q_nb)
        theirs = program.process(data)
        _compare(_process(data, q_nb), theirs)
        count = int(theirs["good"][0])
        seconds = []
        for _ in range(rounds):
            begin = time.thread_time()
            _process(data, q_nb)
            middle = time.thread_time()
            program.process(data)
            seconds.append((middle - begin, time.thread_time() - middle))
    own, other = np.min(seconds, axis=0).tolist()
    n = rounds * count
    return [Measure("bytes to velocity, H, B, P, Q", n, count / own, "C -O3 -march=native", n, count / other)]


class Program:
    """The program in C, compiled.

    Parameters
    ----------
    folder : Path
        Where to put it.
    q_nb : ndarray, shape (4,)
        Attitude at the start.
    """

    def __init__(self, folder: Path, q_nb: NDArray[np.float64]) -> None:
        compiler = shutil.which("gcc") or shutil.which("cc")
        if compiler is None:
            raise SystemExit("bench.py vh: expected a C compiler called gcc or cc for the comparison")
        library = folder / "bench_vh.so"
        subprocess.run([compiler, *COMPILE, str(SOURCE), "-o", str(library)], check=True)
        self._process = ctypes.CDLL(str(library)).process
        self._process.argtypes = (ctypes.c_char_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_void_p)
        self._process.restype = None
        self._unit, self._start = np.zeros(1, UNIT), np.zeros(1, RUN)
        self._unit["a_b"] = np.linalg.inv(CALIBRATION.C_ba)
        for name in UNIT.names or ():
            if name.endswith(("_per_k", "_degc")):
                self._unit[name] = getattr(CALIBRATION.temperature, name.removesuffix("_per_k"))
            elif name != "a_b":
                self._unit[name] = getattr(CALIBRATION, name)
        self._start["q_nb"] = q_nb
        self._start["position"] = PLACE[:3]

    def process(self, data: bytes) -> Records:
        """Return the row of `RUN` at the end of the bytes."""
        run = self._start.copy()
        self._process(data, len(data), self._unit.ctypes.data, run.ctypes.data)
        return run


def _capture() -> tuple[bytes, NDArray[np.float64]]:
    """Return the bytes of the motion, repeated, some of them damaged; and the attitude at the start."""
    chunks = list(simulate(SCENARIO, LAYOUT))
    pulses = np.concatenate([chunk.pulses for chunk in chunks])
    pulses["temperature_degc"] = 35.0 + np.arange(len(pulses))[:, None] * 1e-5  # a step in a second
    first = pulses["counter"].copy()
    (message,) = LAYOUT.messages
    encoder = StreamEncoder(LAYOUT)
    line = StreamFaults(Faults(stream=DAMAGE), [(message.length, message.header)], seed=3)
    sent = []
    for k in range(REPEATS):
        pulses["counter"] = first + k * len(pulses)
        sent.append(line.apply(encoder.encode(pulses), pulses["counter"] * LAYOUT.interval_ns)[0])
    return b"".join(sent), quaternion_of_matrix(chunks[0].truth["C_nb"][0])


def _process(data: bytes, q_nb: NDArray[np.float64]) -> Records:
    """Do what `Program.process` does, in the pieces of a capture; return `RUN` without `FLAGS`."""
    decoder, tracker = StreamDecoder(LAYOUT), SequenceTracker(LAYOUT)
    compensator = Compensator(CALIBRATION, LAYOUT)
    navigator = Navigator(PLACE, q_nb, C_ba=CALIBRATION.C_ba, every=EVERY)
    whole = memoryview(data)
    for begin in range(0, len(data), CHUNK_BYTES):
        frames = decoder.feed(whole[begin : begin + CHUNK_BYTES]).frames
        navigator.feed(compensator.feed(tracker.feed(frames)))
    run, latest = np.zeros(1, RUN), navigator.latest
    for name in ("q_nb", "v_n", *MATRICES.names):
        run[name] = latest[name]
    run["position"] = [latest[name][0] for name in ("latitude_rad", "longitude_rad", "height_m")]
    for name in COUNTS:
        run[name] = getattr(tracker.counts, name)
    return run


def _compare(ours: Records, theirs: Records) -> None:
    """Require that both accounted for every frame alike, and came to the same velocity and matrices."""
    for name in COUNTS:
        assert ours[name] == theirs[name], (name, ours[name], theirs[name])
    assert theirs["valid"] == theirs["in_range"] == theirs["good"]
    # The C compiler rounds `a b + c` once, and the terms of some sums come in another order: each sample may
    # differ by half a unit in the last place of the largest value.
    tolerance = float(theirs["good"][0]) * 0.5 * np.finfo(np.float64).eps
    for name in ("v_n", *MATRICES.names):
        largest = np.abs(theirs[name]).max()
        assert np.allclose(ours[name], theirs[name], rtol=0.0, atol=tolerance * largest), name
