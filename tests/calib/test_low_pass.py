"""Dither in the angle increments is filtered out and named; motion stays, and no cut of the data shows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.estimation.dither_line import dither_lines
from calib.estimation.low_pass import without_dither
from imudrv.records import INCREMENTS, Records
from imudrv.units import ARCSEC

HALF = 8
"""Rows at each end whose neighbours are not all there."""


def capture(dtheta: np.ndarray, interval_ns: int = 1_000_000) -> Records:
    rows = np.zeros(len(dtheta), INCREMENTS)
    rows["counter"] = 7 + np.arange(len(rows))
    rows["interval_ns"] = interval_ns
    rows["dtheta_b"] = dtheta[:, None] * [1.0, -2.0, 0.5]
    rows["dv_b"] = np.random.default_rng(1).standard_normal((len(rows), 3))
    return rows


def filtered(rows: Records) -> Records:
    return np.concatenate(list(without_dither([rows])))


@pytest.mark.parametrize("frequency_hz", [370.0, 391.0, 400.0, 412.0, 430.0])
def test_dither_is_removed(frequency_hz: float) -> None:
    t = np.arange(4001) * 1e-3
    out = filtered(capture(np.diff(1e-3 * np.sin(2.0 * np.pi * frequency_hz * t))))
    # the filter passes 6e-5 of the amplitude; increments of a sine reach twice its amplitude
    assert np.abs(out["dtheta_b"][:, 0]).max() < 1.5e-7


def test_a_turn_by_hand_stays_as_it_was() -> None:
    u = np.clip((np.arange(5001) - 1000) / 2500.0, 0.0, 1.0)
    angle = np.pi * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    rows = capture(np.diff(angle))
    out = filtered(rows)
    middle = rows["dtheta_b"][HALF:-HALF]
    # the trapezoidal rule: T^3 / 12 times the second derivative of the rate, at most 12 rad/s^3; at the ends
    # of the quintic, where that jumps, some times more
    assert np.abs(out["dtheta_b"] - middle)[:, 0].max() < 1e-9 / 12.0 * 12.0 * 4.0
    np.testing.assert_allclose(out["dtheta_b"].sum(axis=0), middle.sum(axis=0), rtol=1e-9)
    for name in ("counter", "interval_ns", "dv_b", "flags", "t_ns"):
        np.testing.assert_array_equal(out[name], rows[name][HALF:-HALF])


@given(cuts=st.lists(st.integers(0, 300), max_size=12))
@settings(max_examples=50, deadline=None)
def test_any_pieces_give_the_same_bits(cuts: list[int]) -> None:
    rows = capture(np.random.default_rng(2).standard_normal(300))
    whole = filtered(rows)
    pieces = np.split(rows, sorted(cuts))
    np.testing.assert_array_equal(np.concatenate(list(without_dither(pieces))), whole)


def test_rows_beside_a_gap_are_as_they_came() -> None:
    rows = capture(np.random.default_rng(3).standard_normal(200))
    rows["counter"][100:] += 5
    rows["interval_ns"][100] *= 6
    out = filtered(rows)
    changed = (out["dtheta_b"] != rows["dtheta_b"][HALF:-HALF]).all(axis=1)
    at = np.flatnonzero(~changed) + HALF
    assert at.tolist() == list(range(100 - HALF, 101 + HALF))


def test_at_a_rate_that_aliases_the_dither_nothing_changes() -> None:
    rows = capture(np.random.default_rng(4).standard_normal(50), interval_ns=5_000_000)
    np.testing.assert_array_equal(filtered(rows), rows)


def test_a_capture_shorter_than_the_filter_gives_no_rows() -> None:
    assert list(without_dither([capture(np.ones(2 * HALF))])) == []
    assert list(without_dither([])) == []


@pytest.mark.parametrize(
    ("interval_ms", "shown_hz"),
    [
        pytest.param(1.0, 392.0, id="1 kHz"),
        pytest.param(2.5, 8.0, id="400 Hz"),
        pytest.param(5.0, 8.0, id="200 Hz"),
    ],
)
def test_dither_is_named_at_a_sample_rate_that_aliases_it_into_the_motion(
    interval_ms: float, shown_hz: float
) -> None:
    t = interval_ms * 1e-3 * np.arange(round(20e3 / interval_ms) + 1)
    angle = 1e-8 * np.random.default_rng(1).standard_normal((len(t), 3))
    angle[:, 1] += 10.0 * ARCSEC * np.sin(2.0 * np.pi * 392.0 * t)
    (line,) = dither_lines(np.diff(angle, axis=0), interval_ms * 1e-3)
    assert (line.axis, line.frequency_hz) == ("Y", pytest.approx(shown_hz, abs=0.5))
    assert line.amplitude_rad == pytest.approx(10.0 * ARCSEC, rel=0.05)  # windows of a second


def test_what_sways_a_bench_is_not_taken_for_dither() -> None:
    t = 1e-3 * np.arange(20_001)
    angle = 1e-8 * np.random.default_rng(1).standard_normal((len(t), 3))
    angle[:, 1] += 10.0 * ARCSEC * np.sin(2.0 * np.pi * 8.0 * t)
    assert dither_lines(np.diff(angle, axis=0), 1e-3) == ()
