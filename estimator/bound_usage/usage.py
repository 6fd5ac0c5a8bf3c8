"""All declared bounds against one drive's samples.

The order matters: a bound that fewer others are needed for is weighed first, and what is proved of it then counts for
those after it (`Ledger.trusted`). So one wrong bound is not blamed on all.
"""

from collections.abc import Iterable

from drivers.config import DevicesConfig
from drivers.samples import Sample
from estimator.bound_usage import at_rest, clocks, on_the_move, receiver, scans
from estimator.bound_usage.ledger import Ledger, Usage
from estimator.bound_usage.recording import record, standing
from estimator.config import FilterConfig, RobotConfig

UNSEEN_STILL_S = 0.5
"""Where standstill is never declared, scans are still taken of a robot that seems to stand."""
CONSTANT = "an error that stays the same"
WILDER = "wilder drives than this one"
LEAST = "the least latency: only how much it varies is seen"
OUTSIDE = "all of it: needs a measurement from outside the robot"


def bound_usage(
    robot: RobotConfig, config: FilterConfig, devices: DevicesConfig, samples: Iterable[Sample]
) -> list[Usage]:
    """How much of each declared bound the samples use, in the order of the configuration."""
    still_ns = round((config.standstill_s or UNSEEN_STILL_S) * 1e9)
    recording = record(samples, still_ns)
    ledger = _declared(robot, config, devices)
    clocks.weigh_clocks(ledger, recording, devices.imu, devices.gps)
    rests = standing(recording, still_ns)
    if config.standstill_s is not None:
        at_rest.weigh_standing(ledger, recording, rests)
    turns = on_the_move.turning(recording.gyro, devices.imu.clock_drift_ppm)
    if turns is not None:
        on_the_move.weigh_turning(ledger, turns)
        on_the_move.weigh_tilt_against_gyro(ledger, recording, turns)
    on_the_move.weigh_tracks(ledger, recording, robot, devices.encoders, turns)
    on_the_move.weigh_acceleration(ledger, recording, turns)
    if devices.gps is not None:
        receiver.weigh_fixes(ledger, recording, robot, devices.encoders, devices.gps, turns)
    scans.weigh_scans(ledger, recording.scans, rests, devices.laser)
    return ledger.usages()


def _declared(robot: RobotConfig, config: FilterConfig, devices: DevicesConfig) -> Ledger:
    """An account for each bound; `blind_to` says what such data can't show of it."""
    ledger, imu, gps = Ledger(), devices.imu, devices.gps
    declare = ledger.declare
    declare(on_the_move.SPEED, robot.max_speed_mps, WILDER, whole=False)
    declare(on_the_move.ACCELERATION, robot.max_acceleration_mps2, WILDER, whole=False)
    declare(on_the_move.TURN_RATE, robot.max_turn_rate_dps, WILDER, whole=False)
    declare(on_the_move.TURN_ACCELERATION, robot.max_turn_acceleration_dps2, WILDER, whole=False)
    declare(on_the_move.SLIP, robot.slip_ratio, "slip of both tracks alike, but for long straight ways between fixes")
    for name in ("lateral_slip_ratio", "turning_centre_m", "normal_slip_ratio"):
        declare(f"robot.{name}", getattr(robot, name), OUTSIDE)
    declare(on_the_move.QUANTISATION, devices.encoders.quantisation_ticks, OUTSIDE)
    declare("devices.encoders.latency_ms", _width(devices.encoders.latency_ms), "all of it: counters have no clock")
    declare(clocks.IMU_LATENCY, _width(imu.latency_ms), LEAST, whole=False)
    declare(clocks.IMU_DRIFT, imu.clock_drift_ppm, "other temperatures", whole=False)
    declare(at_rest.GYRO_BIAS, imu.gyro_bias_bound_dps, "other temperatures, other days")
    declare(at_rest.GYRO_DRIFT, imu.gyro_bias_drift_dps2, "other temperatures", whole=False)
    declare(at_rest.GYRO_NOISE, imu.gyro_noise_bound_dps, "what a driving robot's shaking adds")
    declare(at_rest.GYRO_SCALE, imu.gyro_scale_bound, OUTSIDE)
    declare(at_rest.TILT, imu.tilt_bound_deg, "an error that the accelerometers share")
    declare(at_rest.ACCEL, imu.accel_bound_mps2, "an error that the tilt sensor shares")
    if gps is not None:
        declare(clocks.GPS_LATENCY, _width(gps.latency_ms), LEAST, whole=False)
        declare(receiver.GST, gps.gst_factor, CONSTANT, whole=False)
        declare(receiver.RANGE, gps.range_error_m, CONSTANT, whole=False)
        if gps.rtk_fixed_horizontal_m is not None:
            declare(receiver.RTK_HORIZONTAL, gps.rtk_fixed_horizontal_m, CONSTANT, whole=False)
        if gps.rtk_fixed_vertical_m is not None:
            declare(receiver.RTK_VERTICAL, gps.rtk_fixed_vertical_m, CONSTANT, whole=False)
    declare(scans.RANGE_BOUND, devices.laser.range_bound_m, CONSTANT, whole=False)
    if config.standstill_rate_dps is not None:
        declare(at_rest.STILL_RATE, config.standstill_rate_dps, OUTSIDE)
    return ledger


def _width(latency_ms: tuple[float, float]) -> float:
    """What a latency can vary by."""
    return latency_ms[1] - latency_ms[0]
