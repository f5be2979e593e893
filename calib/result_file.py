"""JSON document of an identification."""

import json
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from calib.detection.turns import Turn
from calib.estimation.priors import Priors
from calib.estimation.result import ChiSquare, LeverArmEstimate
from calib.estimation.runs import Run
from calib.identification import CaptureSummary, IdentificationResult, scatter
from calib.lever_arms.gauge import LeverArms
from calib.messages import english
from imudrv.arrays import Array
from imudrv.files.atomic import atomic_write
from imudrv.units import ARCSEC, DEG, DEG_PER_H, MM, PPM, STANDARD_GRAVITY, UG, URAD

FORMAT: Final = "imu50-identification"


VERSION: Final = 1


def result_document(identification: IdentificationResult, arms: LeverArms) -> dict[str, Any]:
    """Return the whole result as plain data, with units in the names.

    Parameters
    ----------
    identification : IdentificationResult
        The result.
    arms : LeverArms
        The lever arms in the desired gauge.

    Returns
    -------
    dict
        For JSON.
    """
    result = identification.result
    return {
        "format": FORMAT,
        "version": VERSION,
        "created": _time(identification.created),
        "software": identification.software,
        "serial_number": identification.prior_calibration.calibration.serial_number,
        "method": result.method,
        **inputs_document(identification),
        "gauge": arms.gauge,
        "r_mm": _by_axis(arms.r_b / MM),
        "covariance_mm2": None if arms.covariance is None else (arms.covariance / MM**2).tolist(),
        **outcome_document(result),
        "differences_covariance_mm2": (result.differences_covariance / MM**2).tolist(),
        "reason": english(result.reason),
        "notes": [*map(english, result.notes)],
        "noise": {
            "angle_walk_rad_per_sqrt_s": result.noise.angle_walk,
            "velocity_walk_m_s_per_sqrt_s": result.noise.velocity_walk,
            "degrees_of_freedom": result.noise.degrees_of_freedom,
        },
        "parameters_si": [
            {
                "name": n.name,
                "value": n.value,
                "sigma": n.sigma,
                "prior_sigma": n.prior,
                "observable": n.observable,
            }
            for n in result.parameters
        ],
        "correlation_of_r_with_parameters": result.correlation.tolist(),
        "correlation_of_differences_with_parameters": identification.differences_correlation.tolist(),
        "leave_one_out": [
            {
                "run": one.label,
                "rank": one.rank,
                "shift_mm": None if one.shift_m is None else (one.shift_m / MM).tolist(),
                "shift_sigma_mm": None if one.sigma_m is None else (one.sigma_m / MM).tolist(),
                "test": None if one.test is None else _test(one.test),
            }
            for one in result.leave_one_out
        ],
        "runs": [
            {
                **_profile(run),
                "turns": [
                    {
                        **_turn(turn),
                        "turn": gained.label,
                        "V_n_m_s": gained.V_n.tolist(),
                        "H_n_m_s_per_m": gained.H.tolist(),
                        "V_n_minus_H_R_m_s": gained.compensated_n.tolist(),
                    }
                    for turn, gained in zip(run.turns, outcome.turns, strict=True)
                ],
                "H_rest_m_s_per_m": outcome.H_rest,
                "rate_filter": outcome.rate_filter,
                "dither": [
                    {
                        "axis": line.axis,
                        "frequency_hz": line.frequency_hz,
                        "amplitude_arcsec": line.amplitude_rad / ARCSEC,
                    }
                    for line in outcome.lines
                ],
                "t_s": outcome.t_s.tolist(),
                "v_n_m_s": outcome.v_n.tolist(),
                "fitted_n_m_s": outcome.fitted_n.tolist(),
            }
            for run, outcome in zip(identification.runs, result.runs, strict=True)
        ],
    }


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write plain data as JSON, atomically.

    Parameters
    ----------
    path : Path
        The file.
    document : dict
        From `result_document`.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    with atomic_write(path) as file:
        file.write(json.dumps(document, indent=1, allow_nan=False).encode() + b"\n")


def inputs_document(identification: IdentificationResult) -> dict[str, Any]:
    """Return the inputs of an identification."""
    calibration = identification.prior_calibration
    return {
        "calibration": {"name": calibration.name, "sha256": calibration.sha256},
        "site": identification.site.model_dump(exclude={"format", "version"}, exclude_none=True),
        "captures": [_capture(source) for source in identification.sources],
        "limits": asdict(identification.limits),
        "priors": _priors(identification.priors),
    }


def _test(test: ChiSquare) -> dict[str, Any]:
    """Return a chi-square test; without degrees of freedom there was nothing to test."""
    return {
        "chi_square": test.value,
        "degrees_of_freedom": test.degrees_of_freedom,
        "band_95": list(test.band),
        "p_value": test.p_value,
    }


def _capture(source: CaptureSummary) -> dict[str, Any]:
    rotations = source.rotations
    return {
        "name": source.name,
        "sha256": source.sha256,
        "profile": source.profile,
        **({} if source.channel is None else {"channel": source.channel}),
        "duration_s": rotations.segments.duration_s,
        "samples": str(source.counts),
        "temperature_degc": {t.channel: [t.least_degc, t.most_degc] for t in source.temperatures},
        "runs": [run.label for run in rotations.runs],
        "restarts_s": list(rotations.restarts_s),
        "rejected": [
            {
                "start_s": rotation.start_s,
                "stop_s": rotation.stop_s,
                "reasons": [*map(english, reasons)],
                "messages": [*map(asdict, reasons)],
            }
            for rotation, reasons in rotations.rejected
        ],
    }


def _priors(priors: Priors) -> dict[str, Any]:
    return {
        "from_certificate": priors.covariance is not None,
        "accelerometer_bias_ug": priors.accelerometer_bias / UG,
        "accelerometer_scale_ppm": priors.accelerometer_scale / PPM,
        "accelerometer_misalignment_urad": priors.accelerometer_misalignment / URAD,
        "gyro_bias_deg_per_h": priors.gyro_bias / DEG_PER_H,
        "gyro_scale_ppm": priors.gyro_scale / PPM,
        "gyro_misalignment_urad": priors.gyro_misalignment / URAD,
        "accelerometer_bias_of_run_ug": priors.accelerometer_bias_of_run / UG,
        "gyro_bias_of_run_deg_per_h": priors.gyro_bias_of_run / DEG_PER_H,
        "skew_s": priors.skew,
        "expected_skew_s": priors.expected_skew,
        "quadratic_ug_per_g2": priors.quadratic * STANDARD_GRAVITY**2 / UG,
        "arm_mm": priors.arm / MM,
    }


def outcome_document(result: LeverArmEstimate) -> dict[str, Any]:
    """Return the key figures of a result."""
    names = ("x_minus_y", "x_minus_z")
    return {
        "differences_mm": dict(zip(names, (result.differences / MM).tolist(), strict=True)),
        "differences_sigma_mm": dict(zip(names, (result.differences_sigma / MM).tolist(), strict=True)),
        "rank": result.rank,
        "direction_sigma_mm": (result.direction_sigma / MM).tolist(),
        "singular_values_m_s_per_m": result.singular_values.tolist(),
        "scatter": None if result.scatter is None else _test(result.scatter),
        "redundancy": _test(result.redundancy),
        "dither_error_sigma": result.dither_error,
        "residual_scatter_mm_s": {run.label: scatter(run) / MM for run in result.runs},
    }


def _profile(run: Run) -> dict[str, Any]:
    """Return the properties of a run."""
    aligned, before = run.aligned, run.turns[0].before
    return {
        "run": run.label,
        "up": run.turns[0].axis,
        "rest_before_s": before.duration_s,
        "alignment": {
            "duration_s": aligned.duration_s,
            "heading_deg": aligned.heading_rad / DEG,
            "heading_sigma_deg": aligned.heading_sigma_rad / DEG,
            "level_sigma_arcsec": aligned.level_sigma_rad / ARCSEC,
            "motion": None if aligned.motion is None else str(aligned.motion),
        },
    }


def _turn(turn: Turn) -> dict[str, Any]:
    """Return the properties of a turn."""
    return {
        "accepted": turn.accepted,
        "reasons": [*map(english, turn.reasons)],
        "messages": [*map(asdict, turn.reasons)],
        "start_s": turn.start_s,
        "stop_s": turn.stop_s,
        "angle_deg": turn.angle_deg,
        "peak_deg_per_s": turn.peak_deg_per_s,
        "axis_tilt_deg": turn.axis_tilt_deg,
        "missing_samples": turn.missing,
        "rest_after_s": turn.after.duration_s,
    }


def _by_axis(rows: Array) -> dict[str, Any]:
    return dict(zip("xyz", rows.tolist(), strict=True))


def _time(time: datetime) -> str:
    return time.isoformat().replace("+00:00", "Z")
