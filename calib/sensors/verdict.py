"""Verdict on a calibration of the sensors: the sentences, each with its mark."""

from collections.abc import Iterator, Sequence
from math import degrees
from typing import Final

import numpy as np

from calib.messages import Message, message
from calib.sensors import observability
from calib.sensors.adjustment import Adjustment
from calib.sensors.equations import ACCELEROMETER_WANDER_CEILING, GYRO_WANDER_CEILING
from calib.sensors.evidence import Evidence
from calib.sensors.result import Estimate, Judgement, pose_of
from imudrv.nav.earth import EARTH_RATE
from imudrv.site import Site
from imudrv.units import ARCSEC, DEG_PER_H, MGAL, PPM, UG

REDUCED_CAUTION: Final = 1.5
REDUCED_BAD: Final = 2.0
"""Reduced chi-square from which the data contradict the model."""
BLOCK_SIGMAS: Final = 5.0
SCALE_LIMIT: Final = 0.2
"""Largest deviation of a scale from nominal."""
TEMPERATURE_K: Final = 1.0
"""Largest change of temperature that is not mentioned."""


def judge(
    adjustment: Adjustment, estimates: tuple[Estimate, ...], evidence: Evidence, poses: tuple[str, ...]
) -> Iterator[Judgement]:
    """Yield the sentences on an adjustment that converged."""
    lacking = [one.path for one in estimates if not one.observable]
    shown = [one for one in estimates if one.is_shown]
    known = sum(one.observable for one in shown)
    yield Judgement(
        "good",
        message(
            "rests_and_motions",
            rests=len(evidence.rests),
            motions=len(evidence.links),
            known=known,
            shown=len(shown),
        ),
    )
    reduced, n = adjustment.reduced, adjustment.degrees_of_freedom
    if reduced > REDUCED_BAD:
        yield Judgement("bad", message("rests_contradict", reduced=reduced, n=n, limit=REDUCED_BAD))
    elif reduced > REDUCED_CAUTION:
        yield Judgement("caution", message("reduced_large", reduced=reduced, n=n, limit=REDUCED_CAUTION))
    if reduced > REDUCED_CAUTION:
        yield from dither_judgement(evidence)
    yield from _wander(adjustment)
    yield from _blocks(adjustment, evidence, poses)
    yield from _scales(adjustment)
    if lacking:
        yield Judgement("note", message("numbers_unobservable", names=tuple(grouped(lacking))))
    yield from _one_sided(adjustment, estimates)


def dither_judgement(evidence: Evidence) -> Iterator[Judgement]:
    """Yield the sentence on dither in the increments, which contradicts the motions where it is large."""
    if not evidence.dither:
        return
    lines = tuple(
        message(
            "dither_of_gyro",
            amplitude_arcsec=line.amplitude_rad / ARCSEC,
            frequency_hz=line.frequency_hz,
            axis=line.axis,
        )
        for line in evidence.dither
    )
    yield Judgement("caution", message("dither_at_rest", lines=lines))


def _one_sided(adjustment: Adjustment, estimates: tuple[Estimate, ...]) -> Iterator[Judgement]:
    """Yield the sentences on accelerometers that were not turned both up and down."""
    up = set(map(pose_of, adjustment.attitudes))
    for k, axis in enumerate("XYZ"):
        sides = tuple(side for side in (f"+{axis}", f"-{axis}") if side not in up)
        own = [one for one in estimates if one.observable and one.path.endswith(f"[{k}]")]
        known = tuple(filter(None, map(_known, own)))
        if sides and known:
            yield Judgement("note", message("side_absent", sides=sides, axis=axis, known=known))


def _known(one: Estimate) -> Message | None:
    """Return to what a number is known that an accelerometer shows best when it is turned up and down."""
    if one.path.startswith("accelerometer.scale"):
        return message("known_scale", size=one.sigma / (one.value * PPM))
    if one.path.startswith("accelerometer.quadratic"):
        return message("known_quadratic", size=one.sigma)
    if one.path.startswith("accelerometer.asymmetry"):
        return message("known_asymmetry", size=one.sigma)
    return None


def _wander(adjustment: Adjustment) -> Iterator[Judgement]:
    if adjustment.wander.gyro_exceeds:
        limit = GYRO_WANDER_CEILING / DEG_PER_H
        yield Judgement("caution", message("gyro_wander", limit_deg_per_h=limit))
    if adjustment.wander.accelerometer_exceeds:
        limit = ACCELEROMETER_WANDER_CEILING / UG
        yield Judgement("caution", message("accelerometer_wander", limit_ug=limit))


def _blocks(adjustment: Adjustment, evidence: Evidence, poses: tuple[str, ...]) -> Iterator[Judgement]:
    for block, sigmas in zip(adjustment.system.blocks, worst_residuals(adjustment), strict=True):
        if sigmas > BLOCK_SIGMAS:
            if block.is_motion:
                link = evidence.links[block.number]
                at_s = evidence.rests[link.before].stop_s
                yield Judgement("caution", message("residual_of_motion", at_s=at_s, sigmas=sigmas))
            else:
                pose, at_s = poses[block.number], evidence.rests[block.number].start_s
                yield Judgement("caution", message("residual_of_rest", pose=pose, at_s=at_s, sigmas=sigmas))


def worst_residuals(adjustment: Adjustment) -> list[float]:
    """Return the largest residual of each rest and motion, in sigma."""
    ratio = np.abs(adjustment.residual) / adjustment.residual_sigma
    return [float(ratio[block.rows].max()) for block in adjustment.system.blocks]


def _scales(adjustment: Adjustment) -> Iterator[Judgement]:
    for name, matrix in (("gyro", adjustment.p.W), ("accelerometer", adjustment.p.M)):
        lengths = np.linalg.norm(np.linalg.inv(matrix), axis=1)
        ratios = 1.0 / lengths if name == "gyro" else lengths
        for axis, ratio in zip("XYZ", ratios, strict=True):
            if abs(ratio - 1.0) > SCALE_LIMIT:
                yield scale_judgement(name, axis, float(ratio))


def scale_judgement(sensor: str, axis: str, ratio: float) -> Judgement:
    """Return the sentence on a scale that is far off: of a ``gyro`` or an ``accelerometer``."""
    if sensor == "gyro":
        return Judgement("bad", message("gyro_scale_off", axis=axis, ratio=ratio, limit=SCALE_LIMIT))
    return Judgement("bad", message("accelerometer_scale_off", axis=axis, ratio=ratio, limit=SCALE_LIMIT))


def gravity_judgement(site: Site, sigma: float) -> Iterator[Judgement]:
    """Yield the sentence on gravity that was not measured."""
    if site.gravity_m_s2 is None:
        yield Judgement(
            "note",
            message(
                "gravity_not_measured",
                gravity_m_s2=site.gravity,
                sigma_mgal=sigma / MGAL,
                error_ppm=sigma / site.gravity / PPM,
            ),
        )


def temperature_judgement(evidence: Evidence, is_free: bool) -> Iterator[Judgement]:
    """Yield the sentence on a temperature that moved."""
    if is_free:
        return
    degc = np.array([rest.degc for rest in evidence.rests])
    known = np.isfinite(degc).all(axis=0)
    span = float(np.ptp(degc[:, known], axis=0).max()) if known.any() else 0.0
    if span > TEMPERATURE_K:
        yield Judgement(
            "caution",
            message(
                "temperature_moved",
                span_k=span,
                bias_deg_per_h=0.005 * span,
                bias_ug=5.0 * span,
                scale_ppm=5.0 * span,
            ),
        )


def earth_judgement(site: Site, earth: np.ndarray, sigmas: float) -> Judgement:
    """Return the sentence on an Earth rate that is not that of the site."""
    north, up = earth
    latitude = degrees(np.arctan2(up, north))
    return Judgement(
        "caution",
        message(
            "earth_rate_refuted",
            sigmas=sigmas,
            found_deg=latitude,
            ratio=float(np.hypot(north, up)) / EARTH_RATE,
            site_deg=site.latitude_deg,
        ),
    )


def grouped(paths: Sequence[str]) -> list[str]:
    """Return paths, the three of one vector together."""
    groups: dict[str, list[str]] = {}
    for path in paths:
        groups.setdefault(path.split("[")[0], []).append(path)
    return [name if len(members) >= 3 else ", ".join(members) for name, members in groups.items()]


def lacks_mandatory(estimates: tuple[Estimate, ...]) -> list[str]:
    """Return what is not observable and has to be in a certificate."""
    return [e.path for e in estimates if not e.observable and not observability.is_optional(e.path)]
