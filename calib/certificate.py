"""Findings as files: the unit's new certificate, and the whole result for programs."""

import json
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.findings import Findings, Source, scatter
from calib.gauge import Arms
from calib.identify import Identification
from calib.runs import Priors, Run
from imudrv.calibration import Calibration, SensingPoints, SizeEffect, read_calibration, write_calibration
from imudrv.errors import FaultyFileError, InputError
from imudrv.sinks.files import replacing
from imudrv.units import ARCSEC, DEG, DEG_PER_H, MM, PPM, STANDARD_GRAVITY, UG, URAD

Array = NDArray[np.float64]

FORMAT: Final = "imu50-identification"
VERSION: Final = 1
FOUND: Final = "inner_lever_arms"
"""Where the provenance says how they were found."""
CHANGED: Final = "inner_lever_arms_gauge"
"""Where it says from which file their gauge was converted."""

_R_DECIMALS: Final = 6
"""Of the sensing points in the certificate, mm: a nanometre."""
_COVARIANCE_DECIMALS: Final = 9
"""Of their covariance, mm^2."""


def certificate(findings: Findings, arms: Arms) -> Calibration:
    """Make the unit's new certificate: its calibration, with the arms and how they were found.

    Parameters
    ----------
    findings : Findings
        What was found.
    arms : Arms
        The lever arms in the gauge that is wanted.

    Returns
    -------
    Calibration
        All else is as it was; so is the rest of its provenance.

    Raises
    ------
    InputError
        The result is one that nothing may be certified on, see `Identification.refusals`.
    """
    result = findings.result
    if result.refusals:
        raise InputError(f"no certificate: {'; '.join(result.refusals)}")
    found = {"method": result.method, **_made_of(findings), **_outcome(result)}
    return with_arms(findings.basis.calibration, arms, FOUND, found, findings.created)


def with_arms(
    calibration: Calibration, arms: Arms, key: str, how: dict[str, Any], when: datetime | None = None
) -> Calibration:
    """Put lever arms into a calibration.

    Parameters
    ----------
    calibration : Calibration
        Of the unit.
    arms : Arms
        Kept to a nanometre.
    key : {FOUND, CHANGED}
        Under which the provenance says how.
    how : dict
        What it says.
    when : datetime, optional
        Date of the new calibration; now, if absent.

    Returns
    -------
    Calibration
    """
    provenance = dict(calibration.provenance or {})
    if key == FOUND:
        provenance.pop(CHANGED, None)
    provenance[key] = {"software": software(), **how}
    covariance = None if arms.covariance is None else arms.covariance / MM**2
    rows = np.round(arms.r_b / MM, _R_DECIMALS) + 0.0  # no -0
    size_effect = SizeEffect(
        r_mm=SensingPoints(**{axis: _row(r) for axis, r in zip("xyz", rows, strict=True)}),
        gauge=arms.gauge,
        covariance_mm2=None
        if covariance is None
        else tuple(_row(r) for r in np.round(covariance, _COVARIANCE_DECIMALS) + 0.0),
    )
    return calibration.model_copy(
        update={
            "created": when or datetime.now(UTC).replace(microsecond=0),
            "size_effect": size_effect,
            "provenance": provenance,
        }
    )


def arms_of(calibration: Calibration, name: str) -> Arms:
    """Take the lever arms out of a calibration.

    Parameters
    ----------
    calibration : Calibration
        Of the unit.
    name : str
        What messages call it.

    Returns
    -------
    Arms

    Raises
    ------
    InputError
        It has none.
    """
    effect = calibration.size_effect
    if effect is None:
        raise InputError(
            f"{name}: expected a calibration with size_effect, got one without; identify them first"
        )
    return Arms(effect.r_m, effect.covariance_m2, effect.gauge)


def check_target(path: Path, calibration: Calibration) -> None:
    """Make sure that a certificate may be written to a file.

    Parameters
    ----------
    path : Path
        Where.
    calibration : Calibration
        Of the unit.

    Raises
    ------
    InputError
        There is the certificate of another unit, or another kind of file.
    """
    if not path.exists():
        return
    wanted = f"{path}: expected the certificate of unit {calibration.serial_number!r}, or no file yet"
    try:
        serial_number = read_calibration(path).serial_number
    except FaultyFileError:
        raise InputError(f"{wanted}, got a file that is no certificate; choose another name") from None
    if serial_number != calibration.serial_number:
        raise InputError(f"{wanted}, got that of {serial_number!r}; choose another name")


def write(path: Path, calibration: Calibration) -> None:
    """Write a certificate; the one that was there is kept under its date.

    Parameters
    ----------
    path : Path
        Where.
    calibration : Calibration
        Of the unit.

    Raises
    ------
    InputError
        See `check_target`; or it cannot be written.
    """
    check_target(path, calibration)
    write_calibration(path, calibration)


def software() -> str:
    """Name and version of what computes."""
    return f"imu50 {version('imu50')}"


def result_document(findings: Findings, arms: Arms) -> dict[str, Any]:
    """Put the whole result into plain data, units in the names.

    Parameters
    ----------
    findings : Findings
        What was found.
    arms : Arms
        The lever arms in the gauge that is wanted.

    Returns
    -------
    dict
        For JSON.
    """
    result = findings.result
    return {
        "format": FORMAT,
        "version": VERSION,
        "created": _time(findings.created),
        "software": findings.software,
        "serial_number": findings.basis.calibration.serial_number,
        "method": result.method,
        **_made_of(findings),
        "gauge": arms.gauge,
        "r_mm": _by_axis(arms.r_b / MM),
        "covariance_mm2": None if arms.covariance is None else (arms.covariance / MM**2).tolist(),
        **_outcome(result),
        "differences_covariance_mm2": (result.differences_covariance / MM**2).tolist(),
        "reason": result.reason,
        "notes": list(result.notes),
        "noise": {
            "angle_walk_rad_per_sqrt_s": result.noise.angle_walk,
            "velocity_walk_m_s_per_sqrt_s": result.noise.velocity_walk,
            "velocity_white_m_s": result.noise.velocity_white,
            "velocity_pulse_m_s": result.noise.velocity_pulse,
        },
        "nuisances_si": [
            {"name": n.name, "value": n.value, "sigma": n.sigma, "prior_sigma": n.prior, "seen": n.seen}
            for n in result.nuisances
        ],
        "correlation_of_r_with_nuisances": result.correlation.tolist(),
        "correlation_of_differences_with_nuisances": findings.differences_correlation.tolist(),
        "left_out": [
            {
                "run": one.label,
                "rank": one.rank,
                "shift_mm": None if one.shift_m is None else (one.shift_m / MM).tolist(),
            }
            for one in result.left_out
        ],
        "runs": [
            {
                **_profile(run),
                "V_n_m_s": told.V_n.tolist(),
                "H_n_m_s_per_m": told.H.tolist(),
                "V_n_minus_H_R_m_s": told.compensated_n.tolist(),
                "H_rest_m_s_per_m": told.H_rest,
                "t_s": told.t_s.tolist(),
                "v_n_m_s": told.v_n.tolist(),
                "fitted_n_m_s": told.fitted_n.tolist(),
            }
            for run, told in zip(findings.runs, result.runs, strict=True)
        ],
    }


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write plain data as JSON; the file appears whole.

    Parameters
    ----------
    path : Path
        Where.
    document : dict
        What `result_document` gives.

    Raises
    ------
    InputError
        It cannot be written.
    """
    with replacing(path) as file:
        file.write(json.dumps(document, indent=1, allow_nan=False).encode() + b"\n")


def _made_of(findings: Findings) -> dict[str, Any]:
    """What the findings rest on."""
    basis = findings.basis
    return {
        "calibration": {"name": basis.name, "sha256": basis.sha256},
        "site": findings.site.model_dump(exclude={"format", "version"}, exclude_none=True),
        "captures": [_capture(source) for source in findings.sources],
        "limits": asdict(findings.limits),
        "priors": _priors(findings.priors),
    }


def _capture(source: Source) -> dict[str, Any]:
    evidence = source.evidence
    return {
        "name": source.name,
        "sha256": source.sha256,
        "profile": source.profile,
        **({} if source.channel is None else {"channel": source.channel}),
        "duration_s": evidence.segments.duration_s,
        "samples": source.books,
        "temperature_degc": {t.channel: [t.least_degc, t.most_degc] for t in source.temperatures},
        "runs": [run.label for run in evidence.runs],
        "rejected": [
            {"start_s": rotation.start_s, "stop_s": rotation.stop_s, "reasons": list(reasons)}
            for rotation, reasons in evidence.rejected
        ],
    }


def _priors(priors: Priors) -> dict[str, float]:
    return {
        "accelerometer_bias_ug": priors.accelerometer_bias / UG,
        "accelerometer_scale_ppm": priors.accelerometer_scale / PPM,
        "accelerometer_misalignment_urad": priors.accelerometer_misalignment / URAD,
        "gyro_bias_deg_per_h": priors.gyro_bias / DEG_PER_H,
        "gyro_scale_ppm": priors.gyro_scale / PPM,
        "gyro_misalignment_urad": priors.gyro_misalignment / URAD,
        "skew_s": priors.skew,
        "quadratic_ug_per_g2": priors.quadratic * STANDARD_GRAVITY**2 / UG,
        "arm_mm": priors.arm / MM,
    }


def _outcome(result: Identification) -> dict[str, Any]:
    """The figures that a reader of the certificate asks for first."""
    names = ("x_minus_y", "x_minus_z")
    return {
        "differences_mm": dict(zip(names, (result.differences / MM).tolist(), strict=True)),
        "differences_sigma_mm": dict(zip(names, (result.differences_sigma / MM).tolist(), strict=True)),
        "rank": result.rank,
        "direction_sigma_mm": (result.direction_sigma / MM).tolist(),
        "singular_values_m_s_per_m": result.singular_values.tolist(),
        "chi_square": result.chi_square,
        "degrees_of_freedom": result.degrees_of_freedom,
        "residual_scatter_mm_s": {run.label: scatter(run) / MM for run in result.runs},
    }


def _profile(run: Run) -> dict[str, Any]:
    """How a rotation went."""
    rotation, aligned = run.rotation, run.aligned
    return {
        "run": run.label,
        "up": rotation.axis,
        "start_s": rotation.start_s,
        "stop_s": rotation.stop_s,
        "angle_deg": rotation.angle_deg,
        "peak_deg_per_s": rotation.peak_deg_per_s,
        "axis_tilt_deg": rotation.axis_tilt_deg,
        "missing_samples": rotation.missing,
        "rest_before_s": None if rotation.before is None else rotation.before.duration_s,
        "rest_after_s": None if rotation.after is None else rotation.after.duration_s,
        "alignment": {
            "duration_s": aligned.duration_s,
            "heading_deg": aligned.heading_rad / DEG,
            "heading_sigma_deg": aligned.heading_sigma_rad / DEG,
            "level_sigma_arcsec": aligned.level_sigma_rad / ARCSEC,
            "motion": aligned.motion,
        },
    }


def _by_axis(rows: Array) -> dict[str, Any]:
    return dict(zip("xyz", rows.tolist(), strict=True))


def _row(values: Array) -> Any:
    """A row as the models of files have it."""
    return tuple(values.tolist())


def _time(time: datetime) -> str:
    return time.isoformat().replace("+00:00", "Z")
