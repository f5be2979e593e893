"""Exchanged and reversed axes, before anything else: the adjustment would not converge.

The turns of a motion carry gravity: `dC^T f` of the rest before is f of the rest after. Each of the 48 signed
exchanges of the accelerometers' axes is tried with the gyros as they are and all reversed; the right one
leaves hardly a difference. To change all axes at once, f to Q f and omega to det(Q) Q omega, changes nothing:
so of two explanations the one with fewer axes is named.
"""

from dataclasses import replace
from itertools import permutations, product
from typing import Final, NamedTuple

import numpy as np

from calib.sensors.equations import curved
from calib.sensors.evidence import Evidence
from calib.sensors.motion import integrate
from calib.sensors.parameters import Parameters
from imudrv.arrays import Array
from imudrv.nav.earth import EARTH_RATE
from imudrv.units import DEG_PER_H

RIGHT: Final = 0.3
"""Difference of carried and measured force, in g, up to which the axes may be right; 5 % of scale: 0.16."""
BETTER: Final = 0.5
"""An exchange explains the motions if it leaves less than this part of the difference."""
LEAST_TURN: Final = 0.3
"""Least change of direction of gravity, in g, by which a motion distinguishes axes."""
SIGN_SIGMAS: Final = 4.0


def signed_exchanges() -> list[Array]:
    """Return the 48 matrices with one 1 or -1 in each row and column, the identity first."""
    exchanges = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            S = np.zeros((3, 3))
            for row, (column, sign) in enumerate(zip(order, signs, strict=True)):
                S[row, column] = sign
            exchanges.append(S)
    return exchanges


def find_exchange(evidence: Evidence, p: Parameters) -> str:
    """Return which axes are exchanged or reversed.

    Parameters
    ----------
    evidence : Evidence
    p : Parameters
        Starting values.

    Returns
    -------
    str
        Empty where the axes are right, or the motions do not show it.
    """
    forces = [p.M @ (e - p.q * curved(e, p)) / p.gravity for e in (r.rate[3:] - p.b for r in evidence.rests)]
    carried: dict[float, list[tuple[Array, Array, Array]]] = {}
    for sense in (1.0, -1.0):
        own = replace(p, W=sense * p.W)
        parts = []
        for link in evidence.links:
            before, after = forces[link.before], forces[link.after]
            if np.linalg.norm(before - after) > LEAST_TURN:
                zero = np.zeros(3)
                motion = integrate(link.samples, own, (zero, zero), (before, after))
                parts.append((motion.C, before, after))
        carried[sense] = parts
    if not carried[1.0]:
        return ""

    def score(S: Array, sense: float) -> float:
        return float(np.mean([np.linalg.norm(dC.T @ S @ a - S @ b) for dC, a, b in carried[sense]]))

    tried = [(score(S, sense), S, sense) for S in signed_exchanges() for sense in (1.0, -1.0)]
    own_score = tried[0][0]
    best = min(tried, key=lambda one: one[0])
    if own_score < RIGHT or best[0] > BETTER * own_score:
        return ""
    close = [one for one in tried if one[0] < 1.2 * best[0] + 0.01]
    texts = [explanation for _, S, sense in close for explanation in _explanations(S, sense)]
    return min(texts)[1]


def _explanations(S: Array, sense: float) -> list[tuple[int, str]]:
    """Return how an exchange can be put into words, each with the number of axes that it changes."""
    found = []
    if sense > 0.0:
        found.append(_described("accelerometer", S))
    gyros = sense * np.linalg.det(S) * S.T
    found.append(_described("gyro", gyros))
    if sense < 0.0 and abs(np.trace(S)) == 3.0:
        text = "the axes are left-handed: write sign: -1 for one axis of gyros and accelerometers both"
        found = [(0, f"{text}, or for all gyros, in the profile")]
    return found


def _described(sensor: str, S: Array) -> tuple[int, str]:
    changed = [k for k in range(3) if S[k, k] != 1.0]
    reversed_ = [k for k in changed if S[k, k] == -1.0]
    names = ", ".join("XYZ"[k] for k in changed[:-1]) + " and " * (len(changed) > 1) + "XYZ"[changed[-1]]
    several = "s" if len(changed) > 1 else ""
    if len(reversed_) == len(changed):
        is_are = "are" if several else "is"
        how = f"{sensor}{several} {names} {is_are} reversed: write sign: -1 for {'them' if several else 'it'}"
    else:
        comes = ", ".join(
            f"axis {'xyz'[k]} of the field {'xyz'[int(np.argmax(np.abs(S[k])))]}"
            + (" with sign: -1" if S[k].min() < 0.0 else "")
            for k in changed
        )
        how = f"{sensor}{several} {names} are exchanged: write {comes}"
    return len(changed), f"{how} in the profile"


class Latitude(NamedTuple):
    """Sine of the latitude, as force and rate of the rests show it."""

    sine: float
    sigma: float


def measured_latitude(evidence: Evidence, p: Parameters) -> Latitude:
    """Return the sine of the latitude from `f . (omega - bias)` of the rests."""
    rows, values = [], []
    for rest in evidence.rests:
        e = rest.rate[3:] - p.b
        up = p.M @ (e - p.q * curved(e, p))
        up = up / np.linalg.norm(up)
        rows.append([*up, EARTH_RATE])
        values.append(up @ (p.W @ rest.rate[:3] - p.beta))
    noise = [max(evidence.noise.angle_walk, 1e-9) / np.sqrt(rest.duration_s) for rest in evidence.rests]
    X, y = np.array(rows) / np.array(noise)[:, None], np.array(values) / np.array(noise)
    N = X.T @ X
    N[:3, :3] += np.eye(3) / (2.0 * DEG_PER_H) ** 2
    covariance = np.linalg.inv(N)
    return Latitude(float((covariance @ X.T @ y)[3]), float(np.sqrt(covariance[3, 3])))


def wrong_hemisphere(latitude: Latitude, site_sine: float) -> bool:
    """Return whether the rests show the other sign of the latitude; not within 3 deg of the equator."""
    if abs(site_sine) < 0.052:
        return False
    sign = np.sign(site_sine)
    return bool(sign * latitude.sine < -SIGN_SIGMAS * latitude.sigma and sign * latitude.sine < -0.02)


def scale_faults(evidence: Evidence, gravity: float, most: float) -> dict[str, float]:
    """Return the accelerometers whose scale is far off, with its ratio to the nominal one.

    Each that was up and down shows it at once.
    """
    s = np.array([rest.rate[3:] for rest in evidence.rests])
    faults = {}
    for k, axis in enumerate("XYZ"):
        span = float(np.ptp(s[:, k]))
        others = np.linalg.norm(
            np.delete(s[[int(s[:, k].argmax()), int(s[:, k].argmin())]], k, axis=1), axis=1
        )
        if span > gravity and (others < 0.4 * gravity).all():
            ratio = span / (2.0 * gravity)
            if abs(ratio - 1.0) > most:
                faults[axis] = ratio
    return faults
