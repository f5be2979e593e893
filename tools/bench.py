#!/usr/bin/env python3
"""Measure the speed of each stage, compared with what a user would otherwise write.

    tools/run python tools/bench.py [--rounds N] [--json]
    tools/run python tools/bench.py live|can [--seconds N] [--rounds N] [--json]
    tools/run python tools/bench.py nav [--rounds N] [--json]
    tools/run python tools/bench.py vh [--rounds N] [--json]
    tools/run python tools/bench.py noise [--rounds N] [--hours H] [--json]

A capture with damaged frames passes all stages, piece by piece, in one process on one core. Absolute figures
depend on the machine and its load; the ratios are what to look at.
"""

import argparse
import binascii
import importlib.util
import json
import os
import platform
import struct
import time
from collections.abc import Callable
from dataclasses import asdict
from itertools import islice
from math import inf
from typing import Final

import numba
import numpy as np
from bench_live import TRANSPORTS, live
from bench_nav import Measure, nav
from bench_noise import against_allantools, long_record
from bench_vh import vh
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles import load
from imudrv.records import PULSES, Flag, Records
from imudrv.sim.capture import wire
from imudrv.sim.faults import StreamFaults
from imudrv.sim.scenario import Faults, StreamRates
from imudrv.sim.scenario import load as load_scenario
from imudrv.units import ARCSEC, DEG_PER_H, UG
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.encode import StreamEncoder
from imudrv.wire.stream import StreamDecoder

Array = NDArray[np.float64]

LAYOUT: Final = load("imu50-rs422").layout()
TAU: Final = 1e-3
PIECE: Final = 4096
"""Samples a piece: the output of a stage is still in the cache when the next one reads it."""
SAMPLES: Final = 80 * PIECE
"""Length of the capture; twelve rounds are more than an hour of samples."""
OTHER_ROUNDS: Final = 3
"""Rounds of the alternatives."""
SLOW_SAMPLES: Final = 16 * PIECE
"""Part of the capture that the loop in Python decodes."""
DAMAGE: Final = StreamRates(
    bit_flips=0.004, bytes_lost=0.004, bytes_inserted=0.004, false_sync_between=0.004, frame_lost=0.004
)
OTHERS: Final = (
    ("kvh1775", "f32 and a counter of 7 bits", "imu50-rs422"),
    ("bosch-mm7", "bit fields, three messages", "imu50-can"),
)
"""Profiles of other makers, what is in them, and the profile of our unit on the same kind of line."""
CALIBRATION: Final = Coefficients(
    gyro_scale=np.array([0.45, 0.76, 0.85]) * ARCSEC,
    gyro_bias=np.array([0.2, -0.3, 0.1]) * DEG_PER_H,
    C_bg=np.eye(3) + 1e-3,
    accelerometer_scale=np.array([2382.0, 1731.0, 1643.0]),
    accelerometer_bias=np.array([80.0, -190.0, 40.0]) * UG,
    C_ba=np.eye(3) - 1e-3,
    r_b=np.array([[0.024, -0.011, -0.009], [-0.023, 0.029, -0.007], [-0.001, -0.018, 0.016]]),
)


def capture(samples: int) -> list[bytes]:
    """Return the pieces of a damaged capture with random pulses."""
    random = np.random.default_rng(1)
    encoder = StreamEncoder(LAYOUT)
    (message,) = LAYOUT.messages
    line = StreamFaults(Faults(stream=DAMAGE), [(message.length, message.header)], seed=3)
    pieces = []
    for first in range(0, samples, PIECE):
        pulses = np.zeros(min(PIECE, samples - first), PULSES)
        pulses["counter"] = first + np.arange(len(pulses))
        pulses["gyro"] = random.integers(-2000, 2000, (len(pulses), 3))
        pulses["accelerometer"] = random.integers(-50, 50, (len(pulses), 3))
        pulses["temperature_degc"] = 35.0
        sent, _ = line.apply(encoder.encode(pulses), pulses["counter"] * LAYOUT.interval_ns)
        pieces.append(sent)
    return pieces


def best_seconds(run: Callable[[], object], rounds: int) -> float:
    """Return the shortest of several runs: disturbances only add time."""
    seconds = []
    for _ in range(rounds):
        begin = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


def plain_decode(data: bytes) -> list[tuple[int, ...]]:
    """Search, check and unpack frame by frame; after a bad frame move on by one byte."""
    frames = []
    at = data.find(b"\xeb\x90\x50\x26")
    while 0 <= at <= len(data) - 44:
        (crc,) = struct.unpack_from("<H", data, at + 42)
        if binascii.crc_hqx(data[at + 2 : at + 42], 0xFFFF) == crc:
            frames.append(struct.unpack_from("<I6i4hH", data, at + 4))
            at += 44
        else:
            at += 1
        at = data.find(b"\xeb\x90\x50\x26", at)
    return frames


def plain_account(frames: Records) -> tuple[Records, int]:
    """Return pulses and number of lost samples; ignores disorder, duplicates and restarts."""
    steps = np.diff(frames["counter"], prepend=frames["counter"][0] - 1) % 2**32
    status = LAYOUT.status
    fault = frames["status"] & status.fault != 0
    saturated = frames["status"] & status.saturated != 0
    for sensor in ("gyro", "accelerometer"):
        saturated |= (np.abs(frames[sensor].astype(np.int64)) >= LAYOUT.pulse_limit).any(axis=1)
    pulses = np.zeros(len(frames), PULSES)
    pulses["counter"] = frames["counter"][0] - 1 + np.cumsum(steps)
    pulses["arrival_ns"] = frames["t_ns"]
    pulses["elapsed_ns"] = np.cumsum(steps) * LAYOUT.interval_ns
    pulses["interval_ns"] = LAYOUT.interval_ns
    pulses["gyro"] = frames["gyro"]
    pulses["accelerometer"] = frames["accelerometer"]
    pulses["temperature_degc"] = np.nan
    for k, scale in enumerate(LAYOUT.degc_per_count):
        pulses["temperature_degc"][:, k] = scale * frames["temperature"][:, k]
    pulses["status"] = frames["status"]
    pulses["flags"] = (
        np.where(fault | saturated, 0, Flag.VALID)
        | np.where(steps > 1, Flag.MISSING_BEFORE, 0)
        | np.where(saturated, Flag.SATURATED, 0)
        | np.where(fault, Flag.FAULT, 0)
        | np.where(frames["status"] & status.warm_up != 0, Flag.WARM_UP, 0)
    )
    return pulses, int((steps - 1).sum())


def plain_compensate(pulses: Records, c: Coefficients) -> tuple[Array, Array]:
    """Compensate whole arrays (section 1 of the mathematics); ignores gaps, long intervals and chunk ends."""
    assert c.r_b is not None
    a_b = np.linalg.inv(c.C_ba)
    dtheta_b = (pulses["gyro"] * c.gyro_scale) @ c.C_bg.T - c.gyro_bias * TAU
    dv_a = pulses["accelerometer"] / c.accelerometer_scale - c.accelerometer_bias * TAU
    w1 = np.zeros_like(dtheta_b)
    w1[2:] = (2.0 * dtheta_b[:-2] - 7.0 * dtheta_b[1:-1] + 11.0 * dtheta_b[2:]) / (6.0 * TAU)
    w0 = np.vstack([np.zeros(3), w1[:-1]])
    wm = dtheta_b / TAU
    for i, (a, r) in enumerate(zip(a_b, c.r_b, strict=True)):
        start, middle, end = (np.cross(w, np.cross(w, r)) for w in (w0, wm, w1))
        integral = np.cross(w1 - w0, r) + TAU / 6.0 * (start + 4.0 * middle + end)
        dv_a[:, i] -= integral @ a
    return dtheta_b, dv_a @ c.C_ba.T


def throughput(rounds: int) -> list[Measure]:
    """Measure decoding, accounting and compensation; both implementations must agree.

    Parameters
    ----------
    rounds : int
        Number of passes over the capture.

    Returns
    -------
    list of Measure
        In the order of the flow.
    """
    pieces = capture(SAMPLES)
    some = b"".join(pieces[: SLOW_SAMPLES // PIECE])

    # Run each stage once: compiles its kernels and makes the input of the next one.
    decoder, tracker = StreamDecoder(LAYOUT), SequenceTracker(LAYOUT)
    frames = [decoder.feed(piece).frames for piece in pieces]
    pulses = [tracker.feed(piece) for piece in frames]
    increments = Compensator(CALIBRATION, LAYOUT).feed(pulses[0])
    count = sum(map(len, frames))

    by_loop = plain_decode(some)
    assert [row[0] for row in by_loop] == np.concatenate(frames)["counter"][: len(by_loop)].tolist()
    by_arrays, lost = plain_account(np.concatenate(frames))
    assert lost == tracker.counts.lost
    for name in PULSES.names or ():
        assert np.array_equal(
            by_arrays[name], np.concatenate(pulses)[name], equal_nan=name == "temperature_degc"
        )
    unbroken = int(np.argmax(pulses[0]["flags"] & Flag.MISSING_BEFORE != 0))
    _, dv_b = plain_compensate(pulses[0][:unbroken], CALIBRATION)
    assert np.allclose(increments["dv_b"][3:unbroken], dv_b[3:], rtol=0.0, atol=1e-14)

    def flow() -> tuple[float, float, float]:
        """Pass the capture through all stages, piece by piece; return the seconds of each."""
        decoder, tracker = StreamDecoder(LAYOUT), SequenceTracker(LAYOUT)
        compensator = Compensator(CALIBRATION, LAYOUT)
        decoding = accounting = compensating = 0.0
        for piece in pieces:
            begin = time.perf_counter()
            found = decoder.feed(piece).frames
            decoded = time.perf_counter()
            good = tracker.feed(found)
            accounted = time.perf_counter()
            compensator.feed(good)
            compensating += time.perf_counter() - accounted
            accounting += accounted - decoded
            decoding += decoded - begin
        return decoding, accounting, compensating

    ours = np.min([flow() for _ in range(rounds)], axis=0).tolist()
    theirs = (
        best_seconds(lambda: plain_decode(some), OTHER_ROUNDS) / len(by_loop),
        best_seconds(lambda: [plain_account(piece) for piece in frames], OTHER_ROUNDS) / count,
        best_seconds(lambda: [plain_compensate(piece, CALIBRATION) for piece in pulses], OTHER_ROUNDS)
        / count,
    )
    stages = (
        ("decode, 2 % damaged", "loop, struct and crc_hqx", len(by_loop)),
        ("account", "numpy, losses only", count),
        ("compensate, size effect", "numpy, no gaps", count),
    )
    return [
        Measure(stage, rounds * count, count / seconds, other, OTHER_ROUNDS * n, 1.0 / each)
        for (stage, other, n), seconds, each in zip(stages, ours, theirs, strict=True)
    ]


def decode_of_others(rounds: int) -> list[Measure]:
    """Measure the decoder with profiles of other makers against those of our unit, in alternating rounds."""
    measures = []
    for name, kind, own in OTHERS:
        layouts = [load(name).layout(), load(own).layout()]
        captures = [
            [piece.data for piece in islice(wire(load_scenario("static"), layout, PIECE), SAMPLES // PIECE)]
            for layout in layouts
        ]
        seconds = [inf, inf]
        for _ in range(rounds):
            for k, (layout, pieces) in enumerate(zip(layouts, captures, strict=True)):
                decoder = FrameDecoder(layout)
                begin = time.perf_counter()
                count = sum(len(decoder.feed(piece)) for piece in pieces)
                seconds[k] = min(seconds[k], time.perf_counter() - begin)
                assert count + len(decoder.close()) == SAMPLES
        theirs, ours = (SAMPLES / each for each in seconds)
        stage, samples = f"decode {name}: {kind}", rounds * SAMPLES
        measures.append(Measure(stage, samples, theirs, f"decode {own}", samples, ours))
    return measures


def machine() -> dict[str, str | int]:
    """Describe machine and software."""
    return {
        "machine": platform.machine(),
        "cpus": os.cpu_count() or 0,
        "system": platform.system(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
    }


def show(measures: list[Measure], how: str) -> None:
    """Print a table and the conditions of the measurement."""
    console = Console()
    console.print(", ".join(f"{name} {value}" for name, value in machine().items()))
    table = Table("stage", "M samples/s", "alternative", "M samples/s", "ratio")
    for column in (table.columns[1], table.columns[3], table.columns[4]):
        column.justify = "right"
    for m in measures:
        ours, theirs = f"{m.per_second / 1e6:.1f}", f"{m.other_per_second / 1e6:.2f}"
        table.add_row(m.stage, ours, m.other_way, theirs, f"{m.ratio:.3g}")
    console.print(table)
    counts = ", ".join(f"{m.samples / 1e6:.1f} M and {m.other_samples / 1e6:.1f} M" for m in measures)
    console.print(f"One core, {how}, best round. Samples, own and alternative: {counts}.")


def show_live(rows: dict[str, dict[str, float]]) -> None:
    """Print a table."""
    table = Table("latency from unit to receiver", *next(iter(rows.values())))
    for which, row in rows.items():
        if "/" in which:
            table.add_row(which, *(f"{ratio:.2f}" for ratio in row.values()))
        else:
            *quantiles_s, cpu = row.values()
            table.add_row(which, *(f"{x * 1e6:.0f} us" for x in quantiles_s), f"{100 * cpu:.1f} %")
    Console().print(table)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument(
        "what",
        nargs="?",
        choices=("stages", "live", "can", "nav", "vh", "noise"),
        default="stages",
        help="default: stages of the driver",
    )
    parser.add_argument(
        "--rounds",
        type=int,
        help="default: 12 over 5.4 minutes of samples; live 3 of each; nav 5 over an hour; vh 40; noise 3",
    )
    parser.add_argument(
        "--seconds", type=int, default=20, help="duration of a live round (default: %(default)s)"
    )
    parser.add_argument(
        "--hours", type=float, default=1.0, help="length of the record of noise (default: %(default)s)"
    )
    options = parser.parse_args()
    rounds = (
        options.rounds or {"stages": 12, "live": 3, "can": 3, "nav": 5, "vh": 40, "noise": 3}[options.what]
    )
    if rounds < 1 or options.seconds < 1 or options.hours < 0.1:
        parser.error("--rounds, --seconds: expected 1 or more; --hours: 0.1 or more")
    if options.what in TRANSPORTS:
        quantiles = live(TRANSPORTS[options.what], options.seconds, rounds)
        if options.json:
            print(json.dumps({"machine": machine(), "seconds": quantiles}, indent=1))
        else:
            show_live(quantiles)
        return
    how, extra = f"{PIECE:,} samples at a time", dict[str, float]()
    if options.what == "nav":
        if importlib.util.find_spec("pyins") is None:
            parser.exit(2, "bench.py nav: expected python-ins for the comparison: pip install python-ins\n")
        measures, peak_mb = nav(rounds)
        how = f"an hour in the pieces of a capture, a row a second, peak memory {peak_mb:.0f} MB"
        extra = {"peak_mb": peak_mb}
    elif options.what == "noise":
        measures, record = [against_allantools(rounds)], long_record(options.hours)
        how = (
            f"one channel; six channels at rest for {options.hours:g} h at 1 kHz: {record['seconds']:.1f} s, "
            f"{record['grown_mb']:.1f} MB more than after a minute"
        )
        extra = record
    elif options.what == "vh":
        measures = vh(rounds)
        how = f"200 s of damaged bytes, {1.0 / measures[0].ratio:.2f} times the time of C"
    else:
        measures = throughput(rounds) + decode_of_others(rounds)
    if options.json:
        rows = [{**asdict(m), "ratio": m.ratio} for m in measures]
        print(json.dumps({"machine": machine(), "measures": rows, **extra}, indent=1))
    else:
        show(measures, how)


if __name__ == "__main__":
    main()
