"""Rate filters: exact for the motions they promise, quiet where the dither is."""

import numpy as np
import pytest

from imudrv.errors import InputError
from imudrv.imu.rate_filter import NAMES, RateFilter, rate_filter

TAU_NS = 1_000_000
TAU = 1e-3
PROMISED_DEGREE = {"causal": 2, "centred": 1, "dither": 2}


def apply(taps_of: RateFilter, angle: np.polynomial.Polynomial, at: int) -> float:
    """Rate at the end of interval `at`, from the increments of an angle that is a function of time."""
    newest = at + taps_of.lag
    edges = TAU * np.arange(newest - len(taps_of.taps), newest + 1)
    return float(taps_of.taps @ np.diff(angle(edges))) / TAU


@pytest.mark.parametrize("name", NAMES)
def test_a_filter_is_exact_for_the_rates_it_promises_and_for_no_more(name):
    f = rate_filter(name, TAU_NS)
    at = 3
    for degree in range(PROMISED_DEGREE[name] + 1):
        rate = np.polynomial.Polynomial.basis(degree)
        # Rounding: taps of the order of 1 times angles of the order of the rate.
        assert apply(f, rate.integ(), at) == pytest.approx(rate(at * TAU), rel=1e-9)
    # The error of one degree more is a few percent of the rate's change over the filter, far from rounding.
    # A symmetric filter has none at odd degrees about its centre, hence degree 4 there.
    beyond = 4 if name == "dither" else PROMISED_DEGREE[name] + 1
    rate = np.polynomial.Polynomial.basis(beyond)
    assert apply(f, rate.integ(), at) != pytest.approx(rate(at * TAU), rel=1e-3)


@pytest.mark.parametrize(("name", "lag"), [("causal", 0), ("centred", 1), ("dither", 12)])
def test_the_lag_is_the_samples_behind_the_interval_that_a_filter_waits_for(name, lag):
    assert rate_filter(name, TAU_NS).lag == lag


def test_the_dither_filter_has_linear_phase():
    taps = rate_filter("dither", TAU_NS).taps
    # Both halves come from the same solution.
    assert np.array_equal(taps, taps[::-1])


def passed(name: str, frequency_hz: float) -> float:
    """Amplitude of the rate that a filter gives for a vibration of amplitude 1, worst phase."""
    f = rate_filter(name, TAU_NS)
    edges = TAU * (np.arange(len(f.taps) + 1) - len(f.taps) + f.lag)
    angle = np.exp(2j * np.pi * frequency_hz * edges) / (2j * np.pi * frequency_hz)
    return float(abs(f.taps @ np.diff(angle))) / TAU


def test_the_dither_filter_takes_out_the_dither_and_the_others_do_not():
    # The design leaves 5e-8 at 400 Hz and up to 1.0e-7 within 20 Hz of it: of 2 rad/s, 2e-7 rad/s.
    assert max(passed("dither", f) for f in np.linspace(380.0, 420.0, 41)) < 2e-7
    assert passed("causal", 400.0) > 1.0  # a filter that looks ahead amplifies it


def test_the_dither_filter_leaves_rocking_alone():
    # Fierce rocking is at 3 Hz; the fourth degree, the first that is not exact, takes 1e-6 of it there.
    assert passed("dither", 3.0) == pytest.approx(1.0, abs=2e-6)


@pytest.mark.parametrize(("rate_hz", "appears_at"), [(400, "0 Hz"), (500, "100 Hz"), (200, "0 Hz")])
def test_the_dither_filter_is_refused_where_sampling_hides_the_dither_in_the_motion(rate_hz, appears_at):
    message = f"rate filter dither: expected .*got {rate_hz} Hz, where it appears at {appears_at}; use causal"
    with pytest.raises(InputError, match=message):
        rate_filter("dither", round(1e9 / rate_hz))


@pytest.mark.parametrize("rate_hz", [400, 100])
@pytest.mark.parametrize("name", ["causal", "centred"])
def test_the_short_filters_are_the_same_at_any_sample_rate(name, rate_hz):
    assert np.array_equal(rate_filter(name, round(1e9 / rate_hz)).taps, rate_filter(name, TAU_NS).taps)
