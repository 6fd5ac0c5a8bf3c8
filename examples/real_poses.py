"""Real drives through the pose filter: a set at every instant, held against the truth where there is one.

    python examples/real_poses.py [--output FOLDER] [--set ellipsoid]

For each drive: bounds as an owner declares them from data sheets (examples/real_poses/*.toml), what `check --bounds`
says of them, the drive's pose sets, and a picture (of boxes, the default). A contradiction is told, with the sensor
and the time.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import cos, sin
from pathlib import Path
from typing import Annotated

import numpy as np
import pymap3d
from cyclopts import App, Parameter
from numpy.typing import NDArray

from drivers.errors import TerraboundError
from drivers.samples import Scan
from estimator.bound_usage.ledger import Usage, Verdict
from estimator.bound_usage.usage import bound_usage
from estimator.config import SetName
from estimator.filter import Filter
from examples.recorded_drives import BEGIN_NS, HOME, RecordedDrive, data_folder, husky, plaza, victoria_park
from service.config import Config, load

Floats = NDArray[np.float64]
DRIVES: dict[str, tuple[str, Callable[[Path], RecordedDrive]]] = {
    "plaza": ("plaza", plaza),
    "asphalt": ("husky", lambda folder: husky(folder, "ASPHALT")),
    "snow": ("husky", lambda folder: husky(folder, "SNOW")),
    "victoria_park": ("victoria_park", victoria_park),
}
"""Where each drive's bounds stand, and how it is read."""
HERE = Path(__file__).resolve().parent
STEP_NS = 200_000_000
NOWHERE_M = 1e5
"""A set so wide comes from before the first fix."""


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """What the filter made of a drive; a row for each moment that was asked for.

    With GPS the sets stand on Earth, which is the recording's own frame; without, in the map frame.
    """

    drive: RecordedDrive
    config: Config
    filter: Filter
    contradicted: list[Usage]
    """What `check --bounds` says against the declared bounds."""
    time_ns: NDArray[np.int64]
    low: Floats
    """[n, 6]"""
    high: Floats
    truth: Floats | None
    """[n, 3] x, y, heading in the frame of the sets."""
    outside: int | None
    """True places outside of their set; None without a truth."""
    refused: int
    """Moments without a pose."""

    @property
    def half_widths(self) -> Floats:
        """[6] medians."""
        return np.asarray(np.median(0.5 * (self.high - self.low), axis=0))

    @property
    def said(self) -> str:
        """What became of the guarantee."""
        guarantee = self.filter.guarantee
        if guarantee.contradicted_ns is None:
            return "the filter saw no contradiction"
        seconds = (guarantee.contradicted_ns - BEGIN_NS) * 1e-9
        return f"the filter was contradicted by {guarantee.sensor} at {seconds:.1f} s"


def configuration(name: str, kind: SetName = "box") -> Config:
    """The bounds declared for a drive."""
    declared = load(HERE / "real_poses" / f"{name}.toml").config
    return replace(declared, filter=replace(declared.filter, set=kind))


def follow(drive: RecordedDrive, config: Config, step_ns: int = STEP_NS) -> Followed:
    """Give the filter the samples in their order; ask for a pose every `step_ns`, as soon as it is to be had."""
    gps = config.devices.gps
    pose_filter = Filter(config.robot, config.filter, config.devices.encoders, config.devices.imu, gps)
    times, lows, highs = list[int](), list[Floats](), list[Floats]()
    due, refused = None, 0
    for sample in drive.samples:
        if isinstance(sample, Scan):
            continue
        pose_filter.accept(sample)
        horizon = pose_filter.horizon_ns
        if horizon is None:
            continue
        due = horizon if due is None else due
        while due <= horizon:
            pose = (pose_filter.pose_over if gps is None else pose_filter.pose_on_earth)(due, due)
            if pose is None or pose.high[0] - pose.low[0] > NOWHERE_M:
                refused += 1
            else:
                times.append(due)
                lows.append(pose.low)
                highs.append(pose.high)
            due += step_ns
    time_ns = np.array(times, np.int64)
    low, high = np.array(lows).reshape(-1, 6), np.array(highs).reshape(-1, 6)
    if anchor := pose_filter.anchor:
        home = np.array(
            pymap3d.geodetic2enu(anchor.origin_lat_deg, anchor.origin_lon_deg, anchor.origin_alt_m, *HOME), float
        )
        low[:, :3], high[:, :3] = low[:, :3] + home, high[:, :3] + home
    truth, outside = None, None
    if drive.truth is not None and drive.truth_ns is not None:
        truth = _truth(drive, time_ns, in_map=gps is None)
        inside = np.all((low[:, :2] <= truth[:, :2]) & (truth[:, :2] <= high[:, :2]), axis=1)
        outside = int(np.count_nonzero(~inside))
    against = contradicted(drive, config)
    return Followed(drive, config, pose_filter, against, time_ns, low, high, truth, outside, refused)


def _truth(drive: RecordedDrive, time_ns: NDArray[np.int64], *, in_map: bool) -> Floats:
    """[n, 3] the truth at those times; in the map frame it is seen from where the drive began."""
    assert drive.truth is not None
    assert drive.truth_ns is not None
    poses = np.column_stack([np.interp(time_ns, drive.truth_ns, drive.truth[:, k]) for k in range(3)])
    return to_map(drive.truth[0], poses) if in_map else poses


def to_map(start: Floats, poses: Floats) -> Floats:
    """Poses [n, 3] (x, y, heading) seen from `start`."""
    c, s = cos(start[2]), sin(start[2])
    x, y = poses[:, 0] - start[0], poses[:, 1] - start[1]
    return np.column_stack([c * x + s * y, c * y - s * x, poses[:, 2] - start[2]])


def contradicted(drive: RecordedDrive, config: Config) -> list[Usage]:
    """What `check --bounds` says against the declared bounds."""
    usages = bound_usage(config.robot, config.filter, config.devices, drive.samples)
    return [usage for usage in usages if usage.verdict is Verdict.CONTRADICTED]


def summary(followed: Followed) -> str:
    """One paragraph for people."""
    half = followed.half_widths
    counts = {name: n for name, n in followed.filter.counts.items() if name.startswith("contradiction")}
    lines = [
        f"{followed.drive.title}: {len(followed.time_ns)} poses over "
        f"{(followed.time_ns[-1] - followed.time_ns[0]) * 1e-9:.0f} s, {followed.said} {counts or ''}",
        f"  median half-width x {half[0]:.2f} m, y {half[1]:.2f} m, yaw {np.degrees(half[5]):.1f} degrees",
    ]
    if followed.outside is not None:
        lines.append(f"  truth outside: {followed.outside} of {len(followed.time_ns)}")
    for usage in followed.contradicted:
        lines.append(
            f"  check --bounds: {usage.key} = {usage.declared:g} is contradicted at "
            f"{((usage.when_ns or BEGIN_NS) - BEGIN_NS) * 1e-9:.1f} s ({usage.worst}); at least {usage.needed:.3g}"
        )
    return "\n".join(lines)


app = App(name="real_poses", help=__doc__)


@app.default
def main(
    *,
    output: Annotated[Path, Parameter(help="folder of the pictures")] = HERE.parent / "docs",
    kind: Annotated[SetName, Parameter(name="--set", help="an ellipsoid is not drawn")] = "box",
) -> int:
    """Follow all four drives and draw them."""
    from examples.real_poses_picture import draw_drives

    try:
        folder = data_folder()
        followed = {}
        for name, (bounds, read) in DRIVES.items():
            followed[name] = follow(read(folder), configuration(bounds, kind))
            print(summary(followed[name]), flush=True)
        for path in draw_drives(followed, output) if kind == "box" else ():
            print(path)
    except TerraboundError as error:
        print(f"real_poses: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(app())
