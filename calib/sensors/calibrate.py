"""From captures of rests and motions to the calibration of the sensors."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from math import degrees, radians, sin
from pathlib import Path
from typing import Final, Literal

import numpy as np

from calib.detection.sections import split_at_restarts
from calib.inputs import StrPath, profile_of, require_six_axes, site_of
from calib.messages import message, verbatim
from calib.procedure.planned_turn import turn_fault
from calib.procedure.schema import Procedure
from calib.sensors.adjustment import (
    MEASURED_GRAVITY,
    NORMAL_GRAVITY,
    Adjustment,
    Free,
    NoConvergence,
    adjust,
    earth_rate_shift,
    leave_one_out,
)
from calib.sensors.axis_search import find_exchange, measured_latitude, scale_faults, wrong_hemisphere
from calib.sensors.equations import Equations, start_attitudes
from calib.sensors.evidence import Evidence
from calib.sensors.faces import find_faces
from calib.sensors.parameters import (
    EARTH,
    Nonlinearity,
    Parameters,
    nominal_scales,
    start_parameters,
)
from calib.sensors.prediction import additions
from calib.sensors.rests import GUARD_S, read_evidence
from calib.sensors.result import CaptureInput, Judgement, SensorsInput, SensorsResult, pose_of
from calib.sensors.verdict import (
    REDUCED_BAD,
    SCALE_LIMIT,
    dither_judgement,
    earth_judgement,
    gravity_judgement,
    grouped,
    judge,
    lacks_mandatory,
    scale_judgement,
    temperature_judgement,
)
from imudrv.arrays import Array
from imudrv.calibration import Calibration
from imudrv.capture import Capture
from imudrv.errors import InputError
from imudrv.files.atomic import sha256, unchanged
from imudrv.nav.earth import earth_rate_n
from imudrv.profiles.schema import Profile
from imudrv.records import Records
from imudrv.site import Site
from imudrv.wording import counted

EARTH_SIGMAS: Final = 5.0
"""Difference of the Earth rate from that of the site that is believed."""


@dataclass(frozen=True)
class SensorsOptions:
    """Choices of a calibration of the sensors.

    Attributes
    ----------
    frame : {'gyro', 'faces'}
        Body axes along the gyros, or along the faces that the unit stood on.
    pivot : {'free', 'fixed'}
        `fixed`: the origin of b stays where it is in every motion.
    temperature : bool
        Whether slopes per kelvin are estimated.
    without : tuple of {'quadratic', 'skew'}
        Parameters that are left out.
    nonlinearity : {'quadratic', 'asymmetry'}
        What the change of scale with the sign or size of the input is taken for.
    """

    frame: Literal["gyro", "faces"] = "gyro"
    pivot: Literal["free", "fixed"] = "free"
    temperature: bool = False
    without: tuple[Literal["quadratic", "skew"], ...] = ()
    nonlinearity: Nonlinearity = "quadratic"

    @property
    def free(self) -> Free:
        """Which parameters are free."""
        return Free(
            self.pivot == "fixed",
            self.temperature,
            "quadratic" not in self.without,
            "skew" not in self.without,
        )


def calibrate_sensors(
    captures: Sequence[StrPath],
    *,
    site: StrPath | Site,
    unit: str,
    profile: StrPath | Profile | None = None,
    start: Calibration | None = None,
    procedure: Procedure | None = None,
    options: SensorsOptions | None = None,
    channel: str | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> SensorsResult:
    """Calibrate the sensors of a unit from captures of rests in several poses and the motions between them.

    Parameters
    ----------
    captures : sequence of path-like
        Wire bytes, CAN logs or recordings; each is a session of its own, and each part between restarts of
        the unit.
    site : path-like or Site
        Place of the unit.
    unit : str
        Serial number.
    profile : path-like or Profile, optional
        Wire format; recordings contain it.
    start : Calibration, optional
        Starting values; default: nominal scale factors and aligned axes.
    procedure : Procedure, optional
        What was planned: names the poses.
    options : SensorsOptions, optional
    channel : str, optional
        CAN channel of candump logs.
    advance : callable
        Called with the number of bytes read; each capture is read three times.

    Returns
    -------
    SensorsResult

    Raises
    ------
    InputError
        A file cannot be read, there are fewer than three rests, the latitude has the wrong sign, or the pivot
        is not fixed.
    """
    options, site = options or SensorsOptions(), site_of(site)
    if start is not None and start.serial_number != unit:
        raise InputError(
            f"--start: expected the calibration of unit {unit!r}, got that of {start.serial_number!r}; "
            "give the unit's own"
        )
    paths = list(map(Path, captures))
    with ExitStack() as files:
        readers: list[partial[Iterator[Records]]] = []
        opened: list[Capture] = []
        digests: list[str] = []
        for path in paths:
            files.enter_context(unchanged(path))
            digest = sha256(path)
            if digest in digests:
                other = paths[digests.index(digest)].name
                raise InputError(f"{path}: expected another capture, got that of {other} once more")
            digests.append(digest)
            capture = Capture(path, profile_of(profile), channel)
            opened.append(capture)
            readers.append(partial(_pulses, capture, advance))
        layout = require_six_axes(opened[0].layout)
        for capture in opened[1:]:
            if capture.layout.name != layout.name:
                raise InputError(
                    f"{capture.path}: expected a capture of {layout.name} as in {opened[0].path}, got "
                    f"{capture.layout.name}; give captures of one unit"
                )
        nominal = nominal_scales(opened[0].profile, start)
        if nominal is None:
            raise InputError(
                f"{layout.name}: expected nominal scale factors, got a profile without them; write nominal: "
                "in the profile, or give --start"
            )
        evidence = read_evidence(readers, layout, nominal)
        inputs = [
            CaptureInput(path.name, digest, str(capture.tracker.counts))
            for path, digest, capture in zip(paths, digests, opened, strict=True)
        ]
    given = SensorsInput(
        unit,
        layout.name,
        procedure.name if procedure else "",
        site,
        tuple(inputs),
        start,
        options.frame,
        options.free,
        nominal,
    )
    return solve(given, evidence, options, procedure)


def _pulses(capture: Capture, advance: Callable[[int], None]) -> Iterator[Records]:
    seen = 0
    for section, piece in split_at_restarts(capture.pulses(advance), capture.layout.counter_step):
        seen = section
        yield piece
    restarts = capture.tracker.counts.restarts
    if restarts > seen:  # it does not show in the numbers of the samples
        raise InputError(
            f"{capture.path}: expected a unit that stays powered, got {counted(restarts, 'restart')}; divide "
            "the capture there, each part is a session of its own"
        )


def solve(
    inputs: SensorsInput, evidence: Evidence, options: SensorsOptions, procedure: Procedure | None = None
) -> SensorsResult:
    """Solve for the parameters that an evidence shows; see `calibrate_sensors`."""
    site = inputs.site
    earth = np.array(earth_rate_n(site.latitude_rad)[1:])
    p = start_parameters(site.gravity, earth, inputs.nominal, inputs.start, options.nonlinearity)
    gravity_sigma = MEASURED_GRAVITY if site.gravity_m_s2 is not None else NORMAL_GRAVITY
    reference = _reference(evidence)
    if options.temperature and np.isnan(reference):
        raise InputError(
            f"--temperature: expected temperatures, got none from {inputs.profile}; leave it out"
        )
    failed = partial(
        SensorsResult, inputs, evidence, p, None, None, reference_degc=reference, gravity_sigma=gravity_sigma
    )
    attitudes = start_attitudes(p, evidence, reference)
    poses = tuple(map(pose_of, attitudes))
    if text := find_exchange(evidence, p):
        return failed(poses, (_refused(text),))
    if faults := scale_faults(evidence, site.gravity, SCALE_LIMIT):
        return failed(poses, tuple(scale_judgement("accelerometer", *fault) for fault in faults.items()))
    _require_hemisphere(evidence, p, site)
    equations = Equations(evidence, reference, options.free.fixed_pivot)
    try:
        found, extra = _adjust(equations, p, attitudes, options.free, gravity_sigma, site)
    except NoConvergence as error:
        if options.free.fixed_pivot:
            _require_fixed_pivot(evidence, p, attitudes, options.free, gravity_sigma, reference)
        bad = _refused(str(error))
        return failed(poses, (bad, *dither_judgement(evidence)))
    if options.free.fixed_pivot and found.reduced > REDUCED_BAD:
        _require_fixed_pivot(evidence, p, attitudes, options.free, gravity_sigma, reference)
    faces = find_faces(found.attitudes) if options.frame == "faces" else None
    result = SensorsResult(
        inputs,
        evidence,
        p,
        found,
        faces,
        named_poses(found.attitudes, procedure),
        (),
        reference,
        gravity_sigma,
        leave_one_out=leave_one_out(found, options.free, gravity_sigma),
    )
    verdict = [
        *_unplanned(result.poses, procedure),
        *_turns(found, evidence, result.poses, procedure),
        *judge(found, result.estimates, evidence, result.poses),
        *extra,
        *gravity_judgement(site, gravity_sigma),
        *temperature_judgement(evidence, options.temperature),
    ]
    if result.not_observable and not any(one.mark == "bad" for one in verdict):
        result = replace(result, missing=tuple(_missing(result)))
    lacking = lacks_mandatory(result.estimates)
    if lacking and inputs.start is None:
        verdict.append(Judgement("note", message("refused", why=message("start_lacking"))))
    return replace(result, verdict=tuple(verdict))


def _refused(why: str) -> Judgement:
    """Return the sentence on what is told in English only."""
    return Judgement("bad", message("sensors_refused", why=verbatim(f"{why[0].upper()}{why[1:]}")))


def _unplanned(poses: Sequence[str], procedure: Procedure | None) -> Iterator[Judgement]:
    """Yield the sentence on poses that were planned and are not there."""
    planned = dict(_planned(procedure)) if procedure else {}
    absent = [name for name in planned if name not in poses]
    if absent:
        yield Judgement("note", message("poses_absent", poses=tuple(absent)))


def _turns(
    adjustment: Adjustment, evidence: Evidence, poses: Sequence[str], procedure: Procedure | None
) -> Iterator[Judgement]:
    """Yield the sentences on motions that are not the turns planned for a table."""
    planned = {(a.id, b.id): b.turn for a, b in pairwise(procedure.rests)} if procedure else {}
    for link in evidence.links:
        turn = planned.get((poses[link.before], poses[link.after]))
        if turn is None:
            continue
        p = adjustment.p
        turned = p.W @ link.samples["gyro"].sum(axis=0) - p.beta * link.duration_s
        if fault := turn_fault(turn, turned.tolist()):
            yield Judgement("caution", message("turn_to_pose", pose=poses[link.after], why=fault))


def _missing(result: SensorsResult) -> Iterator[str]:
    """Yield the motions to add, each with what it would show."""
    adjustment, inputs, evidence = result.adjustment, result.inputs, result.evidence
    if adjustment is None:
        return
    linked = {link.after for link in evidence.links}
    sessions: list[list[Array]] = []
    for k, C_nb in enumerate(adjustment.attitudes):
        if k in linked:
            sessions[-1].append(C_nb)
        else:
            sessions.append([C_nb])
    rest_s = float(np.mean([rest.duration_s for rest in evidence.rests])) + 2.0 * GUARD_S
    lacking = [path for path in result.not_observable if not path.startswith("temperature")]
    for text, paths in additions(
        sessions, lacking, site=inputs.site, rest_s=rest_s, free=replace(inputs.free, temperature=False)
    ):
        yield f"{text}: shows {', '.join(grouped(paths))}"
    if len(lacking) < len(result.not_observable):
        yield "the same while the unit warms up by 10 K: shows the slopes per kelvin"


def _reference(evidence: Evidence) -> float:
    degc = np.array([rest.degc for rest in evidence.rests])
    known = degc[np.isfinite(degc)]
    return round(float(known.mean()), 1) if known.size else float("nan")


def _require_hemisphere(evidence: Evidence, p: Parameters, site: Site) -> None:
    latitude = measured_latitude(evidence, p)
    if wrong_hemisphere(latitude, sin(site.latitude_rad)):
        shown = degrees(np.arcsin(np.clip(latitude.sine, -1.0, 1.0)))
        raise InputError(
            f"site: expected the latitude that force and rate of the rests show, {shown:+.1f} deg, got "
            f"{site.latitude_deg:+.2f} deg; correct its sign, or that of all accelerometers in the profile"
        )


def _adjust(
    equations: Equations,
    p: Parameters,
    attitudes: Sequence[Array],
    free: Free,
    gravity_sigma: float,
    site: Site,
) -> tuple[Adjustment, list[Judgement]]:
    """Adjust; with a free Earth rate where that of the site is refuted."""
    from_p, from_attitudes = p, tuple(attitudes)
    try:
        found = adjust(equations, p, attitudes, free, gravity_sigma)
    except NoConvergence:
        pass
    else:
        shift, P = earth_rate_shift(found, free, gravity_sigma)
        if shift @ np.linalg.solve(P, shift) < EARTH_SIGMAS**2:
            return found, []
        from_p, from_attitudes = found.p, found.attitudes
    measured = adjust(
        equations, from_p, from_attitudes, replace(free, earth=True), gravity_sigma, site.gravity
    )
    difference = measured.p.earth - np.array(earth_rate_n(site.latitude_rad)[1:])
    P = measured.covariance[EARTH, EARTH] * max(1.0, measured.reduced)
    sigmas = float(np.sqrt(difference @ np.linalg.solve(P, difference)))
    if from_p is not p and sigmas < EARTH_SIGMAS:  # the Earth rate explains nothing
        return found, []
    return measured, [earth_judgement(site, measured.p.earth, sigmas)]


def _require_fixed_pivot(
    evidence: Evidence,
    p: Parameters,
    attitudes: Sequence[Array],
    free: Free,
    gravity_sigma: float,
    reference: float,
) -> None:
    """Refuse a fixed pivot where the rest of the equations agrees without it."""
    try:
        without = adjust(
            Equations(evidence, reference, False),
            p,
            attitudes,
            replace(free, fixed_pivot=False),
            gravity_sigma,
        )
    except NoConvergence:
        return
    if without.reduced < REDUCED_BAD:
        raise InputError(
            "--pivot fixed: expected an origin of the body axes that stays where it is, got displacements "
            f"that contradict it (reduced chi-square without it {without.reduced:.2f}); use --pivot free"
        )


def _planned(procedure: Procedure) -> Iterator[tuple[str, Array]]:
    """Yield name and attitude C_bn of each planned rest; those of a rotation are one pose."""
    for rest in procedure.rests:
        yield rest.id, rest.C_bn
    for run in procedure.runs:
        yield run.id, run.C_bn
        yield run.id, run.C_bn @ np.diag([-1.0, -1.0, 1.0])


def named_poses(attitudes: Sequence[Array], procedure: Procedure | None) -> tuple[str, ...]:
    """Return the name of each rest: that of the nearest pose planned, or the axis that is up.

    A pose that is planned several times, such as the two ends of a loop, is named in the order of the plan.
    """
    planned = list(_planned(procedure)) if procedure is not None else []
    names: list[str] = []
    for C_nb in attitudes:
        distances = [angle(C_nb @ C_bn) for _, C_bn in planned]
        nearest = min(distances, default=np.inf)
        same = [
            name
            for (name, _), distance in zip(planned, distances, strict=True)
            if distance < nearest + SAME_POSE
        ]
        fresh = [name for name in same if name not in names]
        names.append((fresh or same)[0] if nearest < NEAR_POSE else pose_of(C_nb))
    return tuple(names)


NEAR_POSE: Final = radians(46.0)
"""Angle within which a rest is a pose of the procedure, rad."""
SAME_POSE: Final = 1e-6
"""Difference of the angles to two planned poses that are one, rad."""


def angle(C: Array) -> float:
    """Return the angle of a rotation, rad."""
    return float(np.arccos(np.clip((np.trace(C) - 1.0) / 2.0, -1.0, 1.0)))
