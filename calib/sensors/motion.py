"""One pass over a motion: attitude, velocity and displacement from rest, and what they owe to each parameter.

In the frozen axes of the motion's beginning, with dC the attitude relative to it:

    u(T) = integral of dC f_b        w(T) = integral of u        phi = integral of dC domega

Coning and sculling are those of `imudrv.nav.mechanisation`, the size effect and the skew are taken off in
increments (mathematics, section 1). The Jacobians are

    P (3, 12)   angle by W and beta                     integral of dC nu^T, of dC
    U (3, 37)   velocity by all of `parameters.BASE`    integral of phi x dC f_b for the gyros
    X (3, 37)   displacement                            integral of U

to first order: products of the small parameters are left out of them, not of the motion itself.
"""

from typing import Final, NamedTuple

import numpy as np

from calib.sensors.parameters import BASE, Parameters
from imudrv.arrays import Array
from imudrv.imu.rate_filter import RateFilter
from imudrv.kernels import kernel
from imudrv.nav.attitude import product, put_quaternion, quaternion_of_vector, rows_of, unit
from imudrv.records import Records
from imudrv.vectors import (
    Matrix,
    Vector,
    add,
    cross,
    dot,
    matrix,
    put,
    rotate,
    row,
    scale,
    subtract,
    times,
    vector_at,
)

SAMPLE: Final = np.dtype(
    [
        ("T", np.float64),  # length of the interval, s
        ("gyro", np.float64, 3),  # angle at nominal scale, rad
        ("accelerometer", np.float64, 3),  # velocity at nominal scale, m/s
    ]
)
"""A sample of a motion."""

CONSTANTS: Final = np.dtype(
    [
        ("W", np.float64, (3, 3)),
        ("beta", np.float64, 3),
        ("M", np.float64, (3, 3)),
        ("b", np.float64, 3),
        ("q", np.float64, 3),
        ("is_asymmetry", np.bool_),
        ("A", np.float64, (3, 3)),
        ("C_ba", np.float64, (3, 3)),
        ("r_b", np.float64, (3, 3)),
        ("skew_s", np.float64),
        ("mean_of_ends", np.bool_),  # gives the rate in the middle: the angle has dither in it
        ("omega_before", np.float64, 3),  # rate and forces of the rests before and after, body axes
        ("force_before", np.float64, 3),
        ("force_after", np.float64, 3),
    ],
    align=True,
)
"""Constants of one motion."""

RESULT: Final = np.dtype(
    [
        ("q", np.float64, 4),  # dC at the end
        ("u", np.float64, 3),
        ("w", np.float64, 3),
        ("T", np.float64),
        ("P", np.float64, (12, 3)),
        ("U", np.float64, (BASE, 3)),
        ("X", np.float64, (BASE, 3)),
    ],
    align=True,
)


STEADY: Final = RateFilter("centred", np.array([-1.0, 7.0, 7.0, -1.0]) / 12.0, 2)
"""Rate at the end of a sample, exact for one cubic in time."""


class Motion(NamedTuple):
    """A motion from rest to rest, integrated."""

    duration_s: float
    C: Array  # (3, 3), attitude at the end relative to the beginning
    u: Array  # (3,)
    w: Array  # (3,)
    P: Array  # (3, 12)
    U: Array  # (3, BASE)
    X: Array  # (3, BASE)


def integrate(
    samples: Records,
    p: Parameters,
    rates: tuple[Array, Array],
    forces: tuple[Array, Array],
    rate_filter: RateFilter = STEADY,
) -> Motion:
    """Integrate a motion.

    Parameters
    ----------
    samples : ndarray of SAMPLE
        From the end of a rest to the start of the next.
    p : Parameters
        Those at the temperature of the motion.
    rates, forces : tuple of two ndarray, shape (3,)
        Rate, rad/s, and specific force, m/s^2, of the rests before and after, body axes.
    rate_filter : RateFilter
        For the rate of the size effect.

    Returns
    -------
    Motion
    """
    constants, out = np.zeros(1, CONSTANTS), np.zeros(1, RESULT)
    c = constants[0]
    c["W"], c["beta"], c["M"], c["b"], c["q"] = p.W, p.beta, p.M, p.b, p.q
    c["is_asymmetry"] = p.nonlinearity == "asymmetry"
    c["A"], c["C_ba"], c["r_b"], c["skew_s"] = p.A, np.linalg.inv(p.A), p.r_b, p.skew_s
    c["omega_before"], c["mean_of_ends"] = rates[0], rate_filter.middle_from_ends
    c["force_before"], c["force_after"] = forces
    _integrate(samples, _end_rates(samples, p, rates, rate_filter), constants, out)
    result = out[0]
    return Motion(
        float(result["T"]),
        np.array(rows_of(tuple(result["q"].tolist()))),
        result["u"],
        result["w"],
        result["P"].T,
        result["U"].T,
        result["X"].T,
    )


def _end_rates(samples: Records, p: Parameters, rates: tuple[Array, Array], rate_filter: RateFilter) -> Array:
    """Return the rate at the beginning of a motion and at the end of each sample, rad/s, body axes."""
    omega = samples["gyro"] @ p.W.T / samples["T"][:, None] - p.beta
    taps, lag = rate_filter.taps, rate_filter.lag
    padded = np.concatenate([np.tile(rates[0], (len(taps) - lag, 1)), omega, np.tile(rates[1], (lag, 1))])
    n = len(omega) + 1
    ends: Array = sum((tap * padded[j : j + n] for j, tap in enumerate(taps.tolist())), np.zeros((n, 3)))
    ends[0], ends[-1] = rates  # a mean is better known than single samples
    return ends


@kernel
def _integrate(samples: Records, ends: Array, constants: Records, out: Records) -> None:
    """Fill in the one row of `out`."""
    c, o = constants[0], out[0]
    M, C_ba, A = matrix(c["M"]), matrix(c["C_ba"]), matrix(c["A"])
    r_x, r_y, r_z = row(c["r_b"], 0), row(c["r_b"], 1), row(c["r_b"], 2)
    q, u, w = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    w0, f1 = vector_at(c["omega_before"], 0), vector_at(c["force_before"], 0)
    T1 = samples[0]["T"]
    dtheta1, dv1 = scale(T1, w0), scale(T1, f1)
    count, elapsed = len(samples), 0.0
    for k in range(count):
        sample = samples[k]
        T = sample["T"]
        dtheta = _angle(sample, c)
        e, curve = _input(sample, c)
        measured = rotate(M, subtract(e, times(vector_at(c["q"], 0), curve)))
        w1 = row(ends, k + 1)
        middle_rate = scale(0.5, add(w0, w1)) if c["mean_of_ends"] else scale(1.0 / T, dtheta)
        effect = _effect(w0, middle_rate, w1, T)
        s_x, s_y, s_z = _along(A[0], effect), _along(A[1], effect), _along(A[2], effect)
        dv = subtract(measured, rotate(C_ba, (dot(s_x, r_x), dot(s_y, r_y), dot(s_z, r_z))))

        f = scale(1.0 / T, measured)
        begin = rows_of(q)
        late = rotate(begin, subtract(f, f1))  # of the skew, at the boundary of two intervals
        k1 = T * T / (6.0 * T1 * (T1 + T))
        phi = add(dtheta, scale(k1, cross(dtheta1, dtheta)))
        sculled = add(dv, scale(k1, add(cross(dtheta1, dv), cross(dv1, dtheta))))
        x = dot(dtheta, dtheta)
        turned = cross(dtheta, sculled)
        dv_b = add(
            add(sculled, scale(0.5 - x * (1 / 24 - x / 720), turned)),
            scale(1 / 6 - x * (1 / 120 - x / 5040), cross(dtheta, turned)),
        )
        gained = subtract(rotate(begin, dv_b), scale(c["skew_s"], late))
        w = add(w, scale(T, add(u, scale(0.5, gained))))
        u = add(u, gained)
        middle = rows_of(product(q, quaternion_of_vector(scale(0.5, phi))))
        _add_jacobians(o, sample, e, curve, middle, M, rotate(middle, dv), T)
        _add_arms(o, middle, C_ba, s_x, s_y, s_z, T)
        _add_column(o["U"], o["X"], 36, scale(-1.0, late), T)
        q = unit(product(q, quaternion_of_vector(phi)))
        w0, f1, T1, dtheta1, dv1 = w1, f, T, dtheta, dv
        elapsed += T
    late = rotate(rows_of(q), subtract(vector_at(c["force_after"], 0), f1))
    u = subtract(u, scale(c["skew_s"], late))
    _add_column(o["U"], o["X"], 36, scale(-1.0, late), 0.0)
    put_quaternion(o["q"], q)
    put(o["u"], 0, u)
    put(o["w"], 0, w)
    o["T"] = elapsed


@kernel
def _angle(sample: np.void, c: np.void) -> Vector:
    """Return the angle of a sample, body axes."""
    return subtract(
        rotate(matrix(c["W"]), vector_at(sample["gyro"], 0)), scale(sample["T"], vector_at(c["beta"], 0))
    )


@kernel
def _input(sample: np.void, c: np.void) -> tuple[Vector, Vector]:
    """Return velocity on the sensing axes, and its square or half of its size, per time and times time."""
    T = sample["T"]
    e = subtract(vector_at(sample["accelerometer"], 0), scale(T, vector_at(c["b"], 0)))
    if c["is_asymmetry"]:
        return e, (0.5 * abs(e[0]), 0.5 * abs(e[1]), 0.5 * abs(e[2]))
    return e, scale(1.0 / T, times(e, e))


@kernel
def _effect(w0: Vector, wm: Vector, w1: Vector, T: float) -> Matrix:
    """Return the integral of `[omega_dot x] + [omega x]^2` over an interval, by rows."""
    d = subtract(w1, w0)
    xx, yy, zz, xy, yz, zx = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for weight, w in ((T / 6.0, w0), (T / 1.5, wm), (T / 6.0, w1)):
        xx, yy, zz = xx + weight * w[0] * w[0], yy + weight * w[1] * w[1], zz + weight * w[2] * w[2]
        xy, yz, zx = xy + weight * w[0] * w[1], yz + weight * w[1] * w[2], zx + weight * w[2] * w[0]
    return (
        (-yy - zz, xy - d[2], zx + d[1]),
        (xy + d[2], -xx - zz, yz - d[0]),
        (zx - d[1], yz + d[0], -xx - yy),
    )


@kernel
def _along(a: Vector, effect: Matrix) -> Vector:
    """Return `a @ effect`."""
    return add(add(scale(a[0], effect[0]), scale(a[1], effect[1])), scale(a[2], effect[2]))


@kernel
def _column(C: Matrix, j: int) -> Vector:
    return C[0][j], C[1][j], C[2][j]


@kernel
def _add_column(U: Array, X: Array, j: int, velocity: Vector, T: float) -> None:
    """Add what an interval brings to column j of the velocity, and of the displacement."""
    for m in range(3):
        X[j, m] += T * (U[j, m] + 0.5 * velocity[m])
        U[j, m] += velocity[m]


@kernel
def _add_jacobians(
    o: np.void, sample: np.void, e: Vector, curve: Vector, C: Matrix, M: Matrix, dv_n: Vector, T: float
) -> None:
    """Add to the columns of W, beta, M, b and q."""
    P, U, X = o["P"], o["U"], o["X"]
    nu = sample["gyro"]
    for i in range(3):
        axis = _column(C, i)
        for j in range(3):
            _add_angle(P, U, X, 3 * i + j, scale(nu[j], axis), dv_n, T)
            _add_column(U, X, 12 + 3 * i + j, scale(e[j], axis), T)
        _add_angle(P, U, X, 9 + i, scale(-T, axis), dv_n, T)
        sensing = rotate(C, _column(M, i))
        _add_column(U, X, 21 + i, scale(-T, sensing), T)
        _add_column(U, X, 24 + i, scale(-curve[i], sensing), T)


@kernel
def _add_angle(P: Array, U: Array, X: Array, j: int, angle: Vector, dv_n: Vector, T: float) -> None:
    """Add an angle error to column j, and what it turns of the velocity."""
    phi = P[j, 0] + 0.5 * angle[0], P[j, 1] + 0.5 * angle[1], P[j, 2] + 0.5 * angle[2]
    _add_column(U, X, j, cross(phi, dv_n), T)
    for m in range(3):
        P[j, m] += angle[m]


@kernel
def _add_arms(o: np.void, C: Matrix, C_ba: Matrix, s_x: Vector, s_y: Vector, s_z: Vector, T: float) -> None:
    """Add to the columns of R."""
    U, X = o["U"], o["X"]
    for i, s in enumerate((s_x, s_y, s_z)):
        axis = rotate(C, _column(C_ba, i))
        for j in range(3):
            _add_column(U, X, 27 + 3 * i + j, scale(-s[j], axis), T)
