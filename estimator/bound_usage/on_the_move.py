"""A driving robot: how fast it turns and drives, and whether tracks, gyroscope and tilt sensor tell one story."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.config import EncodersConfig
from estimator.bound_usage.at_rest import (
    ACCEL,
    GRAVITY_MID,
    GRAVITY_REACH,
    GYRO_BIAS,
    GYRO_DRIFT,
    GYRO_NOISE,
    GYRO_SCALE,
    TILT,
)
from estimator.bound_usage.ledger import Ledger
from estimator.bound_usage.recording import Array, Inertial, Recording, Whole
from estimator.config import RobotConfig
from estimator.motion import excursion

TURN_RATE, TURN_ACCELERATION = "robot.max_turn_rate_dps", "robot.max_turn_acceleration_dps2"
SPEED, ACCELERATION, SLIP = "robot.max_speed_mps", "robot.max_acceleration_mps2", "robot.slip_ratio"
GAUGE, QUANTISATION = "robot.track_gauge_m", "devices.encoders.quantisation_ticks"
SPEED_WINDOW_S = 0.4
SLIP_WINDOWS_S = (1.0, 4.0, 12.0)
SHORTEST_SLIP_M = 0.3
"""Tracks that ran less than this say little of their slip."""
TILT_LAGS = (1, 10, 50)
GAP = 1.5
"""An interval between packets longer than this times the usual one is a gap."""
SIDE_BY_SIDE_NS = 20_000_000
MILLISECOND_US = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """The gyroscope's readings summed up, on its own clock."""

    when_ns: Whole
    """[n] middle of each packet's stamp."""
    stamp_ns: int
    """Longest stamp: a packet's time is off by at most half of it."""
    seconds: Array
    """[n] from the packet before, as the board's clock has it."""
    longest: Array
    """[n] the same at most: its resolution and drift."""
    rate: Array
    """[n, 3] rad/s; 0 where an axis is not measured."""
    measured: NDArray[np.bool_]
    """[3]"""
    gap: NDArray[np.bool_]
    """[n] readings are missing before this one."""

    def rate_error(self, ledger: Ledger) -> Array:
        """[n, 3] how far the mean rate can be off, rad/s."""
        fixed = np.radians(ledger.trusted(GYRO_NOISE) + ledger.trusted(GYRO_BIAS))
        scale = ledger.trusted(GYRO_SCALE)
        return np.asarray(fixed + scale * (np.abs(self.rate) + fixed) / max(1.0 - scale, 0.1))

    def varied(self, ledger: Ledger) -> Array:
        """[n, 3] integral of |rate| since the packet before, at most: a rate may change its sign (SMF equation 5)."""
        turn_back = 0.25 * np.radians(ledger.trusted(TURN_ACCELERATION)) * self.longest[:, None] ** 2
        return np.asarray((np.abs(self.rate) + self.rate_error(ledger)) * self.longest[:, None] + turn_back)


def turning(gyro: Inertial, drift_ppm: float) -> Turning | None:
    """The gyroscope's intervals, by the board's clock if it has one; None without enough packets."""
    when = gyro.stamps.mid_ns
    if len(when) < 3:
        return None
    seconds = np.diff(when, prepend=when[0]) * 1e-9
    coarse = bool(np.all(np.nan_to_num(gyro.device_us) % MILLISECOND_US == 0.0))
    resolution_us = MILLISECOND_US if coarse else 1.0
    device = np.diff(gyro.device_us, prepend=np.nan) * 1e-6
    same = np.diff(gyro.epoch, prepend=gyro.epoch[0]) == 0
    seconds = np.where(same & np.isfinite(device) & (device > 0.0), device, np.maximum(seconds, 0.0))
    seconds[0] = 0.0
    longest = (seconds + resolution_us * 1e-6) * (1.0 + drift_ppm * 1e-6)
    return Turning(
        when,
        int((gyro.stamps.latest_ns - gyro.stamps.earliest_ns).max()),
        seconds,
        longest,
        np.nan_to_num(gyro.values),
        np.asarray(np.isfinite(gyro.values).all(axis=0)),
        ~same | (seconds > GAP * float(np.median(seconds[1:]))),
    )


def weigh_turning(ledger: Ledger, turns: Turning) -> None:
    """The mean rates of packets bound the largest rate; those of neighbours, the largest acceleration."""
    error = turns.rate_error(ledger)
    least, seen = np.degrees(np.abs(turns.rate) - error), np.degrees(np.abs(turns.rate))
    for k, name in enumerate("xyz"):
        if not turns.measured[k]:
            continue
        ledger.charge(
            TURN_RATE, needed=np.maximum(least[:, k], 0.0), seen=seen[:, k], when_ns=turns.when_ns,
            values=np.degrees(turns.rate[:, k]), worst=f"{name}: {{}} deg/s",
            given=(GYRO_NOISE, GYRO_BIAS, GYRO_SCALE),
        )  # fmt: skip
        # the mean over [t - T, t] and the one over [t, t + T'] are rates at two instants at most T + T' apart
        change = np.degrees(np.abs(np.diff(turns.rate[:, k])))
        noise = 2.0 * ledger.trusted(GYRO_NOISE) + ledger.trusted(GYRO_DRIFT) * 2.0 * float(turns.longest.max())
        scale = ledger.trusted(GYRO_SCALE) * (seen[1:, k] + seen[:-1, k]) * 1.1
        apart = turns.longest[1:] + turns.longest[:-1]
        usable = ~turns.gap[1:] & ~turns.gap[:-1] & (apart > 0.0) & (np.arange(1, len(turns.rate)) > 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = np.where(usable, np.maximum(change - noise - scale, 0.0) / apart, np.nan)
        ledger.charge(
            TURN_ACCELERATION, needed=needed, when_ns=turns.when_ns[1:], values=np.degrees(turns.rate[1:, k]),
            worst=f"{name}: {{}} deg/s, another rate just before", given=(GYRO_NOISE, GYRO_SCALE),
        )  # fmt: skip


def weigh_tracks(
    ledger: Ledger, recording: Recording, robot: RobotConfig, encoders: EncodersConfig, turns: Turning | None
) -> None:
    """Speed and acceleration from the counts; slip where tracks and gyroscope disagree on a turn."""
    metres = recording.counts * np.array([encoders.left_metres_per_tick, encoders.right_metres_per_tick])
    quantum = ledger.trusted(QUANTISATION) * (abs(encoders.left_metres_per_tick) + abs(encoders.right_metres_per_tick))
    if turns is not None and turns.measured[2]:
        for window_s in SLIP_WINDOWS_S:
            _slip_in_turns(ledger, recording, robot, metres, quantum, turns, window_s)
    early, late, begin, end = (
        recording.ticks.earliest_ns,
        recording.ticks.latest_ns,
        *_windows(recording, SPEED_WINDOW_S),
    )
    if len(begin) == 0:
        return
    path = np.cumsum(np.abs(np.diff(metres, axis=0, prepend=metres[:1])), axis=0).sum(axis=1)
    way = 0.5 * (metres[end] - metres[begin]).sum(axis=1)
    error = 0.5 * (quantum + ledger.trusted(SLIP) * (path[end] - path[begin]))
    shortest, longest = (early[end] - late[begin]) * 1e-9, (late[end] - early[begin]) * 1e-9
    middle = 0.5 * (shortest + longest)
    when = recording.ticks.mid_ns
    ledger.charge(
        SPEED, needed=np.maximum(np.abs(way) - error, 0.0) / longest, seen=np.abs(way) / middle, when_ns=when[end],
        values=way / middle, worst="{} m/s by the tracks", given=(SLIP, QUANTISATION),
    )  # fmt: skip
    # mean speeds of two neighbouring windows are speeds at two instants at most both windows apart
    low = np.where(way - error > 0, (way - error) / longest, (way - error) / shortest)
    high = np.where(way + error > 0, (way + error) / shortest, (way + error) / longest)
    following = np.searchsorted(begin, end)
    paired = (following < len(begin)) & (shortest > 0.0)
    i, j = np.flatnonzero(paired), following[paired]
    joined = (begin[j] == end[i]) & (shortest[j] > 0.0)
    i, j = i[joined], j[joined]
    apart = (late[end[j]] - early[begin[i]]) * 1e-9
    least = np.maximum(np.maximum(low[j] - high[i], low[i] - high[j]), 0.0)
    change = np.abs(way[j] / middle[j] - way[i] / middle[i])
    ledger.charge(
        ACCELERATION, needed=least / apart, seen=2.0 * change / (middle[i] + middle[j]), when_ns=when[end[i]],
        values=way[j] / middle[j], worst="{} m/s by the tracks, another speed just before", given=(SLIP, QUANTISATION),
    )  # fmt: skip


def _slip_in_turns(
    ledger: Ledger,
    recording: Recording,
    robot: RobotConfig,
    metres: Array,
    quantum: float,
    turns: Turning,
    window_s: float,
) -> None:
    """right - left over the ground = gauge * what the body turned about its z axis; the tracks slip by the rest."""
    begin, end = _windows(recording, window_s)
    when = recording.ticks.mid_ns
    ok = (when[begin] > turns.when_ns[0]) & (when[end] < turns.when_ns[-1])
    begin, end = begin[ok], end[ok]
    if len(begin) == 0:
        return
    angle = np.cumsum(turns.rate[:, 2] * turns.seconds)
    untimed = np.abs(turns.rate[:, 2]) * (turns.longest - turns.seconds)
    error = np.cumsum(turns.rate_error(ledger)[:, 2] * turns.longest + untimed)
    gaps = np.cumsum(turns.gap)
    at = np.interp(when, turns.when_ns, angle)
    err = np.interp(when, turns.when_ns, error)
    missing = np.interp(when, turns.when_ns, gaps)
    packet_s = float(np.median(turns.longest))
    # both ends of the window are known to within the stamps and a packet
    fastest = np.maximum(_fastest_near(turns, when[begin]), _fastest_near(turns, when[end]))
    stamps = (recording.ticks.latest_ns - recording.ticks.earliest_ns).astype(float) * 1e-9
    loose_s = 0.5 * (stamps[begin] + stamps[end]) + turns.stamp_ns * 1e-9 + 2.0 * packet_s
    off = (err[end] - err[begin]) + fastest * loose_s
    off += 4.0 * np.radians(ledger.trusted(TURN_ACCELERATION)) * packet_s**2  # inside the packets at both ends
    difference = metres[:, 1] - metres[:, 0]
    path = np.cumsum(np.abs(np.diff(metres, axis=0, prepend=metres[:1])), axis=0).sum(axis=1)
    ran = path[end] - path[begin]
    apart = np.abs(difference[end] - difference[begin] - robot.track_gauge_m * (at[end] - at[begin]))
    usable = (ran > SHORTEST_SLIP_M) & (missing[end] - missing[begin] < 0.5)
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = np.where(usable, np.maximum(apart - robot.track_gauge_m * off - quantum, 0.0) / ran, np.nan)
        seen = np.where(usable, apart / ran, np.nan)
    ledger.charge(
        SLIP, needed=needed, seen=seen, when_ns=when[end], values=apart,
        worst=f"tracks and gyroscope differ by {{}} m in {window_s:g} s",
        given=(GAUGE, GYRO_NOISE, GYRO_BIAS, GYRO_SCALE, QUANTISATION),
    )  # fmt: skip


def _fastest_near(turns: Turning, when_ns: Whole) -> Array:
    """[m] the largest |rate about z| of the packets around each time, and its error."""
    at = np.searchsorted(turns.when_ns, when_ns)
    reach = np.arange(-4, 5)
    around = np.clip(at[:, None] + reach[None, :], 0, len(turns.when_ns) - 1)
    return np.asarray(np.abs(turns.rate[around, 2]).max(axis=1))


def weigh_tilt_against_gyro(ledger: Ledger, recording: Recording, turns: Turning) -> None:
    """Between two tilt readings roll and pitch move no further than the body rates vary (motion.excursion)."""
    if not turns.measured.all():
        return
    tilt = recording.tilt
    total = np.cumsum(turns.varied(ledger), axis=0)
    gaps = np.cumsum(turns.gap)
    for lag in TILT_LAGS:
        first = np.arange(0, len(tilt.values) - lag, max(1, lag // 2))
        last = first + lag
        # packets that surely cover all that lies between the two readings
        a = np.searchsorted(turns.when_ns, tilt.stamps.earliest_ns[first] - turns.stamp_ns) - 1
        b = np.searchsorted(turns.when_ns, tilt.stamps.latest_ns[last] + turns.stamp_ns) + 1
        ok = (a >= 0) & (b < len(total)) & np.isfinite(tilt.values[first]).all(axis=1)
        ok &= np.isfinite(tilt.values[last]).all(axis=1)
        ok[ok] &= gaps[b[ok]] == gaps[a[ok]]
        first, last, a, b = first[ok], last[ok], a[ok], b[ok]
        varied = total[b] - total[a]
        moved = np.full((len(first), 3), np.nan)
        reach = np.radians(ledger.trusted(TILT))
        row = np.empty(3)
        for k, (roll, pitch) in enumerate(tilt.values[first]):
            if excursion((roll - reach, roll + reach), (pitch - reach, pitch + reach), varied[k], row):
                moved[k] = row
        for axis, name in enumerate(("roll", "pitch")):
            change = tilt.values[last, axis] - tilt.values[first, axis]
            ledger.charge(
                TILT, needed=np.degrees(0.5 * np.maximum(np.abs(change) - moved[:, axis], 0.0)),
                when_ns=tilt.stamps.mid_ns[last], values=np.degrees(change),
                worst=f"{name} jumps by {{}} deg while the gyroscope turns less",
                given=(GYRO_NOISE, GYRO_BIAS, GYRO_SCALE),
            )  # fmt: skip


def weigh_acceleration(ledger: Ledger, recording: Recording, turns: Turning | None) -> None:
    """What an accelerometer feels beside gravity, as the tilt gives it, is error and the robot's acceleration."""
    tilt = recording.tilt
    if len(tilt.values) < 2:
        return
    times = tilt.stamps.mid_ns
    fastest = 0.0 if turns is None else float(np.abs(turns.rate).max() + turns.rate_error(ledger).max())
    for source, accelerometer in recording.accelerometers.items():
        near = np.clip(np.searchsorted(times, accelerometer.stamps.mid_ns), 1, len(times) - 1)
        when = accelerometer.stamps.mid_ns
        near = np.where(np.abs(times[near] - when) < np.abs(times[near - 1] - when), near, near - 1)
        stamps = (accelerometer.stamps.latest_ns - accelerometer.stamps.earliest_ns) + (
            tilt.stamps.latest_ns - tilt.stamps.earliest_ns
        )[near]
        apart_s = (np.abs(times[near] - when) + 0.5 * stamps) * 1e-9
        roll, pitch = tilt.values[near, 0], tilt.values[near, 1]
        angle = np.radians(ledger.trusted(TILT)) + fastest * apart_s
        gravity = np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll)])
        error = ledger.trusted(ACCEL) + 2.0 * GRAVITY_MID * angle[:, None] + GRAVITY_REACH * np.abs(gravity)
        close = np.abs(times[near] - when) < SIDE_BY_SIDE_NS
        for k, axis in enumerate(("ahead", "left")):
            felt = np.abs(accelerometer.values[:, k] - GRAVITY_MID * gravity[:, k])
            ledger.charge(
                ACCELERATION, needed=np.where(close, np.maximum(felt - error[:, k], 0.0), np.nan),
                seen=np.where(close, np.maximum(felt - ledger.trusted(ACCEL), 0.0), np.nan), when_ns=when,
                values=accelerometer.values[:, k], worst=f"{source[0]} {source[1]} {axis}: {{}} m/s^2",
                given=(ACCEL, TILT),
            )  # fmt: skip


def _windows(recording: Recording, window_s: float) -> tuple[Whole, Whole]:
    """First and last reading of windows of about that length that begin at every few readings, in one epoch."""
    when, epoch = recording.ticks.mid_ns, recording.count_epoch
    if len(when) < 3:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    begin = np.arange(len(when), dtype=np.int64)
    end = np.searchsorted(when, when + round(window_s * 1e9)).astype(np.int64)
    ok = end < len(when)
    begin, end = begin[ok], end[ok]
    ok = (epoch[begin] == epoch[end]) & (when[end] - when[begin] < 1.3e9 * window_s)
    return begin[ok], end[ok]
