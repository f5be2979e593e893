"""Specific force that gyro dither causes in accelerometers at different points: closed form, line by line.

Gyro j dithers about u_j with the angle a_j sin(W_j t + phi_j), so with the rate A_j cos(W_j t + phi_j),
A_j = a_j W_j:

    omega = sum_j u_j A_j cos psi_j,   omega_dot = - sum_j u_j A_j W_j sin psi_j,   psi_j = W_j t + phi_j

Accelerometer i, along a_i at r_i, senses f_i = a_i . ([omega_dot x] + [omega x]^2) r_i (mathematics, section
1). With a . (d x r) = d . (r x a), with [w x]^2 r = w (w . r) - r (w . w), and with

    T_ij = (r_i x a_i) . u_j
    Q_ijk = 1/2 [(a_i . u_j)(u_k . r_i) + (a_i . u_k)(u_j . r_i)] - (a_i . r_i)(u_j . u_k)

the products of cosines become sums, and

    f_i = - sum_j A_j W_j T_ij sin psi_j                                      W_j: tangential
          + sum_j 1/2 A_j^2 Q_ijj (1 + cos 2 psi_j)                           mean and 2 W_j: centripetal
          + sum_j<k A_j A_k Q_ijk [cos(psi_j - psi_k) + cos(psi_j + psi_k)]   W_j -+ W_k: between gyros

For aligned axes these are equations 2 to 4 of the literature. One gyro, about x (u = x, A_x = A):

    f_x = 0
    f_y = - A^2 cos^2(W t) r_yy + A W sin(W t) r_yz
    f_z = - A^2 cos^2(W t) r_zz - A W sin(W t) r_zy

with the mean - A^2/2 times the arm along the accelerometer. Three gyros of different frequencies,
accelerometer x:

    mean of f_x = - 1/2 (A_y^2 + A_z^2) r_xx

Two gyros of the same frequency add A_j A_k Q_ijk cos(phi_j - phi_k) to the mean.

**Sampling.** An increment is the mean over the interval tau: a line at nu is multiplied by
sinc(nu tau) = sin(pi nu tau) / (pi nu tau). The sample rate is F = 1 / tau, so nu is aliased to |nu - m F|, m
the nearest integer; at 1 kHz, 400 Hz remains and 800 Hz is aliased to 200 Hz with 0.23 of its amplitude.

**The rate filter.** The compensation subtracts (w1 - w0) / tau . (r x a) and the mean of the squares by
Simpson's rule, 1/6 w0, 4/6 wm, 1/6 w1. The dither in these rates is that of the increments times a gain. At
the ends it is G_j = sinc(f_j tau) sum_m h_m exp(i W_j tau (m - 1/2)), with a phase of -+ W_j tau / 2 from the
middle. In the middle it is sinc(f_j tau) if wm is the angle of the interval itself; then, for gyros of
different frequencies, the subtracted mean is 2/3 sinc^2 + 1/3 |G|^2 of the mean above, and no filter of the
ends alone reduces it below 0.38 of that at 400 Hz. Therefore the filter `dither` has wm = (w0 + w1) / 2, with
the gain G_j cos(W_j tau / 2). If the dither of the block is in the increments and the case is at rest, the
whole compensation is false; if the case moves, the effect is true, and what the filter blocks remains.

Lever arms are measured from the origin of b, which the dither does not move; if the case turns about another
point, give the lever arms from that point (gauge ``given``).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imudrv.arrays import Array
from imudrv.imu.rate_filter import RateFilter

Phasors: TypeAlias = NDArray[np.complexfloating[Any, Any]]


AXES: Final = "xyz"


_HZ_DECIMALS: Final = 6
"""Decimals of a frequency in Hz within which lines are one line."""


@dataclass(frozen=True)
class Dither:
    """Dither about fixed axes.

    Parameters
    ----------
    axes_b : ndarray, shape (n, 3)
        Row j: u_j, body axes; unit vectors if a body turns.
    amplitude_rad, frequency_hz : ndarray, shape (n,)
        Angle a sin(2 pi f t + phase).
    phase_rad : ndarray, shape (n,), or float
        Its phase.
    """

    axes_b: Array
    amplitude_rad: Array
    frequency_hz: Array
    phase_rad: Array | float = 0.0

    @property
    def rate(self) -> Array:
        """Amplitude of the rate, rad/s, shape (n,)."""
        return 2.0 * np.pi * self.frequency_hz * self.amplitude_rad

    def alone(self, gyro: int) -> "Dither":
        """Return the same with dither of one gyro only."""
        return replace(
            self, amplitude_rad=np.where(np.arange(len(self.rate)) == gyro, self.amplitude_rad, 0.0)
        )


def sensing_directions(C_bg: Array) -> Array:
    """Return the unit vectors along which the gyros sense, as rows in body axes: the rows of inv(C_bg).

    The blocks themselves turn about the columns of C_bg.
    """
    rows = np.linalg.inv(C_bg)
    directions: Array = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return directions


@dataclass(frozen=True)
class LineSpectrum:
    """Specific force along each accelerometer as a sum of lines: Re sum c exp(2 pi i f t).

    Parameters
    ----------
    names : tuple of str
        Name of each line: `mean`, `Wx`, `2 Wx`, `Wx-Wy`, `Wx+Wy`; joined if their frequency is the same.
    frequency_hz : ndarray, shape (n,)
        Ascending, the mean first.
    phasor : ndarray, shape (n, 3)
        Complex amplitudes, m/s^2; column i: accelerometer i.
    """

    names: tuple[str, ...]
    frequency_hz: Array
    phasor: Phasors

    @property
    def mean(self) -> Array:
        """Rectified part, m/s^2, shape (3,)."""
        rectified: Array = self.phasor[self.frequency_hz == 0.0].real.sum(axis=0)
        return rectified

    @property
    def amplitude(self) -> Array:
        """Amplitude of each line, m/s^2, shape (n, 3)."""
        size: Array = np.abs(self.phasor)
        return size

    def at(self, t_s: ArrayLike) -> Array:
        """Return the force at times, m/s^2, shape (..., 3)."""
        turns = np.asarray(t_s, np.float64)[..., None] * self.frequency_hz
        force: Array = np.real(np.exp(2j * np.pi * turns) @ self.phasor).astype(np.float64)
        return force

    def averaged(self, interval_s: float) -> "LineSpectrum":
        """Return the mean over sample intervals, at their middles, as increments contain it."""
        return replace(self, phasor=self.phasor * np.sinc(self.frequency_hz * interval_s)[:, None])

    def aliased(self, interval_s: float) -> "LineSpectrum":
        """Return the lines at the frequencies of their aliases, at most half the sample rate.

        Parameters
        ----------
        interval_s : float
            Sample k is at the middle of interval k, (k + 1/2) interval_s.

        Returns
        -------
        LineSpectrum
            The same values at these times.
        """
        m = np.rint(self.frequency_hz * interval_s)
        # exp(2 pi i m F t) is (-1)^m in the middles
        phasor = self.phasor * np.where(m % 2 == 0, 1.0, -1.0)[:, None]
        return _merged(zip(self.names, self.frequency_hz - m / interval_s, phasor, strict=True))

    def __sub__(self, other: "LineSpectrum") -> "LineSpectrum":
        pairs = (
            (name, frequency, sign * phasor)
            for lines, sign in ((self, 1.0), (other, -1.0))
            for name, frequency, phasor in zip(lines.names, lines.frequency_hz, lines.phasor, strict=True)
        )
        return _merged(pairs)


def size_effect(dither: Dither, C_ba: ArrayLike, r_b: ArrayLike) -> LineSpectrum:
    """Return the instantaneous force on the accelerometers: the three sums above.

    Parameters
    ----------
    dither : Dither
        Dither of the case.
    C_ba : array_like, shape (3, 3)
        Accelerometer axes to body.
    r_b : array_like, shape (3, 3)
        Row i: sensing point of accelerometer i, m, body axes.

    Returns
    -------
    LineSpectrum
    """
    one = np.ones_like(dither.rate, np.complex128)
    return _lines(dither, C_ba, r_b, 2j * np.pi * dither.frequency_hz, [(1.0, one)])


def compensated(
    dither: Dither, C_ba: ArrayLike, r_b: ArrayLike, rate_filter: RateFilter, interval_s: float
) -> LineSpectrum:
    """Return what the compensation subtracts from increments with dither, as a mean over each interval.

    Parameters
    ----------
    dither : Dither
        Dither in the gyro increments.
    C_ba, r_b : array_like, shape (3, 3)
        As for `size_effect`, from the certificate.
    rate_filter : RateFilter
        Filter that gives the rates at the ends of the intervals.
    interval_s : float
        Sample interval, s.

    Returns
    -------
    LineSpectrum
        At the middles of the intervals; see `aliased` for the frequencies in the samples.
    """
    frequency = dither.frequency_hz
    end = gain(rate_filter, frequency, interval_s)
    half = np.exp(1j * np.pi * frequency * interval_s)
    first, last = end / half, end * half
    own = np.sinc(frequency * interval_s).astype(np.complex128)
    middle = 0.5 * (first + last) if rate_filter.middle_from_ends else own
    simpson = [(1.0 / 6.0, first), (4.0 / 6.0, middle), (1.0 / 6.0, last)]
    return _lines(dither, C_ba, r_b, (last - first) / interval_s, simpson)


def gain(rate_filter: RateFilter, frequency_hz: ArrayLike, interval_s: float) -> Phasors:
    """Return the ratio of the filtered to the true rate at the end of an interval, for a vibration.

    Parameters
    ----------
    rate_filter : RateFilter
        The filter, applied to exact increments.
    frequency_hz : array_like, shape (...)
        Frequency of the vibration.
    interval_s : float
        Sample interval, s.

    Returns
    -------
    ndarray of complex, shape (...)
    """
    turns = np.asarray(frequency_hz, np.float64) * interval_s
    taps = rate_filter.taps
    centre = np.arange(len(taps)) - (len(taps) - rate_filter.lag) + 0.5  # of the tap's interval, from the end
    response: Phasors = np.sinc(turns) * (np.exp(2j * np.pi * turns[..., None] * centre) @ taps)
    return response


def _lines(
    dither: Dither,
    C_ba: ArrayLike,
    r_b: ArrayLike,
    slope: Phasors,
    squares: Sequence[tuple[float, Phasors]],
) -> LineSpectrum:
    """Return lines of the tangential part, `slope` times the rates, and of weighted centripetal parts.

    Each of `squares` is a weight and the gains of the gyro rates.
    """
    a = np.linalg.inv(np.asarray(C_ba, np.float64))
    r = np.asarray(r_b, np.float64)
    u, f = dither.axes_b, dither.frequency_hz
    rate = dither.rate * np.exp(1j * dither.phase_rad)
    dithering = np.flatnonzero(rate).tolist()
    au, ru = a @ u.T, r @ u.T
    tangential = np.cross(r, a) @ u.T  # T_ij

    def centripetal(j: int, k: int) -> Array:
        across: Array = 0.5 * (au[:, j] * ru[:, k] + au[:, k] * ru[:, j]) - np.sum(a * r, axis=1) * (
            u[j] @ u[k]
        )
        return across  # Q_ijk

    def terms() -> Iterator[tuple[str, float, Phasors]]:
        yield "mean", 0.0, np.zeros(3, np.complex128)
        for j in dithering:
            name = AXES[j]
            yield f"W{name}", f[j], slope[j] * rate[j] * tangential[:, j]
            for weight, gains in squares:
                p = gains[j] * rate[j]
                yield "mean", 0.0, 0.5 * weight * abs(p) ** 2 * centripetal(j, j)
                yield f"2 W{name}", 2.0 * f[j], 0.5 * weight * p**2 * centripetal(j, j)
        for j, k in combinations(dithering, 2):
            for weight, gains in squares:
                p, q = gains[j] * rate[j], gains[k] * rate[k]
                between = weight * centripetal(j, k)
                yield f"W{AXES[j]}-W{AXES[k]}", f[j] - f[k], p * q.conjugate() * between
                yield f"W{AXES[j]}+W{AXES[k]}", f[j] + f[k], p * q * between

    return _merged(terms())


def _merged(terms: Iterable[tuple[str, float, Phasors]]) -> LineSpectrum:
    """Merge the lines of each frequency; a negative frequency is the complex conjugate."""
    names: dict[float, dict[str, None]] = {}
    sums: dict[float, Phasors] = {}
    for name, frequency, phasor in terms:
        at = round(abs(frequency), _HZ_DECIMALS)
        value = np.conj(phasor) if frequency < 0.0 else phasor
        sums[at] = sums.get(at, np.zeros(3, np.complex128)) + (value if at else value.real)
        names.setdefault(at, {}).update(dict.fromkeys(name.split(", ")))
    order = sorted(sums)
    phasors = np.array([sums[at] for at in order], np.complex128).reshape(-1, 3)
    return LineSpectrum(tuple(", ".join(names[at]) for at in order), np.array(order), phasors)
