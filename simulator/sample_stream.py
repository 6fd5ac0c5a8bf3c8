"""What the drivers would deliver, straight from the simulated world: for benches that need no bytes.

All readings of one moment share its stamp, which is exact unless a stamp's uncertainty is asked for.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import floor, nan

from drivers.samples import Fix, InertialSample, Stamp, WheelTicks
from simulator.world import World


@dataclass(frozen=True, slots=True)
class Rates:
    """How often each sensor reads."""

    step_ns: int = 20_000_000
    """Gyroscope, accelerometers and encoders."""
    steps_per_tilt: int = 5
    steps_per_fix: int = 50


def sample_stream(
    world: World, fix_bound_m: tuple[float, float, float] | None, rates: Rates = Rates()
) -> Iterator[tuple[int, list[InertialSample | WheelTicks | Fix]]]:
    """(time, readings) step by step, over the whole drive, which begins at `world.start_ns`; None: no GPS."""
    world.begin_drive(world.start_ns)
    end_ns = world.drive_end_ns
    assert end_ns is not None
    for k in range((end_ns - world.start_ns) // rates.step_ns):
        now_ns = world.start_ns + k * rates.step_ns
        stamp = Stamp(now_ns, now_ns)
        device_us = now_ns // 1000
        ahead, left = world.accel(now_ns, 0)
        tilt = world.tilt(now_ns) if k % rates.steps_per_tilt == 0 else (nan, nan)
        gyro = world.gyro(now_ns - rates.step_ns, now_ns)
        counts = world.count(now_ns)
        readings: list[InertialSample | WheelTicks | Fix] = [
            InertialSample(stamp, "HIGHRES_IMU", 0, device_us, (ahead, left, nan), gyro, tilt),
            WheelTicks(stamp, floor(counts[0]), floor(counts[1])),
        ]
        if fix_bound_m is not None and k % rates.steps_per_fix == 0:
            lat, lon, alt = world.position(now_ns)
            velocity = world.ground_velocity(now_ns)
            readings.append(Fix(stamp, None, lat, lon, alt, 4, 0.8, fix_bound_m, velocity))
        yield now_ns, readings
