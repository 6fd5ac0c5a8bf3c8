"""Recordings of four real drives, as the samples that our drivers would have given.

None of these vehicles is a tracked robot, and none recorded all that the filter asks for. What is bent or made up
stands with each; the promise holds only as far as that is true.
"""

import os
from dataclasses import dataclass, field
from math import nan
from pathlib import Path

import numpy as np
import pymap3d
from numpy.typing import NDArray

from drivers.errors import TerraboundError
from drivers.samples import Fix, InertialSample, Sample, Stamp, WheelTicks
from examples.matlab_file import read_arrays

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]

TICK_M = 1e-4
HOME = (0.0, 0.0, 0.0)
"""The recordings have local metres: they are put here on Earth."""
BEGIN_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class RecordedDrive:
    """One drive."""

    title: str
    samples: list[Sample]
    """In the order of their stamps."""
    truth_ns: Whole | None
    truth: Floats | None
    """[n, 3] x, y in metres, heading in rad, in the recording's own frame; None: there was none."""
    fixes: Floats
    """[m, 2] x, y of the fixes, the recording's frame."""

    turned: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """[k, 3] second of the drive, what the gyroscope turned about z so far (rad), by how much that can be off."""
    tracks: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """[k, 3] second of the drive, way of the left and of the right wheels (m)."""

    @property
    def fix_ns(self) -> Whole:
        """[m] their times."""
        return np.array([sample.stamp.mid_ns for sample in self.samples if isinstance(sample, Fix)], np.int64)


def data_folder() -> Path:
    """Where the recordings lie. Raises TerraboundError where they don't."""
    folder = Path(os.environ.get("TERRABOUND_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    folder = folder / "localisation"
    if not folder.is_dir():
        raise TerraboundError(
            f"{folder}: no such folder; the recorded drives do not come with the project: "
            "set TERRABOUND_DATA to the folder that holds them"
        )
    return folder


def plaza(folder: Path, fix_bound_m: float | None = 0.6, seed: int = 1) -> RecordedDrive:
    """Plaza 1: a mower over grass, 1.9 km, wheel odometry and fibre-optic gyro at 5 Hz; truth from RTK GPS.

    Bent: one odometer stands for both tracks; their difference is what the gyroscope turned. Made up: roll, pitch and
    their rates ("level", declared to a degree or two); and GPS: the recording's centimetre positions are its truth,
    so fixes are drawn from the truth, once a second, anywhere inside `fix_bound_m` (None: no GPS at all). Known: the
    truth's heading is the gyro's own, and most of its steps are the odometer's; so it is an independent witness of
    place over a distance, not of heading.
    """
    arrays = read_arrays(folder / "Plaza1_.mat")
    steps, truth = arrays["DR"], arrays["GT"]
    time_ns = _ns(truth[:, 0] - truth[0, 0])
    turned = np.concatenate([[0.0], steps[:, 2]])
    counts = _both_tracks(np.concatenate([[0.0], steps[:, 1]]), turned, gauge_m=1.0)
    seconds = np.diff(time_ns, prepend=time_ns[0] - 200_000_000) * 1e-9
    samples: list[Sample] = []
    random = np.random.default_rng(seed)
    fixes = []
    for k, now in enumerate(time_ns.tolist()):
        samples += _planar(now, 5_000_000, turned[k] / seconds[k])
        samples.append(WheelTicks(Stamp(now - 5_000_000, now + 5_000_000), *counts[k]))
        if fix_bound_m is not None and k % 5 == 0:
            place = truth[k, 1:3] + random.uniform(-fix_bound_m, fix_bound_m, 2)
            fixes.append(place)
            samples.append(_fix(now, 5_000_000, place, (fix_bound_m, fix_bound_m, 2.0 * fix_bound_m), 2))
    heading = np.unwrap(truth[:, 3])
    return RecordedDrive(
        "Plaza 1: a mower on grass", samples, time_ns, np.column_stack([truth[:, 1:3], heading]),
        np.array(fixes).reshape(-1, 2),
    )  # fmt: skip


def husky(folder: Path, ground: str) -> RecordedDrive:
    """A skid-steer robot with four wheels, on ASPHALT or SNOW: inertial unit at 100 Hz, wheel speeds at 6.5 Hz.

    Bent: the wheels of one side stand for a track. Speeds are integrated to counts. The tilt "sensor" is made of the
    accelerometers: turned into the frame of now by the gyroscope and averaged over two seconds. Vibration of up to 9 g
    averages out, since the velocity can't change by more than twice the largest meanwhile (which is declared as part
    of its error). No GPS, no truth.
    """
    name = {"ASPHALT": "02", "SNOW": "00"}[ground]
    inertial = np.loadtxt(folder / f"{ground}_imu_{name}.csv", delimiter=",", skiprows=1)
    wheels = np.loadtxt(folder / f"{ground}_pro_{name}.csv", delimiter=",", skiprows=1)
    samples: list[Sample] = []
    window = 200
    turns = _orientations(inertial[:, 1:4] * 0.01)
    sums = np.cumsum(np.einsum("nij,nj->ni", turns, inertial[:, 4:7]), axis=0)
    for k, row in enumerate(inertial):
        now = BEGIN_NS + round(row[0] * 1e9)
        stamp = Stamp(now, now + 2_000_000)
        rates = (float(row[1]), float(row[2]), float(row[3]))
        samples.append(InertialSample(stamp, "HIGHRES_IMU", 0, now // 1000, gyro_rps=rates))
        if k >= window and k % 2 == 0:
            mean = turns[k].T @ (sums[k] - sums[k - window])
            tilt = float(np.arctan2(mean[1], mean[2])), float(np.arctan2(-mean[0], np.hypot(mean[1], mean[2])))
            samples.append(InertialSample(stamp, "ATTITUDE", 0, now // 1000, tilt_rad=tilt))
    way = np.cumsum(wheels[:, 3:5] * np.diff(wheels[:, 0], prepend=wheels[0, 0])[:, None], axis=0)
    for row, (left, right) in zip(wheels, np.rint(way / TICK_M).astype(np.int64), strict=True):
        now = BEGIN_NS + round(row[0] * 1e9)
        if row[0] < TILT_KNOWN_S:
            continue  # the map begins where there is a tilt
        samples.append(WheelTicks(Stamp(now - 10_000_000, now + 10_000_000), int(left), int(right)))
    title = f"A skid-steer robot on {ground.lower()}"
    error = np.radians(GYRO_ERROR_DPS) * inertial[:, 0]
    return RecordedDrive(
        title, _ordered(samples), None, None, np.zeros((0, 2)),
        turned=np.column_stack([inertial[:, 0], np.cumsum(inertial[:, 3]) * 0.01, error]),
        tracks=np.column_stack([wheels[:, 0], way]),
    )  # fmt: skip


TILT_KNOWN_S = 2.1
GYRO_ERROR_DPS = 0.7
"""For the picture: declared bias and noise of the gyroscope (husky.toml)."""

WHEEL_BASE_M, LEFT_WHEEL_M = 2.83, 0.76
"""Of the Victoria Park car: between the axles; its encoder sits on the left rear wheel, so far from the middle."""


def victoria_park(folder: Path, bound_m: float = 15.0) -> RecordedDrive:
    """Victoria Park: a car among trees, speed and steering angle at 40 Hz, GPS with gaps of up to 58 s. No truth.

    Bent: a car has no tracks and no gyroscope; its turn rate is v tan(steering) / wheel base, given as a gyroscope's,
    with an error as large as half a degree of steering. Made up: "level".
    """
    dead, gps = read_arrays(folder / "aa3_dr.mat"), read_arrays(folder / "aa3_gpsx.mat")
    time_s = dead["time"][:, 0] * 1e-3
    begin_s = time_s[0]
    steering = dead["steering"][:, 0]
    speed = dead["speed"][:, 0] / (1.0 - LEFT_WHEEL_M / WHEEL_BASE_M * np.tan(steering))
    seconds = np.diff(time_s, prepend=time_s[0] - 0.025)
    rate = speed * np.tan(steering) / WHEEL_BASE_M
    counts = _both_tracks(speed * seconds, rate * seconds, gauge_m=1.52)
    samples: list[Sample] = []
    for now, turn, count in zip(_ns(time_s - begin_s).tolist(), rate.tolist(), counts, strict=True):
        samples += _planar(now, 15_000_000, turn)
        samples.append(WheelTicks(Stamp(now - 15_000_000, now + 15_000_000), *count))
    places = np.column_stack([gps["Lo_m"], gps["La_m"]])
    for now, place in zip(_ns(gps["timeGps"][:, 0] * 1e-3 - begin_s).tolist(), places, strict=True):
        samples.append(_fix(now, 100_000_000, place, (bound_m, bound_m, 2.0 * bound_m), 1))
    return RecordedDrive("Victoria Park: a car among trees", _ordered(samples), None, None, places)


def _orientations(turned: Floats) -> Floats:
    """[n, 3, 3] the body's axes seen from where it began, from its turns [n, 3] between readings (Rodrigues)."""
    now, all_of_them = np.eye(3), np.empty((len(turned), 3, 3))
    for k, (x, y, z) in enumerate(turned):
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        angle = float(np.sqrt(x * x + y * y + z * z)) or 1.0
        now = now @ (np.eye(3) + np.sin(angle) / angle * cross + (1.0 - np.cos(angle)) / angle**2 * cross @ cross)
        all_of_them[k] = now
    return all_of_them


def _planar(now: int, half_ns: int, turn_rps: float) -> list[Sample]:
    """A gyroscope's packet of a vehicle that is said to be level."""
    stamp = Stamp(now - half_ns, now + half_ns)
    return [
        InertialSample(stamp, "HIGHRES_IMU", 0, now // 1000, gyro_rps=(0.0, 0.0, float(turn_rps)), tilt_rad=(0.0, 0.0))
    ]


def _both_tracks(steps_m: Floats, turns_rad: Floats, gauge_m: float) -> list[list[int]]:
    """[n][2] counts of a left and a right track that drive like this."""
    half = 0.5 * gauge_m * turns_rad
    way = np.cumsum(np.column_stack([steps_m - half, steps_m + half]), axis=0)
    counts: list[list[int]] = np.rint(way / TICK_M).astype(np.int64).tolist()
    return counts


def _fix(now: int, half_ns: int, place: Floats, bound: tuple[float, float, float], quality: int) -> Fix:
    lat, lon, alt = pymap3d.enu2geodetic(float(place[0]), float(place[1]), 0.0, *HOME)
    return Fix(Stamp(now - half_ns, now + half_ns), None, float(lat), float(lon), float(alt), quality, nan, bound)


def _ordered(samples: list[Sample]) -> list[Sample]:
    return sorted(samples, key=lambda sample: sample.stamp.mid_ns)


def _ns(seconds: Floats) -> Whole:
    return np.asarray(BEGIN_NS + np.rint(seconds * 1e9), np.int64)
