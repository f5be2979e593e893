"""Inner lever arms of the IMU that `imudrv` drives: where its three accelerometers sense.

In a notebook::

    import calib

    calib.predict("three-rotations", site="site.yaml")
    result = calib.identify(["z.raw", "x.raw", "y.raw"], calibration="unit.yaml", site="site.yaml",
                            profile="imu50-rs422")
    calib.calibrate_sensors(["session.raw"], site="site.yaml", unit="50-0017", profile="imu50-rs422")
    calib.validate("z.raw", calibration="unit.yaml", site="site.yaml", profile="imu50-rs422")

Data flow; every module can be read alone::

    increments -> Segments -> Run, Run, ... -> LeverArmEstimate -> LeverArms
              detection    estimation      estimation         lever_arms

    detection       rests and rotations in increments, offline and live
    estimation      rotations aligned and navigated; lever arms from their velocities; accuracy of a plan
    lever_arms      gauges, and the formats of other programs
    identification  captures to an identification result
    sensors         a new unit: scales, axes, biases and arms from rests and the motions between them
    alignment       a rest of a capture to level and heading, compared with the site
    result_file     the result as JSON      certificate  the result as a calibration file

    procedure       the bench procedure as data, and its state machine
    bench           a session with an operator: journal, recordings, screen
    noise           Allan deviations of a long rest, and their coefficients
    validation      navigation with and without compensation, on recordings and simulated units
    dither          effect of gyro dither on the size effect
    reports         reports as text, for a terminal and as HTML
    messages        texts for the operator, by key
    signing         keys, and signatures of sessions and certificates
    api             functions for a notebook      cli  the command `calib`

Increments are compensated for everything except the size effect. The conventions are those of `imudrv`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calib.alignment import align as align
    from calib.api import load_procedure as load_procedure
    from calib.api import predict as predict
    from calib.api import validate as validate
    from calib.bench.session import Session as Session
    from calib.estimation.predict import PlannedRotation as PlannedRotation
    from calib.identification import EstimationOptions as EstimationOptions
    from calib.identification import identify as identify
    from calib.lever_arms.gauge import LeverArms as LeverArms
    from calib.noise.analysis import analyse_noise as analyse_noise
    from calib.sensors.calibrate import SensorsOptions as SensorsOptions
    from calib.sensors.calibrate import calibrate_sensors as calibrate_sensors
    from calib.sensors.prediction import predict_sensors as predict_sensors

# Imported at first use, so that a program pays only for what it needs.
_MODULES = {
    "EstimationOptions": "calib.identification",
    "LeverArms": "calib.lever_arms.gauge",
    "PlannedRotation": "calib.estimation.predict",
    "Session": "calib.bench.session",
    "SensorsOptions": "calib.sensors.calibrate",
    "align": "calib.alignment",
    "analyse_noise": "calib.noise.analysis",
    "calibrate_sensors": "calib.sensors.calibrate",
    "identify": "calib.identification",
    "load_procedure": "calib.api",
    "predict": "calib.api",
    "predict_sensors": "calib.sensors.prediction",
    "validate": "calib.api",
}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'calib' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
