"""Certificate and JSON of a calibration of the sensors."""

import re
from importlib.metadata import version
from typing import Any, Final

import numpy as np

from calib.sensors.observability import is_optional
from calib.sensors.parameters import numbers
from calib.sensors.result import Estimate, SensorsResult
from calib.sensors.verdict import lacks_mandatory, worst_residuals
from imudrv.arrays import Array
from imudrv.calibration import PROVENANCE_SENSORS, Calibration
from imudrv.errors import InputError
from imudrv.files.settings_file import parse
from imudrv.units import ARCSEC, DEG_PER_H, DEG_PER_SQRT_H, UG

FORMAT: Final = "imu50-sensors"
VERSION: Final = 1

DIGITS: Final = 12
"""Significant digits of a number in the certificate."""
COVARIANCE_DIGITS: Final = 9


def certificate(result: SensorsResult) -> Calibration:
    """Return the certificate of the unit.

    Parameters
    ----------
    result : SensorsResult

    Returns
    -------
    Calibration
        With the numbers that are observable, and those of the start for the others; optional ones are left
        out where neither is.

    Raises
    ------
    InputError
        The verdict is bad, or a scale, a bias or an axis is neither observable nor in the start.
    """
    if refusal := why_none(result):
        raise InputError(f"no certificate: {refusal}")
    start = result.inputs.start
    document: dict[str, Any] = {
        "format": "imu50-calibration",
        "version": 1,
        "serial_number": result.inputs.serial_number,
        "created": result.created,
    }
    kept = _kept(result)
    values = {one.path: one.value for one in result.estimates if one.path in kept}
    for one in numbers(result.start, result.inputs.nominal):  # what was not estimated stays
        if (
            one.path not in values
            and (start is not None or not is_optional(one.path))
            and _in_start(one.path, start)
        ):
            values[one.path] = one.value
    for path, value in values.items():
        _put(document, path, _rounded(value, DIGITS))
    document["gyro"]["frame"] = result.inputs.frame
    if "size_effect" in document:
        arms = document["size_effect"]
        arms["gauge"] = _gauge(result)
        _centre(arms)
        if set(_paths("size_effect.r_mm", "xyz")) <= kept:
            arms["covariance_mm2"] = _arms_covariance(result).tolist()
    if "temperature" in document:
        document["temperature"] = _temperature(result, document["temperature"])
    if start is not None and start.noise is not None:
        document["noise"] = start.noise.model_dump(mode="python")
    provenance = dict(start.provenance or {}) if start is not None else {}
    provenance.pop("inner_lever_arms", None)
    provenance[PROVENANCE_SENSORS] = provenance_document(result, kept)
    document["provenance"] = provenance
    return parse(_plain(document), Calibration, "the new certificate")


def why_none(result: SensorsResult) -> str:
    """Return why there is no certificate; empty if there is one."""
    if result.mark == "bad" or result.adjustment is None:
        return next(one.text for one in result.verdict if one.mark == "bad")
    lacking = lacks_mandatory(result.estimates)
    if lacking and result.inputs.start is None:
        return f"not observable and not given with --start: {', '.join(lacking)}"
    return ""


def _kept(result: SensorsResult) -> set[str]:
    """Return the paths whose estimate enters the certificate: a vector of arms whole or not at all."""
    kept = {one.path for one in result.estimates if one.observable}
    arms = {one.path for one in result.estimates if one.path.startswith("size_effect")}
    if not arms <= kept:
        kept -= arms
    for key in ("accelerometer.quadratic", "accelerometer.asymmetry"):
        vector = {one.path for one in result.estimates if one.path.startswith(key)}
        if not vector <= kept and result.inputs.start is None:
            kept -= vector
    slopes = {one.path for one in result.estimates if one.path.startswith("temperature")}
    if slopes & kept:  # the others are written as what they are taken for
        return kept
    return kept - slopes


def _in_start(path: str, start: Calibration | None) -> bool:
    """Return whether the start has a number; of a mandatory one the nominal value does as well."""
    if not is_optional(path):
        return True
    if start is None:
        return False
    if path.startswith("size_effect"):
        return start.size_effect is not None
    if path.startswith("skew"):
        return start.skew_ms is not None
    if path.startswith("temperature"):
        return start.temperature is not None
    if path.startswith("accelerometer.quadratic"):
        return start.accelerometer.quadratic_ug_per_g2 is not None
    return start.accelerometer.asymmetry_ppm is not None


def _put(document: dict[str, Any], path: str, value: float) -> None:
    """Set a number by its path, such as gyro.C_bg[1][0]; a vector grows from its first number on."""
    keys = [int(key) if key.isdigit() else key for key in re.findall(r"[A-Za-z_0-9]+", path)]
    place: Any = document
    for key, following in zip(keys, [*keys[1:], None], strict=True):
        new: Any = value if following is None else [] if isinstance(following, int) else {}
        if isinstance(key, int):
            while len(place) <= key:
                place.append([] if isinstance(following, int) else 0.0)
            if following is None:
                place[key] = value
        elif following is None:
            place[key] = value
        else:
            place.setdefault(key, new)
        if following is not None:
            place = place[key]


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits - 1}e}") + 0.0


def _paths(key: str, axes: str) -> list[str]:
    return [f"{key}.{axis}[{k}]" for axis in axes for k in range(3)]


def _gauge(result: SensorsResult) -> str:
    if result.inputs.free.fixed_pivot:
        return "given"
    start = result.inputs.start
    if (
        start is not None
        and start.size_effect is not None
        and not set(_paths("size_effect.r_mm", "xyz")) <= _kept(result)
    ):
        return start.size_effect.gauge
    return "centroid"


def _centre(arms: dict[str, Any]) -> None:
    """Round the arms to a nanometre, their centroid exactly there where it is the gauge."""
    for axis in "xyz":
        arms["r_mm"][axis] = [round(value, 6) + 0.0 for value in arms["r_mm"][axis]]
    if arms["gauge"] == "centroid":
        x, y = np.array(arms["r_mm"]["x"]), np.array(arms["r_mm"]["y"])
        arms["r_mm"]["z"] = [round(value, 6) + 0.0 for value in (-x - y).tolist()]


def _arms_covariance(result: SensorsResult) -> Array:
    rows = [k for k, one in enumerate(result.estimates) if one.path.startswith("size_effect")]
    C = result.covariance[np.ix_(rows, rows)]
    rounded: Array = np.round(0.5 * (C + C.T), 9) + 0.0
    return rounded


def _temperature(result: SensorsResult, slopes: dict[str, Any]) -> dict[str, Any]:
    degc = np.array([rest.degc for rest in result.evidence.rests])
    start = result.inputs.start
    whole = {
        key: slopes.get(key, [0.0, 0.0, 0.0])
        for key in (
            "gyro_bias_deg_per_h_per_k",
            "gyro_scale_ppm_per_k",
            "accelerometer_bias_ug_per_k",
            "accelerometer_scale_ppm_per_k",
        )
    }
    for values in whole.values():
        values += [0.0] * (3 - len(values))
    if not result.inputs.free.temperature and start is not None and start.temperature is not None:
        return {
            "reference_degc": start.temperature.reference_degc,
            "range_degc": list(start.temperature.range_degc),
            **whole,
        }
    low, high = float(np.nanmin(degc)), float(np.nanmax(degc))
    return {
        "reference_degc": result.reference_degc,
        "range_degc": [round(low, 2), round(high, 2)],
        **whole,
    }


def provenance_document(result: SensorsResult, kept: set[str]) -> dict[str, Any]:
    """Return how the sensors were calibrated, as `imudrv.sensor_calibration.SensorsProvenance`."""
    adjustment = result.adjustment
    if adjustment is None:
        return {}
    gyro, accelerometer, *_ = adjustment.wander
    site = result.inputs.site
    document = {
        "software": software(),
        "captures": [{"name": one.name, "sha256": one.sha256} for one in result.inputs.captures],
        "procedure": result.inputs.procedure or None,
        "rests": [
            {
                "pose": pose,
                "start_s": round(rest.start_s, 3),
                "duration_s": round(rest.duration_s, 3),
                "temperature_degc": round(float(rest.degc[0]), 2) if np.isfinite(rest.degc[0]) else None,
            }
            for pose, rest in zip(result.poses, result.evidence.rests, strict=True)
        ],
        "chi_square": round(adjustment.chi_square, 3),
        "degrees_of_freedom": max(0, adjustment.degrees_of_freedom),
        "wander": {
            "gyro_deg_per_h": round(gyro / DEG_PER_H, 6),
            "accelerometer_ug": round(accelerometer / UG, 4),
        },
        "gravity": {
            "m_s2": site.gravity,
            "source": "normal" if site.gravity_m_s2 is None else "measured",
            "sigma_m_s2": result.gravity_sigma,
        },
        "not_observable": list(result.not_observable),
        "covariance": _covariance(result, kept),
    }
    return {key: value for key, value in document.items() if value is not None}


def software() -> str:
    """Return name and version of the software."""
    return f"imu50 {version('imu50')}"


def _covariance(result: SensorsResult, kept: set[str]) -> dict[str, Any]:
    """Return the covariance of the numbers that are written."""
    rows = [k for k, one in enumerate(result.estimates) if one.path in kept]
    C = result.covariance[np.ix_(rows, rows)]
    return {
        "names": [result.estimates[k].path for k in rows],
        "lower_triangle": [
            [_rounded(float(value), COVARIANCE_DIGITS) for value in C[k, : k + 1]] for k in range(len(rows))
        ],
    }


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items() if one is not None}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return value


def result_document(result: SensorsResult) -> dict[str, Any]:
    """Return the whole result as plain data, with units in the names.

    Parameters
    ----------
    result : SensorsResult

    Returns
    -------
    dict
        For JSON.
    """
    adjustment = result.adjustment
    evidence = result.evidence
    kept = _kept(result) if adjustment is not None else set()
    document: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "created": result.created.isoformat().replace("+00:00", "Z"),
        "serial_number": result.inputs.serial_number,
        "verdict": [{"mark": one.mark, "text": one.text} for one in result.verdict],
        "certificate": not why_none(result),
        "frame": result.inputs.frame,
        "parameters": [_estimate(one) for one in result.estimates] if adjustment is not None else [],
        "missing": list(result.missing),
        "left_out": [
            {
                "capture": result.inputs.captures[evidence.captures[one.session]].name,
                "what": one.what,
                "start_s": round(one.start_s, 3),
                "stop_s": round(one.stop_s, 3),
                "reason": one.reason,
            }
            for one in evidence.left
        ],
        "noise": {
            "gyro_deg_per_sqrt_h": evidence.noise.angle_walk / DEG_PER_SQRT_H,
            "accelerometer_ug_per_sqrt_hz": evidence.noise.velocity_walk / UG,
        },
    }
    if adjustment is None:
        return document
    sigmas = worst_residuals(adjustment)
    document["sensors"] = provenance_document(result, kept)
    document["iterations"] = adjustment.iterations
    document["blocks"] = [
        {
            "what": "motion" if block.is_motion else "rest",
            "number": block.number,
            "residual_si": adjustment.residual[block.rows].tolist(),
            "sigmas": worst,
        }
        for block, worst in zip(adjustment.system.blocks, sigmas, strict=True)
    ]
    document["leave_one_out"] = list(result.leave_one_out)
    if result.faces is not None:
        faces = result.faces
        document["faces"] = {
            "theta_arcsec": (faces.theta / ARCSEC).tolist(),
            "plate_tilt_arcsec": (faces.tilt_n / ARCSEC).tolist(),
            "squareness_arcsec": {name: (d / ARCSEC).tolist() for name, d in faces.squareness.items()},
            "repeatability_arcsec": faces.repeatability / ARCSEC,
        }
    return document


def _estimate(one: Estimate) -> dict[str, Any]:
    return {
        "path": one.path,
        "value": one.value,
        "u": one.sigma,
        "observable": one.observable,
        "start": one.start,
    }
