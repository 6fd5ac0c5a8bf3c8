"""The soonest at which any sound method could contradict wheels whose scale is wrong: a bound that nobody beats.

It is given more than any filter has: the true attitude and the true turning at every instant, counts without
quantisation. Then all that is unknown are slips, within their declared bounds, and the errors of fixes, within theirs;
and the places that these allow are a convex polygon, step by step: a Minkowski sum with the step's forward and lateral
freedom, cut by each fix's box. While the polygon isn't empty, a motion within all bounds explains all measurements, so
no sound method can name anybody. (Vertices that are dropped to keep the polygon small only make it smaller: sooner.)
"""

from math import cos, sin

import numpy as np
import pymap3d
from numpy.typing import NDArray

from bench.fault_drive import RATES, RTK, declared
from simulator.faults import WrongTracks
from simulator.robot import STEP_NS, rotations
from simulator.world import World

Array = NDArray[np.float64]
MOST_VERTICES = 48


def soonest_s(world: World, fault: WrongTracks, bound_m: tuple[float, float, float] = RTK) -> float:
    """Seconds of the drive until the polygon is empty, or a step's turning contradicts its tracks; inf: never."""
    robot, devices = declared(bound_m)
    gps, slip, drive = devices.gps, robot.slip_ratio, world.drive
    assert gps is not None
    lever = np.array([gps.antenna_x_m, gps.antenna_y_m, gps.antenna_z_m])
    rows = RATES.step_ns // STEP_NS
    world.begin_drive(world.start_ns)
    place = np.array([[-1e3, -1e3], [1e3, -1e3], [1e3, 1e3], [-1e3, 1e3]])
    for k in range(1, (len(drive.pose) - 1) // rows):
        now, before = k * rows, (k - 1) * rows
        t_s = now * STEP_NS * 1e-9
        scale = np.array(fault.scale) if fault.begin_s <= t_s < fault.end_s else np.ones(2)
        counted = (drive.tracks[now] - drive.tracks[before]) * scale
        turned = drive.turned[now, 2] - drive.turned[before, 2]
        path = float(np.abs(counted).max()) * (1.0 + slip)
        low, high = counted - slip * np.abs(counted) - 1e-9, counted + slip * np.abs(counted) + 1e-9
        half = 0.5 * robot.track_gauge_m * turned
        ahead = max(low[0] + half, low[1] - half), min(high[0] + half, high[1] - half)
        if ahead[0] > ahead[1]:
            return t_s
        side = robot.lateral_slip_ratio * path + robot.turning_centre_m * abs(turned)
        pose = drive.pose[(now + before) // 2]
        bounce = robot.normal_slip_ratio * path * float(np.sin(np.abs(pose[3:5]).sum())) + 1e-6
        yaw, level = pose[5], cos(pose[4])
        place = _moved(place, np.array([cos(yaw), sin(yaw)]) * level, ahead[0] - bounce, ahead[1] + bounce)
        place = _moved(place, np.array([-sin(yaw), cos(yaw)]), -side - bounce, side + bounce)
        if k % RATES.steps_per_fix == 0:
            now_ns = world.start_ns + now * STEP_NS
            east, north, _ = pymap3d.geodetic2enu(*world.position(now_ns), *world.origin)
            arm = rotations(drive.pose[now][np.newaxis])[0] @ lever
            middle = np.array([east, north]) - arm[:2]
            for axis in range(2):
                place = _cut(place, axis, 1.0, middle[axis] + bound_m[axis])
                place = _cut(place, axis, -1.0, bound_m[axis] - middle[axis])
            if len(place) == 0:
                return t_s
    return float("inf")


def _moved(polygon: Array, direction: Array, least: float, most: float) -> Array:
    """Minkowski sum with a segment along a direction; the polygon's vertices go counterclockwise."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    right = edges[:, 0] * direction[1] - edges[:, 1] * direction[0] < 0.0
    # A vertex goes along with the edges beside it: to the far end after edges that look that way, else to the near.
    out = []
    for i in range(len(polygon)):
        ends = {bool(right[i - 1]), bool(right[i])}
        order = [bool(right[i - 1]), bool(right[i])] if len(ends) == 2 else [bool(right[i])]
        out += [polygon[i] + direction * (most if far else least) for far in order]
    return _thinned(np.array(out))


def _thinned(polygon: Array) -> Array:
    """Without the vertices that matter least: a part of the polygon."""
    while len(polygon) > MOST_VERTICES:
        a, b = np.roll(polygon, 1, axis=0) - polygon, np.roll(polygon, -1, axis=0) - polygon
        area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        least = int(np.argmin(area))
        polygon = np.delete(polygon, least, axis=0)
    return polygon


def _cut(polygon: Array, axis: int, sign: float, limit: float) -> Array:
    """What of it fulfils sign * coordinate <= limit."""
    out = []
    for i in range(len(polygon)):
        here, there = polygon[i], polygon[(i + 1) % len(polygon)]
        a, b = sign * here[axis] - limit, sign * there[axis] - limit
        if a <= 0.0:
            out.append(here)
        if (a < 0.0 < b) or (b < 0.0 < a):
            out.append(here + (there - here) * (a / (a - b)))
    return np.array(out).reshape(-1, 2)
