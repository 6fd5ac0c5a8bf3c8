"""Positions against each other: two fixes can't be further apart than both bounds and the way between them."""

from dataclasses import dataclass

import numpy as np
import pymap3d

from drivers.config import EncodersConfig, GpsConfig
from drivers.samples import Fix
from estimator.bound_usage.ledger import Ledger
from estimator.bound_usage.on_the_move import QUANTISATION, SLIP, TURN_RATE, Turning
from estimator.bound_usage.recording import Array, Recording, Whole
from estimator.config import RobotConfig

GST, RANGE = "devices.gps.gst_factor", "devices.gps.range_error_m"
RTK_HORIZONTAL, RTK_VERTICAL = "devices.gps.rtk_fixed_horizontal_m", "devices.gps.rtk_fixed_vertical_m"
RTK_FIXED = 4
LAGS = (1, 4, 10, 30)
SHORTEST_WAY_M = 3.0
MOST_TURN = 0.6
"""rad of turning, all axes together, in what counts as a straight run."""
STANDS_M = 0.01
HALF_STEP_M = 0.1
"""Half a step of the coarsest digits in use, 0.0001 minutes, stands in every bound besides."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Pairs of fixes, and what tracks and gyroscope say of the way between them. [m] each."""

    old: Whole
    new: Whole
    apart: Array
    """[m, 3] east, north, up."""
    most_way: Array
    """What the tracks ran, at most, metres."""
    least_way: Array
    """... and at least, all in one direction; 0 where they turned round."""
    turn: Array
    """How far the body turned at most, all axes together, rad."""


def weigh_fixes(
    ledger: Ledger,
    recording: Recording,
    robot: RobotConfig,
    encoders: EncodersConfig,
    gps: GpsConfig,
    turns: Turning | None,
) -> None:
    """Receiver bounds from pairs of fixes; slip from the way between them."""
    fixes = recording.fixes
    if len(fixes) < 2 or len(recording.counts) < 2:
        return
    columns = np.array([(fix.lat_deg, fix.lon_deg, fix.alt_m) for fix in fixes]).T
    place = np.column_stack(pymap3d.geodetic2enu(*columns, fixes[0].lat_deg, fixes[0].lon_deg, fixes[0].alt_m))
    bound = np.array([fix.bound_m for fix in fixes])
    keys = np.array([_keys(fix, gps) for fix in fixes])
    when = recording.fix_stamps.mid_ns
    quantum = ledger.trusted(QUANTISATION) * (abs(encoders.left_metres_per_tick) + abs(encoders.right_metres_per_tick))
    arm = float(np.linalg.norm([gps.antenna_x_m, gps.antenna_y_m, gps.antenna_z_m]))
    for lag in LAGS:
        pairs = _pairs(ledger, recording, encoders, turns, place, lag)
        old, new = pairs.old, pairs.new
        if len(old) == 0:
            continue
        both = bound[old] + bound[new]
        aside = (robot.lateral_slip_ratio + robot.normal_slip_ratio) * pairs.most_way
        aside += robot.turning_centre_m * pairs.turn + arm * np.minimum(2.0, pairs.turn) + quantum
        moved = (1.0 + ledger.trusted(SLIP)) * pairs.most_way + aside
        share = np.maximum(np.abs(pairs.apart) - moved[:, None], 0.0) / both
        seen = np.where(moved < STANDS_M, np.abs(pairs.apart).T / both.T, np.nan).T
        for axis, name in enumerate(("east", "north", "up")):
            for key in np.unique(keys[:, axis]):
                alike = (keys[old, axis] == key) & (keys[new, axis] == key)
                floor = _floor(key, gps, axis)
                width = bound[new, axis] - floor
                ledger.charge(
                    key,
                    needed=np.where(alike, _factor(share[:, axis], bound[new, axis], floor, width), np.nan)
                    * ledger.accounts[key].declared,
                    seen=np.where(alike, _factor(seen[:, axis], bound[new, axis], floor, width), np.nan)
                    * ledger.accounts[key].declared,
                    when_ns=when[new],
                    values=pairs.apart[:, axis],
                    worst=f"{name}: two fixes {{}} m apart, the tracks ran less",
                    given=(SLIP, QUANTISATION),
                )
        if any(ledger.accounts[key].contradicted for key in np.unique(keys)):
            continue  # whose fault the distance is, is settled
        reach, error = np.linalg.norm(pairs.apart, axis=1), np.linalg.norm(both, axis=1) + aside
        long = pairs.least_way > SHORTEST_WAY_M
        most, least = np.maximum(pairs.most_way, 1e-9), np.maximum(pairs.least_way, 1e-9)
        straight = long & (pairs.turn < MOST_TURN)
        for needed, text in (
            (np.where(long, (reach - error) / most - 1.0, np.nan), "fixes {} m apart: the tracks ran less"),
            (
                np.where(straight, 1.0 - (reach + error) / (least * np.cos(np.minimum(pairs.turn, 1.5))), np.nan),
                "fixes {} m apart, straight on: the tracks ran more",
            ),
        ):
            # `seen` stays empty: how far the receiver was off is not known
            ledger.charge(
                SLIP, needed=np.maximum(needed, 0.0), seen=np.full(len(needed), np.nan), when_ns=when[new],
                values=reach, worst=text, given=tuple(sorted(set(keys[:, 0].tolist()))),
            )  # fmt: skip


def _pairs(
    ledger: Ledger, recording: Recording, encoders: EncodersConfig, turns: Turning | None, place: Array, lag: int
) -> Pairs:
    """Fixes `lag` apart between which the counts are whole."""
    fixes, ticks, epoch = recording.fix_stamps, recording.ticks, recording.count_epoch
    old, new = np.arange(len(place) - lag), np.arange(lag, len(place))
    steps = np.diff(recording.counts, axis=0, prepend=recording.counts[:1]) * np.array(
        [encoders.left_metres_per_tick, encoders.right_metres_per_tick]
    )
    path = np.cumsum(0.5 * np.abs(steps).sum(axis=1))
    way = np.cumsum(0.5 * steps.sum(axis=1))
    # readings that surely enclose the time between the two fixes ...
    a = np.searchsorted(ticks.latest_ns, fixes.earliest_ns[old]) - 1
    b = np.searchsorted(ticks.earliest_ns, fixes.latest_ns[new])
    ok = (a >= 0) & (b < len(path))
    ok[ok] &= epoch[a[ok]] == epoch[b[ok]]
    old, new, a, b = old[ok], new[ok], a[ok], b[ok]
    # ... and that are surely inside of it
    c = np.clip(np.searchsorted(ticks.earliest_ns, fixes.latest_ns[old]), 0, len(path) - 1)
    d = np.clip(np.searchsorted(ticks.latest_ns, fixes.earliest_ns[new]) - 1, 0, len(path) - 1)
    one_way = np.abs(np.abs(way[b] - way[a]) - (path[b] - path[a])) < 1e-9
    return Pairs(
        old,
        new,
        place[new] - place[old],
        path[b] - path[a],
        np.where(one_way & (d > c), path[d] - path[c], 0.0),
        _turned(ledger, turns, ticks.earliest_ns[a], ticks.latest_ns[b]),
    )


def _turned(ledger: Ledger, turns: Turning | None, begin_ns: Whole, end_ns: Whole) -> Array:
    """[m] how far the body can have turned in each stretch, all axes together."""
    most = 3.0 * np.radians(ledger.trusted(TURN_RATE)) * (end_ns - begin_ns) * 1e-9
    if turns is None or not turns.measured.all():
        return np.asarray(most)
    effort = turns.varied(ledger).sum(axis=1).cumsum()
    gaps = np.cumsum(turns.gap)
    a = np.searchsorted(turns.when_ns, begin_ns - turns.stamp_ns) - 1
    b = np.searchsorted(turns.when_ns, end_ns + turns.stamp_ns) + 1
    known = (a >= 0) & (b < len(effort))
    a, b = np.clip(a, 0, len(effort) - 1), np.clip(b, 0, len(effort) - 1)
    return np.asarray(np.where(known & (gaps[a] == gaps[b]), np.minimum(effort[b] - effort[a], most), most))


def _keys(fix: Fix, gps: GpsConfig) -> tuple[str, str, str]:
    """The key that each axis of a fix's bound came from."""
    horizontal = vertical = GST
    if 0.0 <= fix.bound_m[0] - (fix.hdop * gps.range_error_m + gps.floor_horizontal_m) < HALF_STEP_M:
        horizontal = vertical = RANGE
    if fix.quality == RTK_FIXED and gps.rtk_fixed_horizontal_m is not None:
        horizontal = RTK_HORIZONTAL
    if fix.quality == RTK_FIXED and gps.rtk_fixed_vertical_m is not None:
        vertical = RTK_VERTICAL
    return horizontal, horizontal, vertical


def _floor(key: str, gps: GpsConfig, axis: int) -> float:
    """The part of a bound that its key doesn't scale."""
    if key in (RTK_HORIZONTAL, RTK_VERTICAL):
        return 0.0
    return gps.floor_vertical_m if axis == 2 else gps.floor_horizontal_m


def _factor(share: Array, bound: Array, floor: float, width: Array) -> Array:
    """By how much the key must be scaled for the whole bound to be scaled by `share`."""
    return np.asarray(np.maximum(share * bound - floor, 0.0) / np.maximum(width, 1e-12))
