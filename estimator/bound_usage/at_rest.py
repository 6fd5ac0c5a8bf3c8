"""A standing robot shows the errors themselves: nothing moves, so whatever changes in a reading is error.

Two readings of one constant, each off by at most e, differ by at most 2 e: half the largest difference is a proof. A
standing robot is taken not to accelerate: what an idling engine shakes is the accelerometers' error here.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.bound_usage.ledger import Ledger
from estimator.bound_usage.recording import Array, Inertial, Recording, Whole, within
from estimator.observations import GRAVITY

GYRO_NOISE, GYRO_BIAS = "devices.imu.gyro_noise_bound_dps", "devices.imu.gyro_bias_bound_dps"
GYRO_DRIFT, GYRO_SCALE = "devices.imu.gyro_bias_drift_dps2", "devices.imu.gyro_scale_bound"
STILL_RATE = "filter.standstill_rate_dps"
TILT, ACCEL = "devices.imu.tilt_bound_deg", "devices.imu.accel_bound_mps2"
BLOCK_NS = 1_000_000_000
PIECE_NS = 5_000_000_000
MOST_BLOCKS = 1000
SHORTEST_DRIFT_S = 30.0
"""Means further apart than this say something of the drift."""
GRAVITY_MID = 0.5 * (GRAVITY[0] + GRAVITY[1])
GRAVITY_REACH = 0.5 * (GRAVITY[1] - GRAVITY[0])


def weigh_standing(ledger: Ledger, recording: Recording, stretches: list[tuple[int, int]]) -> None:
    """Gyroscope, tilt and accelerometers of the standing robot."""
    _gyro(ledger, recording.gyro, stretches)
    _tilt(ledger, recording.tilt, stretches)
    for source, accelerometer in recording.accelerometers.items():
        _accelerometer(ledger, f"{source[0]} {source[1]}", accelerometer, recording.tilt, _chopped(stretches))


def _gyro(ledger: Ledger, gyro: Inertial, stretches: list[tuple[int, int]]) -> None:
    """reading = bias(t) ± (noise + what a standing robot may still turn), |d bias/dt| <= drift, |bias| <= its bound."""
    inside = within(stretches, gyro.stamps)
    inside[:1] = -1
    inside[1:][inside[:-1] != inside[1:]] = -1  # a mean reaches back to the packet before
    chosen = inside >= 0
    when = gyro.stamps.mid_ns[chosen]
    if len(when) < 2:
        return
    time_s = (when - when[0]) * 1e-9
    slack_s = float((gyro.stamps.latest_ns - gyro.stamps.earliest_ns)[chosen].max()) * 1e-9
    drift, scale = ledger.trusted(GYRO_DRIFT), ledger.trusted(GYRO_SCALE)
    still = ledger.trusted(STILL_RATE) * (1.0 + scale) + scale * ledger.trusted(GYRO_BIAS)
    axes = [(name, np.degrees(gyro.values[chosen, k])) for k, name in enumerate("xyz")]
    axes = [(name, rate) for name, rate in axes if np.isfinite(rate).all()]
    for name, rate in axes:
        half = 0.5 * (largest_change(rate, time_s, drift) - drift * slack_s)
        ledger.charge(
            GYRO_NOISE, needed=half - still, seen=half, when_ns=when, values=rate,
            worst=f"{name}: {{}} deg/s, and the opposite before", given=(GYRO_DRIFT, STILL_RATE),
        )  # fmt: skip
    noise = ledger.trusted(GYRO_NOISE)
    for name, rate in axes:
        ledger.charge(
            GYRO_BIAS, needed=np.abs(rate) - noise - still, seen=np.full_like(rate, abs(np.median(rate))),
            when_ns=when, values=rate, worst=f"{name}: {{}} deg/s at rest", given=(GYRO_NOISE, STILL_RATE),
        )  # fmt: skip
        _drift(ledger, name, rate, when, 2.0 * (noise + still))


def _drift(ledger: Ledger, name: str, rate: Array, when: Whole, spread: float) -> None:
    """Between two blocks of a second the bias changed by more than noise can explain: over the time between them."""
    block = (when - when[0]) // BLOCK_NS
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    starts = starts[:: len(starts) // MOST_BLOCKS + 1]
    ends = np.append(starts[1:], len(rate))
    high, low = np.maximum.reduceat(rate, starts), np.minimum.reduceat(rate, starts)
    mean = np.add.reduceat(rate, starts) / (ends - starts)
    begin_s, end_s = (when[starts] - when[0]) * 1e-9, (when[ends - 1] - when[0]) * 1e-9
    for j in range(1, len(starts)):
        apart = end_s[j] - begin_s[:j]
        change = np.maximum(high[j] - low[:j], high[:j] - low[j]) - spread
        far = apart >= SHORTEST_DRIFT_S
        seen = np.where(far, np.abs(mean[j] - mean[:j]) / apart, np.nan)
        needed = np.where(far, np.maximum(change / apart, 0.0), np.nan)
        ledger.charge(
            GYRO_DRIFT, needed=needed, seen=seen, when_ns=np.full(j, when[starts[j]]), values=apart,
            worst=f"{name}: mean changed over {{}} s", given=(GYRO_NOISE, STILL_RATE),
        )  # fmt: skip


def _tilt(ledger: Ledger, tilt: Inertial, stretches: list[tuple[int, int]]) -> None:
    """A standing robot's roll and pitch don't change, but for what vibration may turn it."""
    still = 2.0 * ledger.trusted(STILL_RATE)
    for inside in _stretches(tilt, stretches):
        when = tilt.stamps.mid_ns[inside]
        for k, name in enumerate(("roll", "pitch")):
            angle = np.degrees(tilt.values[inside, k])
            half = 0.5 * largest_change(angle, (when - when[0]) * 1e-9, still)
            ledger.charge(
                TILT, needed=half, when_ns=when, values=angle, worst=f"{name} {{}} deg, and the opposite before",
                given=(STILL_RATE,),
            )  # fmt: skip


def _accelerometer(
    ledger: Ledger, source: str, accelerometer: Inertial, tilt: Inertial, stretches: list[tuple[int, int]]
) -> None:
    """A standing robot feels gravity alone: constant, and what the tilt sensor says of it."""
    still = GRAVITY[1] * np.radians(2.0 * ledger.trusted(STILL_RATE))
    for inside in _stretches(accelerometer, stretches):
        when = accelerometer.stamps.mid_ns[inside]
        for k, axis in enumerate(("ahead", "left")):
            force = accelerometer.values[inside, k]
            half = 0.5 * largest_change(force, (when - when[0]) * 1e-9, still)
            ledger.charge(
                ACCEL, needed=half, when_ns=when, values=force,
                worst=f"{source} {axis}: {{}} m/s^2, and the opposite before", given=(STILL_RATE,),
            )  # fmt: skip
        stretch = within(stretches, accelerometer.stamps)[inside][0]
        beside = within(stretches, tilt.stamps) == stretch
        if beside.any():
            turned = still * (when[-1] - when[0]) * 1e-9  # meanwhile, as a force
            _beside_tilt(ledger, source, accelerometer.values[inside], when, np.median(tilt.values[beside], 0), turned)


def _beside_tilt(ledger: Ledger, source: str, forces: Array, when: Whole, tilt: Array, turned: float) -> None:
    """f_x = -g sin(pitch) and f_y = g cos(pitch) sin(roll), each to within both sensors' errors (SMF equation 17)."""
    roll, pitch = tilt
    gravity = -GRAVITY_MID * np.sin(pitch), GRAVITY_MID * np.cos(pitch) * np.sin(roll)
    for k, axis in enumerate(("ahead", "left")):
        off = np.abs(forces[:, k] - gravity[k])
        slope = GRAVITY[1] * (1.0 + (abs(np.sin(roll)) if k else 0.0))  # of a force by an angle, at most
        known = GRAVITY_REACH * abs(gravity[k]) / GRAVITY_MID + turned
        usual = float(np.abs(np.median(forces[:, k]) - gravity[k]))
        allowed = slope * np.radians(ledger.trusted(TILT)) + known, ledger.trusted(ACCEL) + known
        worst = f"{source} {axis}: {{}} m/s^2 beside the tilt sensor"
        ledger.charge(
            ACCEL, needed=np.maximum(off - allowed[0], 0.0), seen=np.full_like(off, usual), when_ns=when,
            values=forces[:, k], worst=worst, given=(TILT, STILL_RATE),
        )  # fmt: skip
        ledger.charge(
            TILT, needed=np.degrees(np.maximum(off - allowed[1], 0.0) / slope),
            seen=np.full_like(off, np.degrees(usual / GRAVITY_MID)), when_ns=when,
            values=forces[:, k], worst=worst, given=(ACCEL, STILL_RATE),
        )  # fmt: skip


def _chopped(stretches: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The same time in short pieces: a standing robot hardly turns in one of them."""
    return [(piece, min(piece + PIECE_NS, end)) for begin, end in stretches for piece in range(begin, end, PIECE_NS)]


def _stretches(sensor: Inertial, stretches: list[tuple[int, int]]) -> list[NDArray[np.bool_]]:
    """Which readings belong to each stretch that has some."""
    inside = within(stretches, sensor.stamps)
    return [inside == k for k in range(len(stretches)) if np.count_nonzero(inside == k) > 1]


def largest_change(values: Array, time_s: Array, rate: float, above: Array | None = None) -> Array:
    """[n] how far each value is from any before it, less `rate` times the time between them.

    With `above` each is an interval [values, above]: the gap between the two.
    """
    above = values if above is None else above
    way = rate * time_s
    up = values - way - np.minimum.accumulate(above - way)
    down = np.maximum.accumulate(values + way) - (above + way)
    return np.maximum(up, down)
