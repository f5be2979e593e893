"""From pulses to compensated increments in body axes (mathematics, section 1).

    dtheta_b = C_bg @ (k_g N_g) - b_g T
    dv_b     = C_ba @ (dv_a - dv_r)
    dv_a     = e - (k2 e^2 / T + |e| / 2 asymmetry) - skew (f_late - f_early)        e = N_a / K - b_a T

Scale factors and biases follow the temperature; k2 is the quadratic term. With a positive skew, where the
intervals of the accelerometers end later than those of the gyros, f_late is the mean force on the sensing
axes over the interval itself and f_early that over the one before; with a negative one they are those of the
one after and of the interval itself, which makes the output one sample later. Over any run the skew's part
adds up to that of its two ends. The size effect `dv_r` (`imudrv.imu.size_effect`) needs the angular rate at
both ends of the interval, an FIR over the angle increments around them. Where the filter has
too few neighbours (the first samples, those beside a gap) a sample is output without size-effect
compensation, its flag clear. A long interval, recovered from running totals, enters the filter as equal
parts, one for each sample interval; as the tangential part of the size effect telescopes, their error does
not stay in velocity.
"""

from dataclasses import replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.rate_filter import RateFilter, RateFilterName
from imudrv.imu.rate_filter import rate_filter as make_filter
from imudrv.imu.size_effect import SIZE_EFFECT, SizeEffect, dv_r, size_effect_constants, unpack_size_effect
from imudrv.kernels import kernel
from imudrv.records import INCREMENTS, PULSES, Flag, Records
from imudrv.units import MS, NS
from imudrv.vectors import Matrix, Vector, add, matrix, put, rotate, row, scale, subtract, times, vector_at
from imudrv.wire.layout import Layout

MAX_TAPS: Final = 32
"""Longest rate filter."""

LEAVES_OUT_SKEW: Final = (
    "skew not compensated: a negative one needs a rate filter with a lag, centred or dither"
)
"""Message to the user about `Compensator.leaves_out_skew`."""

CONSTANTS: Final = np.dtype(
    [
        ("gyro_in_pulses", np.bool_),  # otherwise the bits of a float64
        ("accelerometer_in_pulses", np.bool_),
        ("gyro_scale", np.float64, 3),  # rad per pulse
        ("gyro_bias", np.float64, 3),  # rad/s, body axes
        ("C_bg", np.float64, (3, 3)),
        ("accelerometer_scale", np.float64, 3),  # pulses per m/s
        ("accelerometer_bias", np.float64, 3),  # m/s^2, sensing axes
        ("C_ba", np.float64, (3, 3)),
        ("is_nonlinear", np.bool_),
        ("quadratic", np.float64, 3),  # s^2/m
        ("half_asymmetry", np.float64, 3),
        ("skew_s", np.float64),  # 0: not compensated
        ("reference_degc", np.float64),
        ("low_degc", np.float64),  # above high_degc: no temperature compensation
        ("high_degc", np.float64),
        ("gyro_scale_per_k", np.float64, 3),  # relative
        ("gyro_bias_per_k", np.float64, 3),
        ("accelerometer_scale_per_k", np.float64, 3),  # relative
        ("accelerometer_bias_per_k", np.float64, 3),
        ("channels", np.int64, 4),  # temperatures of the gyros and of each accelerometer; -1: not measured
        ("has_size_effect", np.bool_),
        ("size_effect", SIZE_EFFECT),
        ("counter_step", np.int64),  # from a sample to the next
        ("interval_ns", np.int64),  # of one sample
        ("lag", np.int64),  # of the rate filter, samples
        ("length", np.int64),  # of its taps
        ("lacks_axes", np.bool_),  # the unit has no gyro or accelerometer in some axes
        ("lacks_gyro", np.int64, 3),  # 1 for such an axis,
        ("lacks_accelerometer", np.int64, 3),
        ("lacks_dtheta_b", np.int64, 3),  # and for the axes of the body that it would be a part of
        ("lacks_dv_b", np.int64, 3),
        ("taps", np.float64, MAX_TAPS),  # 1/s, oldest first
    ],
    align=True,
)
"""Constants of the kernels."""

STATE: Final = np.dtype(
    [
        ("force_known", np.bool_),
        ("force", np.float64, 3),  # mean over the latest row, sensing axes, m/s^2
        ("parts", np.int64),  # sample intervals since the last gap
        ("head_end", np.int64),  # `parts` at the end of the first row that waits
        ("rate_known", np.bool_),
        ("rate", np.float64, 3),  # at the end of the last finished row, rad/s
        ("slot", np.int64),  # of the oldest part in `history`
        ("history", np.float64, (2 * MAX_TAPS, 3)),  # angles of the latest parts, see `_remember`
        ("waiting", np.int64),  # increments whose rates are not known yet
    ],
    align=True,
)
"""State of the kernels between calls."""

CompensatorArrays: TypeAlias = tuple[Records, Records, Records]
"""Constants, state, increments that wait."""

_ZERO: Final = (0.0, 0.0, 0.0)
_MISSING_BEFORE: Final = int(Flag.MISSING_BEFORE)
_TEMPERATURE_RANGE: Final = int(Flag.TEMPERATURE_RANGE)
_SIZE_EFFECT: Final = int(Flag.SIZE_EFFECT)


class Compensator:
    """Compensation of one unit's pulses; any cut of them into pieces gives the same bits.

    Parameters
    ----------
    coefficients : Coefficients
        The calibration.
    layout : Layout
        Layout of the profile: sample interval, axes, temperature channels.
    rate_filter : {'causal', 'centred', 'dither'}
        Filter of the rate for the size effect, see `imudrv.imu.rate_filter`. Its lag delays increments only
        where there is a size effect to compensate.

    Attributes
    ----------
    has_size_effect : bool
        Whether there is a size effect to compensate.
    leaves_out_skew : bool
        Whether the certificate has a negative skew, which a filter without lag does not compensate.

    Raises
    ------
    InputError
        The calibration is of other numbers than the unit sends, see `require_sensors`, or its skew is longer
        than a sample interval.
    """

    def __init__(
        self, coefficients: Coefficients, layout: Layout, rate_filter: RateFilterName = "causal"
    ) -> None:
        require_sensors(coefficients, layout)
        gyro, accelerometer = layout.missing_axes
        if gyro or len(accelerometer) == 3:
            coefficients = replace(coefficients, r_b=None)  # the size effect needs all angular rates
        self.has_size_effect = coefficients.r_b is not None
        _require_short_skew(coefficients.skew_s, layout)
        rates = make_filter(rate_filter, layout.interval_ns)
        self.leaves_out_skew = coefficients.skew_s < 0.0 and rates.lag == 0
        if self.leaves_out_skew or len(accelerometer) == 3:
            coefficients = replace(coefficients, skew_s=0.0)
        self._samples_type = layout.samples_type
        self._constants = _constants(coefficients, layout, rates)
        self._state = np.zeros(1, STATE)
        self._waiting = np.zeros(MAX_TAPS, INCREMENTS)

    @property
    def arrays(self) -> CompensatorArrays:
        """Arguments of `compensate`."""
        return self._constants, self._state, self._waiting

    @property
    def lag(self) -> int:
        """Delay of the output, samples."""
        if self.has_size_effect:
            return int(self._constants[0]["lag"])
        return 1 if self._constants[0]["skew_s"] < 0.0 else 0

    def feed(self, pulses: Records) -> Records:
        """Compensate pulses.

        Parameters
        ----------
        pulses : ndarray of `imudrv.records.samples_type`
            In order.

        Returns
        -------
        ndarray of INCREMENTS
            Those that are ready; `t_ns` is the time by the counter, `elapsed_ns` of the pulses. NaN for a
            body axis that an axis missing in the unit is a part of.
        """
        out = np.empty(int(self._state[0]["waiting"]) + len(pulses), INCREMENTS)
        pulses = pulses.astype(self._samples_type, copy=False).view(PULSES)
        return out[: compensate(pulses, *self.arrays, out)]

    def close(self) -> Records:
        """End the stream.

        Returns
        -------
        ndarray of INCREMENTS
            Those that still waited for a rate, without size-effect compensation, or for a force.
        """
        rest: Records = self._waiting[: self._state[0]["waiting"]].copy()
        _close(rest, self._constants)
        self._state[:] = np.zeros(1, STATE)
        return rest


def require_sensors(coefficients: Coefficients, layout: Layout) -> None:
    """Check that a calibration is of the numbers that the unit sends.

    Parameters
    ----------
    coefficients : Coefficients
        The calibration.
    layout : Layout
        Layout of the profile.

    Raises
    ------
    InputError
        It is of pulses, and the unit sends other units, or the other way round.
    """
    for name, sensor, of_pulses, key in (
        ("gyro", layout.gyro, coefficients.gyro_in_pulses, "scale_arcsec_per_pulse"),
        ("accelerometer", layout.accelerometer, coefficients.accelerometer_in_pulses, "scale_pulse_per_m_s"),
    ):
        if any(sensor.axes) and sensor.in_pulses != of_pulses:
            keys = (key, "scale") if sensor.in_pulses else ("scale", key)
            raise InputError(
                f"{name}: expected a calibration with {name}.{keys[0]} for {layout.name}, which sends "
                f"{'pulses' if sensor.in_pulses else 'other units than pulses'}, got one with "
                f"{name}.{keys[1]}; use the certificate of the unit, or the right profile"
            )


def _require_short_skew(skew_s: float, layout: Layout) -> None:
    if abs(skew_s) > layout.interval_ns * NS:
        raise InputError(
            f"skew_ms: expected at most a sample interval of {layout.name}, {layout.interval_ns / 1e6:g} ms, "
            f"got {skew_s / MS:g} ms; use the certificate of the unit, or the right profile"
        )


def _constants(c: Coefficients, layout: Layout, rate_filter: RateFilter) -> Records:
    """Fill in the one row of `CONSTANTS`."""
    constants = np.zeros(1, CONSTANTS)
    k = constants[0]
    k["gyro_in_pulses"] = layout.gyro.is_counted
    k["accelerometer_in_pulses"] = layout.accelerometer.is_counted
    k["gyro_scale"], k["gyro_bias"], k["C_bg"] = c.gyro_scale, c.gyro_bias, c.C_bg
    k["accelerometer_scale"], k["accelerometer_bias"] = c.accelerometer_scale, c.accelerometer_bias
    k["C_ba"] = c.C_ba
    k["quadratic"], k["half_asymmetry"], k["skew_s"] = c.quadratic, 0.5 * c.asymmetry, c.skew_s
    k["is_nonlinear"] = bool(np.any(c.quadratic) or np.any(c.asymmetry))
    k["low_degc"], k["high_degc"], k["channels"] = np.inf, -np.inf, -1
    if (t := c.temperature) is not None:
        k["reference_degc"], k["low_degc"], k["high_degc"] = t.reference_degc, t.low_degc, t.high_degc
        k["gyro_scale_per_k"], k["gyro_bias_per_k"] = t.gyro_scale, t.gyro_bias
        k["accelerometer_scale_per_k"] = t.accelerometer_scale
        k["accelerometer_bias_per_k"] = t.accelerometer_bias
        k["channels"] = _temperature_channels(layout)
    interval_s, taps = layout.interval_ns * NS, rate_filter.taps
    k["counter_step"] = layout.counter_step
    k["interval_ns"], k["lag"], k["length"] = layout.interval_ns, rate_filter.lag, len(taps)
    k["taps"][: len(taps)] = taps / interval_s
    if c.r_b is not None:
        mean_of_ends_s = interval_s if rate_filter.middle_from_ends else 0.0
        k["has_size_effect"] = True
        k["size_effect"] = size_effect_constants(c.C_ba, c.r_b, mean_of_ends_s)[0]
    for sensor, axes, out, C in zip(
        ("lacks_gyro", "lacks_accelerometer"),
        layout.missing_axes,
        ("lacks_dtheta_b", "lacks_dv_b"),
        (np.asarray(c.C_bg), np.asarray(c.C_ba)),
        strict=True,
    ):
        k["lacks_axes"] |= bool(axes)
        k[sensor][axes] = 1
        k[out] = C[:, axes].any(axis=1)
    return constants


def _temperature_channels(layout: Layout) -> NDArray[np.int64]:
    """Find the temperature channel of the gyros and of each accelerometer; -1 where none is measured."""
    names = layout.temperature_names

    def channel(*candidates: str) -> int:
        return next((names.index(c) for c in candidates if c in names), -1)

    accelerometers = [channel(f"accelerometer_{axis}", "accelerometer") for axis in "xyz"]
    return np.array([channel("gyro"), *accelerometers], np.int64)


class _AtTemperature(NamedTuple):
    """Scale and bias of all axes at a temperature."""

    gyro_scale: Vector  # rad per pulse
    gyro_bias: Vector  # rad/s
    accelerometer_scale: Vector  # m/s per pulse
    accelerometer_bias: Vector  # m/s^2
    in_range: bool


@kernel
def compensate(
    pulses: Records, constants: Records, state: Records, waiting: Records, increments: Records
) -> int:
    """Compensate pulses.

    The `dv_b` of an increment that waits for its rate still is on the axes of the accelerometers.

    Parameters
    ----------
    pulses : ndarray of PULSES
        In order.
    constants, state, waiting
        `Compensator.arrays`.
    increments : ndarray of INCREMENTS
        Receives those that waited and one for each of the pulses.

    Returns
    -------
    int
        Number of increments that are ready; the others wait.
    """
    c, s = constants[0], state[0]
    count = s["waiting"]
    for k in range(count):
        increments[k] = waiting[k]
    out = increments[: count + len(pulses)]
    _scale(pulses, out[count:], c)
    if c["skew_s"] != 0.0:
        _remove_skew(out, count, c["skew_s"], s)
    if c["has_size_effect"]:
        ready = _remove_size_effect(out, count, c, s)
    else:
        ready = len(out)
        if c["skew_s"] < 0.0 and ready > 0:
            ready -= 1  # waits for the force after it
        _finish_plainly(out[:ready], matrix(c["C_ba"]))
    s["waiting"] = len(out) - ready
    for k in range(s["waiting"]):
        waiting[k] = out[ready + k]
    if c["lacks_axes"]:
        _remove_lacking(out[:ready], c)
    return ready


@kernel
def _close(rest: Records, constants: Records) -> None:
    """Finish the increments that wait, at the end of the stream."""
    c = constants[0]
    _finish_plainly(rest, matrix(c["C_ba"]))
    if c["lacks_axes"]:
        _remove_lacking(rest, c)


@kernel
def _present(values: Vector, lacks: NDArray[np.int64]) -> Vector:
    """Return the increments of a sensor, 0 where the unit lacks the axis."""
    x, y, z = values
    return 0.0 if lacks[0] else x, 0.0 if lacks[1] else y, 0.0 if lacks[2] else z


@kernel
def _remove_lacking(increments: Records, c: np.void) -> None:
    """Set to NaN what an axis that the unit lacks would be a part of."""
    for i in range(len(increments)):
        for axis in range(3):
            if c["lacks_dtheta_b"][axis]:
                increments[i]["dtheta_b"][axis] = np.nan
            if c["lacks_dv_b"][axis]:
                increments[i]["dv_b"][axis] = np.nan


@kernel
def _scale(pulses: Records, out: Records, c: np.void) -> None:
    """Apply scale, bias and temperature; rotate the angles into body axes."""
    if len(pulses) == 0:
        return
    C_bg, channels = matrix(c["C_bg"]), c["channels"]
    degc = pulses[0]["temperature_degc"]
    at = _at_temperature(degc, c)
    for i in range(len(pulses)):
        sample, increment = pulses[i], out[i]
        T = sample["interval_ns"] * NS
        if _differ(sample["temperature_degc"], degc, channels):
            degc = sample["temperature_degc"]
            at = _at_temperature(degc, c)
        gyro = _numbers(sample["gyro"], c["gyro_in_pulses"])
        accelerometer = _numbers(sample["accelerometer"], c["accelerometer_in_pulses"])
        if c["lacks_axes"]:
            gyro = _present(gyro, c["lacks_gyro"])
            accelerometer = _present(accelerometer, c["lacks_accelerometer"])
        gyro, accelerometer = times(gyro, at.gyro_scale), times(accelerometer, at.accelerometer_scale)
        put(increment["dtheta_b"], 0, subtract(rotate(C_bg, gyro), scale(T, at.gyro_bias)))
        e = subtract(accelerometer, scale(T, at.accelerometer_bias))
        put(increment["dv_b"], 0, _linear(e, T, c) if c["is_nonlinear"] else e)
        increment["counter"], increment["t_ns"] = sample["counter"], sample["elapsed_ns"]
        if c["counter_step"] != 1:
            increment["counter"] //= c["counter_step"]
        increment["interval_ns"] = sample["interval_ns"]
        increment["flags"] = sample["flags"] if at.in_range else sample["flags"] | _TEMPERATURE_RANGE


@kernel
def _linear(e: Vector, T: float, c: np.void) -> Vector:
    """Subtract the quadratic term and the asymmetry."""
    square = scale(1.0 / T, times(vector_at(c["quadratic"], 0), times(e, e)))
    size = times(vector_at(c["half_asymmetry"], 0), (abs(e[0]), abs(e[1]), abs(e[2])))
    return subtract(subtract(e, square), size)


@kernel
def _remove_skew(out: Records, waiting: int, skew_s: float, s: np.void) -> None:
    """Move velocities, sensing axes, to the intervals of the gyros; the first `waiting` are not new."""
    known, force = s["force_known"], vector_at(s["force"], 0)
    for i in range(waiting, len(out)):
        new = out[i]
        own = scale(1.0 / (new["interval_ns"] * NS), vector_at(new["dv_b"], 0))
        if known and not new["flags"] & _MISSING_BEFORE:
            change = scale(skew_s, subtract(own, force))
            corrected = new if skew_s > 0.0 else out[i - 1]
            put(corrected["dv_b"], 0, subtract(vector_at(corrected["dv_b"], 0), change))
        known, force = True, own
    s["force_known"] = known
    put(s["force"], 0, force)


@kernel
def _numbers(a: NDArray[np.int64], in_pulses: bool) -> Vector:
    """Return the increments of a sensor: pulses, or other numbers from their bits."""
    if in_pulses:
        return float(a[0]), float(a[1]), float(a[2])
    return (
        float(np.int64(a[0]).view(np.float64)),
        float(np.int64(a[1]).view(np.float64)),
        float(np.int64(a[2]).view(np.float64)),
    )


@kernel
def _remove_size_effect(out: Records, waiting: int, c: np.void, s: np.void) -> int:
    """Finish the rows of `out` whose rates become known; return how many. The first `waiting` are not new."""
    interval_ns, lag, length, taps = c["interval_ns"], c["lag"], c["length"], c["taps"]
    C_ba, effect = matrix(c["C_ba"]), unpack_size_effect(c["size_effect"])
    parts, head_end, slot, history = s["parts"], s["head_end"], s["slot"], s["history"]
    rate_known, w0 = s["rate_known"], vector_at(s["rate"], 0)
    ready, i = 0, waiting
    single = 0  # rows of one interval each, without a gap, right before row i in `out`
    while i < len(out):
        if single >= length and rate_known:
            first = i
            i, w0 = _remove_steadily(out, i, c, effect, C_ba, w0)
            for k in range(max(first, i - length), i):
                slot = _remember(history, slot, length, vector_at(out[k]["dtheta_b"], 0))
            parts += i - first
            ready += i - first
            head_end = parts - lag + 1
            single = 0
            continue
        new = out[i]
        if new["flags"] & _MISSING_BEFORE:
            _finish_plainly(out[ready:i], C_ba)
            ready, parts, rate_known, single = i, 0, False, 0
        steps = 1 if new["interval_ns"] == interval_ns else new["interval_ns"] // interval_ns
        dtheta = vector_at(new["dtheta_b"], 0)
        if steps > 1:
            dtheta = dtheta[0] / steps, dtheta[1] / steps, dtheta[2] / steps
        if ready == i:
            head_end = parts + steps
        for _ in range(steps):
            slot = _remember(history, slot, length, dtheta)
            parts += 1
            if ready > i or head_end != parts - lag:
                continue
            head = out[ready]
            known = parts >= length
            w1 = _end_rate(taps, length, history, slot) if known else _ZERO
            if known and rate_known:
                _finish_compensated(head, C_ba, effect, head["interval_ns"] * NS, w0, w1)
            else:
                _finish(head, C_ba, _ZERO)
            w0, rate_known = w1, known
            ready += 1
            if ready <= i:
                following_ns = out[ready]["interval_ns"]
                head_end += 1 if following_ns == interval_ns else following_ns // interval_ns
        single = single + 1 if steps == 1 else 0
        i += 1
    s["parts"], s["head_end"], s["slot"], s["rate_known"] = parts, head_end, slot, rate_known
    put(s["rate"], 0, w0)
    return ready


@kernel
def _remove_steadily(
    out: Records, i: int, c: np.void, effect: SizeEffect, C_ba: Matrix, w0: Vector
) -> tuple[int, Vector]:
    """Finish rows while single intervals follow each other; return the first other row, and the last rate.

    The same bits as `_remove_size_effect` in half the time: the rows that the filter needs are all in `out`.
    """
    interval_ns, lag, length, taps = c["interval_ns"], c["lag"], c["length"], c["taps"]
    T = interval_ns * NS
    while i < len(out):
        new = out[np.uint64(i)]  # unsigned: no test for an index from the end
        if new["interval_ns"] != interval_ns or new["flags"] & _MISSING_BEFORE:
            break
        w1 = _ZERO
        for j in range(length):
            dtheta = out[np.uint64(i + 1 - length + j)]["dtheta_b"]
            w1 = add(w1, scale(taps[np.uint64(j)], vector_at(dtheta, 0)))
        _finish_compensated(out[np.uint64(i - lag)], C_ba, effect, T, w0, w1)
        w0 = w1
        i += 1
    return i, w0


@kernel
def _finish_compensated(
    increment: np.void, C_ba: Matrix, effect: SizeEffect, T: float, w0: Vector, w1: Vector
) -> None:
    """Subtract the size effect and rotate the velocity into body axes."""
    increment["flags"] |= _SIZE_EFFECT
    _finish(increment, C_ba, dv_r(effect, T, w0, vector_at(increment["dtheta_b"], 0), w1))


@kernel
def _finish(increment: np.void, C_ba: Matrix, excess: Vector) -> None:
    put(increment["dv_b"], 0, rotate(C_ba, subtract(vector_at(increment["dv_b"], 0), excess)))


@kernel
def _finish_plainly(rows: Records, C_ba: Matrix) -> None:
    """Rotate the velocity of rows into body axes, the size effect in it."""
    for i in range(len(rows)):
        _finish(rows[i], C_ba, _ZERO)


@kernel
def _end_rate(taps: Array, length: int, history: Array, oldest: int) -> Vector:
    """Rate at the end of the part `lag` before the newest one, rad/s."""
    w = _ZERO
    for j in range(length):
        w = add(w, scale(taps[j], row(history, oldest + j)))
    return w


@kernel
def _remember(history: Array, slot: int, length: int, dtheta: Vector) -> int:
    """Put an angle in the place of the oldest one; return the next place.

    Each is stored twice, so that the latest `length` ones always are in sequence.
    """
    for at in (slot, slot + length):
        history[at, 0], history[at, 1], history[at, 2] = dtheta
    return slot + 1 if slot + 1 < length else 0


@kernel
def _differ(degc: Array, before: Array, channels: NDArray[np.int64]) -> bool:
    """Whether a temperature that is used has changed."""
    for k in range(len(channels)):  # noqa: SIM110  numba does not compile any()
        if channels[k] >= 0 and degc[channels[k]] != before[channels[k]]:
            return True
    return False


@kernel
def _at_temperature(degc: Array, c: np.void) -> _AtTemperature:
    """Scale and bias at a sample's temperatures."""
    low, high, channels = c["low_degc"], c["high_degc"], c["channels"]
    gyro, accelerometer, in_range = 0.0, _ZERO, True  # kelvins from the reference
    if low <= high:
        reference = c["reference_degc"]
        gyro = _kelvin(degc, channels[0], reference)
        accelerometer = (
            _kelvin(degc, channels[1], reference),
            _kelvin(degc, channels[2], reference),
            _kelvin(degc, channels[3], reference),
        )
        for k in range(len(channels)):
            in_range = in_range and channels[k] >= 0 and low <= degc[channels[k]] <= high
    K = _scale_at(c["accelerometer_scale"], c["accelerometer_scale_per_k"], accelerometer)
    return _AtTemperature(
        _scale_at(c["gyro_scale"], c["gyro_scale_per_k"], (gyro, gyro, gyro)),
        add(vector_at(c["gyro_bias"], 0), scale(gyro, vector_at(c["gyro_bias_per_k"], 0))),
        (1.0 / K[0], 1.0 / K[1], 1.0 / K[2]),
        add(
            vector_at(c["accelerometer_bias"], 0),
            times(accelerometer, vector_at(c["accelerometer_bias_per_k"], 0)),
        ),
        in_range,
    )


@kernel
def _scale_at(reference: Array, per_k: Array, kelvin: Vector) -> Vector:
    """Scale factors that far from the reference temperature."""
    change = times(vector_at(per_k, 0), kelvin)
    return times(vector_at(reference, 0), (1.0 + change[0], 1.0 + change[1], 1.0 + change[2]))


@kernel
def _kelvin(degc: Array, channel: int, reference_degc: float) -> float:
    """Temperature above the reference; 0 where it is not known."""
    if channel < 0 or np.isnan(degc[channel]):
        return 0.0
    return float(degc[channel]) - reference_degc
