"""From captures of rests and motions to the calibration of the sensors."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from math import degrees, radians, sin
from pathlib import Path
from typing import Final, Literal

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.inputs import StrPath, profile_of, require_six_axes, site_of
from calib.procedure.schema import Procedure
from calib.sensors.adjustment import Adjustment, Free, NoConvergence, adjust, prior_information
from calib.sensors.axis_search import find_exchange, measured_latitude, scale_faults, wrong_hemisphere
from calib.sensors.equations import Equations, start_attitudes
from calib.sensors.faces import find_faces
from calib.sensors.parameters import (
    COLUMNS,
    EARTH,
    GRAVITY,
    Nonlinearity,
    Parameters,
    nominal_scales,
    start_parameters,
)
from calib.sensors.rests import Evidence, read_evidence
from calib.sensors.result import CaptureInput, Judgement, SensorsInput, SensorsResult, pose_of
from calib.sensors.verdict import (
    REDUCED_BAD,
    SCALE_LIMIT,
    earth_judgement,
    gravity_judgement,
    judge,
    lacks_mandatory,
    scale_text,
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

MEASURED_GRAVITY: Final = 1e-5
NORMAL_GRAVITY: Final = 50e-5
"""Uncertainty of gravity that was measured, and of normal gravity, m/s^2."""
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
        Wire bytes, CAN logs or recordings; each is a session of its own.
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
        inputs: list[CaptureInput] = []
        readers, opened = [], []
        for path in paths:
            files.enter_context(unchanged(path))
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
        for path, capture in zip(paths, opened, strict=True):
            digest = sha256(path)
            if digest in [one.sha256 for one in inputs]:
                raise InputError(f"{path}: expected another capture, got one twice")
            inputs.append(CaptureInput(path.name, digest, str(capture.tracker.counts)))
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
    yield from capture.pulses(advance)
    restarts = capture.tracker.counts.restarts
    if restarts:
        raise InputError(
            f"{capture.path}: expected a unit that stays powered, got {restarts} restarts; divide the "
            "capture there, each part is a session of its own"
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
    if text := find_exchange(evidence, p).text:
        return failed(poses, (Judgement("bad", f"{text[0].upper()}{text[1:]}. No certificate is made."),))
    if faults := scale_faults(evidence, site.gravity, SCALE_LIMIT):
        return failed(poses, tuple(Judgement("bad", scale_text(fault)) for fault in faults))
    _require_hemisphere(evidence, p, site)
    equations = Equations(evidence, reference, options.free.fixed_pivot)
    try:
        found, extra = _adjust(equations, p, attitudes, options.free, gravity_sigma, site)
    except NoConvergence as error:
        return failed(poses, (Judgement("bad", f"{error}. No certificate is made."),))
    if options.free.fixed_pivot and found.reduced > REDUCED_BAD:
        _require_fixed_pivot(evidence, found, options.free, gravity_sigma, site.gravity, reference)
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
        *judge(found, result.estimates, evidence, result.poses),
        *extra,
        *gravity_judgement(site, gravity_sigma),
        *temperature_judgement(evidence, options.temperature),
    ]
    lacking = lacks_mandatory(result.estimates)
    if lacking and inputs.start is None:
        verdict.append(
            Judgement(
                "note",
                "No certificate is made: scales, biases and axes that are not observable have to come from "
                "--start.",
            )
        )
    return replace(result, verdict=tuple(verdict))


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
    try:
        found = adjust(equations, p, attitudes, free, gravity_sigma)
        from_p, from_attitudes = found.p, found.attitudes
    except NoConvergence:
        found, from_p, from_attitudes = None, p, tuple(attitudes)
    measured = adjust(
        equations, from_p, from_attitudes, replace(free, earth=True), gravity_sigma, site.gravity
    )
    difference = measured.p.earth - np.array(earth_rate_n(site.latitude_rad)[1:])
    P = measured.covariance[EARTH, EARTH] * max(1.0, measured.reduced)
    sigmas = float(np.sqrt(difference @ np.linalg.solve(P, difference)))
    if found is not None and sigmas < EARTH_SIGMAS:
        return found, []
    return measured, [earth_judgement(site, measured.p.earth, sigmas)]


def _require_fixed_pivot(
    evidence: Evidence,
    found: Adjustment,
    free: Free,
    gravity_sigma: float,
    site_gravity: float,
    reference: float,
) -> None:
    """Refuse a fixed pivot where the rest of the equations agrees without it."""
    try:
        without = adjust(
            Equations(evidence, reference, False),
            found.p,
            found.attitudes,
            replace(free, fixed_pivot=False),
            gravity_sigma,
            site_gravity,
        )
    except NoConvergence:
        return
    if without.reduced < REDUCED_BAD:
        raise InputError(
            "--pivot fixed: expected an origin of the body axes that stays where it is, got displacements "
            f"that contradict it (reduced chi-square {found.reduced:.1f}, {without.reduced:.1f} without); "
            "use --pivot free"
        )


def named_poses(attitudes: Sequence[Array], procedure: Procedure | None) -> tuple[str, ...]:
    """Return the name of each rest: that of the nearest pose planned, or the axis that is up."""
    names = []
    for C_nb in attitudes:
        name = pose_of(C_nb)
        if procedure is not None:
            steps = [(rest.id, rest.C_bn) for rest in procedure.rests]
            turned = [(id_, C_bn @ np.diag([-1.0, -1.0, 1.0])) for id_, C_bn in steps]
            near = {id_: angle(C_nb @ C_bn) for id_, C_bn in [*turned, *steps]}
            planned = min(near, key=lambda id_: near[id_])
            if near[planned] < NEAR_POSE:
                name = planned
        names.append(name)
    return tuple(names)


NEAR_POSE: Final = radians(46.0)
"""Angle within which a rest is a pose of the procedure, rad."""


def angle(C: Array) -> float:
    """Return the angle of a rotation, rad."""
    return float(np.arccos(np.clip((np.trace(C) - 1.0) / 2.0, -1.0, 1.0)))


def leave_one_out(found: Adjustment, free: Free, gravity_sigma: float) -> tuple[float, ...]:
    """Return for each rest by how much the sigma of a parameter grows at most without it and its motions."""
    system, K = found.system, len(found.attitudes)
    basis = free.basis
    m = basis.shape[1]
    Z = np.zeros((COLUMNS + 3 * K, m + 3 * K))
    Z[:COLUMNS, :m], Z[COLUMNS:, m:] = basis, np.eye(3 * K)
    J = system.J @ Z
    damping = np.zeros((COLUMNS, COLUMNS)) + prior_information(found.p)
    damping[GRAVITY, GRAVITY] += 1.0 / gravity_sigma**2
    prior = np.zeros((m + 3 * K, m + 3 * K))
    prior[:m, :m] = basis.T @ damping @ basis
    prior[m:, m:] = np.eye(3 * K)  # an attitude of no equation
    motion_psi = [np.abs(system.J[block.rows, COLUMNS:]).max(axis=0) > 0.0 for block in system.blocks]

    def sigma(without: int) -> Array:
        kept = np.ones(len(system.residual), np.bool_)
        for block, psi in zip(system.blocks, motion_psi, strict=True):
            if without >= 0 and psi[3 * without : 3 * without + 3].any():
                kept[block.rows] = False
        V = found.V[np.ix_(kept, kept)]
        N = J[kept].T @ cho_solve(cho_factor(V, lower=True), J[kept]) + prior
        scale = 1.0 / np.sqrt(np.diag(N))
        inverse = np.linalg.inv(N * scale * scale[:, None])[:m, :m] * scale[:m] * scale[:m, None]
        return np.sqrt(np.diag(inverse))

    whole = sigma(-1)
    return tuple(float((sigma(k) / whole).max()) for k in range(K))
