"""Strapdown navigation in local level axes (east, north, up) on WGS-84, and the measurement matrices with it.

An interval of length T brings the increments `dtheta`, `dv`; the one before, of length T1, `dtheta1`, `dv1`.
Rate and specific force are taken as linear in time over both:

    k    = T^2 / (6 T1 (T1 + T))                                 (1/12 for equal intervals)
    phi  = dtheta + k dtheta1 x dtheta                           coning
    dv'  = dv + k (dtheta1 x dv + dv1 x dtheta)                  sculling
    dv_b = dv' + c1 dtheta x dv' + c2 dtheta x (dtheta x dv')    rotation, exact for constant rate and force

`dv_b` is the velocity gained, in the body axes of the interval's beginning. With `omega_ie` the Earth's rate,
`omega_en` the transport rate, `zeta = (omega_ie + omega_en) T`, and v' the velocity in the middle:

    dv_n = C_nb dv_b
    v_n += dv_n - 1/2 zeta x dv_n + (g_n - (2 omega_ie + omega_en) x v') T
    q_nb = q(-zeta) q_nb q(phi)

Sources: Savage, Strapdown Inertial Navigation Integration Algorithm Design, Journal of Guidance, Control, and
Dynamics 21 (1998), part 1 (attitude), 19-28, and part 2 (velocity and position), 208-221; Titterton and
Weston, Strapdown Inertial Navigation Technology, 2nd ed., chapters 3 and 11. k for unequal intervals follows
from the same model: for `omega = w0 + w1 t` coning is `w0 x w1 T^3 / 12`, and `dtheta1 x dtheta` is
`w0 x w1 T T1 (T + T1) / 2`. Left out: terms in zeta^2 (8e-14 m/s^2 at 1 ms) and that the Earth's terms change
within an interval, or while latitude and height stay within a centimetre: 3e-8 m/s^2, 1e-13 rad/s.

**The measurement matrices** say how the navigated velocity answers to what is left in the increments
(mathematics, sections 2 and 4). All of it is measured minus true, to first order:

    delta v_n = H R + B b + f_n x (phi_0 t - Q vec(dG))        phi = phi_0 - P vec(dG)

    H (3, 9)  R: sensing points (r_x, r_y, r_z) that were not compensated, m
    B (3, 3)  b: bias left in the specific force, body axes, m/s^2; the integral of C_nb
    P (3, 9)  dG by rows: scale and misalignment, `dG @ omega_ib_b` too much rate; integral of C_nb kron omega
    Q (3, 9)  the integral of P

A size effect also acts back through Coriolis' acceleration (1.5e-3 of it in 10 s), so that

    dH/dt = C_nb S - 2 omega_ie x H

and a common shift of the sensing points, which is a true motion, leaves no velocity at rest. Not in the
matrices: gravity at a place in error (`1.5e-6 t^2 / 2`: 1e-4 after 12 s), the speed over ground in Coriolis'
term and, in B, P and Q, the Earth's rotation (7e-5 t).

H is causal, without lag: the rate at an interval's end comes from this interval and the two before, exact for
a rate quadratic in time. Before the first interval the body rests on the Earth, so that no noise of a first
rate, which would stay in H for ever, comes in.

Time for which there are no increments is not navigated; a row bears the flags of its sample.
"""

from math import cos, sin, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imudrv.errors import InputError
from imudrv.kernels import kernel
from imudrv.nav.attitude import Quaternion, conjugate, product, quaternion_of_vector, rows_of, turn, unit
from imudrv.nav.earth import SEMI_MAJOR_AXIS, earth_rate_n, normal_gravity, radii
from imudrv.records import Records
from imudrv.units import NS
from imudrv.vectors import Vector, add, cross, dot, put, scale, subtract, vector_at

NAVIGATION: Final = np.dtype(
    [
        ("counter", np.int64),
        ("t_ns", np.int64),  # end of the interval
        ("flags", np.int64),  # of the sample
        ("q_nb", np.float64, 4),  # scalar first
        ("v_n", np.float64, 3),  # east, north, up, m/s
        ("latitude_rad", np.float64),
        ("longitude_rad", np.float64),
        ("height_m", np.float64),
    ]
)
"""Where the unit is, how fast and how turned, at the end of a sample."""

MEASUREMENT: Final = np.dtype(
    [
        *((name, *NAVIGATION.fields[name][:1]) for name in NAVIGATION.names or ()),  # type: ignore[index]
        ("H", np.float64, (3, 9)),
        ("B", np.float64, (3, 3)),
        ("P", np.float64, (3, 9)),
        ("Q", np.float64, (3, 9)),
    ]
)
"""`NAVIGATION` and the measurement matrices."""

NEAR: Final = 0.01
"""So far to the north or up the Earth's terms serve, m: they take a third of the time of navigation."""

MAX_LATITUDE: Final = 1.5
"""Largest latitude, rad: east and north have no meaning at the poles."""

# The state, one array of floats: what a row of output has, then what the next step needs besides.
_Q, _V, _PLACE, _H, _B, _P, _IP = 0, 4, 7, 10, 37, 46, 73
_T1, _DTHETA1, _DV1, _T2, _DTHETA2, _OMEGA, _EARTH = 100, 101, 104, 107, 108, 111, 114
_STATE: Final = 116
_HEAD: Final = 3  # words of a row before its floats


class Navigator:
    """Navigation from a known attitude and place; any chunks give the same bits.

    Parameters
    ----------
    latitude_rad, longitude_rad, height_m : float
        Where it starts.
    gravity_m_s2 : float or None
        Measured there. Its difference from normal gravity is added everywhere. None: normal gravity.
    q_nb : array_like, shape (4,)
        Attitude at the start.
    v_n : array_like, shape (3,)
        Velocity at the start, m/s.
    C_ba : array_like, shape (3, 3), optional
        Accelerometer axes to body. With it rows are `MEASUREMENT`, and the body must rest at the start.
    every : int
        Only each so-manieth sample makes a row, counted from the start.

    Raises
    ------
    InputError
        A start that is no attitude or lies at a pole.
    """

    def __init__(
        self,
        latitude_rad: float,
        longitude_rad: float,
        height_m: float,
        gravity_m_s2: float | None,
        q_nb: ArrayLike,
        v_n: ArrayLike = (0.0, 0.0, 0.0),
        *,
        C_ba: ArrayLike | None = None,
        every: int = 1,
    ) -> None:
        q = _checked("attitude q_nb", q_nb, (4,))
        if abs(np.linalg.norm(q) - 1.0) > 1e-6:
            raise InputError(
                f"navigation: expected q_nb of length 1 within 1e-6, got {np.linalg.norm(q):.9g}; "
                "normalise it"
            )
        place = _checked("latitude, longitude, height", (latitude_rad, longitude_rad, height_m), (3,))
        if abs(latitude_rad) > MAX_LATITUDE:
            raise InputError(
                f"navigation: expected a latitude of at most {MAX_LATITUDE} rad, got {latitude_rad:.9g}; "
                "east and north have no meaning at a pole"
            )
        if every < 1:
            raise InputError(f"navigation: expected a row every 1 or more samples, got {every}")
        self._gravity_offset = 0.0
        if gravity_m_s2 is not None:
            self._gravity_offset = gravity_m_s2 - normal_gravity(latitude_rad, height_m)
        self._matrices = C_ba is not None
        C = np.eye(3) if C_ba is None else _checked("C_ba", C_ba, (3, 3))
        self._constants = np.concatenate([C.ravel(), np.linalg.inv(C).ravel()])
        self._every = every
        self._samples = 0
        self._state = np.zeros(_STATE)
        self._state[_Q:_V] = q / np.linalg.norm(q)
        self._state[_V:_PLACE] = _checked("velocity v_n", v_n, (3,))
        self._state[_PLACE:_H] = place
        self._state[_EARTH:] = latitude_rad, height_m

    @property
    def latest(self) -> Records:
        """One row, shape (1,): the newest state, with `counter`, `t_ns` and `flags` zero."""
        row = np.zeros(1, MEASUREMENT if self._matrices else NAVIGATION)
        words = _words(row)
        words[0, _HEAD:] = self._state[: words.shape[1] - _HEAD]
        return row

    def feed(self, increments: Records) -> Records:
        """Navigate through increments.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order; intervals may differ.

        Returns
        -------
        ndarray of NAVIGATION or MEASUREMENT
            One row for each `every` samples.
        """
        if self._samples == 0 and len(increments):
            self._rest_before(increments["interval_ns"][0] * NS)
        skip = -(self._samples + 1) % self._every  # rows before the first that is put out
        told = increments[skip :: self._every]
        out = np.empty(len(told), MEASUREMENT if self._matrices else NAVIGATION)
        for name in ("counter", "t_ns", "flags"):
            out[name] = told[name]
        _navigate(
            increments,
            _words(out),
            self._state,
            self._constants,
            self._gravity_offset,
            self._matrices,
            skip,
            self._every,
        )
        self._samples += len(increments)
        return out

    def _rest_before(self, T: float) -> None:
        """Fill in the two intervals before the first: the body rests on the Earth."""
        s = self._state
        q_bn = conjugate(tuple(s[_Q:_V].tolist()))
        latitude, _, height = s[_PLACE:_H].tolist()
        gravity = normal_gravity(latitude, height) + self._gravity_offset
        rate = turn(q_bn, earth_rate_n(latitude))
        s[_T1], s[_T2], s[_OMEGA:_EARTH] = T, T, rate
        s[_DTHETA1:_DV1] = s[_DTHETA2:_OMEGA] = scale(T, rate)
        s[_DV1:_T2] = turn(q_bn, (0.0, 0.0, gravity * T))


def _checked(name: str, value: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.array(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"navigation: expected {name} as finite numbers of shape {shape}, got {value!r}")
    return array


def _words(rows: Records) -> NDArray[np.float64]:
    """See the rows as a table of 8-byte words, in the same memory."""
    return rows.view(np.float64).reshape(len(rows), rows.dtype.itemsize // 8)


@kernel
def _navigate(
    increments: Records,
    out: NDArray[np.float64],
    state: NDArray[np.float64],
    constants: NDArray[np.float64],
    gravity_offset: float,
    matrices: bool,
    skip: int,
    every: int,
) -> None:
    """Step through `increments`; row `skip` and each `every` behind it go to `out`."""
    q = (state[_Q], state[_Q + 1], state[_Q + 2], state[_Q + 3])
    v, place = vector_at(state, _V), vector_at(state, _PLACE)
    T1, dtheta1, dv1 = state[_T1], vector_at(state, _DTHETA1), vector_at(state, _DV1)
    T2, dtheta2, omega = state[_T2], vector_at(state, _DTHETA2), vector_at(state, _OMEGA)
    weights, T_weights = (0.0, 0.0, 0.0), 0.0
    at_latitude, at_height = state[_EARTH], state[_EARTH + 1]
    earth = _earth(at_latitude, at_height)
    filled = 0
    for i in range(increments.shape[0]):
        sample = increments[i]
        T = sample["interval_ns"] * NS
        dtheta = (sample["dtheta_b"][0], sample["dtheta_b"][1], sample["dtheta_b"][2])
        dv = (sample["dv_b"][0], sample["dv_b"][1], sample["dv_b"][2])
        phi, dv_b = body_step(T, dtheta, dv, T1, dtheta1, dv1)
        if abs(place[0] - at_latitude) * SEMI_MAJOR_AXIS > NEAR or abs(place[2] - at_height) > NEAR:
            at_latitude, at_height = place[0], place[2]
            earth = _earth(at_latitude, at_height)
        q1, v, place = _step(q, v, place, T, phi, dv_b, earth, gravity_offset)
        if matrices:
            if not T == T1 == T2 == T_weights:
                weights, T_weights = _end_rate_weights(T, T1, T2), T if T == T1 == T2 else 0.0
            latest = add(scale(weights[0], dtheta), scale(weights[1], dtheta1))
            omega1 = add(latest, scale(weights[2], dtheta2))
            _measure(state, constants, q, q1, earth.omega_ie, T, dtheta, omega, omega1)
            T2, dtheta2, omega = T1, dtheta1, omega1
        q, T1, dtheta1, dv1 = q1, T, dtheta, dv
        if i == skip:
            skip += every
            out[filled, 3], out[filled, 4], out[filled, 5], out[filled, 6] = q
            out[filled, 7], out[filled, 8], out[filled, 9] = v
            out[filled, 10], out[filled, 11], out[filled, 12] = place
            if matrices:
                for k in range(_H, _T1):
                    out[filled, _HEAD + k] = state[k]
            filled += 1
    state[_Q], state[_Q + 1], state[_Q + 2], state[_Q + 3] = q
    put(state, _V, v)
    put(state, _PLACE, place)
    state[_T1], state[_T2] = T1, T2
    put(state, _DTHETA1, dtheta1)
    put(state, _DV1, dv1)
    put(state, _DTHETA2, dtheta2)
    put(state, _OMEGA, omega)
    state[_EARTH], state[_EARTH + 1] = at_latitude, at_height


@kernel
def body_step(
    T: float, dtheta: Vector, dv: Vector, T1: float, dtheta1: Vector, dv1: Vector
) -> tuple[Vector, Vector]:
    """Rotation and velocity of an interval, with coning, sculling and rotation.

    Parameters
    ----------
    T, T1 : float
        This interval and the one before, s.
    dtheta, dv, dtheta1, dv1 : tuple of 3 float
        Their increments, rad and m/s.

    Returns
    -------
    tuple of 2 tuples of 3 float
        Rotation vector, rad, and velocity gained, m/s, in the body axes of the interval's beginning.
    """
    k = T * T / (6.0 * T1 * (T1 + T))
    phi = add(dtheta, scale(k, cross(dtheta1, dtheta)))
    sculling = add(cross(dtheta1, dv), cross(dv1, dtheta))
    dv = add(dv, scale(k, sculling))
    x = dot(dtheta, dtheta)
    if x < 0.01:  # as series, the first term left out under 1e-13
        c1 = 1 / 2 + x * (-1 / 24 + x * (1 / 720 + x * (-1 / 40320)))
        c2 = 1 / 6 + x * (-1 / 120 + x * (1 / 5040 + x * (-1 / 362880)))
    else:
        angle = sqrt(x)
        c1, c2 = (1.0 - cos(angle)) / x, (1.0 - sin(angle) / angle) / x
    turned = cross(dtheta, dv)
    return phi, add(dv, add(scale(c1, turned), scale(c2, cross(dtheta, turned))))


class _Earth(NamedTuple):
    omega_ie: Vector  # rad/s
    gravity: float  # normal, m/s^2
    per_north: float  # rad of latitude a metre to the north
    per_east: float  # rad of turn about the meridian a metre to the east
    secant: float  # of the latitude
    tangent: float


@kernel
def _earth(latitude: float, height: float) -> _Earth:
    """Terms of the Earth that change with the place."""
    meridian, prime_vertical = radii(latitude)
    secant = 1.0 / cos(latitude)
    return _Earth(
        earth_rate_n(latitude),
        normal_gravity(latitude, height),
        1.0 / (meridian + height),
        1.0 / (prime_vertical + height),
        secant,
        sin(latitude) * secant,
    )


@kernel
def _step(
    q: Quaternion,
    v: Vector,
    place: Vector,
    T: float,
    phi: Vector,
    dv_b: Vector,
    earth: _Earth,
    gravity_offset: float,
) -> tuple[Quaternion, Vector, Vector]:
    """Attitude, velocity and place after an interval."""
    gravity = (0.0, 0.0, -(earth.gravity + gravity_offset) * T)

    dv_n = turn(q, dv_b)
    middle = add(v, scale(0.5, add(dv_n, gravity)))
    east = middle[0] * earth.per_east
    omega_en = (-middle[1] * earth.per_north, east, east * earth.tangent)
    omega_in = add(earth.omega_ie, omega_en)
    zeta = scale(T, omega_in)
    coriolis = add(earth.omega_ie, omega_in)
    turned = add(scale(0.5, cross(zeta, dv_n)), scale(T, cross(coriolis, middle)))
    v1 = add(v, subtract(add(dv_n, gravity), turned))

    mean = scale(0.5 * T, add(v, v1))
    north_rad = mean[1] * earth.per_north
    # the meridians draw together on the way: cosine of the middle latitude, to first order
    east_rad = mean[0] * earth.per_east * earth.secant * (1.0 + 0.5 * earth.tangent * north_rad)
    latitude, longitude, height = place
    place1 = (latitude + north_rad, longitude + east_rad, height + mean[2])
    # zeta, 7e-5 rad a second, to second order: `unit` brings what is left out of the cosine
    q_zeta = (1.0, -0.5 * zeta[0], -0.5 * zeta[1], -0.5 * zeta[2])
    q1 = unit(product(q_zeta, product(q, quaternion_of_vector(phi))))
    return q1, v1, place1


@kernel
def _end_rate_weights(T: float, T1: float, T2: float) -> Vector:
    """Weights of the angles of an interval and the two before it in the rate at its end, 1/s.

    The derivative of the cubic through the angle, by Newton's divided differences: exact for a rate quadratic
    in time. For equal intervals they are (11, -7, 2) / 6 T.
    """
    k = T / (T + T1)
    m = T / (T + T1 + T2)
    m1 = m * (T + T1) / (T1 + T2)
    return (1.0 + k + m) / T, -(k + m + m1) / T1, m1 / T2


@kernel
def _measure(
    state: NDArray[np.float64],
    constants: NDArray[np.float64],
    q: Quaternion,
    q1: Quaternion,
    omega_ie: Vector,
    T: float,
    dtheta: Vector,
    w0: Vector,
    w1: Vector,
) -> None:
    """Take H, B, P and Q through an interval from attitude q to q1; w0 and w1 are the rates at its ends."""
    # The sum of two near unit quaternions lies half-way between them.
    C = rows_of((q[0] + q1[0], q[1] + q1[1], q[2] + q1[2], q[3] + q1[3]))
    Omega = _omega_increment(T, dtheta, w0, w1)
    zeta = scale(2.0 * T, omega_ie)  # without an east component
    _gain_columns(state, constants, 0, C, Omega, zeta)
    _gain_columns(state, constants, 1, C, Omega, zeta)
    _gain_columns(state, constants, 2, C, Omega, zeta)
    _gain_row(state, 0, T, C[0], dtheta)
    _gain_row(state, 1, T, C[1], dtheta)
    _gain_row(state, 2, T, C[2], dtheta)


@kernel
def _gain_columns(
    state: NDArray[np.float64],
    constants: NDArray[np.float64],
    i: int,
    C: tuple[Vector, Vector, Vector],
    Omega: tuple[Vector, Vector, Vector],
    zeta: Vector,
) -> None:
    """Columns of H of accelerometer i: add `C_nb c_i a_i^T Omega`, take off `zeta x` the columns."""
    a = vector_at(constants, 9 + 3 * i)
    felt = add(scale(a[0], Omega[0]), add(scale(a[1], Omega[1]), scale(a[2], Omega[2])))
    c = (constants[i], constants[3 + i], constants[6 + i])
    at = _H + 3 * i
    east, north, up = vector_at(state, at), vector_at(state, at + 9), vector_at(state, at + 18)
    north1 = subtract(north, scale(zeta[2], east))
    up1 = add(up, scale(zeta[1], east))
    east1 = add(east, subtract(scale(zeta[2], north), scale(zeta[1], up)))
    put(state, at, add(east1, scale(dot(C[0], c), felt)))
    put(state, at + 9, add(north1, scale(dot(C[1], c), felt)))
    put(state, at + 18, add(up1, scale(dot(C[2], c), felt)))


@kernel
def _gain_row(state: NDArray[np.float64], n: int, T: float, c: Vector, dtheta: Vector) -> None:
    """Row n of B, P and Q; c is that row of C_nb."""
    at = _B + 3 * n
    put(state, at, add(vector_at(state, at), scale(T, c)))
    half = scale(0.5, dtheta)
    _gain_angle(state, 9 * n, T, scale(c[0], half))
    _gain_angle(state, 9 * n + 3, T, scale(c[1], half))
    _gain_angle(state, 9 * n + 6, T, scale(c[2], half))


@kernel
def _gain_angle(state: NDArray[np.float64], at: int, T: float, half: Vector) -> None:
    """Three elements of P, and of its integral by the trapezoidal rule; half of what P gains."""
    P, Q = vector_at(state, _P + at), vector_at(state, _IP + at)
    middle = add(P, half)
    put(state, _IP + at, add(Q, scale(T, middle)))
    put(state, _P + at, add(middle, half))


@kernel
def _omega_increment(T: float, dtheta: Vector, w0: Vector, w1: Vector) -> tuple[Vector, Vector, Vector]:
    """Rows of the integral of Omega over an interval (mathematics, section 1).

    `[(w1 - w0) x] + T / 6 ([w0 x]^2 + 4 [wm x]^2 + [w1 x]^2)`, wm = dtheta / T; `[w x]^2 = w w^T - w^2 I`.
    """
    end, middle = T * (1 / 6), (4 / 6) / T
    xx = end * (w0[0] * w0[0] + w1[0] * w1[0]) + middle * (dtheta[0] * dtheta[0])
    yy = end * (w0[1] * w0[1] + w1[1] * w1[1]) + middle * (dtheta[1] * dtheta[1])
    zz = end * (w0[2] * w0[2] + w1[2] * w1[2]) + middle * (dtheta[2] * dtheta[2])
    xy = end * (w0[0] * w0[1] + w1[0] * w1[1]) + middle * (dtheta[0] * dtheta[1])
    yz = end * (w0[1] * w0[2] + w1[1] * w1[2]) + middle * (dtheta[1] * dtheta[2])
    zx = end * (w0[2] * w0[0] + w1[2] * w1[0]) + middle * (dtheta[2] * dtheta[0])
    x, y, z = subtract(w1, w0)
    return (-yy - zz, xy - z, zx + y), (xy + z, -zz - xx, yz - x), (zx - y, yz + x, -xx - yy)
