"""From pulses to compensated increments in body axes (mathematics, section 1).

    dtheta_b = C_bg @ (k_g N_g) - b_g T
    dv_b     = C_ba @ (N_a / K - b_a T - dv_r)

with the size effect of accelerometer i, sensing along a_i at r_i, over an interval T with the rates w0 and w1
at its ends and wm = dtheta_b / T, or (w0 + w1) / 2 where the filter is to take dither out of it too:

    dv_r,i = a_i . { (w1 - w0) x r_i + T/6 ([w0 x]^2 + 4 [wm x]^2 + [w1 x]^2) r_i }

The tangential part telescopes, so that the quantisation of a rate never adds up in velocity. For speed both
parts are written as inner products with what does not change: a . (d x r) = d . (r x a), and a . [w x]^2 r =
sum of w_j w_k times the fixed `q` of a and r.

The rates come from an FIR that needs neighbours. Where there are none (the first samples, those beside a gap)
a sample is handed on without the size effect, its flag clear. A long interval, bridged by running totals,
counts in the FIR as equal parts; as the tangential part telescopes, its error does not stay in velocity.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.imu.rate_filter import RateFilter
from imudrv.kernels import kernel
from imudrv.records import INCREMENTS, Flag, Records
from imudrv.units import NS
from imudrv.wire.layout import Layout

Array = NDArray[np.float64]


def _zeros() -> Array:
    return np.zeros(3)


@dataclass(frozen=True)
class TemperatureTerms:
    """How bias and scale follow the temperature.

    Parameters
    ----------
    reference_degc, low_degc, high_degc : float
        Where the terms vanish, and the range they were found in.
    gyro_bias, gyro_scale, accelerometer_bias, accelerometer_scale : ndarray, shape (3,)
        rad/s, 1, m/s^2 and 1 per kelvin.
    """

    reference_degc: float
    low_degc: float
    high_degc: float
    gyro_bias: Array = field(default_factory=_zeros)
    gyro_scale: Array = field(default_factory=_zeros)
    accelerometer_bias: Array = field(default_factory=_zeros)
    accelerometer_scale: Array = field(default_factory=_zeros)


@dataclass(frozen=True)
class Coefficients:
    """A calibration in SI units, as the compensation reads it.

    Parameters
    ----------
    gyro_scale : ndarray, shape (3,)
        rad a pulse.
    gyro_bias : ndarray, shape (3,)
        rad/s, body axes.
    C_bg : ndarray, shape (3, 3)
        Gyro axes to body.
    accelerometer_scale : ndarray, shape (3,)
        Pulses per m/s.
    accelerometer_bias : ndarray, shape (3,)
        m/s^2, on the sensing axes.
    C_ba : ndarray, shape (3, 3)
        Accelerometer axes to body.
    r_b : ndarray, shape (3, 3), optional
        Row i: sensing point of accelerometer i, m, body axes. None: no size-effect compensation.
    temperature : TemperatureTerms, optional
        None: no temperature terms.
    """

    gyro_scale: Array
    gyro_bias: Array
    C_bg: Array
    accelerometer_scale: Array
    accelerometer_bias: Array
    C_ba: Array
    r_b: Array | None = None
    temperature: TemperatureTerms | None = None


# Where each constant begins in the kernel's array of constants.
_KG, _BG, _CBG, _KA, _BA, _CBA, _C, _Q, _TREF, _KG_T, _BG_T, _KA_T, _BA_T, _T_ENDS = (
    *(0, 3, 6, 15, 18, 21, 30, 39, 57),
    *(60, 63, 66, 69, 72),
)
_CONSTANTS: Final = 73
_NOTHING: Final = np.zeros(0, INCREMENTS)

_MISSING_BEFORE: Final = int(Flag.MISSING_BEFORE)
_TEMPERATURE_RANGE: Final = int(Flag.TEMPERATURE_RANGE)
_SIZE_EFFECT: Final = int(Flag.SIZE_EFFECT)


class Compensator:
    """Compensation of one unit's pulses; feed them in any pieces, the output is the same bits.

    Parameters
    ----------
    coefficients : Coefficients
        The calibration.
    layout : Layout
        Of the profile: sample interval and temperature channels.
    rate_filter : RateFilter
        For the size effect. Its lag holds increments back only where there is a size effect to compensate.

    Attributes
    ----------
    has_size_effect : bool
        Whether there is a size effect to compensate.
    """

    def __init__(self, coefficients: Coefficients, layout: Layout, rate_filter: RateFilter) -> None:
        self._interval_ns = layout.interval_ns
        self.has_size_effect = coefficients.r_b is not None
        self._constants = _constants(coefficients)
        if rate_filter.middle_from_ends:
            self._constants[_T_ENDS] = layout.interval_ns * NS
        terms = coefficients.temperature
        self._range = (terms.low_degc, terms.high_degc) if terms else (np.inf, -np.inf)
        self._channels = _temperature_channels(layout) if terms else np.full(4, -1, np.int64)
        self._taps = rate_filter.taps / (layout.interval_ns * NS)
        self._lag = rate_filter.lag
        self._history = np.zeros((2 * len(rate_filter.taps), 3))
        self._rate = np.zeros(3)
        self._state = np.zeros(4, np.int64)
        self._waiting = _NOTHING

    @property
    def lag(self) -> int:
        """Samples by which the output is late."""
        return self._lag if self.has_size_effect else 0

    def feed(self, pulses: Records) -> Records:
        """Compensate pulses.

        Parameters
        ----------
        pulses : ndarray of PULSES
            In order.

        Returns
        -------
        ndarray of INCREMENTS
            What is ready; `t_ns` is the time by the counter, `elapsed_ns` of the pulses.
        """
        waiting = len(self._waiting)
        out = np.empty(waiting + len(pulses), INCREMENTS)
        if waiting:
            out[:waiting] = self._waiting
        ready = _compensate(
            pulses,
            out,
            waiting,
            self._constants,
            self._channels,
            self._range,
            self.has_size_effect,
            self._interval_ns,
            self._taps,
            self._lag,
            self._history,
            self._rate,
            self._state,
        )
        self._waiting = out[ready:].copy() if ready < len(out) else _NOTHING
        return out[:ready]

    def close(self) -> Records:
        """End of the stream: increments that still wait for a rate, without their size effect."""
        rest, self._waiting = self._waiting, _NOTHING
        _finish_all(rest, self._constants)
        self._state[:] = 0
        return rest


def _constants(c: Coefficients) -> Array:
    constants = np.zeros(_CONSTANTS)

    def put(at: int, values: Array) -> None:
        constants[at : at + values.size] = values.ravel()

    put(_KG, c.gyro_scale)
    put(_BG, c.gyro_bias)
    put(_CBG, c.C_bg)
    put(_KA, c.accelerometer_scale)
    put(_BA, c.accelerometer_bias)
    put(_CBA, c.C_ba)
    if c.r_b is not None:
        a_b = np.linalg.inv(c.C_ba)
        put(_C, np.cross(c.r_b, a_b))
        put(_Q, np.array([_centripetal(a, r) for a, r in zip(a_b, c.r_b, strict=True)]))
    if c.temperature is not None:
        constants[_TREF] = c.temperature.reference_degc
        put(_KG_T, c.temperature.gyro_scale)
        put(_BG_T, c.temperature.gyro_bias)
        put(_KA_T, c.temperature.accelerometer_scale)
        put(_BA_T, c.temperature.accelerometer_bias)
    return constants


def _centripetal(a: Array, r: Array) -> Array:
    """Factors of (w_x^2, w_y^2, w_z^2, w_x w_y, w_y w_z, w_z w_x) in a . (w (w . r) - r (w . w))."""
    ar = a * r
    x, y, z = 0, 1, 2
    return np.array(
        [
            -ar[y] - ar[z],
            -ar[z] - ar[x],
            -ar[x] - ar[y],
            a[x] * r[y] + a[y] * r[x],
            a[y] * r[z] + a[z] * r[y],
            a[z] * r[x] + a[x] * r[z],
        ]
    )


def _temperature_channels(layout: Layout) -> NDArray[np.int64]:
    """Find the temperature channel of the gyros and of each accelerometer; -1 where none is measured."""
    names = layout.temperature_names

    def channel(*candidates: str) -> int:
        return next((names.index(c) for c in candidates if c in names), -1)

    accelerometers = [channel(f"accelerometer_{axis}", "accelerometer") for axis in "xyz"]
    return np.array([channel("gyro"), *accelerometers], np.int64)


@kernel
def _rotate(m, at, x, y, z):  # type: ignore[no-untyped-def]
    """Multiply a vector by the 3x3 matrix that begins at `at` of `m`."""
    return (
        m[at] * x + m[at + 1] * y + m[at + 2] * z,
        m[at + 3] * x + m[at + 4] * y + m[at + 5] * z,
        m[at + 6] * x + m[at + 7] * y + m[at + 8] * z,
    )


@kernel
def _compensate(  # type: ignore[no-untyped-def]
    pulses, out, filled, m, channels, limits, size_effect, interval_ns, taps, lag, history, rate, state
):
    """Append one increment a row of `pulses` behind the `filled` ones of `out`; how many are then ready.

    The first `filled` rows wait for the rate at their end. Until it is known a row has in `dv_b` what its
    accelerometers felt, on their own axes.
    """
    _scale(pulses, out[filled:], m, channels, limits)
    if size_effect:
        return _move(out, filled, m, interval_ns, taps, lag, history, rate, state)
    _finish_all(out, m)
    return out.shape[0]


@kernel
def _scale(pulses, out, m, channels, limits):  # type: ignore[no-untyped-def]
    """Scale, bias and temperature; the gyros to body axes."""
    if pulses.shape[0] == 0:
        return
    c = pulses[0]["temperature_degc"]
    terms = _at_temperature(c, m, channels, limits)
    (k0, k1, k2), (b0, b1, b2), (s0, s1, s2), (a0, a1, a2), in_range = terms
    for i in range(pulses.shape[0]):
        p, row = pulses[i], out[i]
        T = p["interval_ns"] * NS
        if _differ(p["temperature_degc"], c, channels):
            c = p["temperature_degc"]
            terms = _at_temperature(c, m, channels, limits)
            (k0, k1, k2), (b0, b1, b2), (s0, s1, s2), (a0, a1, a2), in_range = terms
        d0, d1, d2 = _rotate(m, _CBG, p["gyro"][0] * k0, p["gyro"][1] * k1, p["gyro"][2] * k2)
        row["dtheta_b"][0], row["dtheta_b"][1], row["dtheta_b"][2] = d0 - b0 * T, d1 - b1 * T, d2 - b2 * T
        row["dv_b"][0] = p["accelerometer"][0] * s0 - a0 * T
        row["dv_b"][1] = p["accelerometer"][1] * s1 - a1 * T
        row["dv_b"][2] = p["accelerometer"][2] * s2 - a2 * T
        row["counter"], row["t_ns"], row["interval_ns"] = p["counter"], p["elapsed_ns"], p["interval_ns"]
        row["flags"] = p["flags"] if in_range else p["flags"] | _TEMPERATURE_RANGE


@kernel
def _move(out, filled, m, interval_ns, taps, lag, history, rate, state):  # type: ignore[no-untyped-def]
    """Finish the rows of `out` whose rates become known; the rows from `filled` on are new."""
    ready = 0
    parts, slot, head_end, rate_known = state[0], state[1], state[2], state[3] != 0
    x0, x1, x2 = rate[0], rate[1], rate[2]
    length = taps.shape[0]
    i = filled
    single = 0  # rows of one interval each, unbroken, that stand in `out` right before row i
    while i < out.shape[0]:
        if single >= length and rate_known:
            first = i
            i, x0, x1, x2 = _move_steadily(out, i, m, interval_ns, taps, lag, x0, x1, x2)
            for k in range(max(first, i - length), i):
                part = out[k]
                d0, d1, d2 = part["dtheta_b"][0], part["dtheta_b"][1], part["dtheta_b"][2]
                slot = _remember(history, slot, d0, d1, d2)
            parts += i - first
            ready += i - first
            head_end = parts - lag + 1
            single = 0
            continue
        row = out[i]
        if row["flags"] & _MISSING_BEFORE:
            _finish_all(out[ready:i], m)
            ready, parts, rate_known, single = i, 0, False, 0
        steps = 1 if row["interval_ns"] == interval_ns else row["interval_ns"] // interval_ns
        d0, d1, d2 = row["dtheta_b"][0], row["dtheta_b"][1], row["dtheta_b"][2]
        if steps > 1:
            d0, d1, d2 = d0 / steps, d1 / steps, d2 / steps
        if ready == i:
            head_end = parts + steps
        for _ in range(steps):
            slot = _remember(history, slot, d0, d1, d2)
            parts += 1
            if ready > i or head_end != parts - lag:
                continue
            head = out[ready]
            known = parts >= length
            if known:
                y0, y1, y2 = _fir(taps, history, slot)
            else:
                y0 = y1 = y2 = 0.0
            if known and rate_known:
                head["flags"] |= _SIZE_EFFECT
                m0, m1, m2 = head["dtheta_b"][0], head["dtheta_b"][1], head["dtheta_b"][2]
                e0, e1, e2 = _size_effect(m, head["interval_ns"] * NS, x0, x1, x2, m0, m1, m2, y0, y1, y2)
                _finish(head, m, e0, e1, e2)
            else:
                _finish(head, m, 0.0, 0.0, 0.0)
            x0, x1, x2, rate_known = y0, y1, y2, known
            ready += 1
            if ready <= i:
                after = out[ready]["interval_ns"]
                head_end += 1 if after == interval_ns else after // interval_ns
        single = single + 1 if steps == 1 else 0
        i += 1
    state[0], state[1], state[2], state[3] = parts, slot, head_end, rate_known
    rate[0], rate[1], rate[2] = x0, x1, x2
    return ready


@kernel
def _move_steadily(out, i, m, interval_ns, taps, lag, x0, x1, x2):  # type: ignore[no-untyped-def]
    """Finish rows while rows of one interval each come unbroken: the same bits as `_move`, in half the time.

    The rows that the filter needs all stand in `out`. Gives the first row that is not so, and the rate at the
    end of the last one that was finished.
    """
    length = taps.shape[0]
    T = interval_ns * NS
    while i < out.shape[0]:
        row = out[np.uint64(i)]
        if row["interval_ns"] != interval_ns or row["flags"] & _MISSING_BEFORE:
            break
        y0 = y1 = y2 = 0.0
        for j in range(length):
            part, h = out[np.uint64(i + 1 - length + j)], taps[np.uint64(j)]
            y0 += h * part["dtheta_b"][0]
            y1 += h * part["dtheta_b"][1]
            y2 += h * part["dtheta_b"][2]
        head = out[np.uint64(i - lag)]
        head["flags"] |= _SIZE_EFFECT
        m0, m1, m2 = head["dtheta_b"][0], head["dtheta_b"][1], head["dtheta_b"][2]
        e0, e1, e2 = _size_effect(m, T, x0, x1, x2, m0, m1, m2, y0, y1, y2)
        _finish(head, m, e0, e1, e2)
        x0, x1, x2 = y0, y1, y2
        i += 1
    return i, x0, x1, x2


@kernel
def _remember(history, slot, d0, d1, d2):  # type: ignore[no-untyped-def]
    """Put an angle in the place of the oldest one; the next place."""
    length = history.shape[0] // 2
    # Kept twice, so that the latest ones always stand in a row.
    for at in (slot, slot + length):
        history[at, 0], history[at, 1], history[at, 2] = d0, d1, d2
    return slot + 1 if slot + 1 < length else 0


@kernel
def _differ(degc, before, channels):  # type: ignore[no-untyped-def]
    """Whether a temperature that counts is another than before."""
    for k in range(channels.shape[0]):
        if channels[k] >= 0 and degc[channels[k]] != before[channels[k]]:
            return True
    return False


@kernel
def _at_temperature(degc, m, channels, limits):  # type: ignore[no-untyped-def]
    """Give rad a pulse, gyro bias, m/s a pulse, accelerometer bias; whether all temperatures are in range."""
    low, high = limits
    kelvin = (0.0, 0.0, 0.0, 0.0)
    in_range = True
    if low <= high:
        kelvin = (
            _kelvin(degc, channels[0], m[_TREF]),
            _kelvin(degc, channels[1], m[_TREF]),
            _kelvin(degc, channels[2], m[_TREF]),
            _kelvin(degc, channels[3], m[_TREF]),
        )
        for channel in channels:
            in_range = in_range and channel >= 0 and low <= degc[channel] <= high
    g, x, y, z = kelvin
    return (
        (_scaled(m, _KG, _KG_T, g), _scaled(m, _KG + 1, _KG_T + 1, g), _scaled(m, _KG + 2, _KG_T + 2, g)),
        (m[_BG] + m[_BG_T] * g, m[_BG + 1] + m[_BG_T + 1] * g, m[_BG + 2] + m[_BG_T + 2] * g),
        (
            1.0 / _scaled(m, _KA, _KA_T, x),
            1.0 / _scaled(m, _KA + 1, _KA_T + 1, y),
            1.0 / _scaled(m, _KA + 2, _KA_T + 2, z),
        ),
        (m[_BA] + m[_BA_T] * x, m[_BA + 1] + m[_BA_T + 1] * y, m[_BA + 2] + m[_BA_T + 2] * z),
        in_range,
    )


@kernel
def _scaled(m, at, at_term, kelvin):  # type: ignore[no-untyped-def]
    """Give a scale factor at a temperature."""
    return m[at] * (1.0 + m[at_term] * kelvin)


@kernel
def _kelvin(degc, channel, reference):  # type: ignore[no-untyped-def]
    """Kelvins from the reference; none where the temperature is not known."""
    if channel < 0 or np.isnan(degc[channel]):
        return 0.0
    return degc[channel] - reference


@kernel
def _fir(taps, history, begin):  # type: ignore[no-untyped-def]
    """Rate at the end of the part `lag` before the newest, rad/s."""
    w0 = w1 = w2 = 0.0
    for j in range(taps.shape[0]):
        w0 += taps[j] * history[begin + j, 0]
        w1 += taps[j] * history[begin + j, 1]
        w2 += taps[j] * history[begin + j, 2]
    return w0, w1, w2


@kernel
def _size_effect(m, T, x0, x1, x2, d0, d1, d2, y0, y1, y2):  # type: ignore[no-untyped-def]
    """dv_r of the three accelerometers, m/s, from the rates x and y at the ends and the angle d between."""
    # z is twice the rate between, so that its square counts four times. A bridged interval has its own angle:
    # the rate bends in it, and over many intervals dither cancels.
    if m[_T_ENDS] == T:
        z0, z1, z2 = x0 + y0, x1 + y1, x2 + y2
    else:
        k = 2.0 / T
        z0, z1, z2 = k * d0, k * d1, k * d2
    s0 = x0 * x0 + y0 * y0 + z0 * z0
    s1 = x1 * x1 + y1 * y1 + z1 * z1
    s2 = x2 * x2 + y2 * y2 + z2 * z2
    s3 = x0 * x1 + y0 * y1 + z0 * z1
    s4 = x1 * x2 + y1 * y2 + z1 * z2
    s5 = x2 * x0 + y2 * y0 + z2 * z0
    t0, t1, t2 = _rotate(m, _C, y0 - x0, y1 - x1, y2 - x2)
    sixth = T * (1.0 / 6.0)
    return (
        t0 + sixth * _inner(m, _Q, s0, s1, s2, s3, s4, s5),
        t1 + sixth * _inner(m, _Q + 6, s0, s1, s2, s3, s4, s5),
        t2 + sixth * _inner(m, _Q + 12, s0, s1, s2, s3, s4, s5),
    )


@kernel
def _inner(m, at, s0, s1, s2, s3, s4, s5):  # type: ignore[no-untyped-def]
    return m[at] * s0 + m[at + 1] * s1 + m[at + 2] * s2 + m[at + 3] * s3 + m[at + 4] * s4 + m[at + 5] * s5


@kernel
def _finish(row, m, e0, e1, e2):  # type: ignore[no-untyped-def]
    """Take the size effect e off what the accelerometers felt, and turn it into body axes."""
    v0, v1, v2 = row["dv_b"][0] - e0, row["dv_b"][1] - e1, row["dv_b"][2] - e2
    row["dv_b"][0], row["dv_b"][1], row["dv_b"][2] = _rotate(m, _CBA, v0, v1, v2)


@kernel
def _finish_all(rows, m):  # type: ignore[no-untyped-def]
    """Finish rows without a size effect."""
    for i in range(rows.shape[0]):
        _finish(rows[i], m, 0.0, 0.0, 0.0)
