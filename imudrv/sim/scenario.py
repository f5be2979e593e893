"""Scenario file, checked completely before a simulation starts.

Segments of the motion follow each other; each starts at rest in the attitude at the end of the previous one.
Durations are rounded to whole sample intervals.
"""

from fractions import Fraction
from itertools import chain, pairwise
from pathlib import Path
from typing import Annotated, Final, Literal, Self, TypeAlias

from pydantic import Field as Key
from pydantic import model_validator

from imudrv.calibration import Calibration, SensingPoints, read_calibration
from imudrv.files import shipped as shipped_files
from imudrv.files.model import Model
from imudrv.files.settings_file import parse, read
from imudrv.site import Site
from imudrv.units import NS
from imudrv.wire.layout import Layout

_FOLDER: Final = Path(__file__).parent / "scenarios"

Duration = Annotated[float, Key(gt=0, le=1_000_000)]
Amount = Annotated[float, Key(ge=0, le=1e6)]
Proportion = Annotated[float, Key(ge=0, le=1)]
Tilt = Annotated[float, Key(ge=-200, le=200)]
Offset = Annotated[float, Key(ge=-10_000, le=10_000)]
Frequency = Annotated[float, Key(gt=0, le=2000)]
Rate = Annotated[float, Key(ge=0, le=2000)]
Celsius = Annotated[float, Key(ge=-100, le=200)]
Limit = Annotated[int, Key(ge=1, le=2**31 - 1)]
Change = Annotated[float, Key(ge=-1e6, le=1e6)]
Time = Annotated[float, Key(ge=0, le=1e7)]

MOST_MOTIONS: Final = 1000
"""Motions of a scenario; each of many turns is two."""


class Start(Model):
    """Attitude and pivot of the body before it moves.

    `z_up`: X east, Y north. `x_up`: Y east, Z north. `y_up`: Z east, X north. Then the body is rotated by the
    heading, clockwise as viewed from above, and its upper axis is tilted by `tilt_mrad` to the east and to
    the north. The pivot is fixed in every rotation; the origin of b is at `pivot_offset_mm` from it
    in b.
    """

    pose: Literal["z_up", "x_up", "y_up"] = "z_up"
    heading_deg: Annotated[float, Key(ge=-360, le=360)] = 0.0
    tilt_mrad: tuple[Tilt, Tilt] = (0.0, 0.0)
    pivot_offset_mm: tuple[Offset, Offset, Offset] = (0.0, 0.0, 0.0)
    counter: Annotated[int, Key(ge=0, lt=2**48)] = 0


class Rest(Model):
    """Body at rest, on a plate that meanwhile sinks by `sinks_arcsec` to the east and to the north."""

    duration_s: Duration
    sinks_arcsec: tuple[Change, Change] = (0.0, 0.0)


class Rotate(Model):
    """Rotation from rest to rest, right-handed about an axis fixed to the bench, with minimum jerk.

    The axis is the vertical, tilted by `axis_tilt_mrad` to the east and to the north, or it is `axis_n`.
    The body wobbles about it by `wobble_deg`, along a cone that it goes round at `wobble_hz` as viewed from
    the body; the wobble grows in the first quarter of the rotation and fades in the last.
    """

    angle_deg: Annotated[float, Key(ge=-36_000, le=36_000)]
    duration_s: Annotated[float, Key(ge=0.05, le=1_000_000)]
    axis_tilt_mrad: tuple[Tilt, Tilt] | None = None
    axis_n: tuple[float, float, float] | None = None
    wobble_deg: Annotated[float, Key(ge=0, le=20)] = 0.0
    wobble_hz: Annotated[float, Key(gt=0, le=100)] = 1.0

    @model_validator(mode="after")
    def _one_axis(self) -> Self:
        if self.axis_tilt_mrad is not None and self.axis_n is not None:
            raise ValueError("expected axis_tilt_mrad or axis_n, got both")
        if self.axis_n is not None and max(map(abs, self.axis_n)) < 1e-3:
            raise ValueError(
                f"axis_n: expected a direction, with a component of at least 0.001, got {self.axis_n}"
            )
        return self


Side: TypeAlias = Literal["+X", "-X", "+Y", "-Y", "+Z", "-Z"]
"""A body axis with its sign."""


class Carry(Model):
    """Body carried by hand into another pose, by the shortest turn, from rest to rest.

    `up` and `east`: body axes that point up and east then, but for an error of the hand: `lean_mrad` about
    each horizontal axis and `heading_deg` about the vertical, 1 sigma. The pivot is lifted by `lift_mm` in
    the first quarter and set down in the last; meanwhile the body wobbles as in `rotate`.
    """

    up: Side
    east: Side
    duration_s: Annotated[float, Key(ge=0.5, le=300)] = 5.0
    lift_mm: Annotated[float, Key(ge=0, le=2000)] = 120.0
    wobble_deg: Annotated[float, Key(ge=0, le=20)] = 1.5
    wobble_hz: Annotated[float, Key(gt=0, le=20)] = 1.3
    lean_mrad: Annotated[float, Key(ge=0, le=100)] = 4.0
    heading_deg: Annotated[float, Key(ge=0, le=30)] = 3.0

    @model_validator(mode="after")
    def _two_axes(self) -> Self:
        if self.up[1] == self.east[1]:
            raise ValueError(f"expected two different axes up and east, got {self.up} and {self.east}")
        return self


class Turns(Model):
    """Rotations that follow each other, each with a rest of `arrest_s` after it.

    `alternate`: every second one is the other way round.
    """

    count: Annotated[int, Key(ge=1, le=100)]
    rotate: Rotate
    arrest_s: Duration
    alternate: bool = True

    @property
    def motions(self) -> tuple[Rotate | Rest, ...]:
        """The rotations and rests."""
        rest = Rest(duration_s=self.arrest_s)
        back = self.rotate.model_copy(update={"angle_deg": -self.rotate.angle_deg})
        ways = self.rotate, back if self.alternate else self.rotate
        return tuple(motion for k in range(self.count) for motion in (ways[k % 2], rest))


class _Random(Model):
    """Random motion in a band, faded in and out over `ramp_s`, ending at rest where it started."""

    duration_s: Annotated[float, Key(gt=0, le=36_000)]
    band_hz: tuple[Frequency, Frequency]
    ramp_s: Duration = 1.0

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not self.band_hz[0] < self.band_hz[1]:
            raise ValueError(f"band_hz: expected the lower frequency first, got {list(self.band_hz)}")
        if 2.0 * self.ramp_s > self.duration_s:
            raise ValueError(
                f"ramp_s: expected half of duration_s at most, got {self.ramp_s:g} of {self.duration_s:g}"
            )
        return self


class Rock(_Random):
    """Random rocking: rotations about X, then the rotated Y, then the rotated Z, each with its own rate.

    `rate_rms_deg_per_s` applies to these three rotations between the ramps; for small angles they are the
    body rates. A rotation whose rate exceeds `rate_peak_deg_per_s` at the end of a sample is scaled down.
    `sway_mm` is the rms displacement of the pivot east, north and up, for a unit carried by hand.
    """

    rate_rms_deg_per_s: tuple[Rate, Rate, Rate]
    rate_peak_deg_per_s: Annotated[float, Key(gt=0, le=10_000)] | None = None
    sway_mm: tuple[Amount, Amount, Amount] = (0.0, 0.0, 0.0)


class Vibrate(_Random):
    """Random vibration of the pivot, `g_rms` east, north and up, with the rotation that the bench adds."""

    g_rms: tuple[Rate, Rate, Rate]
    rate_rms_deg_per_s: tuple[Rate, Rate, Rate] = (0.0, 0.0, 0.0)


OneMotion: TypeAlias = Rest | Rotate | Carry | Rock | Vibrate


class Segment(Model):
    """One entry of the motion, with exactly one key."""

    rest: Rest | None = None
    rotate: Rotate | None = None
    carry: Carry | None = None
    turns: Turns | None = None
    rock: Rock | None = None
    vibrate: Vibrate | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> Self:
        names = list(type(self).model_fields)
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected one of {', '.join(names)}, got {' and '.join(given) or 'none'}")
        return self

    @property
    def motions(self) -> tuple[OneMotion, ...]:
        """The motion of the one key; several for many turns."""
        if self.turns is not None:
            return self.turns.motions
        motions: tuple[OneMotion | None, ...] = (
            *(self.rest, self.rotate, self.carry),
            *(self.rock, self.vibrate),
        )
        return tuple(motion for motion in motions if motion is not None)


class Residuals(Model):
    """1-sigma differences between the unit and its calibration, drawn once for each axis.

    Those per kelvin are from `temperature.start_degc` on, or from the reference temperature of a calibration
    that has temperature terms.
    """

    gyro_bias_deg_per_h: Amount = 0.0
    gyro_scale_ppm: Amount = 0.0
    gyro_misalignment_urad: Amount = 0.0
    accelerometer_bias_ug: Amount = 0.0
    accelerometer_scale_ppm: Amount = 0.0
    accelerometer_misalignment_urad: Amount = 0.0
    gyro_bias_deg_per_h_per_k: Amount = 0.0
    gyro_scale_ppm_per_k: Amount = 0.0
    accelerometer_bias_ug_per_k: Amount = 0.0
    accelerometer_scale_ppm_per_k: Amount = 0.0


class BiasStep(Model):
    """Change of the biases from the first sample that ends after `at_s`, as from one pose to the next.

    Gyros in body axes, accelerometers on their sensing axes, as in the calibration.
    """

    at_s: Time
    gyro_deg_per_h: tuple[Change, Change, Change] = (0.0, 0.0, 0.0)
    accelerometer_ug: tuple[Change, Change, Change] = (0.0, 0.0, 0.0)


class BiasWander(Model):
    """Wander of the biases: Gauss-Markov processes of a time constant, 1 sigma of each axis."""

    time_constant_s: Annotated[float, Key(ge=1, le=1_000_000)] = 700.0
    gyro_deg_per_h: Amount = 0.0
    accelerometer_ug: Amount = 0.0


class Noise(Model):
    """White noise of the sensors: angle and velocity random walk."""

    arw_deg_per_sqrt_h: Amount = 0.0
    vrw_m_s_per_sqrt_h: Amount = 0.0


class Dither(Model):
    """Dither of the gyro blocks: `amplitude_arcsec * sin` about the axis of each gyro, with random phases.

    `in_increments` is the fraction left in the gyro increments; `case_reaction` the fraction by which the
    whole body rotates.
    """

    amplitude_arcsec: tuple[Rate, Rate, Rate]
    frequency_hz: tuple[Frequency, Frequency, Frequency]
    in_increments: Proportion = 0.0
    case_reaction: Annotated[float, Key(ge=0, le=0.1)] = 0.0


class Temperature(Model):
    """Temperature of all channels: a slope, and an exponential approach to `settles_at_degc`."""

    start_degc: Celsius = 35.0
    slope_k_per_h: Annotated[float, Key(ge=-1000, le=1000)] = 0.0
    settles_at_degc: Celsius | None = None
    time_constant_s: Duration | None = None

    @model_validator(mode="after")
    def _both_or_neither(self) -> Self:
        if (self.settles_at_degc is None) != (self.time_constant_s is None):
            raise ValueError("expected settles_at_degc and time_constant_s together, got one of them")
        return self


class Saturation(Model):
    """Maximum number of pulses of an axis in one sample interval; further pulses are lost.

    Any axis saturates at the limits of its field, too.
    """

    gyro_pulses: Limit = 2**31 - 1
    accelerometer_pulses: Limit = 2**31 - 1


class Unit(Model):
    """Unit: its calibration (a file, or inline, by default a nominal one for the profile) and its errors.

    The path of the file is relative to the scenario. `r_mm` are the true sensing points, where the
    calibration is that of a unit whose lever arms are still to be found. Residuals make the unit differ from
    its calibration; `seed` draws them, by default that of the scenario: scenarios with the same `seed` here
    and different ones there are of one unit. The sample interval of the accelerometers ends
    `accelerometer_skew_s` later than that of the gyros, beside the skew in the calibration.
    """

    calibration_file: Annotated[str, Key(min_length=1, max_length=4096)] | None = None
    calibration: Calibration | None = None
    r_mm: SensingPoints | None = None
    seed: Annotated[int, Key(ge=0, lt=2**63)] | None = None
    residuals: Residuals = Residuals()
    bias_steps: Annotated[tuple[BiasStep, ...], Key(max_length=1000)] = ()
    bias_wander: BiasWander | None = None
    noise: Noise = Noise()
    dither: Dither | None = None
    accelerometer_skew_s: Annotated[float, Key(ge=-0.01, le=0.01)] = 0.0
    temperature: Temperature = Temperature()
    saturation: Saturation = Saturation()
    warm_up_s: Annotated[float, Key(ge=0, le=1_000_000)] = 0.0

    @model_validator(mode="after")
    def _one_calibration(self) -> Self:
        if self.calibration_file is not None and self.calibration is not None:
            raise ValueError("expected calibration_file or calibration, got both")
        return self


class Motor(Model):
    """Motor on the bench: it shakes the pivot with `mg * sin` east, north and up, during the whole run."""

    frequency_hz: Frequency
    mg: tuple[Change, Change, Change]


class Silence(Model):
    """Time in which nothing is sent."""

    at_s: Time
    duration_s: Duration


class Unplug(Silence):
    """Unplugged cable: a silence; in real time the port disappears and comes back."""


class Restart(Silence):
    """Unit without power; it warms up again, and its counter begins again at 0."""


class CounterJump(Model):
    """Jump of the counter by `by` at the first sample that ends after `at_s`; a jump back is a restart.

    A time jumps by as many samples.
    """

    at_s: Time
    by: Annotated[int, Key(ge=-(2**32), le=2**32)]


class _Rates(Model):
    """Probabilities of faults that exclude each other."""

    @model_validator(mode="after")
    def _at_most_one(self) -> Self:
        total = sum(self.model_dump().values())
        if total > 1.0:
            raise ValueError(f"expected probabilities with a sum of at most 1, got {total:g}")
        return self


class StreamRates(_Rates):
    """Probabilities of the faults of a serial line per frame; a frame has at most one fault."""

    bit_flips: Proportion = 0.0
    bytes_lost: Proportion = 0.0
    bytes_inserted: Proportion = 0.0
    false_sync_inside: Proportion = 0.0
    frame_lost: Proportion = 0.0
    bytes_between: Proportion = 0.0
    false_sync_between: Proportion = 0.0
    frame_doubled: Proportion = 0.0


class MessageRates(_Rates):
    """Probabilities of the faults of a CAN bus per message; a message has at most one fault."""

    lost: Proportion = 0.0
    doubled: Proportion = 0.0
    swapped: Proportion = 0.0


class Faults(Model):
    """Faults of the line and of the counter."""

    stream: StreamRates = StreamRates()
    can: MessageRates = MessageRates()
    silences: Annotated[tuple[Silence, ...], Key(max_length=1000)] = ()
    unplugs: Annotated[tuple[Unplug, ...], Key(max_length=1000)] = ()
    restarts: Annotated[tuple[Restart, ...], Key(max_length=1000)] = ()
    counter_jumps: Annotated[tuple[CounterJump, ...], Key(max_length=1000)] = ()

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        _require_in_order("unplugs", self.unplugs)
        _require_in_order("restarts", self.restarts)
        return self

    @property
    def quiet(self) -> tuple[Silence, ...]:
        """Every time in which nothing is sent."""
        return self.silences + self.unplugs + self.restarts


def _require_in_order(name: str, silences: tuple[Silence, ...]) -> None:
    for before, after in pairwise(silences):
        if before.at_s + before.duration_s >= after.at_s:
            raise ValueError(
                f"{name}: expected one after the other, got one at {after.at_s:g} s "
                f"before the end of that at {before.at_s:g} s"
            )


class Scenario(Model):
    """Scenario file."""

    format: Literal["imu50-scenario"]
    version: Literal[1]
    seed: Annotated[int, Key(ge=0, lt=2**63)] = 0
    site: Site
    start: Start = Start()
    motion: Annotated[tuple[Segment, ...], Key(min_length=1, max_length=MOST_MOTIONS)]
    motor: Motor | None = None
    unit: Unit = Unit()
    faults: Faults = Faults()

    @model_validator(mode="after")
    def _not_too_many(self) -> Self:
        if len(self.motions) > MOST_MOTIONS:
            raise ValueError(
                f"motion: expected at most {MOST_MOTIONS} rotations and rests, got {len(self.motions)} with "
                "those of turns"
            )
        return self

    @property
    def motions(self) -> tuple[OneMotion, ...]:
        """Motions in order."""
        return tuple(chain.from_iterable(segment.motions for segment in self.motion))


NOMINAL = parse(
    {
        "format": "imu50-calibration",
        "version": 1,
        "serial_number": "nominal",
        "created": "2026-01-01T00:00:00Z",
        "gyro": {
            "scale_arcsec_per_pulse": [0.5, 0.5, 0.5],
            "bias_deg_per_h": [0.0, 0.0, 0.0],
            "C_bg": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        },
        "accelerometer": {
            "scale_pulse_per_m_s": [2000.0, 2000.0, 2000.0],
            "bias_ug": [0.0, 0.0, 0.0],
            "C_ba": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        },
        "size_effect": {
            "r_mm": {"x": [24.0, -11.0, -9.0], "y": [-23.0, 29.0, -7.0], "z": [-1.0, -18.0, 16.0]},
            "gauge": "centroid",
        },
    },
    Calibration,
    "nominal unit",
)
"""Calibration of a unit that sends pulses: nominal scales, no errors, lever arms of about 30 mm."""


def shipped() -> list[str]:
    """Return the names of the scenarios that come with the package."""
    return shipped_files.names(_FOLDER)


def load(name_or_path: str) -> Scenario:
    """Load a scenario, by the name of a shipped one or by the path of a file.

    Parameters
    ----------
    name_or_path : str
        ``z-up``, or ``my/run.yaml``.

    Returns
    -------
    Scenario
        Checked scenario, with the content of a calibration file in `unit.calibration`.

    Raises
    ------
    InputError
        The scenario does not exist, or it or its calibration file is not valid.
    """
    path = shipped_files.find("scenario", name_or_path, _FOLDER)
    scenario = read(path, Scenario)
    if scenario.unit.calibration_file is None:
        return scenario
    calibration = read_calibration(path.parent / scenario.unit.calibration_file)
    unit = scenario.unit.model_copy(update={"calibration_file": None, "calibration": calibration})
    return scenario.model_copy(update={"unit": unit})


def files(name_or_path: str) -> tuple[Path, ...]:
    """Return the files of a scenario, calibration included; none for a shipped one."""
    path = Path(name_or_path)
    if name_or_path in shipped():
        return ()
    calibration = read(path, Scenario).unit.calibration_file
    return (path,) if calibration is None else (path, path.parent / calibration)


def nominal(layout: Layout) -> Calibration:
    """Return the calibration of a scenario without one.

    Parameters
    ----------
    layout : Layout
        Layout of the profile.

    Returns
    -------
    Calibration
        `NOMINAL`, with scales of 1 for a sensor that sends no pulses.
    """
    gyro, accelerometer = NOMINAL.gyro, NOMINAL.accelerometer
    ones = {"scale": (1.0, 1.0, 1.0)}
    if not layout.gyro.in_pulses:
        gyro = gyro.model_copy(update={"scale_arcsec_per_pulse": None} | ones)
    if not layout.accelerometer.in_pulses:
        accelerometer = accelerometer.model_copy(update={"scale_pulse_per_m_s": None} | ones)
    return NOMINAL.model_copy(update={"gyro": gyro, "accelerometer": accelerometer})


def samples(scenario: Scenario, interval: Fraction) -> int:
    """Return the number of samples of a scenario; each segment is rounded to whole intervals.

    Parameters
    ----------
    scenario : Scenario
        The scenario.
    interval : Fraction
        Sample interval, ns.

    Returns
    -------
    int
    """
    return sum(intervals(motion.duration_s, interval * NS) for motion in scenario.motions)


def intervals(duration_s: float, interval_s: float) -> int:
    """Return the number of sample intervals of a segment, at least one."""
    return max(1, round(duration_s / interval_s))
