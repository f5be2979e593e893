"""Plan of a procedure of the sensors or of the noise as text: rests, minutes, and what it will show."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.axes import side
from calib.procedure.schema import Procedure
from calib.sensors.adjustment import NORMAL_GRAVITY, Free
from calib.sensors.prediction import MOTION_S, TYPICAL_SCALES, PlannedPose, additions, predict_sensors
from calib.sensors.verdict import gravity_judgement, grouped
from imudrv.site import Site
from imudrv.units import ARCSEC, PPM
from imudrv.wording import counted

_KINDS: Final = (
    ("gyro.scale", "gyro scale, ppm", TYPICAL_SCALES.gyro / ARCSEC * PPM),
    ("gyro.bias", "gyro bias, deg/h", 1.0),
    ("gyro.C_bg", "gyro axes, arcsec", ARCSEC),
    ("accelerometer.scale", "accelerometer scale, ppm", TYPICAL_SCALES.accelerometer * PPM),
    ("accelerometer.bias", "accelerometer bias, ug", 1.0),
    ("accelerometer.C_ba", "accelerometer axes, arcsec", ARCSEC),
    ("accelerometer.quadratic", "quadratic term, ug/g^2", 1.0),
    ("size_effect", "sensing points, mm", 1.0),
    ("skew_ms", "skew, ms", 1.0),
)
"""Beginning of the paths of a kind of number, its name and unit, and that unit in the unit of the file."""


def text(procedure: Procedure, site: Site) -> str:
    """Return a plan as text.

    Parameters
    ----------
    procedure : Procedure
        Of the kind sensors or noise.
    site : Site
        Place of the unit.

    Returns
    -------
    str
        Lines: the rests, how long all takes, and for the sensors the largest sigma of each kind of number,
        what is not observable, and which motion would show it.
    """
    rests = procedure.rests
    minutes = sum(rest.rest_s + MOTION_S for rest in rests) / 60.0
    lines = [f"{procedure.name}: {counted(len(rests), 'rest')}, about {minutes:.0f} min"]
    for rest in rests:
        how = "" if rest.turn is None else f"; {rest.turn.deg:g} deg about {side(rest.turn.about)}"
        took = "" if rest.turn is None else f" in {rest.turn.seconds:g} s"
        lines.append(
            f"  {rest.id}: {side(rest.up)} up, {side(rest.east)} east; rest of {rest.rest_s:g} s{how}{took}"
        )
    if procedure.kind == "sensors":
        lines += _shown(procedure, site)
    return "\n".join(lines)


def _shown(procedure: Procedure, site: Site) -> Iterator[str]:
    poses = [PlannedPose(rest.up, rest.east) for rest in procedure.rests]
    rest_s = float(np.mean([rest.rest_s for rest in procedure.rests]))
    found = predict_sensors([poses], site=site, rest_s=rest_s)
    lacking = found.not_observable
    yield f"rank {found.rank} of {found.unknowns}; expected accuracy (1 sigma), the largest of each kind"
    for begin, name, unit in _KINDS:
        sigma = [
            s for number, s in zip(found.numbers, found.sigma, strict=True) if number.path.startswith(begin)
        ]
        dark = sum(path.startswith(begin) for path in lacking)
        note = f"; {dark} of {len(sigma)} not observable" if dark else ""
        yield f"  {name:30}{max(sigma) / unit:10.3g}{note}"
    for one in gravity_judgement(site, NORMAL_GRAVITY):
        yield f"{one.mark}: {one.text}"
    attitudes = [[pose.C_nb for pose in poses]]
    for more, paths in additions(attitudes, lacking, site=site, rest_s=rest_s, free=Free()):
        yield f"add {more}: shows {', '.join(grouped(paths))}"
