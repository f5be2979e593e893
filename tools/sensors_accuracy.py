"""Accuracy of `calib sensors`: simulated units against their truth, the golden set, the road to the arms.

tools/run python -m tools.sensors_accuracy units --cases 20
tools/run python -m tools.sensors_accuracy units --procedure three-loops
tools/run python -m tools.sensors_accuracy start
tools/run python -m tools.sensors_accuracy scenario three-loops
tools/run python -m tools.sensors_accuracy scenario loops-both --temperature
tools/run python -m tools.sensors_accuracy golden ../shared/data/imusysclbt.bin
tools/run python -m tools.sensors_accuracy road
"""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: threads make small matrices slower

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from calib.identification import PriorCalibration, identify
from calib.procedure.plan import load as load_procedure
from calib.procedure.plan import shipped
from calib.sensors.adjustment import Free
from calib.sensors.calibrate import SensorsOptions, calibrate_sensors
from calib.sensors.certificate import certificate
from calib.sensors.prediction import PlannedPose, predict_sensors, turned
from calib.sensors.result import SensorsResult
from imudrv import profiles
from imudrv.calibration import Calibration
from imudrv.files.settings_file import parse
from imudrv.imu.coefficients import Coefficients
from imudrv.sensor_calibration import number_paths
from imudrv.sim import scenario as scenarios
from imudrv.sim.scenario import Scenario
from imudrv.sim.unit import draw_true_unit, simulate
from imudrv.site import Site
from imudrv.terminal import guarded
from imudrv.units import ARCSEC, DEG_PER_H, PPM, UG
from imudrv.wire.encode import StreamEncoder
from tools.psins_to_wire import FLOAT_PROFILE, convert
from tools.sensors_units import FACES, SITE, new_unit, six_faces_turned, three_loops, write_session

PROFILE: Final = "imu50-rs422"
UNIT: Final = "50-0017"
PROCEDURES: Final = {"six-faces-turned": six_faces_turned, "three-loops": three_loops}
GRAVITY_SIGMA: Final = 1e-5

GROUPS: Final = (
    ("gyro scale, ppm", "gyro.scale"),
    ("C_bg, arcsec", "gyro.C_bg"),
    ("gyro bias, deg/h", "gyro.bias"),
    ("K, ppm", "accelerometer.scale"),
    ("a_i, arcsec", "accelerometer.C_ba"),
    ("bias, ug", "accelerometer.bias"),
    ("k2, ug/g^2", "accelerometer.quadratic"),
    ("arms, mm", "size_effect"),
    ("skew, ms", "skew_ms"),
)
GOLDEN: Final = {
    "gyro": {
        "scale": [1 + 10e-6, 1 + 20e-6, 1 + 30e-6],
        "bias_deg_per_h": [-0.1, -0.2, -0.3],
    },
    "accelerometer": {
        "scale": [1 - 10e-6, 1 - 20e-6, 1 - 30e-6],
        "bias_ug": [-10.0, -20.0, -30.0],
        "quadratic_ug_per_g2": [-10.0, -20.0, -30.0],
    },
    "size_effect": {
        "r_mm": {"x": [-10.0, -20.0, -30.0], "y": [-40.0, -50.0, -60.0], "z": [0.0, 0.0, 0.0]},
    },
    "skew_ms": 1.0,
}
"""Errors that were injected into the golden set, see its README."""


def golden_truth() -> dict[str, float]:
    """Return the numbers of the golden set by their paths."""
    G, A = np.eye(3), np.eye(3)
    G[[1, 2, 2], [0, 0, 1]] = np.array([40.0, 70.0, 100.0]) * ARCSEC
    off = [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    for (i, j), value in zip(off, (-10.0, -20.0, 20.0, -40.0, 40.0, 70.0), strict=True):
        A[i, j] = value * ARCSEC
    C_bg, C_ba = (np.linalg.inv(m / np.linalg.norm(m, axis=1, keepdims=True)) for m in (G, A))
    document = {**GOLDEN, "gyro": {**GOLDEN["gyro"], "C_bg": C_bg.tolist()}}
    document["accelerometer"] = {**GOLDEN["accelerometer"], "C_ba": C_ba.tolist()}
    return values(document)


def values(document: dict) -> dict[str, float]:
    """Return the numbers of a document by their paths."""
    found = {}
    for path in number_paths(document):
        place = document
        for key in path.replace("]", "").replace("[", ".").split("."):
            place = place[int(key)] if key.isdigit() else place[key]
        found[path] = place
    return found


def truth_of(calibration: Calibration | None) -> dict[str, float]:
    """Return the numbers of a true certificate."""
    return values(calibration.model_dump(exclude={"provenance"})) if calibration else {}


def errors(result: SensorsResult, truth: dict[str, float]) -> dict[str, np.ndarray]:
    """Return errors by the groups of the contract, in their units."""
    rows = {}
    for name, path in GROUPS:
        chosen = [one for one in result.estimates if one.path.startswith(path) and one.is_shown]
        difference = np.array([one.value - truth[one.path] for one in chosen])
        rows[name] = difference / _unit(name, np.array([truth[one.path] for one in chosen]))
    return rows


def sigmas(result: SensorsResult) -> dict[str, np.ndarray]:
    """Return the uncertainties by the same groups."""
    rows = {}
    for name, path in GROUPS:
        chosen = [one for one in result.estimates if one.path.startswith(path) and one.is_shown]
        rows[name] = np.array([one.sigma for one in chosen]) / _unit(
            name, np.array([one.value for one in chosen])
        )
    return rows


def _unit(name: str, value: np.ndarray) -> np.ndarray | float:
    return np.abs(value) * 1e-6 if "ppm" in name else ARCSEC if "arcsec" in name else 1.0


def nees(result: SensorsResult, truth: dict[str, float]) -> tuple[float, int]:
    """Return the normalised squared error and its degrees of freedom."""
    rows = [k for k, one in enumerate(result.estimates) if one.is_shown]
    error = np.array([result.estimates[k].value - truth[result.estimates[k].path] for k in rows])
    P = result.covariance[np.ix_(rows, rows)]
    scale = np.sqrt(np.diag(P))
    size, directions = np.linalg.eigh(P / scale / scale[:, None])
    kept = size > 1e-9  # the centroid
    z = directions[:, kept].T @ (error / scale)
    return float((z**2 / size[kept]).sum()), int(kept.sum())


def calibrated(folder: Path, start: Calibration | None = None, **options: object) -> SensorsResult:
    """Return the result for the session in a folder."""
    return calibrate_sensors(
        [folder / "session.raw"],
        site=SITE,
        unit=UNIT,
        profile=PROFILE,
        start=start,
        options=SensorsOptions(**options),
    )


def units(arguments: argparse.Namespace) -> None:
    """Calibrate simulated units and compare them with their truth."""
    layout = profiles.load(PROFILE).layout()
    found: list[dict[str, np.ndarray]] = []
    stated: list[dict[str, np.ndarray]] = []
    squares = freedom = 0.0
    marks = []
    for seed in track(range(arguments.seed, arguments.seed + arguments.cases), transient=True):
        gravity = GRAVITY_SIGMA * np.random.default_rng(10_000 + seed).standard_normal()
        unit = new_unit(
            seed,
            layout,
            PROCEDURES[arguments.procedure](),
            rest_s=arguments.rest_s,
            gravity_error=float(gravity),
            wander=arguments.wander,
        )
        with TemporaryDirectory() as name:
            write_session(unit, layout, Path(name))
            result = calibrated(Path(name))
        truth = truth_of(unit.scenario.unit.calibration)
        if not result.estimates:
            raise RuntimeError(f"unit {seed}: {result}")
        found.append(errors(result, truth))
        found[-1]["K, ppm"] -= gravity / SITE.gravity * 1e6 if arguments.known_gravity else 0.0
        stated.append(sigmas(result))
        one, n = nees(result, truth)
        squares, freedom = squares + one, freedom + n
        marks.append(result.mark)
    planned = _planned(arguments)
    table = Table("", "rms error", "worst", "stated sigma", "planned sigma")
    for name, _ in GROUPS:
        e, s = np.array([row[name] for row in found]), np.array([row[name] for row in stated])
        table.add_row(
            name, *(f"{x:.4f}" for x in (_rms(e), np.abs(e).max(), _rms(s))), f"{_rms(planned[name]):.4f}"
        )
    Console().print(table)
    half = 1.96 * np.sqrt(2.0 / freedom)
    print(f"NEES per dimension {squares / freedom:.2f}, 95 % band {1 - half:.2f} to {1 + half:.2f}")
    print(
        f"{arguments.cases} units, verdicts: {', '.join(f'{m} {marks.count(m)}' for m in sorted(set(marks)))}"
    )


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _planned(arguments: argparse.Namespace) -> dict[str, np.ndarray]:
    """Return the sigma of the plan, by the groups."""
    poses = [one for up, east in FACES for one in (PlannedPose(up, east), turned(PlannedPose(up, east)))]
    if arguments.procedure != "six-faces-turned":
        poses = [PlannedPose(*_sides(C)) for C in PROCEDURES[arguments.procedure]()]
    prediction = predict_sensors([poses], site=SITE, rest_s=arguments.rest_s, free=Free())
    rows = {}
    for name, path in GROUPS:
        rows[name] = np.array(
            [
                sigma / _unit(name, np.array(number.value))
                for number, sigma in zip(prediction.numbers, prediction.sigma, strict=True)
                if number.path.startswith(path) and (".C_" not in path or sigma > 1e-11)
            ]
        )
    return rows


def _sides(C_nb: np.ndarray) -> tuple[str, str]:
    """Return the axes up and east of an attitude."""
    names = []
    for row in (C_nb[2], C_nb[0]):
        k = int(np.argmax(np.abs(row)))
        names.append(f"{'+' if row[k] > 0 else '-'}{'XYZ'[k]}")
    return names[0], names[1]


def start(arguments: argparse.Namespace) -> None:
    """Compare the results from starts far off nominal."""
    layout = profiles.load(PROFILE).layout()
    with TemporaryDirectory() as name:
        write_session(new_unit(arguments.seed, layout), layout, Path(name))
        nominal = calibrated(Path(name))
        print("start, gyros and accelerometers: largest difference from the result of the nominal start")
        for gyro, accelerometer in ((0.05, 0.1), (-0.05, -0.1), (0.05, -0.1), (-0.05, 0.1)):
            off = calibrated(Path(name), _off_nominal(gyro, accelerometer))
            change = [
                abs(a.value - b.value) / a.sigma
                for a, b in zip(nominal.estimates, off.estimates, strict=True)
                if a.is_shown
            ]
            steps = off.adjustment.iterations if off.adjustment else 0
            print(f"{gyro:+.0%} {accelerometer:+.0%}: {max(change):.1e} sigma, {steps} iterations")


def scenario(arguments: argparse.Namespace) -> None:
    """Calibrate the unit of a shipped scenario and compare it with its truth."""
    layout, played = profiles.load(PROFILE).layout(), scenarios.load(arguments.name)
    encoder = StreamEncoder(layout)
    with TemporaryDirectory() as name:
        path = Path(name) / "session.raw"
        with path.open("wb") as file:
            for chunk in simulate(played, layout):
                file.write(encoder.encode(chunk.pulses).tobytes())
        result = calibrate_sensors(
            [path],
            site=played.site,
            unit=UNIT,
            profile=PROFILE,
            procedure=load_procedure(arguments.name) if arguments.name in shipped() else None,
            options=SensorsOptions(temperature=arguments.temperature),
        )
    print("\n".join(f"{one.mark}: {one.text}" for one in result.verdict))
    truth = _at_temperature(truth_of(played.unit.calibration), draw_true_unit(played, layout), result)
    stated = sigmas(result)
    table = Table("", "rms error", "worst", "stated sigma", "worst in sigma")
    for group, error in errors(result, truth).items():
        ratio = np.abs(error / stated[group]).max()
        table.add_row(
            group, *(f"{x:.4f}" for x in (_rms(error), np.abs(error).max(), _rms(stated[group]), ratio))
        )
    Console().print(table)
    square, freedom = nees(result, truth)
    print(f"NEES per dimension {square / freedom:.2f} ({freedom} dimensions)")


def _at_temperature(truth: dict[str, float], drawn: Coefficients, result: SensorsResult) -> dict[str, float]:
    """Return the truth at the reference temperature of a result, with the slopes that were drawn."""
    terms, kelvin = drawn.temperature, 0.0
    if terms is None:
        return truth
    if np.isfinite(result.reference_degc):
        kelvin = result.reference_degc - terms.reference_degc
    truth = dict(truth)
    for k in range(3):
        truth[f"gyro.bias_deg_per_h[{k}]"] += terms.gyro_bias[k] / DEG_PER_H * kelvin
        truth[f"gyro.scale_arcsec_per_pulse[{k}]"] *= 1.0 + terms.gyro_scale[k] * kelvin
        truth[f"accelerometer.bias_ug[{k}]"] += terms.accelerometer_bias[k] / UG * kelvin
        truth[f"accelerometer.scale_pulse_per_m_s[{k}]"] *= 1.0 + terms.accelerometer_scale[k] * kelvin
        slopes = {
            "gyro_bias_deg_per_h_per_k": terms.gyro_bias[k] / DEG_PER_H,
            "gyro_scale_ppm_per_k": terms.gyro_scale[k] / PPM,
            "accelerometer_bias_ug_per_k": terms.accelerometer_bias[k] / UG,
            "accelerometer_scale_ppm_per_k": terms.accelerometer_scale[k] / PPM,
        }
        truth |= {f"temperature.{name}[{k}]": float(slope) for name, slope in slopes.items()}
    return truth


def _off_nominal(gyro: float, accelerometer: float) -> Calibration:
    one = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    return parse(
        {
            "format": "imu50-calibration",
            "version": 1,
            "serial_number": UNIT,
            "created": "2026-01-01T00:00:00Z",
            "gyro": {
                "scale_arcsec_per_pulse": [0.5 * (1 + gyro)] * 3,
                "bias_deg_per_h": [0.0] * 3,
                "C_bg": one,
            },
            "accelerometer": {
                "scale_pulse_per_m_s": [2000.0 * (1 + accelerometer)] * 3,
                "bias_ug": [0.0] * 3,
                "C_ba": one,
            },
        },
        Calibration,
        "start",
    )


def golden(arguments: argparse.Namespace) -> None:
    """Calibrate the golden set and compare it with the errors that were injected."""
    site = Site(latitude_deg=34.0, longitude_deg=106.0, height_m=0.0)
    site = site.model_copy(update={"gravity_m_s2": site.gravity})  # that of the simulation
    with TemporaryDirectory() as name:
        wire = Path(name) / "golden.raw"
        convert(arguments.file, wire)
        result = calibrate_sensors(
            [wire],
            site=site,
            unit="golden",
            profile=str(FLOAT_PROFILE),
            options=SensorsOptions(pivot="fixed"),
        )
    print(result)
    for group, error in errors(result, golden_truth()).items():
        print(f"{group}: errors {', '.join(f'{e:+.4f}' for e in error)}")


def road(arguments: argparse.Namespace) -> None:
    """From raw pulses to the arms: the sensors first, then three rotations with the new certificate."""
    layout = profiles.load(PROFILE).layout()
    totals = []
    for seed in range(arguments.seed, arguments.seed + arguments.cases):
        with TemporaryDirectory() as name:
            folder = Path(name)
            unit = new_unit(seed, layout)
            write_session(unit, layout, folder)
            result = calibrated(folder)
            truth = unit.scenario.unit.calibration
            if truth is None or truth.size_effect is None:
                raise RuntimeError("a unit without arms")
            of_sensors = errors(result, truth_of(truth))
            captures = _rotations(seed, truth, folder)
            new = certificate(result)
            found = identify(
                captures, site=SITE, calibration=PriorCalibration(new, "new.yaml", "0" * 64), profile=PROFILE
            )
        error = (found.arms.r_b - truth.size_effect.r_m) * 1e3
        totals.append(_rms(error - error.mean(axis=0)))
        steps = ", ".join(f"{group} {_rms(e):.3f}" for group, e in of_sensors.items())
        print(f"unit {seed}: {result.mark}; rms errors after the sensors: {steps}")
        print(f"  after three rotations: arms {totals[-1]:.4f} mm rms")
    print(f"arms over {len(totals)} units: {_rms(np.array(totals)):.4f} mm rms")


def _rotations(seed: int, truth: Calibration, folder: Path) -> list[Path]:
    """Write captures of the unit's half turns with Z, X and Y up."""
    layout, captures = profiles.load(PROFILE).layout(), []
    for number, pose in enumerate(("z_up", "x_up", "y_up")):
        scenario = parse(
            {
                "format": "imu50-scenario",
                "version": 1,
                "seed": 1000 * (seed + 1) + number,
                "site": SITE.model_dump(exclude_none=True),
                "start": {"pose": pose, "pivot_offset_mm": [40.0, 30.0, 20.0], "tilt_mrad": [1.0, -2.0]},
                "motion": [
                    {"rest": {"duration_s": 370.0}},
                    {"rotate": {"angle_deg": 180.0, "duration_s": 2.5, "axis_tilt_mrad": [2.0, 1.0]}},
                    {"rest": {"duration_s": 15.0}},
                ],
                "unit": {
                    "calibration": truth.model_dump(mode="python", exclude_none=True),
                    "noise": {"arw_deg_per_sqrt_h": 0.002, "vrw_m_s_per_sqrt_h": 5e-6 * 9.80665 * 60.0},
                },
            },
            Scenario,
            "rotation",
        )
        encoder, path = StreamEncoder(layout), folder / f"{pose}.raw"
        with path.open("wb") as file:
            for chunk in simulate(scenario, layout):
                file.write(encoder.encode(chunk.pulses).tobytes())
        captures.append(path)
    return captures


COMMANDS: Final = (
    ("units", units),
    ("start", start),
    ("scenario", scenario),
    ("golden", golden),
    ("road", road),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    commands = parser.add_subparsers(required=True)
    for name, function in COMMANDS:
        command = commands.add_parser(name, help=function.__doc__)
        command.set_defaults(function=function)
        if name == "golden":
            command.add_argument("file", type=Path, help="imusysclbt.bin")
            continue
        if name == "scenario":
            command.add_argument("name", help="shipped scenario, such as three-loops, or a file")
            command.add_argument("--temperature", action="store_true", help="also the slopes per kelvin")
            continue
        command.add_argument("--seed", type=int, default=1, help="seed of the first unit (default: 1)")
        if name != "start":
            default = 20 if name == "units" else 1
            command.add_argument("--cases", type=int, default=default, help=f"units (default: {default})")
        if name == "units":
            command.add_argument("--procedure", choices=PROCEDURES, default="six-faces-turned")
            command.add_argument("--rest-s", type=float, default=60.0, help="default: 60")
            text = "biases that change from rest to rest, 5 ug and 0.005 deg/h, 750 s"
            command.add_argument("--wander", action="store_true", help=text)
            text = "leave out of K the error of gravity, 1 mGal"
            command.add_argument("--known-gravity", action="store_true", help=text)
    arguments = parser.parse_args(argv)
    return guarded(lambda: arguments.function(arguments))


if __name__ == "__main__":
    sys.exit(main())
