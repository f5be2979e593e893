"""The true unit of a scenario as a calibration file."""

import numpy as np

from imudrv.arrays import Array
from imudrv.calibration import Accelerometer, Calibration, Gyro, SensingPoints, SizeEffect, Temperature
from imudrv.files.model import Matrix3, Vector3
from imudrv.imu.coefficients import TemperatureTerms
from imudrv.sim.scenario import Scenario, nominal
from imudrv.sim.unit import draw_true_unit
from imudrv.units import ARCSEC, DEG_PER_H, MM, PPM, UG
from imudrv.wire.layout import Layout


def true_calibration(scenario: Scenario, layout: Layout) -> Calibration:
    """Return the calibration that would leave no error of the simulated unit but noise and dither.

    Parameters
    ----------
    scenario : Scenario
        Its unit and seed; what changes during the run (bias steps) is not part of it.
    layout : Layout
        Layout of the profile.

    Returns
    -------
    Calibration
        With the true sensing points, for comparisons.
    """
    certificate = scenario.unit.calibration or nominal(layout)
    true = draw_true_unit(scenario, layout)
    angle = ARCSEC if true.gyro_in_pulses else 1.0
    gyro_scale, accelerometer_scale = _three(true.gyro_scale / angle), _three(true.accelerometer_scale)
    gyro = {"scale_arcsec_per_pulse" if true.gyro_in_pulses else "scale": gyro_scale}
    accelerometer = {"scale_pulse_per_m_s" if true.accelerometer_in_pulses else "scale": accelerometer_scale}
    return certificate.model_copy(
        update={
            "gyro": Gyro.model_validate(
                {**gyro, "bias_deg_per_h": _three(true.gyro_bias / DEG_PER_H), "C_bg": _rows(true.C_bg)}
            ),
            "accelerometer": Accelerometer.model_validate(
                {**accelerometer, "bias_ug": _three(true.accelerometer_bias / UG), "C_ba": _rows(true.C_ba)}
            ),
            "size_effect": None if true.r_b is None else _size_effect(true.r_b, certificate.size_effect),
            "temperature": _temperature(true.temperature, certificate.temperature),
        }
    )


def _size_effect(r_b: Array, certified: SizeEffect | None) -> SizeEffect:
    if certified is not None and np.array_equal(certified.r_m, r_b):
        return certified
    x, y, z = _rows(r_b / MM)
    return SizeEffect(r_mm=SensingPoints(x=x, y=y, z=z), gauge="given")


def _temperature(terms: TemperatureTerms | None, certified: Temperature | None) -> Temperature | None:
    if terms is None:
        return None
    return Temperature(
        reference_degc=terms.reference_degc,
        range_degc=certified.range_degc if certified else (-100.0, 200.0),
        gyro_bias_deg_per_h_per_k=_three(terms.gyro_bias / DEG_PER_H),
        gyro_scale_ppm_per_k=_three(terms.gyro_scale / PPM),
        accelerometer_bias_ug_per_k=_three(terms.accelerometer_bias / UG),
        accelerometer_scale_ppm_per_k=_three(terms.accelerometer_scale / PPM),
    )


def _three(values: Array) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z


def _rows(matrix: Array) -> Matrix3:
    x, y, z = map(_three, matrix)
    return x, y, z
