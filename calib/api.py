"""Functions for a notebook: paths or objects in, results out; see also `calib.identification.identify`."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from calib.certificate import lever_arms_of
from calib.estimation.predict import PlannedRotation, Prediction
from calib.estimation.predict import predict as predict_plan
from calib.inputs import StrPath, profile_of, require_six_axes, site_of
from calib.procedure import plan
from calib.procedure.schema import Procedure
from calib.validation.navigate import navigate
from calib.validation.trial import RATE_FILTER, TrialSettings
from calib.validation.verdict import Validation, evaluate
from imudrv.calibration import Calibration, read_calibration
from imudrv.capture import Capture
from imudrv.imu.rate_filter import RateFilterName
from imudrv.nav.alignment import ALIGNMENT_S
from imudrv.profiles.schema import Profile
from imudrv.site import Site


def validate(
    capture: StrPath,
    *,
    calibration: StrPath | Calibration,
    site: StrPath | Site,
    profile: StrPath | Profile | None = None,
    align_s: float = ALIGNMENT_S,
    rate_filter: RateFilterName = RATE_FILTER,
    skew_s: float = 0.0,
    channel: str | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> Validation:
    """Navigate a capture with and without size-effect compensation and compare.

    Parameters
    ----------
    capture : path-like
        Wire bytes, candump log or recording: a rest, a motion, a rest.
    calibration : path-like or Calibration
        Calibration with lever arms.
    site : path-like or Site
        Place of the unit.
    profile : path-like or Profile, optional
        Wire format: a shipped profile's name or a file. A recording contains it.
    align_s : float
        Duration of the alignment at the beginning, s.
    rate_filter : str
        Rate filter for the size effect, see `imudrv.rate_filter`.
    skew_s : float
        Delay of the accelerometers' sample after the gyros' that is corrected, s.
    channel : str, optional
        CAN channel of a candump log; required where the log has several.
    advance : callable
        Called with the number of bytes read.

    Returns
    -------
    Validation

    Raises
    ------
    InputError
        A file cannot be read, the calibration has no lever arms, or a rest is too short.
    """
    if not isinstance(calibration, Calibration):
        name, calibration = os.fspath(calibration), read_calibration(calibration)
        lever_arms_of(calibration, name)
    path = Path(capture)
    opened = Capture(path, profile_of(profile), channel)
    layout = require_six_axes(opened.layout)
    settings = TrialSettings(layout, calibration, site_of(site), align_s, rate_filter, skew_s)
    return evaluate(navigate(path.name, opened.pulses(advance), settings))


def predict(
    procedure: StrPath | Procedure | Sequence[PlannedRotation], *, site: StrPath | Site
) -> Prediction:
    """Predict the accuracy of the lever arms from a procedure, for a unit of typical noise.

    Parameters
    ----------
    procedure : path-like, Procedure or sequence of PlannedRotation
        A shipped procedure's name, a procedure file, a procedure, or its rotations.
    site : path-like or Site
        Place of the unit.

    Returns
    -------
    Prediction

    Raises
    ------
    InputError
        A file cannot be read, or the rotations do not determine the six differences of the lever arms.
    """
    if isinstance(procedure, str | os.PathLike):
        procedure = load_procedure(procedure)
    if isinstance(procedure, Procedure):
        return plan.predicted(procedure, site_of(site))
    return predict_plan(procedure, site_of(site).latitude_rad, plan.TYPICAL_NOISE)


def load_procedure(name_or_path: StrPath) -> Procedure:
    """Load a procedure by the name of a shipped one or by its path; see `calib.procedure.plan.load`."""
    return plan.load(os.fspath(name_or_path))
