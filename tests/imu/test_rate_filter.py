"""Rate filters: exact for the motions they promise, quiet where the dither is."""

import numpy as np
import pytest
from scipy import signal

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


@pytest.mark.parametrize(("name", "lag"), [("causal", 0), ("centred", 1), ("dither", 8)])
def test_the_lag_is_the_samples_behind_the_interval_that_a_filter_waits_for(name, lag):
    assert rate_filter(name, TAU_NS).lag == lag


def test_the_dither_filter_has_linear_phase():
    taps = rate_filter("dither", TAU_NS).taps
    assert np.array_equal(taps, taps[::-1])


def passed(f: RateFilter | str, frequency_hz: float, tau: float = TAU) -> float:
    """Amplitude of the rate that a filter gives for a vibration of amplitude 1, worst phase."""
    if isinstance(f, str):
        f = rate_filter(f, round(tau * 1e9))
    edges = tau * (np.arange(len(f.taps) + 1) - len(f.taps) + f.lag)
    angle = np.exp(2j * np.pi * frequency_hz * edges) / (2j * np.pi * frequency_hz)
    return float(abs(f.taps @ np.diff(angle))) / tau


def test_the_dither_filter_takes_out_the_dither_and_the_others_do_not():
    # The design leaves 3.9e-9 anywhere in the band: of 2 rad/s, 8e-9 rad/s.
    assert max(passed("dither", f) for f in np.linspace(370.0, 430.0, 121)) < 5e-9
    assert passed("causal", 400.0) > 1.0  # a filter that looks ahead amplifies it


@pytest.mark.parametrize("rate_hz", [160, 245, 550, 600, 700, 800, 900, 1100, 1300, 1600, 1840])
def test_the_dither_filter_takes_out_the_dither_at_every_sample_rate_that_it_is_made_for(rate_hz):
    # The wider the band, in parts of the sample rate, the more: at 160-300 Hz 3e-4, from 550 Hz on 6e-5.
    tau = 1.0 / rate_hz
    allowed = 5e-4 if rate_hz < 500 else 1e-4
    assert max(passed("dither", f, tau) for f in np.linspace(370.0, 430.0, 61)) < allowed


def test_the_dither_filter_leaves_rocking_alone():
    # Fierce rocking is at 3 Hz; the fourth degree, the first that is not exact, takes 2.5e-7 of it there.
    assert passed("dither", 3.0) == pytest.approx(1.0, abs=5e-7)


def test_the_dither_filter_amplifies_nothing():
    assert max(passed("dither", f) for f in np.linspace(1.0, 500.0, 500)) <= 1.0


def test_no_plain_low_pass_of_this_length_is_exact_and_as_quiet():
    taps = len(rate_filter("dither", TAU_NS).taps)
    plain = {
        "remez": signal.remez(taps, [0, 20, 370, 500], [1, 0], fs=1000),
        "firwin2": signal.firwin2(taps, [0, 50, 250, 500], [1, 1, 0, 0], fs=1000),
        "firwin": signal.firwin(taps, 150, window=("kaiser", 8.0), fs=1000),
    }
    for name, h in plain.items():
        f = RateFilter("dither", h / h.sum(), taps // 2)
        assert abs(passed(f, 3.0) - 1.0) > 1e-6, name
        assert max(passed(f, x) for x in np.linspace(370.0, 430.0, 61)) > 1e-6, name


@pytest.mark.parametrize(("rate_hz", "appears_at"), [(400, "0 Hz"), (500, "100 Hz"), (200, "0 Hz")])
def test_the_dither_filter_is_refused_where_sampling_hides_the_dither_in_the_motion(rate_hz, appears_at):
    message = f"rate filter dither: expected .*got {rate_hz} Hz, where it appears at {appears_at}; use causal"
    with pytest.raises(InputError, match=message):
        rate_filter("dither", round(1e9 / rate_hz))


@pytest.mark.parametrize("rate_hz", [400, 100])
@pytest.mark.parametrize("name", ["causal", "centred"])
def test_the_short_filters_are_the_same_at_any_sample_rate(name, rate_hz):
    assert np.array_equal(rate_filter(name, round(1e9 / rate_hz)).taps, rate_filter(name, TAU_NS).taps)
