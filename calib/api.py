"""Functions for a notebook: paths or objects in, results out; see also `calib.identification.identify`."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from calib.certificate import lever_arms_of
from calib.detection.noise import Noise
from calib.estimation.predict import PlannedRotation, Prediction
from calib.estimation.predict import predict as predict_plan
from calib.estimation.runs import Priors
from calib.html_table import html_table
from calib.inputs import StrPath, profile_of, site_of
from calib.procedure import plan
from calib.procedure.schema import Procedure
from calib.validation.navigate import navigate
from calib.validation.trial import RATE_FILTER, Trial, TrialSettings
from calib.validation.verdict import TrialMetrics, evaluate
from imudrv.calibration import Calibration, read_calibration
from imudrv.capture import Capture
from imudrv.imu.rate_filter import RateFilterName
from imudrv.nav.alignment import ALIGNMENT_S
from imudrv.profiles.schema import Profile
from imudrv.site import Site
from imudrv.units import MM


@dataclass(frozen=True, repr=False)
class Validation:
    """A capture navigated with and without size-effect compensation.

    Attributes
    ----------
    trial : Trial
        Both velocities.
    metrics : TrialMetrics
        Their comparison; `metrics.good` is the verdict.
    """

    trial: Trial
    metrics: TrialMetrics

    def __repr__(self) -> str:
        return f"<Validation: {self._summary}>"

    def _repr_html_(self) -> str:
        metrics = self.metrics
        head = ("horizontal velocity, mm/s", "not compensated", "compensated")
        rows = [("first second after the motion", metrics.first), ("whole rest, rms", metrics.whole)]
        return html_table(
            self._summary, head, [(name, *(f"{v / MM:.2f}" for v in pair[:2])) for name, pair in rows]
        )

    @property
    def _summary(self) -> str:
        without, compensated = (v / MM for v in self.metrics.first[:2])
        return (
            f"{self.trial.name}: {'good' if self.metrics.good else 'bad'}; velocity after the motion "
            f"{without:.2f} mm/s, compensated {compensated:.2f} mm/s"
        )


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
    settings = TrialSettings(opened.layout, calibration, site_of(site), align_s, rate_filter, skew_s)
    trial = navigate(path.name, opened.pulses(advance), settings)
    return Validation(trial, evaluate(trial))


def predict(
    procedure: StrPath | Procedure | Sequence[PlannedRotation],
    *,
    site: StrPath | Site,
    noise: Noise | None = None,
    priors: Priors | None = None,
) -> Prediction:
    """Predict the accuracy of the lever arms from a procedure.

    Parameters
    ----------
    procedure : path-like, Procedure or sequence of PlannedRotation
        A shipped procedure's name, a procedure file, a procedure, or its rotations.
    site : path-like or Site
        Place of the unit.
    noise : Noise, optional
        Noise of the sensors; default: `calib.procedure.plan.TYPICAL_NOISE`.
    priors : Priors, optional
        Uncertainty of the static calibration.

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
        return plan.predicted(procedure, site_of(site), noise, priors)
    return predict_plan(procedure, site_of(site).latitude_rad, noise or plan.TYPICAL_NOISE, priors)


def load_procedure(name_or_path: StrPath) -> Procedure:
    """Load a procedure by the name of a shipped one or by its path; see `calib.procedure.plan.load`."""
    return plan.load(os.fspath(name_or_path))
