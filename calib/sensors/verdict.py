"""Verdict on a calibration of the sensors: the sentences, each with its mark."""

from collections.abc import Iterator, Sequence
from math import degrees
from typing import Final

import numpy as np

from calib.sensors import observability
from calib.sensors.adjustment import Adjustment
from calib.sensors.equations import ACCELEROMETER_WANDER_CEILING, GYRO_WANDER_CEILING
from calib.sensors.evidence import Evidence
from calib.sensors.result import Estimate, Judgement, pose_of
from imudrv.nav.earth import EARTH_RATE
from imudrv.site import Site
from imudrv.units import ARCSEC, DEG_PER_H, PPM, UG
from imudrv.wording import counted

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
        f"{counted(len(evidence.rests), 'rest')} and {counted(len(evidence.links), 'motion')}; {known} of "
        f"{len(shown)} numbers are observable.",
    )
    reduced, freedom = adjustment.reduced, counted(adjustment.degrees_of_freedom, "degree")
    if reduced > REDUCED_BAD:
        yield Judgement(
            "bad",
            f"The reduced chi-square is {reduced:.2f} ({freedom} of freedom), above {REDUCED_BAD:g}: "
            "the rests and motions contradict each other beyond the noise of the unit. No certificate is "
            "made.",
        )
    elif reduced > REDUCED_CAUTION:
        yield Judgement(
            "caution",
            f"The reduced chi-square is {reduced:.2f} ({freedom} of freedom), above {REDUCED_CAUTION:g}.",
        )
    if reduced > REDUCED_CAUTION:
        yield from dither_judgement(evidence)
    yield from _wander(adjustment)
    yield from _blocks(adjustment, evidence, poses)
    yield from _scales(adjustment)
    if lacking:
        yield Judgement(
            "note", f"Not observable, and kept at the start or left out: {', '.join(grouped(lacking))}."
        )
    yield from _one_sided(adjustment, estimates)


def dither_judgement(evidence: Evidence) -> Iterator[Judgement]:
    """Yield the sentence on dither in the increments, which contradicts the motions where it is large."""
    if not evidence.dither:
        return
    lines = ", ".join(
        f"{line.amplitude_rad / ARCSEC:.3g} arcsec at {line.frequency_hz:.0f} Hz about {line.axis}"
        for line in evidence.dither
    )
    yield Judgement(
        "caution",
        f"The angle increments at rest carry dither: {lines}. Let the unit remove it from the increments, or "
        "lower it; the motions are then free of it.",
    )


def _one_sided(adjustment: Adjustment, estimates: tuple[Estimate, ...]) -> Iterator[Judgement]:
    """Yield the sentences on accelerometers that were not turned both up and down."""
    up = set(map(pose_of, adjustment.attitudes))
    for k, axis in enumerate("XYZ"):
        absent = [side for side in (f"+{axis}", f"-{axis}") if side not in up]
        known = []
        for one in estimates:
            sensor, _, name = one.path.removesuffix(f"[{k}]").partition(".")
            if absent and one.observable and sensor == "accelerometer" and name in _TERMS:
                unit, term = _TERMS[name]
                size = one.value * PPM if name.startswith("scale") else 1.0
                known.append(f"{one.sigma / size:.0f} {unit} in {term}")
        if known:
            yield Judgement(
                "note",
                f"Without a rest with {' or '.join(absent)} up, accelerometer {axis} is known to "
                f"{' and '.join(known)}.",
            )


_TERMS: Final = {
    "scale_pulse_per_m_s": ("ppm", "K"),
    "scale": ("ppm", "scale"),
    "quadratic_ug_per_g2": ("ug/g^2", "the quadratic term"),
    "asymmetry_ppm": ("ppm", "the asymmetry"),
}
"""Unit and name of what an accelerometer shows best when it is turned both up and down."""


def _wander(adjustment: Adjustment) -> Iterator[Judgement]:
    if adjustment.wander.gyro_exceeds:
        yield Judgement(
            "caution",
            f"The biases of the gyros wander by more than {GYRO_WANDER_CEILING / DEG_PER_H:g} deg/h.",
        )
    if adjustment.wander.accelerometer_exceeds:
        yield Judgement(
            "caution",
            "The biases of the accelerometers wander by more than "
            f"{ACCELEROMETER_WANDER_CEILING / UG:.0f} ug.",
        )


def _blocks(adjustment: Adjustment, evidence: Evidence, poses: tuple[str, ...]) -> Iterator[Judgement]:
    for block, sigmas in zip(adjustment.system.blocks, worst_residuals(adjustment), strict=True):
        if sigmas > BLOCK_SIGMAS:
            if block.is_motion:
                link = evidence.links[block.number]
                before = evidence.rests[link.before]
                name = f"the motion from {before.stop_s:.1f} s on"
            else:
                rest = evidence.rests[block.number]
                name = f"the rest {poses[block.number]} at {rest.start_s:.1f} s"
            yield Judgement("caution", f"A residual of {name} is {sigmas:.1f} sigma.")


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
                yield Judgement("bad", scale_text(f"{name} {axis} has {ratio:.3f} of its nominal scale"))


def scale_text(fault: str) -> str:
    """Return the sentence on a scale that is far off."""
    return (
        f"{fault[0].upper()}{fault[1:]}, more than {SCALE_LIMIT:.0%} off: another profile, or a faulty "
        "channel. No certificate is made."
    )


def gravity_judgement(site: Site, sigma: float) -> Iterator[Judgement]:
    """Yield the sentence on gravity that was not measured."""
    if site.gravity_m_s2 is None:
        yield Judgement(
            "note",
            f"Gravity was not measured: normal gravity {site.gravity:.5f} m/s^2, to {sigma / 1e-5:.0f} mGal. "
            f"All three scale factors K are in error by up to {sigma / site.gravity * 1e6:.0f} ppm, alike; "
            "axes, biases and ratios of K are not.",
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
            f"The temperature moved by {span:.1f} K and no slopes are estimated. At 0.005 deg/h, 5 ug and 5 "
            f"ppm a kelvin that is {0.005 * span:.3f} deg/h, {5 * span:.0f} ug and {5 * span:.0f} ppm; use "
            "--temperature.",
        )


def earth_judgement(site: Site, earth: np.ndarray, sigmas: float) -> Judgement:
    """Return the sentence on an Earth rate that is not that of the site."""
    north, up = earth
    latitude = degrees(np.arctan2(up, north))
    return Judgement(
        "caution",
        f"The Earth rate is not that of the site, by {sigmas:.0f} sigma: the rests show a latitude of "
        f"{latitude:.2f} deg and {np.hypot(north, up) / EARTH_RATE:.5f} of the Earth's rate, the site says "
        f"{site.latitude_deg:.2f} deg; check the site. The measured rate is used.",
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
