"""What the owner declares of each device: where it is, how it is set, and how far its readings can be off.

Every bound is a half-width that the truth never leaves; its unit stands in its name. Bounds have no defaults: only
the owner can know them.
"""

from math import ceil, floor
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, defer_build=True)
"""Unknown keys, infinities and NaN are refused. Validators are built when first needed: a section's is part of the
whole configuration's, and its own is for those who make that section alone."""

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Angle = Annotated[float, Field(ge=-360, le=360)]
"""Degrees."""


def _resolution(value: float) -> float:
    if value not in (0.25, 0.5, 1.0):
        raise ValueError("the scanner knows 0.25, 0.5 and 1.0 degrees")
    return value


def _not_zero(value: float) -> float:
    if value == 0:
        raise ValueError("should not be 0: every tick is some way")
    return value


def _rising(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError("give [least, most]")
    return value


MetresPerTick = Annotated[float, AfterValidator(_not_zero)]
Resolution = Annotated[float, AfterValidator(_resolution)]
Rising = AfterValidator(_rising)
"""Of a pair: [least, most]."""
TemperatureRange = Annotated[tuple[float, float], Rising]
"""[least, most]"""
LatencyMs = Annotated[tuple[NotNegative, NotNegative], Rising]
"""[least, most] from acquisition to the read; `most` counts READ_ALLOWANCE_NS, what is later than that is measured."""
READ_ALLOWANCE_NS = 6_000_000
"""An idle reader looks at its port every 4 ms and takes a little to wake up."""


_Turns = Annotated[float, Field(ge=-1000, le=1000)]
MirrorPhaseMs = Annotated[tuple[_Turns, _Turns], Rising]


def latency_ns(latency_ms: tuple[float, float]) -> tuple[int, int]:
    """[least, most] in whole nanoseconds, rounded outward."""
    return floor(latency_ms[0] * 1e6), ceil(latency_ms[1] * 1e6)


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class LaserConfig:
    """A SICK LMS2xx on a serial port, and how it is mounted on the robot."""

    port: str
    baud: Literal[9600, 19200, 38400, 500000] = 500000
    """Rate to stream at; the scanner is found at any rate."""
    scan_angle_deg: Literal[90, 100, 180] = 180
    """90 degrees: the LMS Fast, at 0.5 degree."""
    resolution_deg: Resolution = 1.0
    """180 degrees at 0.25 degree come as interlaced scans, one a mirror turn."""
    unit: Literal["mm", "cm"] = "mm"
    write_configuration: bool = True
    """May the driver write the scanner's EEPROM when its unit or measuring mode differs?"""
    latency_ms: LatencyMs
    """From the first byte's being sent to its being read."""
    mirror_phase_ms: MirrorPhaseMs = (-6.66, 6.66)
    """[least, most] by which beams are shot later than if each telegram left just when the mirror begins a new turn.

    The manual leaves this open. By default the telegram leaves at some time within one turn after its last shot.
    """
    range_bound_m: Positive
    """Range error: systematic + statistical + resolution."""
    angle_bound_deg: NotNegative
    """Scan-angle error of a beam's centre, plus half the beam's divergence: along the scan."""
    across_bound_deg: NotNegative | None = None
    """The same across the scan's plane: half the divergence, and the mirror's wobble. Absent: as angle_bound_deg."""
    range_min_m: NotNegative = 0.3
    range_max_m: Positive = 30.0
    """Ranges outside [range_min_m, range_max_m] are not used."""
    mount_x_m: float
    mount_y_m: float
    mount_z_m: float
    mount_roll_deg: Angle = 0.0
    mount_pitch_deg: Angle
    """The paper's sign: negative looks down."""
    mount_yaw_deg: Angle = 0.0
    mount_position_bound_m: NotNegative
    mount_angle_bound_deg: NotNegative
    """Calibration error of each mounting angle."""

    @property
    def telegram_ms(self) -> float:
        """How long a scan is on the line: two bytes a beam, eight around them and two to be sure, ten bits a byte."""
        whole = (self.scan_angle_deg, self.resolution_deg) != (180, 0.25)
        beams = self.scan_angle_deg / self.resolution_deg + 1 if whole else 181
        return 1000 * 10 * (2 * beams + 10) / self.baud

    @model_validator(mode="after")
    def _variant_exists(self) -> Self:
        if self.scan_angle_deg == 90 and self.resolution_deg != 0.5:
            raise ValueError("resolution_deg: at 90 degrees (LMS Fast) the scanner knows 0.5 degree alone")
        return self

    @model_validator(mode="after")
    def _some_ranges_are_used(self) -> Self:
        if self.range_min_m >= self.range_max_m:
            raise ValueError(
                f"range_min_m = {self.range_min_m:g} should be less than range_max_m = {self.range_max_m:g}: no beam "
                "is used otherwise"
            )
        return self


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class EncodersConfig:
    """Left and right track counters in CAN frames."""

    port: str
    """Serial device of an slcan adapter, or the name of a SocketCAN interface."""
    interface: Literal["slcan", "socketcan"] = "slcan"
    bitrate: Literal[125000, 250000, 500000, 1000000] = 500000
    dbc: str
    """DBC file; a relative path starts at the configuration file's folder."""
    left: str
    """MESSAGE.SIGNAL of the left track's counter."""
    right: str
    left_metres_per_tick: MetresPerTick
    """Negative where the counter falls when the robot drives forward."""
    right_metres_per_tick: MetresPerTick
    quantisation_ticks: NotNegative = 1.0
    """How far a difference of two counts can be off the true number of (fractional) ticks. Where left and right come in
    two messages: plus what a track can count between the two."""
    latency_ms: LatencyMs
    """From the counting to the receipt of the message: by the kernel (socketcan), or to the read of its first byte."""
    counting: Literal["absolute", "incremental"] = "absolute"
    """Does the unit send counters that run on, or the ticks since its last message?"""
    least_period_ms: Positive | None = None
    """Of incremental counts: two messages of a track are never closer. It tells when one was lost."""
    restart_ms: Positive = 100.0
    """A unit that restarts is silent at least so long: after a longer pause its counts may have begun anew. Less than
    the messages' period makes every count useless."""
    pair_within_ms: Positive = 5.0
    """Counts of left and right in two messages make a reading if they come no further apart."""


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class ImuConfig:
    """Inertial board: gyroscope, two dual-axis accelerometers and tilt sensor in MAVLink packets."""

    port: str
    baud: int = 115200
    latency_ms: LatencyMs
    system: Annotated[int, Field(ge=1, le=255)] | None = None
    component: Annotated[int, Field(ge=0, le=255)] | None = None
    """MAVLink's numbers of the board, where others (a gimbal, a camera) send inertial messages on the same line.

    Absent: whoever sends one first is listened to, until it is silent for a second.
    """
    clock_drift_ppm: Annotated[float, Field(ge=0, le=100_000)]
    """Rate error of the board's clock against the host's."""
    gyro_bias_bound_dps: NotNegative
    """Largest bias of any axis, ever."""
    gyro_bias_drift_dps2: NotNegative
    """Largest rate of change of a bias."""
    gyro_noise_bound_dps: NotNegative
    """Error of one packet's mean rate beside bias and scale."""
    gyro_scale_bound: Annotated[float, Field(ge=0, le=0.5)]
    """Relative scale error, as 0.005 for half a percent. (From 1 on a reading would bound no rate at all.)"""
    tilt_bound_deg: Positive
    """Total error of roll and of pitch, lag and motion included."""
    accel_bound_mps2: Positive
    """Total error of one accelerometer axis (the robot's own acceleration is declared under [robot])."""
    temperature_range_degc: TemperatureRange | None = None
    """Where these bounds hold; a packet that tells a sensor's temperature outside of it is not used."""
    always_noisy: bool = False
    """Do readings of a sensor that lives always differ a little? Then one that repeats the last is not used."""


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class GpsConfig:
    """GPS receiver: NMEA sentences on a serial port."""

    port: str
    baud: int = 115200
    latency_ms: LatencyMs
    """From the epoch of the fix to the read of its first sentence."""
    gst_factor: Positive
    """Half-width = gst_factor * GST sigma + floor."""
    range_error_m: Positive
    """Half-width without GST = hdop * range_error_m + floor; of the height, vdop where the receiver tells it."""
    floor_horizontal_m: NotNegative
    """Added to either. Half a step of the digits that the receiver sends is added besides; one that truncates instead
    of rounding needs half a step more here: 0.0001 minutes are 0.185 m."""
    floor_vertical_m: NotNegative
    rtk_fixed_horizontal_m: Positive | None = None
    """Half-width of an RTK fixed solution (quality 4), if the owner vouches for one; used in place of GST and HDOP."""
    rtk_fixed_vertical_m: Positive | None = None
    velocity_bound_mps: Positive | None = None
    """Half-width of the antenna's velocity at the fix, east and north each, as speed and course tell it, with what
    their digits round away; at standstill too. None: velocities are not used."""
    antenna_x_m: float = 0.0
    antenna_y_m: float = 0.0
    antenna_z_m: float = 0.0
    """Antenna in base_link."""


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class DevicesConfig:
    """The robot's devices."""

    laser: LaserConfig
    encoders: EncodersConfig
    imu: ImuConfig
    gps: GpsConfig | None = None
    """A robot without GPS maps in its local frame alone."""
