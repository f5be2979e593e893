#!/usr/bin/env python3
"""Compare the results of two versions bit for bit.

    python tools/same_bits.py --write before.json      on the old code
    python tools/same_bits.py --check before.json      on the new code

Simulated captures of every profile, with line faults, are decoded, checked for sequence, compensated with
each rate filter, stamped, and navigated with H; lever arms are identified and validated on clean ones. Each
result has a name and a SHA-256. The order of columns counts, their names do not.

Bits depend on the processor and on numpy, scipy and numba: a file belongs to one machine and is not
committed. On another one `--check` refuses to compare.
"""

import argparse
import hashlib
import json
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any, Final

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # more threads may add in another order

import llvmlite.binding
import numba
import numpy as np
import scipy

from calib.identification import EstimationOptions, PriorCalibration, identify
from calib.validation.navigate import navigate
from calib.validation.trial import TrialSettings
from imudrv.calibration import Calibration, coefficients
from imudrv.chain import Chain
from imudrv.files.settings_file import parse
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import NAMES
from imudrv.imu.sequence import SequenceTracker
from imudrv.nav.alignment import Alignment
from imudrv.nav.mechanisation import Navigator
from imudrv.profiles import OWN, load
from imudrv.profiles.schema import Profile
from imudrv.records import Records
from imudrv.sim.capture import record, wire
from imudrv.sim.scenario import NOMINAL, Scenario
from imudrv.units import DEG_PER_H, UG
from imudrv.wire.decoder import CaptureDecoder

Results = Iterator[tuple[str, str]]

ALIGN_S: Final = 30.0
MISALIGNED: Final = [[0.9995, 0.0021, -0.0013], [-0.0008, 1.0004, 0.0017], [0.0011, -0.0019, 1.0002]]
UNIT: Final = {
    "gyro": {
        "scale_arcsec_per_pulse": [0.45, 0.76, 0.85],
        "bias_deg_per_h": [0.3, -0.2, 0.1],
        "C_bg": MISALIGNED,
    },
    "accelerometer": {
        "scale_pulse_per_m_s": [2382.0, 1731.0, 1643.0],
        "bias_ug": [80.0, -190.0, 40.0],
        "C_ba": np.transpose(MISALIGNED).tolist(),
    },
    "temperature": {
        "reference_degc": 35.0,
        "range_degc": [10.0, 38.05],  # exceeded after 36 s
        "gyro_bias_deg_per_h_per_k": [0.01, -0.02, 0.03],
        "gyro_scale_ppm_per_k": [2.0, -3.0, 4.0],
        "accelerometer_bias_ug_per_k": [10.0, -20.0, 15.0],
        "accelerometer_scale_ppm_per_k": [20.0, -30.0, 10.0],
    },
}
WHOLE: Final = parse(json.loads(NOMINAL.model_dump_json(exclude_none=True)) | UNIT, Calibration, "unit")
DAMAGE: Final = ("bit_flips", "bytes_lost", "bytes_inserted", "false_sync_inside", "frame_lost")
BETWEEN: Final = ("bytes_between", "false_sync_between", "frame_doubled")
FAULTS: Final = {
    "stream": dict.fromkeys(DAMAGE + BETWEEN, 0.002),
    "can": dict.fromkeys(["lost", "doubled", "swapped"], 0.002),
    "silences": [{"at_s": 36.0, "duration_s": 0.05}, {"at_s": 38.0, "duration_s": 0.7}],
    "counter_jumps": [{"at_s": 39.0, "by": 1000}, {"at_s": 40.0, "by": -30000}],
}
ROCK: Final = {"rock": {"duration_s": 6.0, "band_hz": [0.3, 3.0], "rate_rms_deg_per_s": [20, 20, 20]}}
VIBRATE: Final = {"vibrate": {"duration_s": 6.0, "band_hz": [20, 300], "g_rms": [0, 0, 3]}}
TURN: Final = {"rotate": {"angle_deg": 180, "duration_s": 2.5, "axis_tilt_mrad": [3, 0]}}
TESTS: Final = {"rotation": [TURN], "rocking": [ROCK], "vibration": [VIBRATE], "static": []}


def main() -> int:
    """Write or check; exit code 1: results differ, 2: the file is of another machine."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--write", type=Path, metavar="FILE", help="store the fingerprints of this code")
    what.add_argument("--check", type=Path, metavar="FILE", help="compare this code with those stored")
    options = parser.parse_args()
    if options.write is not None:
        stored = {"machine": machine(), "sha256": dict(results())}
        options.write.write_text(json.dumps(stored, indent=1) + "\n")
        return 0
    stored = json.loads(options.check.read_text())
    if stored["machine"] != machine():
        print(f"{options.check}: expected a file of {machine()}, got one of {stored['machine']}")
        return 2
    before, now = stored["sha256"], dict(results())
    different = [name for name in before | now if before.get(name) != now.get(name)]
    for name in different:
        print(f"{name}: {'differs' if name in before and name in now else 'only in one of the two'}")
    print(f"{len(before | now)} results, {len(different)} differ")
    return 1 if different else 0


def machine() -> str:
    """Describe processor and libraries, on which the bits depend."""
    cpu = f"{platform.system()} {platform.machine()} {llvmlite.binding.get_host_cpu_name()}"
    return ", ".join([cpu, *(f"{m.__name__} {m.__version__}" for m in (np, scipy, numba, llvmlite))])


def results() -> Results:
    """Yield name and hash of each result."""
    for name in OWN:
        profile, run = load(name), scenario([ROCK], faults=FAULTS)
        for what, fingerprint in (*offline(profile, run), *live(profile, run)):
            yield f"{name}: {what}", fingerprint
    yield from identified()
    yield from validated()


def sha256(*arrays: Any) -> str:
    """Hash arrays bit by bit, records column by column, anything else as JSON."""
    digest = hashlib.sha256()
    for array in arrays:
        if not isinstance(array, np.ndarray):
            digest.update(json.dumps(array).encode())
            continue
        for column in [array] if array.dtype.names is None else [array[name] for name in array.dtype.names]:
            digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()


def scenario(motion: list[Any], *, pose: str = "z_up", faults: Any = None, residuals: Any = None) -> Scenario:
    """Return a scenario of motion between two rests; the unit warms up and its counter overflows."""
    start = {"pose": pose, "tilt_mrad": [0.8, -0.5], "pivot_offset_mm": [40, 30, 30], "counter": 2**32 - 700}
    document = {
        "format": "imu50-scenario",
        "version": 1,
        "seed": 7,
        "site": {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0},
        "start": start,
        "motion": [{"rest": {"duration_s": ALIGN_S + 6.0}}, *motion, {"rest": {"duration_s": 10.0}}],
        "unit": {
            "calibration": json.loads(WHOLE.model_dump_json(exclude_none=True)),
            "residuals": residuals or {},
            "noise": {"arw_deg_per_sqrt_h": 0.002, "vrw_m_s_per_sqrt_h": 0.003},
            "temperature": {"start_degc": 38.0, "slope_k_per_h": 5.0},
        },
        "faults": faults or {},
    }
    return parse(document, Scenario, "scenario")


def pieces(whole: Any, longest: int) -> Iterator[Any]:
    """Cut bytes or rows into pieces of random length."""
    rng, at = np.random.default_rng(5), 0
    while at < len(whole):
        length = int(rng.integers(1, longest))
        yield whole[at : at + length]
        at += length


def offline(profile: Profile, run: Scenario) -> Results:
    """Process a capture stage by stage, each fed in pieces."""
    layout, full = profile.layout(), coefficients(WHOLE)
    capture = b"".join(data for data, _ in record(run, layout))
    yield "capture", hashlib.sha256(capture).hexdigest()

    decoder = CaptureDecoder(layout)
    frames = np.concatenate([*map(decoder.feed, pieces(capture, 9000)), decoder.close()])
    yield "decode", sha256(frames, [astuple(rejects) for _, rejects in sorted(decoder.rejected.items())])

    rng = np.random.default_rng(4)
    disordered = frames[np.argsort(np.arange(len(frames)) + rng.exponential(0.3, len(frames)))]
    disordered["counter"][rng.integers(0, len(frames), 20)] = rng.integers(0, 2**16, 20)
    for what, arrived in ((", disordered", disordered), ("", frames)):
        tracker = SequenceTracker(layout)
        pulses = np.concatenate([tracker.feed(piece) for piece in pieces(arrived, 200)])
        yield f"account{what}", sha256(pulses, astuple(tracker.counts))

    for name in NAMES:
        for what, c in (("", full), (", no temperature", replace(full, temperature=None))):
            yield f"compensate, {name}{what}", sha256(compensated(profile, pulses, c, name))
    no_arms = replace(full, r_b=None)
    yield "compensate, no size effect", sha256(compensated(profile, pulses, no_arms, "causal"))

    increments, site = compensated(profile, pulses, full, "centred"), run.site
    alignment = Alignment(site.latitude_rad, 0.01 * DEG_PER_H, 50.0 * UG, ALIGN_S)
    rest = alignment.feed(increments)
    q_nb = alignment.result().q_nb
    yield "align", sha256(q_nb)
    for what, C_ba in (("navigate", None), ("navigate with H", full.C_ba)):
        navigator = Navigator(site.place._replace(gravity_m_s2=None), q_nb, C_ba=C_ba)
        yield what, sha256(np.concatenate([navigator.feed(piece) for piece in pieces(rest, 3000)]))


def compensated(profile: Profile, pulses: Records, c: Coefficients, filter_name: Any) -> Records:
    """Return the increments of pulses fed in pieces."""
    layout = profile.layout()
    compensator = Compensator(c, layout, filter_name)
    return np.concatenate([*map(compensator.feed, pieces(pulses, 1500)), compensator.close()])


def live(profile: Profile, run: Scenario) -> Results:
    """Feed bursts that arrive with random delays, on a host whose clock gains 20 ppm."""
    rng, layout = np.random.default_rng(6), profile.layout()
    chain = Chain(profile, coefficients(WHOLE), "centred")
    outputs, now = [], 0
    for piece in wire(run, layout):
        sent, begin, i = piece.t_ns + piece.t_ns // 50_000 + 10**18, 0, 0
        if not isinstance(piece.data, bytes):
            piece.data["t_ns"] = sent + rng.exponential(100_000.0, len(sent)).astype(np.int64)
        while i < len(sent):
            i = min(i + int(rng.integers(1, 9)), len(sent))
            end, late = int(piece.end[i - 1]), 5e7 if rng.random() < 1e-3 else rng.exponential(1e5)
            now = max(now, int(sent[i - 1]) + int(late))
            outputs.append(chain.feed(piece.data[begin:end], now))
            begin = end
    outputs.append(chain.close())
    pulses, increments = (np.concatenate(parts) for parts in zip(*(o[:2] for o in outputs), strict=True))
    yield "stamp", sha256(pulses, increments, chain.clock.report)


def identified() -> Results:
    """Identify the lever arms of a unit with residual errors from three half turns."""
    profile, residuals = load("imu50-rs422"), {"accelerometer_bias_ug": 50, "gyro_scale_ppm": 5}
    with tempfile.TemporaryDirectory() as folder:
        captures = []
        for pose in ("z_up", "x_up", "y_up"):
            run = scenario([TURN], pose=pose, residuals=residuals)
            captures.append(Path(folder, f"{pose}.raw"))
            captures[-1].write_bytes(b"".join(data for data, _ in record(run, profile.layout())))
        prior = PriorCalibration(WHOLE, "unit", "")
        for option in (EstimationOptions("joint"), EstimationOptions("plain")):
            name = option.method
            found = identify(
                captures, site=run.site, calibration=prior, profile=profile, options=option
            ).result
            yield f"identify, {name}: arms", sha256(found.R_b)
            yield f"identify, {name}: covariance", sha256(found.covariance, found.correlation)
            yield f"identify, {name}: residuals", sha256(*(run.v_n - run.fitted_n for run in found.runs))


def validated() -> Results:
    """Navigate each kind of test without and with compensation of the size effect."""
    layout = load("imu50-rs422").layout()
    variants: dict[str, Any] = {"": {}, ", dither": {"rate_filter": "dither"}, ", skew": {"skew_s": 1e-3}}
    for name, motion in TESTS.items():
        run = scenario(motion, residuals={"accelerometer_bias_ug": 50, "gyro_scale_ppm": 5})
        decoder, tracker = CaptureDecoder(layout), SequenceTracker(layout)
        pulses = [tracker.feed(decoder.feed(data)) for data, _ in record(run, layout)]
        for what, options in variants.items():
            trial = navigate(name, pulses, TrialSettings(layout, WHOLE, run.site, ALIGN_S, **options))
            yield f"validate, {name}{what}", sha256(trial.normal.v_n, trial.compensated.v_n)


if __name__ == "__main__":
    sys.exit(main())
