"""Findings as files: the unit's new certificate, and the whole result for programs."""

from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np

from calib.identification import IdentificationResult
from calib.lever_arms.gauge import LeverArms
from calib.result_file import inputs_document, outcome_document
from imudrv.arrays import Array
from imudrv.calibration import Calibration, SensingPoints, SizeEffect, read_calibration, write_calibration
from imudrv.errors import FaultyFileError, InputError
from imudrv.units import MM

PROVENANCE_IDENTIFIED: Final = "inner_lever_arms"
"""Where the provenance says how they were found."""


PROVENANCE_CONVERTED: Final = "inner_lever_arms_gauge"
"""Where it says from which file their gauge was converted."""


_R_DECIMALS: Final = 6
"""Of the sensing points in the certificate, mm: a nanometre."""


_COVARIANCE_DECIMALS: Final = 9
"""Of their covariance, mm^2."""


def certificate(findings: IdentificationResult, arms: LeverArms) -> Calibration:
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
        The result is one that nothing may be certified on, see `LeverArmEstimate.refusals`.
    """
    result = findings.result
    if result.refusals:
        raise InputError(f"no certificate: {'; '.join(result.refusals)}")
    found = {"method": result.method, **inputs_document(findings), **outcome_document(result)}
    return with_lever_arms(findings.basis.calibration, arms, PROVENANCE_IDENTIFIED, found, findings.created)


def with_lever_arms(
    calibration: Calibration, arms: LeverArms, key: str, how: dict[str, Any], when: datetime | None = None
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
    if key == PROVENANCE_IDENTIFIED:
        provenance.pop(PROVENANCE_CONVERTED, None)
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


def lever_arms_of(calibration: Calibration, name: str) -> LeverArms:
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
    return LeverArms(effect.r_m, effect.covariance_m2, effect.gauge)


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


def _row(values: Array) -> Any:
    """A row as the models of files have it."""
    return tuple(values.tolist())
