"""Certificate with which the service compensates during a session."""

from calib.procedure.schema import Kind
from calib.sensors.parameters import nominal_scales
from imudrv.calibration import Calibration
from imudrv.errors import InputError
from imudrv.files.settings_file import parse
from imudrv.profiles.schema import Profile
from imudrv.units import ARCSEC

_CREATED = "2000-01-01T00:00:00Z"  # it was never issued


def working_certificate(kind: Kind, before: Calibration | None, profile: Profile, unit: str) -> Calibration:
    """Return the certificate with which the service compensates during a session.

    Parameters
    ----------
    kind : {'arms', 'sensors', 'noise'}
        Kind of the procedure.
    before : Calibration or None
        The unit's certificate.
    profile : Profile
        Wire format.
    unit : str
        Serial number.

    Returns
    -------
    Calibration
        That before without size effect and skew, both of which are estimated; without one the nominal scale
        factors of the profile and aligned axes.

    Raises
    ------
    InputError
        There is no certificate and no nominal scale factor, or the kind needs a certificate.
    """
    if before is not None:
        return before.without_size_effect().without_skew()
    if kind != "sensors":
        raise InputError(f"expected the certificate of unit {unit!r} (--calibration), there is none yet")
    nominal = nominal_scales(profile, None)
    if nominal is None:
        raise InputError(
            f"{profile.name}: expected nominal scale factors, got a profile without them; write nominal: in "
            "the profile, or give a certificate to start from (--calibration)"
        )
    gyro = "scale_arcsec_per_pulse" if nominal.gyro_in_pulses else "scale"
    accelerometer = "scale_pulse_per_m_s" if nominal.accelerometer_in_pulses else "scale"
    aligned = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    document = {
        "format": "imu50-calibration",
        "version": 1,
        "serial_number": unit,
        "created": _CREATED,
        "gyro": {
            gyro: [nominal.gyro / ARCSEC if nominal.gyro_in_pulses else 1.0] * 3,
            "bias_deg_per_h": [0.0] * 3,
            "C_bg": aligned,
        },
        "accelerometer": {
            accelerometer: [nominal.accelerometer] * 3,
            "bias_ug": [0.0] * 3,
            "C_ba": aligned,
        },
    }
    return parse(document, Calibration, f"nominal certificate of {profile.name}")
