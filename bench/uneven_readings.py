"""What a random robot's sensors say on its drive: each at its own times, with its own stamps, losses and silences.

The true time of a reading is on a whole millisecond, where the truth is a row and nothing is interpolated; its stamp is
an interval around it as wide as the sensor's latency. All errors are inside what is declared.
"""

from collections.abc import Iterator
from math import floor, nan

import numpy as np
import pymap3d
from numpy.typing import NDArray

from bench.random_robot import DELAY_S, Robot, Timing
from drivers.samples import ABSENT3, Fix, InertialSample, Stamp, WheelTicks
from simulator.robot import STEP_NS, rotations
from simulator.world import World

Array = NDArray[np.float64]
Reading = InertialSample | WheelTicks | Fix

LATE_NS = 60_000_000
FARTHEST_OFF = 1000.0
"""Wrong fixes are up to so many times their bound off."""


def readings_of(robot: Robot, world: World) -> list[tuple[int, Reading]]:
    """(true time, reading) of the whole drive, in the order in which the filter is given them."""
    out: list[tuple[int, Reading]] = [*_inertial(robot, world), *_counts(robot, world), *_fixes(robot, world)]
    random = np.random.default_rng([robot.seed, 3])

    def due_ns(entry: tuple[int, Reading]) -> int:
        stamp = entry[1].stamp
        late_ns = _ms(DELAY_S * random.random()) if random.random() < robot.behaviour.delayed else 0
        return (stamp.mid_ns if robot.behaviour.by_arrival else stamp.latest_ns) + late_ns

    return sorted(out, key=due_ns)


def true_times(robot: Robot, world: World, timing: Timing, name: str) -> tuple[list[int], np.random.Generator]:
    """When it reads, lost readings included."""
    random = np.random.default_rng([robot.seed, *name.encode()])
    begin_ns, end_ns = world.start_ns + _ms(robot.behaviour.begin_s), world.drive_end_ns
    assert end_ns is not None
    times: list[int] = []
    t = begin_ns + random.uniform(0.0, timing.period_s) * 1e9
    while t < end_ns:
        ms = round((t - begin_ns) / STEP_NS) * STEP_NS + begin_ns
        if not times or ms > times[-1]:
            times.append(int(ms))
        t += timing.period_s * 1e9 * (1.0 + timing.jitter * random.uniform(-1.0, 1.0))
    return times, random


def _ms(seconds: float) -> int:
    return round(seconds * 1000.0) * STEP_NS


def _heard(robot: Robot, world: World, timing: Timing, random: np.random.Generator, t_ns: int) -> bool:
    since_s = (t_ns - world.start_ns) * 1e-9 - robot.behaviour.begin_s
    silent = timing.silent_s[0] <= since_s < timing.silent_s[1]
    return not silent and random.random() >= timing.lost


class Stamps:
    """Of one sensor: read in the order of its readings."""

    def __init__(self, timing: Timing, random: np.random.Generator) -> None:
        self._timing, self._random, self._newest_ns = timing, random, -(2**63)

    def of(self, t_ns: int) -> Stamp:
        """An interval that holds t_ns, whose end is not before that of the one before."""
        width_ns = round(self._timing.width_s * 1e9)
        where = self._timing.where
        share = {"first": 1.0, "last": 0.0, "anywhere": self._random.random()}.get(where)
        if share is None:
            share = float(self._random.random() < 0.5)
        latest_ns = max(t_ns + round(share * width_ns), self._newest_ns)
        earliest_ns = min(latest_ns - width_ns, t_ns)
        if self._timing.late_reads and self._random.random() < 0.1:
            latest_ns += round(self._random.random() * LATE_NS)
        self._newest_ns = latest_ns
        return Stamp(earliest_ns, latest_ns)


def _inertial(robot: Robot, world: World) -> Iterator[tuple[int, InertialSample]]:
    """The board's packets."""
    how = robot.behaviour
    times, random = true_times(robot, world, how.gyro, "gyro")
    stamps, before_ns = Stamps(how.gyro, random), None
    message = "HIGHRES_IMU" if how.clock == "none" else how.clock
    for t in times:
        since, before_ns = before_ns if before_ns is not None else t - _ms(how.gyro.period_s) - STEP_NS, t
        rate = world.gyro(since, t)
        if not _heard(robot, world, how.gyro, random, t):
            continue
        gyro = tuple(value if told else nan for value, told in zip(rate, how.axes, strict=True))
        assert len(gyro) == 3
        device_us, epoch = _board_clock(robot, world, t)
        tilt, accel = (nan, nan), ABSENT3
        if how.tilt is None:
            tilt, accel = _attitude(robot, world, t)
        yield t, InertialSample(stamps.of(t), message, 0, device_us, accel, gyro, tilt, epoch)
    if how.tilt is None:
        return
    times, random = true_times(robot, world, how.tilt, "tilt")
    stamps = Stamps(how.tilt, random)
    for t in times:
        if _heard(robot, world, how.tilt, random, t):
            device_us, epoch = _board_clock(robot, world, t)
            tilt, accel = _attitude(robot, world, t)
            kind = "DUAL_AXIS_TILT" if how.clock != "ATTITUDE" else "ATTITUDE"
            yield t, InertialSample(stamps.of(t), kind, 3, device_us, accel, ABSENT3, tilt, epoch)


def _board_clock(robot: Robot, world: World, t_ns: int) -> tuple[int | None, int]:
    """(device time, epoch)"""
    how = robot.behaviour
    since_ns = t_ns - world.start_ns
    epoch = int(since_ns * 1e-9 >= how.board_reboots_s)
    if how.clock == "none":
        return None, epoch
    drift = robot.devices.imu.clock_drift_ppm * 1e-6 * (1.0 - 1e-9)
    us = since_ns * (1.0 + how.clock_rate * drift) * 1e-3
    if epoch:
        us -= how.board_reboots_s * 1e6 * (1.0 + how.clock_rate * drift)
    whole = floor(us) if how.clock == "HIGHRES_IMU" else floor(us * 1e-3) * 1000
    return whole + (0 if epoch else how.clock_offset_us), epoch


def _attitude(robot: Robot, world: World, t_ns: int) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Tilt and specific force as read."""
    how, row = robot.behaviour, _row(world, t_ns)
    roll, pitch = world.tilt(t_ns)
    ahead, left = world.accel(t_ns, 0)
    up = rotations(world.drive.pose[row : row + 1])[0][2]
    more = how.gravity_mps2 - 9.80665
    ahead, left = ahead + more * float(up[0]), left + more * float(up[1])
    return (
        (roll if how.tells_tilt[0] else nan, pitch if how.tells_tilt[1] else nan),
        (ahead if how.tells_accel[0] else nan, left if how.tells_accel[1] else nan, nan),
    )


def _row(world: World, t_ns: int) -> int:
    return min(max((t_ns - world.start_ns) // STEP_NS, 0), len(world.drive.pose) - 1)


def _counts(robot: Robot, world: World) -> Iterator[tuple[int, WheelTicks]]:
    """The tracks' counters."""
    how, encoders = robot.behaviour, robot.devices.encoders
    times, random = true_times(robot, world, how.ticks, "ticks")
    stamps, channel = Stamps(how.ticks, random), robot.law.channel("ticks")
    for t in times:
        if not _heard(robot, world, how.ticks, random, t):
            continue
        loose = (encoders.quantisation_ticks - 1.0) * (0.5 + 0.5 * channel.at(t - world.start_ns))
        left, right = world.count(t)
        epoch = int((t - world.start_ns) * 1e-9 >= how.counter_resets_s)
        offset = -(2**45) if epoch else 17
        yield t, WheelTicks(stamps.of(t), floor(left + loose) + offset, floor(right + loose) - offset, epoch)


def _fixes(robot: Robot, world: World) -> Iterator[tuple[int, Fix]]:
    """The receiver's."""
    how, gps = robot.behaviour, robot.devices.gps
    if gps is None:
        return
    assert gps.rtk_fixed_horizontal_m is not None
    assert gps.rtk_fixed_vertical_m is not None
    times, random = true_times(robot, world, how.fixes, "fixes")
    stamps = Stamps(how.fixes, random)
    channels = [robot.law.channel(f"gps.{axis}") for axis in ("east", "north", "up")]
    arm = np.array([gps.antenna_x_m, gps.antenna_y_m, gps.antenna_z_m])
    wrong: list[bool] = []
    for t in times:
        if not _heard(robot, world, how.fixes, random, t):
            continue
        scale = float(np.exp(random.uniform(0.0, np.log(how.fix_scales))))
        east, up = scale * gps.rtk_fixed_horizontal_m, scale * gps.rtk_fixed_vertical_m
        bound = np.array([east, east, up])
        share = np.array([channel.at(t - world.start_ns) for channel in channels])
        off = bound * share * (1.0 - 1e-6) - 2e-6 * np.sign(share)
        velocity = world.ground_velocity(t)
        is_wrong = _may_be_wrong(robot, wrong) and random.random() < how.wrong_share
        wrong.append(is_wrong)
        if is_wrong:
            off = bound * random.uniform(-1.0, 1.0, 3) * FARTHEST_OFF ** random.random() * 3.0
            if velocity is not None:
                velocity = float(random.uniform(-5.0, 5.0)), float(random.uniform(-5.0, 5.0))
        pose = world.pose(t)
        antenna = pose[:3] + rotations(pose[np.newaxis])[0] @ arm
        lat, lon, alt = _told(pymap3d.enu2geodetic(*antenna, *robot.origin), off)
        yield t, Fix(stamps.of(t), None, lat, lon, alt, 4, 0.8, (east, east, up), velocity)


def _may_be_wrong(robot: Robot, wrong: list[bool]) -> bool:
    """Are there few enough wrong ones among the last? They are counted as they arrive, some perhaps much later."""
    config, in_turn = robot.filter, robot.behaviour.delayed == 0.0
    among = config.wrong_fixes_of - 1 if in_turn else 2 * config.wrong_fixes_of
    return sum(wrong[-among:]) < config.wrong_fixes


def _told(true: tuple[float, float, float], off: Array) -> tuple[float, float, float]:
    """The fix of which the truth is `off` away, along the fix's own east, north and up."""
    lat, lon, alt = (float(value) for value in true)
    for _ in range(4):
        seen = np.array(pymap3d.geodetic2enu(*true, lat, lon, alt))
        lat, lon, alt = (float(value) for value in pymap3d.enu2geodetic(*(seen - off), lat, lon, alt))
    return lat, lon, alt


def standing(robot: Robot, world: World, readings: list[tuple[int, Reading]]) -> tuple[float, float]:
    """The largest body rate (deg/s) and way (m) while the tracks, as read, rest for the declared time before and after.

    A reading that comes after a newer one is none: whoever goes by it sees the tracks move to and fro, and rest later.
    """
    after_s = robot.filter.standstill_s
    assert after_s is not None
    after_ns = int(after_s * 1e9)
    largest, way, first, last = 0.0, 0.0, None, None
    for t, ticks in readings:
        if not isinstance(ticks, WheelTicks):
            continue
        if last is not None and ticks.stamp.mid_ns < last.stamp.mid_ns:
            continue
        same = last is not None and (ticks.left, ticks.right, ticks.epoch) == (last.left, last.right, last.epoch)
        if not same:
            first = t
        last = ticks
        assert first is not None
        a, b = _row(world, first + after_ns), _row(world, t - after_ns)
        if b >= a and t - after_ns >= first + after_ns:
            # Packets' means and tilt may reach beyond both ends by a row.
            largest = max(largest, float(np.abs(world.drive.rate[max(a - 1, 0) : b + 2]).max()))
            way = max(way, float(np.linalg.norm(np.ptp(world.drive.pose[a : b + 1, :3], axis=0))))
    return float(np.degrees(largest)), way
