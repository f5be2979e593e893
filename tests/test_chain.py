"""The whole road: motion -> true increments -> pulses -> wire -> decode -> compensate -> true increments."""

import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from imudrv import profiles
from imudrv.calibration import Calibration, coefficients
from imudrv.errors import InputError
from imudrv.files.settings_file import parse
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import RateFilterName
from imudrv.imu.sequence import SequenceTracker
from imudrv.records import Flag, Records
from imudrv.sim.capture import record
from imudrv.sim.scenario import Scenario, nominal
from imudrv.units import ARCSEC, NS
from imudrv.wire.decoder import CaptureDecoder
from imudrv.wire.layout import Layout, Sensor, Values

MISALIGNED = [[0.9995, 0.0021, -0.0013], [-0.0008, 1.0004, 0.0017], [0.0011, -0.0019, 1.0002]]
ARMS_MM = {"x": [24.0, -11.0, -9.0], "y": [-23.0, 29.0, -7.0], "z": [-1.0, -18.0, 16.0]}


def unit(arcsec: float, pulse_per_m_s: float) -> Calibration:
    """A unit with every static error and known sensing points."""
    document = {
        "format": "imu50-calibration",
        "version": 1,
        "serial_number": "50-0001",
        "created": "2026-11-22T10:00:00Z",
        "gyro": {
            "scale_arcsec_per_pulse": [arcsec, 1.1 * arcsec, 0.9 * arcsec],
            "bias_deg_per_h": [0.3, -0.2, 0.1],
            "C_bg": MISALIGNED,
        },
        "accelerometer": {
            "scale_pulse_per_m_s": [pulse_per_m_s, 1.2 * pulse_per_m_s, 0.8 * pulse_per_m_s],
            "bias_ug": [80.0, -190.0, 40.0],
            "C_ba": np.transpose(MISALIGNED).tolist(),
        },
        "size_effect": {"r_mm": ARMS_MM, "gauge": "centroid"},
        "temperature": {
            "reference_degc": 35.0,
            "range_degc": [10.0, 60.0],
            "gyro_bias_deg_per_h_per_k": [0.01, -0.02, 0.03],
            "gyro_scale_ppm_per_k": [2.0, -3.0, 4.0],
            "accelerometer_bias_ug_per_k": [10.0, -20.0, 15.0],
            "accelerometer_scale_ppm_per_k": [20.0, -30.0, 10.0],
        },
    }
    return parse(document, Calibration, "unit")


def scenario(calibration: Calibration, motion: list[dict[str, object]]) -> Scenario:
    document = {
        "format": "imu50-scenario",
        "version": 1,
        "seed": 3,
        "site": {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0},
        "start": {"counter": 2**32 - 700, "pivot_offset_mm": [60.0, -20.0, 10.0]},
        "motion": motion,
        "unit": {
            "calibration": json.loads(calibration.model_dump_json(exclude_none=True)),
            "temperature": {"start_degc": 38.0},
        },
    }
    return parse(document, Scenario, "scenario")


ROCKING: list[dict[str, object]] = [
    {"rest": {"duration_s": 0.5}},
    {"rock": {"duration_s": 3.0, "band_hz": [2.5, 3.0], "rate_rms_deg_per_s": [20.0, 20.0, 20.0]}},
]


def driven(
    profile: str, run: Scenario, calibration: Calibration, filter_name: RateFilterName = "causal"
) -> tuple[Records, Records]:
    """Compensated increments and the truth of the same samples."""
    layout = profiles.load(profile).layout()
    decoder, tracker = CaptureDecoder(layout), SequenceTracker(layout)
    compensator = Compensator(coefficients(calibration), layout, filter_name)
    got, truth = [], []
    for data, true in record(run, layout):
        got.append(compensator.feed(tracker.feed(decoder.feed(data))))
        truth.append(true)
    got += [compensator.feed(tracker.feed(decoder.close())), compensator.close()]
    assert tracker.counts.closes
    assert tracker.counts.lost == 0
    increments, true = np.concatenate(got), np.concatenate(truth)
    first = len(true) - len(increments)  # running totals give no sample for their first frame
    np.testing.assert_array_equal(np.diff(true["counter"]), layout.counter_step)
    np.testing.assert_array_equal(np.diff(increments["counter"]), 1)
    if layout.counter_step == 1:
        period = 2 ** min(16, layout.sequence.bits)
        np.testing.assert_array_equal((increments["counter"] - true["counter"][first:]) % period, 0)
    return increments, true[first:]


@pytest.mark.parametrize("profile", profiles.OWN)
def test_increments_equal_the_truth_within_the_quantisation(profile: str) -> None:
    arcsec, pulse_per_m_s = 0.5, 2000.0
    calibration = unit(arcsec, pulse_per_m_s)
    increments, truth = driven(profile, scenario(calibration, ROCKING), calibration)
    # The temperature goes out in 0.01 K, over CAN it is known from the first 0x152 on: no error at 38 degC.
    assert np.all(increments["flags"] & Flag.VALID)
    # Pulses are rounded with carry: a sum of increments is off by half a pulse at each end, 1.1 the largest
    # scale, misalignment mixes in 0.5 % of the others.
    angle = np.abs(np.cumsum(increments["dtheta_b"] - truth["dtheta_b"], axis=0))
    assert angle.max() < 1.1 * 1.006 * arcsec * ARCSEC
    # Velocity: the same of its own pulses (0.8 the smallest scale), and the size effect of a rate wrong
    # by no more than sum |h| = 20/6 pulses an interval at the end of the sum and at its begin, on arms of
    # 39 mm; the centripetal part of that error averages out to less than a tenth of it.
    pulse = 1.006 / (0.8 * pulse_per_m_s)
    rate = 20.0 / 6.0 * 1.1 * arcsec * ARCSEC / 1e-3
    settled = slice(4, None)  # the first samples have no size effect compensated, the body still rests
    velocity = np.abs(np.cumsum((increments["dv_b"] - truth["dv_b"])[settled], axis=0))
    assert velocity.max() < pulse + 1.1 * 2.0 * rate * 0.039


@pytest.mark.parametrize("filter_name", ["causal", "centred", "dither"])
def test_the_size_effect_of_rocking_is_removed_to_a_tenth_of_a_micrometre_per_second(
    filter_name: str,
) -> None:
    calibration = unit(2e-5, 2e8)  # so fine that pulses hide nothing
    run = scenario(calibration, ROCKING)
    increments, truth = driven("imu50-canfd", run, calibration, filter_name)
    compensated = (increments["flags"] & Flag.SIZE_EFFECT) != 0
    assert compensated.mean() > 0.98
    error = np.abs(increments["dv_b"] - truth["dv_b"])[compensated]
    assert error.max() < 1e-7
    # What there was to take off is a thousand times larger.
    uncompensated = calibration.without_size_effect()
    without, truth = driven("imu50-canfd", run, uncompensated)
    assert np.abs(without["dv_b"] - truth["dv_b"]).max() > 1e-4


OTHERS = [name for name in profiles.shipped() if name not in profiles.OWN]


def another_unit(layout: Layout) -> Calibration:
    """A unit with the static errors of `unit`, whose scales differ from 1 by up to 2 %."""
    calibration = unit(0.5, 2000.0).without_size_effect().model_copy(update={"temperature": None})
    gyro, accelerometer = nominal(layout).gyro, nominal(layout).accelerometer
    sent = {
        "gyro": gyro.model_copy(
            update={
                "scale": (1.01, 0.99, 1.02),
                "bias_deg_per_h": calibration.gyro.bias_deg_per_h,
                "C_bg": calibration.gyro.C_bg,
            }
        ),
        "accelerometer": accelerometer.model_copy(
            update={
                "scale": (0.99, 1.02, 1.01),
                "bias_ug": calibration.accelerometer.bias_ug,
                "C_ba": calibration.accelerometer.C_ba,
            }
        ),
    }
    return calibration.model_copy(update=sent)


def half_counts(sensor: Sensor, interval_ns: int, largest: float) -> np.ndarray:
    """Half a count of each axis in rad and m/s; of a floating-point number half its last place."""
    size = []
    for axis, per_count in zip(sensor.axes, sensor.per_count, strict=True):
        if axis is None:
            size.append(np.nan)
        elif axis.is_float:
            size.append(largest * 2.0 ** (-24 if axis.size == 4 else -53))
        else:
            size.append(0.5 * per_count * (interval_ns * NS if sensor.values is Values.RATE else 1.0))
    return np.array(size)


@pytest.mark.parametrize("profile", OTHERS)
def test_increments_of_other_units_equal_the_truth_within_half_a_count(profile: str) -> None:
    layout = profiles.load(profile).layout()
    calibration = another_unit(layout)
    increments, truth = driven(profile, scenario(calibration, ROCKING), calibration)
    assert np.all(increments["flags"] == Flag.VALID)
    known = coefficients(calibration)
    for name, sensor, C, scale in (
        ("dtheta_b", layout.gyro, known.C_bg, known.gyro_scale),
        ("dv_b", layout.accelerometer, known.C_ba, 1.0 / known.accelerometer_scale),
    ):
        error = increments[name] - truth[name]
        half = half_counts(sensor, layout.interval_ns, np.abs(truth[name]).max() * 1.03)
        if sensor.values is not Values.RATE and not any(axis and axis.is_float for axis in sensor.axes):
            # Rounded with carry: a sum is off by half a count at its end, of totals at its begin too.
            error = np.cumsum(error, axis=0)
            half *= 2.0 if sensor.values is Values.TOTAL else 1.0
        # Misalignment mixes the axes. Beyond the quantisation: sums of 3500 float64 numbers below 0.1.
        limit = np.abs(C) @ (scale * half) + 3500 * 0.1 * 2.0**-52
        missing = [axis is None for axis in sensor.axes]
        mixed = np.asarray(C)[:, missing].any(axis=1)  # body axes of which a missing axis is a part
        assert np.isnan(error[:, mixed]).all()
        assert np.all(np.abs(error[:, ~mixed]) <= limit[~mixed])
        assert len(error) > 300


def test_a_certificate_of_pulses_is_refused_for_a_unit_that_sends_radians_and_the_other_way_round() -> None:
    of_pulses, of_radians = (profiles.load(name).layout() for name in ("imu50-rs422", "kvh1775"))
    with pytest.raises(InputError, match=r"gyro\.scale for kvh1775, which sends other units than pulses"):
        next(record(scenario(unit(0.5, 2000.0), ROCKING), of_radians))
    with pytest.raises(InputError, match=r"gyro\.scale_arcsec_per_pulse for imu50-rs422, which sends pulses"):
        next(record(scenario(another_unit(of_radians), ROCKING), of_pulses))


@pytest.mark.parametrize("profile", ["kvh1775", "ilabs-ga-200", "stim300-91-totals"])
def test_intervals_of_a_rate_that_is_a_ratio_add_up_exactly(profile: str) -> None:
    layout = replace(profiles.load(profile).layout(), interval=Fraction(5 * 10**9, 4096))
    samples = 1_000_000
    run = scenario(nominal(layout), [{"rest": {"duration_s": float(samples * layout.interval * NS)}}])
    decoder, tracker = CaptureDecoder(layout), SequenceTracker(layout)
    total_ns = count = 0
    for data, truth in record(run, layout):
        rows = tracker.feed(decoder.feed(data))
        total_ns += int(rows["interval_ns"].sum())
        count += len(truth)
        assert set(rows["interval_ns"].tolist()) <= {1_220_703, 1_220_704}
    assert count == samples
    assert tracker.counts.lost == 0
    # 1e6 samples of 5 / 4096 s are 1 220 703 125 us; a running total gives no increment for its first sample.
    first_ns = 1_220_703 if layout.totals else 0
    assert total_ns == 1_220_703_125_000 - first_ns


@pytest.mark.parametrize("profile", ["fog-fg333", "exail-asterix"])
def test_without_all_gyros_or_any_accelerometer_no_size_effect_is_compensated(profile: str) -> None:
    calibration = nominal(profiles.load(profile).layout())
    assert calibration.size_effect is not None
    increments, _ = driven(profile, scenario(calibration, ROCKING), calibration)
    assert not np.any(increments["flags"] & Flag.SIZE_EFFECT)
