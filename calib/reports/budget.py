"""Uncertainty budget of a certificate: the sources with their uncertainty, and what each contributes."""

from collections.abc import Iterator, Mapping
from math import floor, sqrt
from typing import Final, NamedTuple

import numpy as np

from calib.estimation.budget import (
    LATITUDE_SIGMA,
    MEASURED_GRAVITY_SIGMA,
    NORMAL_GRAVITY_SIGMA,
    source_of,
    uncertainty_by_source,
)
from calib.estimation.priors import SHARED, Priors
from calib.estimation.result import TO_DIFFERENCES
from calib.identification import IdentificationResult
from calib.lever_arms.gauge import LeverArms, convert
from calib.messages import Message, message, verbatim
from calib.reports.document import Block, Paragraph, Say, Table
from calib.reports.format import mm
from imudrv.arrays import Array
from imudrv.units import DEG, DEG_PER_H, MGAL, MM, PPM, UG, URAD

_DIFFERENCES: Final = tuple(f"r_x - r_{other}, {axis}" for other in "yz" for axis in "XYZ")
_COMPONENTS: Final = tuple(f"r_{point}, {axis}" for point in "xyz" for axis in "XYZ")

_NAMES: Final = {
    "velocity_walk": message("source_velocity_walk"),
    "angle_walk": message("source_angle_walk"),
    "pulses": message("source_pulses"),
    "accelerometer_bias": message("source_accelerometer_bias"),
    "accelerometer_scale": message("source_accelerometer_scale"),
    "accelerometer_misalignment": message("source_accelerometer_misalignment"),
    "gyro_bias": message("source_gyro_bias"),
    "gyro_scale": message("source_gyro_scale"),
    "gyro_misalignment": message("source_gyro_misalignment"),
    "skew": message("source_skew"),
    "alignment": message("source_alignment"),
    "correlation": message("source_correlation"),
    "site": message("source_site"),
}


class _Input(NamedTuple):
    """Standard uncertainty of a source, and how it was found."""

    u: Message
    kind: str  # A or B, as in the GUM


def budget(identification: IdentificationResult, arms: LeverArms, say: Say) -> Iterator[Block]:
    """Return the uncertainty budget.

    Parameters
    ----------
    identification : IdentificationResult
        Result of the identification: joint, with a free pivot.
    arms : LeverArms
        The lever arms in the gauge of the certificate.
    say : callable
        Language of the certificate.

    Returns
    -------
    iterator of Block
    """
    result = identification.result
    is_measured = identification.site.gravity_m_s2 is not None
    gravity_sigma = MEASURED_GRAVITY_SIGMA if is_measured else NORMAL_GRAVITY_SIGMA
    sources = uncertainty_by_source(identification.runs, identification.priors, gravity_sigma)
    inputs = {name: one for name, one in _inputs(identification, gravity_sigma).items() if name in sources}
    yield Table(
        say(message("budget_inputs")),
        (say(message("budget_source")), say(message("budget_u")), say(message("budget_type"))),
        tuple((say(_NAMES[name]), say(one.u), one.kind) for name, one in inputs.items()),
    )
    differences = {name: TO_DIFFERENCES @ P @ TO_DIFFERENCES.T for name, P in sources.items()}
    yield _table(
        say(message("budget_differences")), _DIFFERENCES, differences, result.differences_covariance, say
    )
    if arms.covariance is not None and arms.gauge != "given":
        shifted = {
            name: convert(LeverArms(result.R_b, P, "centroid"), arms.gauge).covariance
            for name, P in sources.items()
        }
        of_arms = {name: P for name, P in shifted.items() if P is not None}
        title = say(message("budget_arms", gauge=arms.gauge))
        yield _table(title, _COMPONENTS, of_arms, arms.covariance, say)
    yield Paragraph(say(message("budget_explained")))
    if "correlation" in sources:
        yield Paragraph(say(message("budget_correlated")))
    yield Paragraph(say(_freedom(differences, result.noise.degrees_of_freedom)))


def _table(title: str, head: tuple[str, ...], parts: Mapping[str, Array], total: Array, say: Say) -> Table:
    rows = {say(_NAMES[name]): _signed_root(np.diag(P)) for name, P in parts.items()}
    u = np.sqrt(np.diag(total))
    rows |= {say(message("budget_combined")): u, say(message("budget_expanded")): 2.0 * u}
    cells = ((name, *(mm(float(x), ".4f") for x in row)) for name, row in rows.items())
    return Table(title, ("", *head), tuple(cells))


def _signed_root(variance: Array) -> Array:
    return np.asarray(np.sign(variance) * np.sqrt(np.abs(variance)), np.float64)


def _freedom(parts: Mapping[str, Array], freedom: int) -> Message:
    """Return the smallest effective degrees of freedom; those of the random walks are finite."""
    if not freedom:
        return message("budget_no_freedom")
    walks = [np.diag(parts[name]) for name in ("velocity_walk", "angle_walk")]
    total = np.sum([np.diag(P) for P in parts.values()], axis=0)
    effective = float((total**2 / (sum(walk**2 for walk in walks) / freedom)).min())
    return message("budget_freedom", freedom=freedom, effective=floor(min(effective, 1e6)))


def _inputs(identification: IdentificationResult, gravity_sigma: float) -> dict[str, _Input]:
    result, priors = identification.result, identification.priors
    noise, sigma = result.noise, _prior_sigma(priors)
    walk_kind = "A" if noise.degrees_of_freedom else "B"
    heading = max(run.aligned.heading_sigma_rad for run in identification.runs)
    bias = message(
        "input_bias_of_run",
        constant=f"{sigma['accelerometer_bias'] / UG:.3g} ug",
        of_run=f"{priors.accelerometer_bias_of_run / UG:.3g} ug",
    )
    drift = message(
        "input_bias_of_run",
        constant=f"{sigma['gyro_bias'] / DEG_PER_H:.3g} deg/h",
        of_run=f"{priors.gyro_bias_of_run / DEG_PER_H:.3g} deg/h",
    )
    site = message(
        "input_site", latitude_deg=LATITUDE_SIGMA / DEG, gravity_mgal=round(gravity_sigma / MGAL, 3)
    )
    return {
        "velocity_walk": _Input(message("input_velocity_walk", walk=noise.velocity_walk * 60.0), walk_kind),
        "angle_walk": _Input(message("input_angle_walk", walk=noise.angle_walk / DEG * 60.0), walk_kind),
        "pulses": _Input(_pulses(identification), "B"),
        "accelerometer_bias": _Input(bias, "B"),
        "accelerometer_scale": _Input(verbatim(f"{sigma['accelerometer_scale'] / PPM:.3g} ppm"), "B"),
        "accelerometer_misalignment": _Input(
            verbatim(f"{sigma['accelerometer_misalignment'] / URAD:.3g} urad"), "B"
        ),
        "gyro_bias": _Input(drift, "B"),
        "gyro_scale": _Input(verbatim(f"{sigma['gyro_scale'] / PPM:.3g} ppm"), "B"),
        "gyro_misalignment": _Input(verbatim(f"{sigma['gyro_misalignment'] / URAD:.3g} urad"), "B"),
        "skew": _Input(verbatim(f"{priors.skew * 1e3:.3g} ms"), "B"),
        "alignment": _Input(message("input_alignment", heading_deg=heading / DEG), "B"),
        "correlation": _Input(message("input_correlation"), "B"),
        "site": _Input(site, "B"),
    }


def _prior_sigma(priors: Priors) -> dict[str, float]:
    """Return the largest prior sigma of each kind of error, SI."""
    largest: dict[str, float] = {}
    for name, variance in zip(SHARED, np.diag(priors.shared_covariance).tolist(), strict=True):
        source = source_of(name)
        largest[source] = max(largest.get(source, 0.0), sqrt(variance))
    return largest


def _pulses(identification: IdentificationResult) -> Message:
    scale = identification.prior_calibration.calibration.accelerometer.scale_pulse_per_m_s
    if scale is None:
        return message("input_pulses_none")
    sizes = sorted({f"{1.0 / (one * MM * sqrt(12.0)):.3g}" for one in scale})
    return message("input_pulses", sizes=" / ".join(sizes))
