"""The noise of a unit as JSON, and in its certificate."""

from math import isnan
from typing import Any, Final

from calib.noise.analysis import ChannelNoise, NoiseResult
from calib.noise.model import ACCELEROMETER, GYRO, KINDS, Coefficient
from imudrv.calibration import Calibration
from imudrv.errors import InputError
from imudrv.sensor_calibration import AccelerometerNoise, GyroNoise, Noise

FORMAT: Final = "imu50-noise"
VERSION: Final = 1
PROVENANCE_NOISE: Final = "noise"
"""Key in the provenance of a certificate: how the noise was found."""
_DIGITS: Final = 4
"""Significant digits of a coefficient in a certificate."""


def result_document(result: NoiseResult) -> dict[str, Any]:
    """Return the whole result as plain data, with units in the names.

    Parameters
    ----------
    result : NoiseResult
        The result.

    Returns
    -------
    dict
        For JSON; null: not observable.
    """
    calibration = result.calibration
    return {
        "format": FORMAT,
        "version": VERSION,
        "created": f"{result.created:%Y-%m-%dT%H:%M:%SZ}",
        "software": result.software,
        "calibration": calibration and {"name": calibration.name, "sha256": calibration.sha256},
        "captures": [
            {
                **{key: value for key, value in capture._asdict().items() if key != "disturbances"},
                "disturbances": [disturbance._asdict() for disturbance in capture.disturbances],
            }
            for capture in result.captures
        ],
        "verdicts": [{"verdict": mark, "reason": reason} for mark, reason in result.verdicts],
        "at_rest_s": result.at_rest_s,
        "longest_s": result.longest_s,
        "tau_s": result.tau_s.tolist(),
        "channels": [_channel(channel) for channel in result.channels],
    }


def _channel(channel: ChannelNoise) -> dict[str, Any]:
    fit = channel.fit
    columns = zip(channel.units, fit.value.tolist(), fit.sigma.tolist(), fit.below.tolist(), strict=True)
    limits = zip(channel.units, channel.bounds, strict=True)
    return {
        "name": channel.name,
        "allan_deviation_si": channel.deviation.tolist(),
        "is_accepted": fit.is_accepted,
        "chi_square": fit.chi_square,
        "degrees_of_freedom": fit.degrees_of_freedom,
        "fitted_tau_s": [float(fit.tau_s[0]), float(fit.tau_s[-1])],
        "coefficients": {
            unit.key: {
                "value": None if isnan(value) else value / unit.si,
                "sigma": None if isnan(sigma) else sigma / unit.si,
                "below_95_percent": below / unit.si,
            }
            for unit, value, sigma, below in columns
            if fit.is_accepted
        },
        "upper_limits": {
            unit.key: {
                "value": bound.value / unit.si,
                "estimate": bound.estimate / unit.si,
                "tau_s": bound.tau_s,
            }
            for unit, bound in limits
        },
    }


def certificate(result: NoiseResult) -> Calibration:
    """Return the certificate of the unit with its noise.

    Parameters
    ----------
    result : NoiseResult
        Computed with the calibration of the unit.

    Returns
    -------
    Calibration
        Everything else is unchanged. A coefficient that is not observable on all three axes is absent.

    Raises
    ------
    InputError
        There is no calibration, or the verdict is bad.
    """
    if result.calibration is None:
        raise InputError("no certificate: expected the calibration of the unit (--calibration), got none")
    if result.is_bad:
        raise InputError(f"no certificate: {result.verdicts[0][1]}")
    gyros, accelerometers = result.channels[:3], result.channels[3:]
    noise = Noise(
        gyro=GyroNoise(**_of_sensor(gyros, GYRO)),
        accelerometer=AccelerometerNoise(**_of_sensor(accelerometers, ACCELEROMETER)),
    )
    calibration = result.calibration.calibration
    how = {
        "software": result.software,
        "captures": [{"name": capture.name, "sha256": capture.sha256} for capture in result.captures],
        "at_rest_s": result.at_rest_s,
        "longest_s": result.longest_s,
        "reduced_chi_square": [round(channel.fit.reduced_chi_square, 3) for channel in result.channels],
    }
    provenance = {**(calibration.provenance or {}), PROVENANCE_NOISE: how}
    return calibration.model_copy(
        update={"created": result.created, "noise": noise, "provenance": provenance, "signature": None}
    )


def _of_sensor(
    channels: tuple[ChannelNoise, ...], units: tuple[Coefficient, ...]
) -> dict[str, tuple[float, float, float]]:
    """Return the coefficients that all three axes of a sensor have, by their keys."""
    found = {}
    for k in range(len(KINDS)):
        x, y, z = (float(f"{channel.fit.value[k] / units[k].si:.{_DIGITS}g}") for channel in channels)
        if all(channel.fit.is_accepted for channel in channels) and not (isnan(x) or isnan(y) or isnan(z)):
            found[units[k].key] = x, y, z
    return found
