"""Scans of a standing robot: how far a beam's distance wanders while nothing moves. No proof: something may have moved.

A beam's angle wanders too, by its own bound, along the scan and across it, which changes the distance on a slanted
surface: that much is taken off. Along the scan the neighbours tell how slanted it is; across it a beam that ends about
where the ground is, as the mounting tells, is taken to end on it.
"""

import numpy as np

from drivers.config import LaserConfig
from drivers.samples import Scan
from estimator.bound_usage.ledger import Array, Ledger
from estimator.bound_usage.recording import Stamps, within

RANGE_BOUND = "devices.laser.range_bound_m"
FEWEST_SCANS = 20
ABOUT = 2.0
"""A distance to the ground may be so many times more or less than to flat ground under a level robot."""


def weigh_scans(ledger: Ledger, scans: list[Scan], rests: list[tuple[int, int]], laser: LaserConfig) -> None:
    """The middle beam of all, by how much it wanders while the robot stands in one place."""
    inside = within(rests, Stamps.of(scans))
    for k in range(len(rests)):
        chosen = [scan for scan, rest in zip(scans, inside, strict=True) if rest == k]
        size = max((len(scan.ranges_m) for scan in chosen), default=0)
        alike = [scan for scan in chosen if len(scan.ranges_m) == size]
        if len(alike) >= FEWEST_SCANS and size >= 3:
            _wander(ledger, alike, laser)


def _wander(ledger: Ledger, scans: list[Scan], laser: LaserConfig) -> None:
    """Half the spread of each beam, less what its wandering angle does to it."""
    ranges = np.array([scan.ranges_m for scan in scans])
    usable = ((ranges >= laser.range_min_m) & (ranges <= laser.range_max_m)).all(axis=0)
    half = 0.5 * np.ptp(np.where(usable, ranges, 0.0), axis=0)
    mean = np.where(usable, ranges, np.nan).mean(axis=0)
    slope = np.full(len(mean), np.nan)
    slope[1:-1] = np.maximum(np.abs(mean[2:] - mean[1:-1]), np.abs(mean[1:-1] - mean[:-2]))
    slope = slope / abs(scans[0].angle_increment_rad) + across_the_scan(mean, scans[0], laser)
    seen = half - np.radians(laser.angle_bound_deg) * slope
    good = np.flatnonzero(np.isfinite(seen))
    if len(good) == 0:
        return
    middle = good[np.argsort(seen[good])[len(good) // 2]]
    count = len(scans) * len(good)
    ledger.charge(
        RANGE_BOUND, needed=np.zeros(count), seen=np.full(count, max(float(seen[middle]), 0.0)),
        when_ns=np.repeat([scan.stamp.mid_ns for scan in scans], len(good)), values=np.full(count, mean[middle]),
        worst="half of the beams wander by this or more, as one at {} m",
    )  # fmt: skip


def across_the_scan(mean_m: Array, scan: Scan, laser: LaserConfig) -> Array:
    """[n] metres a radian by which beams that end on the ground get longer or shorter as the scan's plane tilts."""
    pitch, roll = np.radians(laser.mount_pitch_deg), np.radians(laser.mount_roll_deg)
    angles = scan.angle_min_rad + scan.angle_increment_rad * np.arange(len(mean_m))
    down = -np.sin(pitch) * np.cos(angles) - np.cos(pitch) * np.sin(roll) * np.sin(angles)
    flat_m = np.divide(laser.mount_z_m, down, out=np.full(len(down), np.inf), where=down > 1e-3)
    grazing = (mean_m < ABOUT * flat_m) & (mean_m > flat_m / ABOUT)
    return np.where(grazing, mean_m * np.sqrt(1.0 - down**2) / np.maximum(down, 1e-3), 0.0)
