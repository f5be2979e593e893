"""The calibration file of a unit with its lever arms."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from calib.identification import IdentificationResult, software
from calib.lever_arms.gauge import LeverArms
from calib.result_file import inputs_document, outcome_document
from calib.signing import certificates
from calib.signing.keys import BenchKey
from imudrv.arrays import Array
from imudrv.calibration import Calibration, SensingPoints, SizeEffect, read_calibration
from imudrv.errors import FaultyFileError, InputError
from imudrv.files import settings_file
from imudrv.units import MM

PROVENANCE_IDENTIFIED: Final = "inner_lever_arms"
"""Key in the provenance: how the lever arms were identified."""


PROVENANCE_CONVERTED: Final = "inner_lever_arms_gauge"
"""Key in the provenance: from which file their gauge was converted."""


_R_DECIMALS: Final = 6
"""Decimals of the sensing points in the certificate, mm: a nanometre."""


_COVARIANCE_DECIMALS: Final = 9
"""Decimals of their covariance, mm^2."""


def certificate(identification: IdentificationResult, arms: LeverArms) -> Calibration:
    """Return the new certificate of the unit: its calibration with the lever arms and their provenance.

    Parameters
    ----------
    identification : IdentificationResult
        The result.
    arms : LeverArms
        The lever arms in the desired gauge.

    Returns
    -------
    Calibration
        Everything else is unchanged, including the rest of its provenance.

    Raises
    ------
    InputError
        The result does not allow a certificate, see `LeverArmEstimate.refusals`.
    """
    result = identification.result
    if result.refusals:
        raise InputError(f"no certificate: {'; '.join(result.refusals)}")
    found = {"method": result.method, **inputs_document(identification), **outcome_document(result)}
    return with_lever_arms(
        identification.prior_calibration.calibration,
        arms,
        PROVENANCE_IDENTIFIED,
        found,
        identification.created,
    )


def with_lever_arms(
    calibration: Calibration, arms: LeverArms, key: str, how: dict[str, Any], when: datetime | None = None
) -> Calibration:
    """Return a calibration with lever arms.

    Parameters
    ----------
    calibration : Calibration
        Calibration of the unit.
    arms : LeverArms
        Rounded to a nanometre.
    key : {PROVENANCE_IDENTIFIED, PROVENANCE_CONVERTED}
        Key of the entry in the provenance.
    how : dict
        The entry.
    when : datetime, optional
        Date of the new calibration; default: now.

    Returns
    -------
    Calibration
    """
    provenance = dict(calibration.provenance or {})
    if key == PROVENANCE_IDENTIFIED:
        provenance.pop(PROVENANCE_CONVERTED, None)
    provenance[key] = {"software": software(), **how}
    covariance: Any = None
    if arms.covariance is not None:
        rounded = np.round(arms.covariance / MM**2, _COVARIANCE_DECIMALS) + 0.0  # no -0
        covariance = tuple(map(tuple, rounded.tolist()))
    r_mm = np.round(arms.r_b / MM, _R_DECIMALS) + 0.0
    size_effect = SizeEffect(r_mm=sensing_points(r_mm), gauge=arms.gauge, covariance_mm2=covariance)
    return calibration.model_copy(
        update={
            "created": when or datetime.now(UTC).replace(microsecond=0),
            "size_effect": size_effect,
            "provenance": provenance,
        }
    )


def lever_arms_of(calibration: Calibration, name: str) -> LeverArms:
    """Return the lever arms of a calibration.

    Parameters
    ----------
    calibration : Calibration
        Calibration of the unit.
    name : str
        Name of the calibration in messages.

    Returns
    -------
    LeverArms

    Raises
    ------
    InputError
        The calibration has no lever arms.
    """
    effect = calibration.size_effect
    if effect is None:
        raise InputError(
            f"{name}: expected a calibration with size_effect, got one without; identify them first"
        )
    return LeverArms(effect.r_m, effect.covariance_m2, effect.gauge)


def check_target(path: Path, calibration: Calibration) -> None:
    """Check that a certificate may be written to a file.

    Parameters
    ----------
    path : Path
        The file.
    calibration : Calibration
        Calibration of the unit.

    Raises
    ------
    InputError
        The file is the certificate of another unit, or of another kind.
    """
    check_unit_file(path, calibration.serial_number)


def check_unit_file(path: Path, unit: str) -> None:
    """Check that the certificate of a unit may be written to a file, see `check_target`."""
    if not path.exists():
        return
    wanted = f"{path}: expected the certificate of unit {unit!r}, or no file yet"
    try:
        serial_number = read_calibration(path).serial_number
    except FaultyFileError:
        raise InputError(f"{wanted}, got a file that is no certificate; choose another name") from None
    if serial_number != unit:
        raise InputError(f"{wanted}, got that of {serial_number!r}; choose another name")


def write(path: Path, calibration: Calibration, key: BenchKey | None) -> None:
    """Write a certificate; an existing one is kept under its date.

    Parameters
    ----------
    path : Path
        The file.
    calibration : Calibration
        Calibration of the unit.
    key : BenchKey or None
        The key of the bench, which signs it; None: unsigned.

    Raises
    ------
    InputError
        See `check_target`; or the file cannot be written.
    """
    check_target(path, calibration)
    settings_file.replace(path, certificates.content(calibration, key))


def sensing_points(r_mm: Array) -> SensingPoints:
    """Return sensing points, rows of a matrix in mm, as the calibration file has them."""
    x, y, z = map(tuple, r_mm.tolist())
    return SensingPoints(x=x, y=y, z=z)
