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

**The measurement matrices** say how the navigated velocity responds to residual errors of the increments
(mathematics, sections 2 and 4). All errors are measured minus true, to first order:

    delta v_n = H R + B b + f_n x (phi_0 t - Q vec(dG))        phi = phi_0 - P vec(dG)

    H (3, 9)  R: sensing points (r_x, r_y, r_z) that were not compensated, m
    B (3, 3)  b: residual bias of the specific force, body axes, m/s^2; the integral of C_nb
    P (3, 9)  dG by rows: scale and misalignment, `dG @ omega_ib_b` too much rate; integral of C_nb kron omega
    Q (3, 9)  the integral of P

A size effect also acts back through Coriolis' acceleration (1.5e-3 of it in 10 s), so that

    dH/dt = C_nb S - 2 omega_ie x H

and a common shift of the sensing points, which is a true motion, leaves no velocity at rest. Not in the
matrices: gravity at a wrong position (`1.5e-6 t^2 / 2`: 1e-4 after 12 s), the speed over ground in the
Coriolis term and, in B, P and Q, the Earth's rotation (7e-5 t).

H is causal, without lag: the rate at an interval's end comes from this interval and the two before, exact for
a rate quadratic in time. Before the first interval the body rests on the Earth, so that the noise of a first
rate, which would stay in H forever, does not enter.

Time without increments is not navigated; a row has the flags of its sample.
"""

from math import cos, sin, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.kernels import kernel
from imudrv.nav.attitude import (
    Quaternion,
    conjugate,
    product,
    put_quaternion,
    quaternion_at,
    quaternion_of_vector,
    rows_of,
    turn,
    unit,
)
from imudrv.nav.earth import SEMI_MAJOR_AXIS, earth_rate_n, normal_gravity, radii
from imudrv.records import Records
from imudrv.units import NS
from imudrv.vectors import Matrix, Vector, add, cross, dot, put, scale, subtract, vector_at

_NAVIGATION: Final = [
    ("counter", np.int64),
    ("t_ns", np.int64),  # end of the interval
    ("flags", np.int64),  # of the sample
    ("q_nb", np.float64, 4),  # scalar first
    ("v_n", np.float64, 3),  # east, north, up, m/s
    ("latitude_rad", np.float64),
    ("longitude_rad", np.float64),
    ("height_m", np.float64),
]
_MATRICES: Final = [
    ("H", np.float64, (3, 9)),
    ("B", np.float64, (3, 3)),
    ("P", np.float64, (3, 9)),
    ("Q", np.float64, (3, 9)),
]
NAVIGATION: Final = np.dtype(_NAVIGATION)
"""Attitude, velocity and position at the end of a sample."""
MEASUREMENT: Final = np.dtype([*_NAVIGATION, *_MATRICES])
"""`NAVIGATION` and the measurement matrices."""

CONSTANTS: Final = np.dtype(
    [
        ("gravity_offset", np.float64),  # of measured from normal gravity, m/s^2
        ("C_ba", np.float64, (3, 3)),
        ("a_b", np.float64, (3, 3)),  # row i: sensing axis of accelerometer i
    ],
    align=True,
)
"""Constants of a navigation."""

STATE: Final = np.dtype(
    [
        ("q_nb", np.float64, 4),
        ("v_n", np.float64, 3),
        ("position", np.float64, 3),  # latitude and longitude, rad, height, m
        ("T1", np.float64),  # the interval before, s, rad, m/s
        ("dtheta1", np.float64, 3),
        ("dv1", np.float64, 3),
        ("T2", np.float64),  # and the one before that
        ("dtheta2", np.float64, 3),
        ("omega1", np.float64, 3),  # rate at the end of the interval before, rad/s
        ("earth_at", np.float64, 2),  # latitude, rad, and height, m, of the Earth's terms
    ],
    align=True,
)
"""State that a call of the kernels leaves to the next."""

MATRICES: Final = np.dtype(_MATRICES)
"""State of the measurement matrices."""

NEAR: Final = 0.01
"""Distance to the north or up for which the Earth's terms are reused, m; they take a third of the time."""

MAX_LATITUDE: Final = 1.5
"""Largest latitude, rad: east and north have no meaning at the poles."""


class Place(NamedTuple):
    """A place on the Earth."""

    latitude_rad: float  # geodetic
    longitude_rad: float
    height_m: float  # above the ellipsoid
    gravity_m_s2: float | None = None  # measured; None: normal gravity


class Navigator:
    """Navigation from a known attitude and position; any chunks give the same bits.

    Parameters
    ----------
    place : Place
        Position at the start. The difference of its gravity from normal gravity is added everywhere.
    q_nb : array_like, shape (4,)
        Attitude at the start.
    v_n : array_like, shape (3,)
        Velocity at the start, m/s.
    C_ba : array_like, shape (3, 3), optional
        Accelerometer axes to body. With it rows are `MEASUREMENT`, and the body must rest at the start.
    every : int
        Only every n-th sample makes a row, counted from the start.

    Raises
    ------
    InputError
        A start that is no attitude or lies at a pole.
    """

    def __init__(
        self,
        place: Place,
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
        latitude_rad, _, height_m, gravity_m_s2 = place
        position = _checked("latitude, longitude, height", place[:3], (3,))
        if abs(latitude_rad) > MAX_LATITUDE:
            raise InputError(
                f"navigation: expected a latitude of at most {MAX_LATITUDE} rad, got {latitude_rad:.9g}; "
                "east and north have no meaning at a pole"
            )
        if every < 1:
            raise InputError(f"navigation: expected a row every 1 or more samples, got {every}")
        gravity = normal_gravity(latitude_rad, height_m)
        C = np.eye(3) if C_ba is None else _checked("C_ba", C_ba, (3, 3))
        self._constants = np.zeros(1, CONSTANTS)
        self._constants["gravity_offset"] = 0.0 if gravity_m_s2 is None else gravity_m_s2 - gravity
        self._constants["C_ba"], self._constants["a_b"] = C, np.linalg.inv(C)
        self._matrices = None if C_ba is None else np.zeros(1, MATRICES)
        self._every = every
        self._samples = 0
        self._state = np.zeros(1, STATE)
        self._state["q_nb"] = q / np.linalg.norm(q)
        self._state["v_n"] = _checked("velocity v_n", v_n, (3,))
        self._state["position"] = position
        self._state["earth_at"] = latitude_rad, height_m

    @property
    def latest(self) -> Records:
        """Current state as one row, shape (1,); its `counter`, `t_ns` and `flags` are zero."""
        row = np.zeros(1, NAVIGATION if self._matrices is None else MEASUREMENT)
        row["q_nb"], row["v_n"] = self._state["q_nb"], self._state["v_n"]
        row["latitude_rad"], row["longitude_rad"], row["height_m"] = self._state["position"][0]
        if self._matrices is not None:
            for name in MATRICES.names or ():
                row[name] = self._matrices[name]
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
        skip = -(self._samples + 1) % self._every  # samples before the first that makes a row
        reported = increments[skip :: self._every]
        out = np.empty(len(reported), NAVIGATION if self._matrices is None else MEASUREMENT)
        for name in ("counter", "t_ns", "flags"):
            out[name] = reported[name]
        _navigate(increments, out, self._constants, self._state, self._matrices, skip, self._every)
        self._samples += len(increments)
        return out

    def _rest_before(self, T: float) -> None:
        """Fill in the two intervals before the first: the body rests on the Earth."""
        s = self._state[0]
        q_bn = conjugate(tuple(s["q_nb"].tolist()))
        latitude, _, height = s["position"].tolist()
        gravity = normal_gravity(latitude, height) + self._constants[0]["gravity_offset"]
        rate = turn(q_bn, earth_rate_n(latitude))
        s["T1"], s["T2"], s["omega1"] = T, T, rate
        s["dtheta1"] = s["dtheta2"] = scale(T, rate)
        s["dv1"] = turn(q_bn, (0.0, 0.0, gravity * T))


def _checked(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.array(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"navigation: expected {name} as finite numbers of shape {shape}, got {value!r}")
    return array


class _Motion(NamedTuple):
    """Attitude, velocity and position."""

    q_nb: Quaternion
    v_n: Vector  # m/s
    position: Vector  # latitude and longitude, rad, height, m


class Gained(NamedTuple):
    """Rotation and velocity of an interval."""

    phi: Vector  # rotation vector, rad
    dv_b: Vector  # m/s, body axes of the interval's beginning


@kernel
def _navigate(
    increments: Records,
    out: Records,
    constants: Records,
    state: Records,
    matrices: Records | None,
    skip: int,
    every: int,
) -> None:
    """Step through `increments`; row `skip` and every `every`-th after it go to `out`.

    numba compiles a version of its own for `matrices` None, in which their code does not exist.
    """
    c, s = constants[0], state[0]
    now = _Motion(quaternion_at(s["q_nb"]), vector_at(s["v_n"], 0), vector_at(s["position"], 0))
    T1, dtheta1, dv1 = s["T1"], vector_at(s["dtheta1"], 0), vector_at(s["dv1"], 0)
    T2, dtheta2, omega1 = s["T2"], vector_at(s["dtheta2"], 0), vector_at(s["omega1"], 0)
    weights, T_weights = (0.0, 0.0, 0.0), 0.0
    latitude, height = s["earth_at"][0], s["earth_at"][1]
    earth = _earth(latitude, height, c["gravity_offset"])
    filled = 0
    for i in range(increments.shape[0]):
        sample = increments[i]
        T = sample["interval_ns"] * NS
        # element by element: a helper for three costs 2 ns per sample
        dtheta = (sample["dtheta_b"][0], sample["dtheta_b"][1], sample["dtheta_b"][2])
        dv = (sample["dv_b"][0], sample["dv_b"][1], sample["dv_b"][2])
        before = now
        gained = body_step(T, dtheta, dv, T1, dtheta1, dv1)
        if _is_far(now.position, latitude, height):
            latitude, height = now.position[0], now.position[2]
            earth = _earth(latitude, height, c["gravity_offset"])
        now = _step(before, T, gained, earth)
        if matrices is not None:
            if not T == T1 == T2 == T_weights:
                weights, T_weights = _end_rate_weights(T, T1, T2), T if T == T1 == T2 else 0.0
            latest = add(scale(weights[0], dtheta), scale(weights[1], dtheta1))
            omega = add(latest, scale(weights[2], dtheta2))
            Omega = _omega_increment(T, dtheta, omega1, omega)
            _measure(matrices[0], c, _halfway(before.q_nb, now.q_nb), Omega, earth.omega_ie, T, dtheta)
            T2, dtheta2, omega1 = T1, dtheta1, omega
        T1, dtheta1, dv1 = T, dtheta, dv
        if i == skip:
            row = out[filled]
            put_quaternion(row["q_nb"], now.q_nb)
            put(row["v_n"], 0, now.v_n)
            row["latitude_rad"], row["longitude_rad"], row["height_m"] = now.position
            if matrices is not None:
                row["H"], row["B"] = matrices[0]["H"], matrices[0]["B"]
                row["P"], row["Q"] = matrices[0]["P"], matrices[0]["Q"]
            filled += 1
            skip += every
    put_quaternion(s["q_nb"], now.q_nb)
    put(s["v_n"], 0, now.v_n)
    put(s["position"], 0, now.position)
    s["T1"], s["T2"] = T1, T2
    put(s["dtheta1"], 0, dtheta1)
    put(s["dv1"], 0, dv1)
    put(s["dtheta2"], 0, dtheta2)
    put(s["omega1"], 0, omega1)
    s["earth_at"][0], s["earth_at"][1] = latitude, height


@kernel
def body_step(T: float, dtheta: Vector, dv: Vector, T1: float, dtheta1: Vector, dv1: Vector) -> Gained:
    """Rotation and velocity of an interval, with coning, sculling and rotation.

    Parameters
    ----------
    T, T1 : float
        This interval and the one before, s.
    dtheta, dv, dtheta1, dv1 : tuple of 3 float
        Their increments, rad and m/s.

    Returns
    -------
    Gained
    """
    k = T * T / (6.0 * T1 * (T1 + T))
    phi = add(dtheta, scale(k, cross(dtheta1, dtheta)))
    sculling = add(cross(dtheta1, dv), cross(dv1, dtheta))
    dv = add(dv, scale(k, sculling))
    x = dot(dtheta, dtheta)
    if x < 0.01:  # series; the first term left out is below 1e-13
        c1 = 1 / 2 + x * (-1 / 24 + x * (1 / 720 + x * (-1 / 40320)))
        c2 = 1 / 6 + x * (-1 / 120 + x * (1 / 5040 + x * (-1 / 362880)))
    else:
        angle = sqrt(x)
        c1, c2 = (1.0 - cos(angle)) / x, (1.0 - sin(angle) / angle) / x
    turned = cross(dtheta, dv)
    return Gained(phi, add(dv, add(scale(c1, turned), scale(c2, cross(dtheta, turned)))))


class _Earth(NamedTuple):
    omega_ie: Vector  # rad/s
    gravity: float  # m/s^2
    per_north: float  # rad of latitude per metre to the north
    per_east: float  # rad of rotation about the meridian per metre to the east
    secant: float  # of the latitude
    tangent: float


@kernel
def _earth(latitude: float, height: float, gravity_offset: float) -> _Earth:
    """Terms of the Earth that depend on the position."""
    meridian, prime_vertical = radii(latitude)
    secant = 1.0 / cos(latitude)
    return _Earth(
        earth_rate_n(latitude),
        normal_gravity(latitude, height) + gravity_offset,
        1.0 / (meridian + height),
        1.0 / (prime_vertical + height),
        secant,
        sin(latitude) * secant,
    )


@kernel
def _is_far(position: Vector, latitude: float, height: float) -> bool:
    """Whether the Earth's terms of that latitude and height no longer serve."""
    return abs(position[0] - latitude) * SEMI_MAJOR_AXIS > NEAR or abs(position[2] - height) > NEAR


@kernel
def _step(before: _Motion, T: float, gained: Gained, earth: _Earth) -> _Motion:
    """Attitude, velocity and position after an interval."""
    q, v, (latitude, longitude, height) = before.q_nb, before.v_n, before.position
    gravity = (0.0, 0.0, -earth.gravity * T)

    dv_n = turn(q, gained.dv_b)
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
    # the meridians converge on the way: cosine of the middle latitude, to first order
    east_rad = mean[0] * earth.per_east * earth.secant * (1.0 + 0.5 * earth.tangent * north_rad)
    position = latitude + north_rad, longitude + east_rad, height + mean[2]
    # zeta, 7e-5 rad a second, to second order: `unit` restores what the cosine lacks
    q_zeta = (1.0, -0.5 * zeta[0], -0.5 * zeta[1], -0.5 * zeta[2])
    return _Motion(unit(product(q_zeta, product(q, quaternion_of_vector(gained.phi)))), v1, position)


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
def _halfway(q: Quaternion, q1: Quaternion) -> Matrix:
    """Rotation matrix half-way between two close attitudes: the sum of their quaternions lies there."""
    return rows_of((q[0] + q1[0], q[1] + q1[1], q[2] + q1[2], q[3] + q1[3]))


@kernel
def _measure(
    m: np.void, c: np.void, C_nb: Matrix, Omega: Matrix, omega_ie: Vector, T: float, dtheta: Vector
) -> None:
    """Take H, B, P and Q through an interval; `C_nb` is the attitude in its middle."""
    zeta = scale(2.0 * T, omega_ie)  # without an east component
    for i in range(3):
        _gain_columns(m["H"], i, c, C_nb, Omega, zeta)
    half = scale(0.5, dtheta)
    _gain_rows(m, 0, T, C_nb[0], half)
    _gain_rows(m, 1, T, C_nb[1], half)
    _gain_rows(m, 2, T, C_nb[2], half)


@kernel
def _gain_columns(H: Array, i: int, c: np.void, C_nb: Matrix, Omega: Matrix, zeta: Vector) -> None:
    """Columns of H of accelerometer i: add `C_nb c_i a_i^T Omega`, subtract `zeta x` the columns."""
    a = vector_at(c["a_b"][i], 0)
    sensed = add(scale(a[0], Omega[0]), add(scale(a[1], Omega[1]), scale(a[2], Omega[2])))
    C_ba = c["C_ba"]
    column = C_ba[0, i], C_ba[1, i], C_ba[2, i]
    east, north, up = vector_at(H[0], 3 * i), vector_at(H[1], 3 * i), vector_at(H[2], 3 * i)
    north1 = subtract(north, scale(zeta[2], east))
    up1 = add(up, scale(zeta[1], east))
    east1 = add(east, subtract(scale(zeta[2], north), scale(zeta[1], up)))
    put(H[0], 3 * i, add(east1, scale(dot(C_nb[0], column), sensed)))
    put(H[1], 3 * i, add(north1, scale(dot(C_nb[1], column), sensed)))
    put(H[2], 3 * i, add(up1, scale(dot(C_nb[2], column), sensed)))


@kernel
def _gain_rows(m: np.void, n: int, T: float, c: Vector, half: Vector) -> None:
    """Row n of B, P and Q; c is that row of C_nb, half of dtheta."""
    B, P, Q = m["B"][n], m["P"][n], m["Q"][n]
    put(B, 0, add(vector_at(B, 0), scale(T, c)))
    _gain_angle(P, Q, 0, T, scale(c[0], half))
    _gain_angle(P, Q, 3, T, scale(c[1], half))
    _gain_angle(P, Q, 6, T, scale(c[2], half))


@kernel
def _gain_angle(P: Array, Q: Array, at: int, T: float, half: Vector) -> None:
    """Three elements of P, and of its integral Q by the trapezoidal rule; `half` of what P gains."""
    middle = add(vector_at(P, at), half)
    put(Q, at, add(vector_at(Q, at), scale(T, middle)))
    put(P, at, add(middle, half))


@kernel
def _omega_increment(T: float, dtheta: Vector, w0: Vector, w1: Vector) -> Matrix:
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
