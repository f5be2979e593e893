"""Simulated unit: true integrals of motion to increments, with the errors of the unit, and the truth.

The true unit is a calibration, with the conventions of the file inverted, that differs by drawn residuals
from the one that will compensate it:

    gyro axes            N_g = C_bg^-1 (dtheta_b + b_g tau) / k_g
    accelerometer i      N_i = K_i (e_i + b_i tau)

where `e_i - q_i e_i^2 / tau - asymmetry_i |e_i| / 2` is the integral of f_i, over an interval that ends later
by the skew,

with `k_g`, `K`, `b_g`, `b` each at the temperature of the sample: the scale in the file times
`1 + ppm_per_k (T - T_reference)`, the bias plus `bias_per_k (T - T_reference)`. `N` are pulses, or rad and
m/s of a unit that sends other units. Pulses and counts of increments and totals are integers; the fraction is
carried into the next sample. The encoder makes counts of rates and of floating-point numbers.
Bias steps change `b_g` and `b` during the run.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import exp, pi, sin, sqrt
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from imudrv.arrays import Array
from imudrv.calibration import Calibration, coefficients
from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients, TemperatureTerms
from imudrv.imu.compensation import require_sensors
from imudrv.imu.conversion import constants
from imudrv.kernels import kernel
from imudrv.nav.earth import earth_rate_n
from imudrv.records import Records
from imudrv.sim.integrate import Body, Dithering, Integrals, Motion, Shaking
from imudrv.sim.path import cycles_at, split_cycles
from imudrv.sim.scenario import (
    Dither,
    Faults,
    Motor,
    OneMotion,
    Residuals,
    Saturation,
    Scenario,
    nominal,
)
from imudrv.units import ARCSEC, DEG_PER_H, DEG_PER_SQRT_H, MM, NS, PPM, STANDARD_GRAVITY, UG, URAD
from imudrv.vectors import Vector, dot, row
from imudrv.wire.layout import Layout, SequenceKind, Values

PER_SQRT_H: Final = 1.0 / 60.0
"""1/sqrt(h) in 1/sqrt(s)."""

TRUTH: Final = np.dtype(
    [
        ("counter", np.int64),
        ("t_s", np.float64),  # end of the interval, since the start of the run
        ("dtheta_b", np.float64, 3),  # integral of omega_ib_b, rad
        ("dv_b", np.float64, 3),  # integral of the specific force at the origin of b, m/s
        ("omega_ib_b", np.float64, 3),  # at the end, rad/s
        ("C_nb", np.float64, (3, 3)),  # at the end
    ],
    align=True,
)
"""Truth of one sample interval."""


More: TypeAlias = Callable[[], OneMotion]
"""Source of the next motion of a unit that is moved while it is simulated."""


@dataclass(frozen=True)
class Chunk:
    """Consecutive samples.

    Attributes
    ----------
    pulses : ndarray of `imudrv.records.samples_type`
        Samples, with times since the start of the run. Flags are zero: sequence tracking sets them.
    truth : ndarray of TRUTH
        Truth of the same samples.
    """

    pulses: Records
    truth: Records


_WANDER_STEP: Final = 0.05
"""Interval of the steps of a bias wander, in time constants."""


class _Counts(NamedTuple):
    """What each axis can send, gyro and accelerometer X Y Z: arrays of shape (6,)."""

    quantum: Array  # of one count: pulses, rad or m/s; NaN for an axis that the unit lacks
    is_whole: np.ndarray  # whether counts are rounded here, the fraction carried
    lowest: Array  # counts of a sample
    highest: Array


class _Electronics(NamedTuple):
    """Parameters of the kernel from integrals to increments; gyro quantities are on the axes of the gyros."""

    interval_s: float
    G: Array  # C_bg^-1
    gyro_scale: Array
    gyro_bias: Array
    gyro_bias_per_k: Array
    gyro_scale_per_k: Array
    gyro_noise: float  # 1 sigma of an increment, rad
    dither: Dithering  # part in the gyro increments
    accelerometer_scale: Array
    accelerometer_bias: Array
    accelerometer_bias_per_k: Array
    accelerometer_scale_per_k: Array
    quadratic: Array  # s^2/m
    half_asymmetry: Array
    accelerometer_noise: float  # m/s
    counts: _Counts
    step_at_s: Array  # (m,), when biases change
    steps: Array  # (m + 1, 6), sums of the changes before, of gyros, rad/s, and accelerometers, m/s^2
    reference_degc: float
    start_degc: float
    slope_k_per_s: float
    rise_k: float
    time_constant_s: float


def draw_true_unit(scenario: Scenario, layout: Layout) -> Coefficients:
    """Draw the true unit from the calibration, the residuals and the seed of a scenario.

    Parameters
    ----------
    scenario : Scenario
        `unit` is used, and its seed, or else `seed`: it gives the normalised residuals, scaled by their
        1-sigma.
    layout : Layout
        Layout of the profile.

    Returns
    -------
    Coefficients

    Raises
    ------
    InputError
        The calibration is of pulses, and the unit sends other units, or the other way round.
    """
    certified = coefficients(_certificate(scenario, layout))
    require_sensors(certified, layout)
    unit = scenario.unit
    residuals, seed = unit.residuals, scenario.seed if unit.seed is None else unit.seed
    gyro_normal, accelerometer_normal = _generator(seed, 2).standard_normal((2, 12))
    return replace(
        certified,
        gyro_scale=certified.gyro_scale * (1.0 + residuals.gyro_scale_ppm * PPM * gyro_normal[0:3]),
        gyro_bias=certified.gyro_bias + residuals.gyro_bias_deg_per_h * DEG_PER_H * gyro_normal[3:6],
        C_bg=_misaligned(residuals.gyro_misalignment_urad, gyro_normal[6:]) @ certified.C_bg,
        accelerometer_scale=certified.accelerometer_scale
        * (1.0 + residuals.accelerometer_scale_ppm * PPM * accelerometer_normal[0:3]),
        accelerometer_bias=certified.accelerometer_bias
        + residuals.accelerometer_bias_ug * UG * accelerometer_normal[3:6],
        C_ba=_misaligned(residuals.accelerometer_misalignment_urad, accelerometer_normal[6:])
        @ certified.C_ba,
        r_b=certified.r_b if unit.r_mm is None else unit.r_mm.r_m,
        temperature=_drifting(certified.temperature, residuals, unit.temperature.start_degc, seed),
    )


def simulate(
    scenario: Scenario, layout: Layout, chunk: int = 65_536, more: More | None = None
) -> Iterator[Chunk]:
    """Simulate a scenario.

    Parameters
    ----------
    scenario : Scenario
        Scenario; of `faults` only the counter jumps apply here, the others act on the wire. What an axis
        cannot send saturates.
    layout : Layout
        Layout of the profile; durations of the motion are rounded to whole sample intervals.
    chunk : int
        Number of samples at a time; any value gives the same bits.
    more : callable, optional
        Called for the next motion when those before are used up; there is no end then.

    Yields
    ------
    Chunk
        Up to `chunk` samples.

    Raises
    ------
    InputError
        The interval or the chunk is out of range, or the calibration is not one for the profile.
    """
    interval, step = layout.interval, layout.counter_step
    if not 10_000 <= interval <= 1_000_000_000:
        raise InputError(
            f"simulation: expected a sample interval of 10 us to 1 s, got {layout.interval_ns} ns"
        )
    if chunk < 1:
        raise InputError(f"simulation: expected chunks of at least one sample, got {chunk}")
    interval_s = interval * NS
    truth = draw_true_unit(scenario, layout)
    rng = _generator(scenario.seed, 3)
    # With a skew, an accelerometer sample is the late part of one interval and the early part of a later one.
    skew, split_ns = divmod(round((truth.skew_s + scenario.unit.accelerometer_skew_s) / NS), interval)
    motion = Motion(scenario, _body(scenario, truth, interval_s), split_ns * NS)
    electronics = _electronics(scenario, truth, layout)
    start = scenario.start.counter if layout.sequence.kind is SequenceKind.COUNTER else 0
    carry = np.zeros(6)
    first, n = 0, 0
    begin = min(0, skew)
    while True:
        first += n
        while more is not None and motion.samples <= first + chunk + max(0, skew + 1):
            motion.append(more())
        n = min(chunk, motion.samples - first)
        if n <= 0:
            return
        around = motion.integrals(first + begin, first + n + max(0, skew + 1))
        own = Integrals(*(a[-begin : n - begin] for a in around))
        later = skew - begin
        velocity = around.late[later : later + n] + around.early[later + 1 : later + 1 + n]
        pulses = np.zeros(n, layout.samples_type)
        ends_ns = np.arange(first, first + n + 1) * interval.numerator // interval.denominator
        t_ns = ends_ns[1:]
        powered_ns = _powered(scenario.faults, t_ns)
        since = -(-(powered_ns + 1) * interval.denominator // interval.numerator) - 1  # first sample after
        begun = np.where(powered_ns < 0, start, -step * since - jumped(scenario.faults, powered_ns))
        counter = begun + step * np.arange(first, first + n)
        pulses["counter"] = counter + jumped(scenario.faults, t_ns)
        pulses["arrival_ns"] = pulses["elapsed_ns"] = t_ns
        pulses["interval_ns"] = np.diff(ends_ns)
        noise = rng.standard_normal((n, 6))
        increments = np.empty((n, 6))
        degc = np.empty(n)
        overflow = np.empty(n, np.bool_)
        _count(electronics, first, own.dtheta_b, velocity, noise, carry, increments, degc, overflow)
        pulses["gyro"], pulses["accelerometer"] = increments[:, :3], increments[:, 3:]
        pulses["temperature_degc"] = degc[:, None]
        warm_up = (t_ns - np.maximum(powered_ns, 0)) * NS <= scenario.unit.warm_up_s
        meaning = layout.status
        pulses["status"] = meaning.inverted ^ (meaning.warm_up * warm_up | meaning.saturated * overflow)
        yield Chunk(pulses, _truth(pulses, own))


def jumped(faults: Faults, t_ns: np.ndarray) -> np.ndarray:
    """Return the sum of the counter jumps up to each sample.

    Parameters
    ----------
    faults : Faults
        Only `counter_jumps` is used.
    t_ns : ndarray of int, shape (n,)
        End of each sample since the start of the run.

    Returns
    -------
    ndarray of int64, shape (n,)
    """
    total = np.zeros(t_ns.size, np.int64)
    for jump in faults.counter_jumps:
        total += jump.by * (t_ns > round(jump.at_s / NS))
    return total


def _powered(faults: Faults, t_ns: np.ndarray) -> np.ndarray:
    """Return when the power came last, for each sample; -1 before the first restart."""
    powered_ns = np.full(t_ns.size, -1, np.int64)
    for restart in faults.restarts:
        again_ns = round((restart.at_s + restart.duration_s) / NS)
        powered_ns[t_ns > again_ns] = again_ns
    return powered_ns


def _certificate(scenario: Scenario, layout: Layout) -> Calibration:
    return scenario.unit.calibration or nominal(layout)


def _generator(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,)))


def _drifting(
    terms: TemperatureTerms | None, residuals: Residuals, start_degc: float, seed: int
) -> TemperatureTerms | None:
    """Add what the calibration does not know of the change with temperature."""
    sigmas = (
        residuals.gyro_bias_deg_per_h_per_k * DEG_PER_H,
        residuals.gyro_scale_ppm_per_k * PPM,
        residuals.accelerometer_bias_ug_per_k * UG,
        residuals.accelerometer_scale_ppm_per_k * PPM,
    )
    if not any(sigmas):
        return terms
    known = terms or TemperatureTerms(start_degc, -np.inf, np.inf)
    normal = _generator(seed, 7).standard_normal((4, 3))
    return replace(
        known,
        gyro_bias=known.gyro_bias + sigmas[0] * normal[0],
        gyro_scale=known.gyro_scale + sigmas[1] * normal[1],
        accelerometer_bias=known.accelerometer_bias + sigmas[2] * normal[2],
        accelerometer_scale=known.accelerometer_scale + sigmas[3] * normal[3],
    )


def _misaligned(urad: float, normal: Array) -> Array:
    E = np.eye(3)
    E[~np.eye(3, dtype=bool)] = urad * URAD * normal
    return E


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _body(scenario: Scenario, truth: Coefficients, interval_s: float) -> Body:
    site = scenario.site
    x, y, z = (MM * offset for offset in scenario.start.pivot_offset_mm)
    dither = scenario.unit.dither
    return Body(
        interval_s=interval_s,
        gravity=site.gravity,
        omega_ie_n=earth_rate_n(site.latitude_rad),
        motor=_shaking(scenario.motor, interval_s),
        pivot_to_origin_b=(x, y, z),
        A=_inverse(truth.C_ba),
        r_b=np.zeros((3, 3)) if truth.r_b is None else truth.r_b,
        case=_dithering(scenario, truth, interval_s, dither.case_reaction if dither else 0.0),
    )


def _shaking(motor: Motor | None, interval_s: float) -> Shaking:
    if motor is None:
        return Shaking((0.0, 0.0, 0.0), 0.0, np.zeros(2))
    east, north, up = (1e-3 * STANDARD_GRAVITY * mg for mg in motor.mg)
    cycles = split_cycles(motor.frequency_hz, interval_s)
    return Shaking((east, north, up), 2.0 * pi * motor.frequency_hz, cycles)


def _dithering(scenario: Scenario, truth: Coefficients, interval_s: float, fraction: float) -> Dithering:
    dither = scenario.unit.dither or Dither(amplitude_arcsec=(0.0, 0.0, 0.0), frequency_hz=(1.0, 1.0, 1.0))
    G = _inverse(truth.C_bg)  # rows: the gyros' sensing directions in b
    frequency_hz = np.array(dither.frequency_hz)
    return Dithering(
        axes_b=G / np.linalg.norm(G, axis=1, keepdims=True),
        amplitude_rad=fraction * np.array(dither.amplitude_arcsec) * ARCSEC,
        rate=2.0 * pi * frequency_hz,
        cycles=split_cycles(frequency_hz, interval_s),
        phase=_generator(scenario.seed, 4).random(3),
    )


def _counts(layout: Layout, limits: Saturation) -> _Counts:
    counts = _Counts(np.full(6, np.nan), np.zeros(6, np.bool_), np.full(6, -np.inf), np.full(6, np.inf))
    converted = constants(layout)[0]
    for first, name, sensor, pulses in (
        (0, "gyro", layout.gyro, limits.gyro_pulses),
        (3, "accelerometer", layout.accelerometer, limits.accelerometer_pulses),
    ):
        is_rate = sensor.values is Values.RATE
        for k, axis in enumerate(sensor.axes):
            if axis is None:
                continue
            m = first + k
            counts.quantum[m] = sensor.per_count[k] * (layout.interval_ns * NS if is_rate else 1.0)
            counts.is_whole[m] = sensor.in_pulses or not (axis.is_float or is_rate)
            lowest, highest = converted[name]["lowest"][k], converted[name]["highest"][k]
            if sensor.values is Values.TOTAL:  # n bits distinguish as many increments as a signed number
                lowest, highest = 1 - (1 << (axis.bits - 1)), (1 << (axis.bits - 1)) - 1
            if sensor.in_pulses:
                lowest, highest = max(lowest, -pulses), min(highest, pulses)
            counts.lowest[m], counts.highest[m] = lowest, highest
    return counts


def _electronics(scenario: Scenario, truth: Coefficients, layout: Layout) -> _Electronics:
    unit, interval_s = scenario.unit, layout.interval * NS
    dither, temperature = unit.dither, unit.temperature
    settles = temperature.settles_at_degc
    G = _inverse(truth.C_bg)
    terms = truth.temperature or TemperatureTerms(0.0, 0.0, 0.0)
    step_at_s, steps = _bias_changes(scenario)
    return _Electronics(
        interval_s=interval_s,
        G=G,
        gyro_scale=truth.gyro_scale,
        gyro_bias=truth.gyro_bias,
        gyro_bias_per_k=terms.gyro_bias,
        gyro_scale_per_k=terms.gyro_scale,
        gyro_noise=unit.noise.arw_deg_per_sqrt_h * DEG_PER_SQRT_H * interval_s**0.5,
        dither=_dithering(scenario, truth, interval_s, dither.in_increments if dither else 0.0),
        accelerometer_scale=truth.accelerometer_scale,
        accelerometer_bias=truth.accelerometer_bias,
        accelerometer_bias_per_k=terms.accelerometer_bias,
        accelerometer_scale_per_k=terms.accelerometer_scale,
        quadratic=truth.quadratic,
        half_asymmetry=0.5 * truth.asymmetry,
        accelerometer_noise=unit.noise.vrw_m_s_per_sqrt_h * PER_SQRT_H * interval_s**0.5,
        counts=_counts(layout, unit.saturation),
        step_at_s=step_at_s,
        steps=steps,
        reference_degc=terms.reference_degc,
        start_degc=temperature.start_degc,
        slope_k_per_s=temperature.slope_k_per_h / 3600.0,
        rise_k=0.0 if settles is None else settles - temperature.start_degc,
        time_constant_s=temperature.time_constant_s or 1.0,
    )


def _bias_changes(scenario: Scenario) -> tuple[Array, Array]:
    """Return the times of the bias steps and of the wander, in order, and the sums before each of them."""
    steps = scenario.unit.bias_steps
    at_s, changes = np.zeros(len(steps)), np.zeros((len(steps), 6))
    for k, step in enumerate(steps):
        at_s[k] = step.at_s
        changes[k, :3] = np.array(step.gyro_deg_per_h) * DEG_PER_H
        changes[k, 3:] = np.array(step.accelerometer_ug) * UG
    wanders_at_s, wanders = _wander(scenario)
    at_s, changes = np.append(at_s, wanders_at_s), np.concatenate([changes, wanders])
    order = np.argsort(at_s, kind="stable")
    sums = np.concatenate([np.zeros((1, 6)), np.cumsum(changes[order], axis=0)])
    return at_s[order], sums


def _wander(scenario: Scenario) -> tuple[Array, Array]:
    """Return times and sizes of the steps of Gauss-Markov processes."""
    wander = scenario.unit.bias_wander
    if wander is None:
        return np.zeros(0), np.zeros((0, 6))
    interval_s = _WANDER_STEP * wander.time_constant_s
    duration_s = sum(motion.duration_s for motion in scenario.motions)
    normal = _generator(scenario.seed, 8).standard_normal((1 + int(duration_s / interval_s), 6))
    left = exp(-_WANDER_STEP)
    values = np.empty_like(normal)
    values[0] = normal[0]
    for k in range(1, len(normal)):
        values[k] = left * values[k - 1] + sqrt(1.0 - left**2) * normal[k]
    values *= np.repeat([wander.gyro_deg_per_h * DEG_PER_H, wander.accelerometer_ug * UG], 3)
    return interval_s * np.arange(len(values), dtype=np.float64), np.diff(values, axis=0, prepend=0.0)


def _truth(pulses: Records, own: Integrals) -> Records:
    truth = np.empty(pulses.size, TRUTH)
    truth["counter"] = pulses["counter"]
    truth["t_s"] = pulses["elapsed_ns"] * NS
    truth["dtheta_b"], truth["dv_b"] = own.dtheta_b, own.dv_b
    truth["omega_ib_b"], truth["C_nb"] = own.omega_ib_b, own.C_nb
    return truth


@kernel
def _count(
    unit: _Electronics,
    first: int,
    dtheta_b: Array,
    velocity: Array,
    noise: Array,
    carry: Array,
    increments: Array,
    degc: Array,
    overflow: np.ndarray,
) -> None:
    """Fill `increments` (n, 6) from sample `first` on; `carry` (6,) holds the fraction of a count."""
    tau = unit.interval_s
    before = _dither_angle(unit.dither, first)
    for i in range(dtheta_b.shape[0]):
        t = (first + i + 1) * tau
        degc[i] = (
            unit.start_degc + unit.slope_k_per_s * t + unit.rise_k * (1.0 - exp(-t / unit.time_constant_s))
        )
        warmer = degc[i] - unit.reference_degc
        angle_now = _dither_angle(unit.dither, first + i + 1)
        gyro_step, accelerometer_step = _bias_change(unit, t)
        angle_b = (
            dtheta_b[i, 0] + tau * (unit.gyro_bias[0] + warmer * unit.gyro_bias_per_k[0] + gyro_step[0]),
            dtheta_b[i, 1] + tau * (unit.gyro_bias[1] + warmer * unit.gyro_bias_per_k[1] + gyro_step[1]),
            dtheta_b[i, 2] + tau * (unit.gyro_bias[2] + warmer * unit.gyro_bias_per_k[2] + gyro_step[2]),
        )
        overflow[i] = False
        for m in range(3):
            angle = dot(row(unit.G, m), angle_b) + angle_now[m] - before[m] + unit.gyro_noise * noise[i, m]
            scale = unit.gyro_scale[m] * (1.0 + warmer * unit.gyro_scale_per_k[m])
            increments[i, m], is_over = _sent(angle / scale, unit.counts, carry, m)
            overflow[i] |= is_over
        for m in range(3):
            bias = (
                unit.accelerometer_bias[m] + warmer * unit.accelerometer_bias_per_k[m] + accelerometer_step[m]
            )
            speed = _input(unit, m, velocity[i, m]) + tau * bias + unit.accelerometer_noise * noise[i, 3 + m]
            scale = unit.accelerometer_scale[m] * (1.0 + warmer * unit.accelerometer_scale_per_k[m])
            increments[i, 3 + m], is_over = _sent(speed * scale, unit.counts, carry, 3 + m)
            overflow[i] |= is_over
        before = angle_now


@kernel
def _input(unit: _Electronics, axis: int, velocity: float) -> float:
    """Return what an accelerometer that is not linear makes of a velocity: two steps of a fixed point."""
    speed = velocity
    for _ in range(2):  # to 1e-6 of the term, itself below 1e-3
        curve = unit.quadratic[axis] * speed * speed / unit.interval_s
        speed = velocity + curve + unit.half_asymmetry[axis] * abs(speed)
    return speed


@kernel
def _bias_change(unit: _Electronics, t: float) -> tuple[Vector, Vector]:
    """Return the sum of the bias changes before the end of a sample, of gyros and accelerometers."""
    total = unit.steps[np.searchsorted(unit.step_at_s, t)]
    return (total[0], total[1], total[2]), (total[3], total[4], total[5])


@kernel
def _dither_angle(dither: Dithering, interval: int) -> Vector:
    """Return the dither angle in the gyro increments at the start of an interval."""
    a = dither.amplitude_rad
    return (
        a[0] * sin(2.0 * pi * (cycles_at(dither.cycles[0], interval) + dither.phase[0])),
        a[1] * sin(2.0 * pi * (cycles_at(dither.cycles[1], interval) + dither.phase[1])),
        a[2] * sin(2.0 * pi * (cycles_at(dither.cycles[2], interval) + dither.phase[2])),
    )


@kernel
def _sent(increment: float, counts: _Counts, carry: Array, axis: int) -> tuple[float, bool]:
    """Return what an axis sends of an increment, and whether that was too large for it."""
    quantum = counts.quantum[axis]
    number = increment / quantum
    if counts.is_whole[axis]:
        number = _quantise(number, carry, axis)
    lowest, highest = counts.lowest[axis], counts.highest[axis]
    return min(max(number, lowest), highest) * quantum, number < lowest or number > highest


@kernel
def _quantise(number: float, carry: Array, axis: int) -> float:
    total = carry[axis] + number
    whole: float = np.rint(total)
    carry[axis] = total - whole
    return whole
