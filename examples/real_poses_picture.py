"""Pictures of real drives with their pose sets. Needs matplotlib."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import TerraboundError
from examples.real_poses import Followed
from examples.recorded_drives import BEGIN_NS

SETS, TRUTH, FIXES = "tab:blue", "black", "tab:orange"
FIX_ALPHA = 0.5
LARGE_M = 45.0
"""Half-width of sets that would hide the whole plan."""


def draw_drives(drives: dict[str, Followed], output: Path) -> list[Path]:
    """One picture for each drive but the skid-steer robot's two, which share one."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError:
        raise TerraboundError("pictures need matplotlib: pip install 'terrabound[plots]'") from None
    output.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, zoom_s, every_s in (("plaza", (600.0, 660.0), 20.0), ("victoria_park", (610.0, 700.0), 15.0)):
        if name in drives:
            paths.append(output / f"real_poses_{name}.png")
            _with_zoom(plt, paths[-1], drives[name], zoom_s, every_s)
    robots = [drives[name] for name in ("asphalt", "snow") if name in drives]
    if robots:
        paths.append(output / "real_poses_skid_steer.png")
        _side_by_side(plt, paths[-1], robots)
    return paths


def _with_zoom(plt: Any, path: Path, drive: Followed, zoom_s: tuple[float, float], every_s: float) -> None:
    """The whole drive, a piece of it, and how large the sets were."""
    figure = plt.figure(figsize=(14, 11), dpi=90, layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(2.4, 1.0))
    whole, piece = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    seconds = _seconds(drive)
    _plan(whole, drive, (0.0, seconds[-1]), every_s)
    _frame(whole, drive)
    large = 0.5 * (drive.high - drive.low)[:, :2].max() > LARGE_M
    left_out = f" (but for those wider than {LARGE_M:g} m)" if large else ""
    whole.set_title(f"The whole drive: {seconds[-1]:.0f} s, a set every {every_s:g} s{left_out}", fontsize=10)
    _plan(piece, drive, zoom_s, 2.0)
    piece.set_title(f"From {zoom_s[0]:.0f} to {zoom_s[1]:.0f} s: a set every 2 s", fontsize=10)
    whole.legend(loc="upper left", fontsize=9)
    _growth(figure.add_subplot(grid[1, :]), drive)
    figure.suptitle(f"{drive.drive.title}: {_verdict(drive)}", fontsize=13)
    figure.savefig(path)
    plt.close(figure)


def _side_by_side(plt: Any, path: Path, drives: list[Followed]) -> None:
    """Two short drives without GPS."""
    figure, rows = plt.subplots(3, len(drives), figsize=(14, 14), dpi=90, layout="constrained", height_ratios=(2, 1, 1))
    for drive, plan, turn, growth in zip(drives, *rows, strict=True):
        _turns(turn, drive)
        _plan(plan, drive, (0.0, _seconds(drive)[-1]), 1.0)
        plan.legend(loc="upper left", fontsize=9)
        against = "".join(
            f"\ncheck --bounds: {usage.key} = {usage.declared:g} is contradicted, at least {usage.needed:.2g}"
            for usage in drive.contradicted
        )
        plan.set_title(f"{drive.drive.title}, a set every second:\n{_verdict(drive)}{against}", fontsize=10)
        plan.margins(0.05, 0.12)
        _growth(growth, drive)
    figure.suptitle("A skid-steer robot without GPS: the sets grow with time, and the wheels slip more than declared")
    figure.savefig(path)
    plt.close(figure)


def _plan(axes: Any, drive: Followed, span_s: tuple[float, float], every_s: float) -> None:
    """Sets from above, truth and fixes."""
    shade = 0.25 if drive.truth is not None else 0.1
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    seconds = _seconds(drive)
    chosen = (seconds >= span_s[0]) & (seconds <= span_s[1])
    at = np.unique(np.searchsorted(seconds, np.arange(max(span_s[0], seconds[0]), span_s[1], every_s)))
    at = at[at < len(seconds)]
    at = at[0.5 * (drive.high - drive.low)[at, :2].max(axis=1) < LARGE_M]
    boxes = [
        Rectangle((drive.low[k, 0], drive.low[k, 1]), *(drive.high[k, :2] - drive.low[k, :2]).tolist()) for k in at
    ]
    axes.add_collection(PatchCollection(boxes, facecolor=SETS, edgecolor=SETS, alpha=shade))
    axes.plot([], [], "s", color=SETS, alpha=0.4, label="pose set: the vehicle is in there")
    if len(drive.drive.fixes):
        fixes = drive.drive.fixes[_fixes_in(drive, span_s)]
        axes.plot(*fixes.T, ".", color=FIXES, markersize=3, alpha=FIX_ALPHA, label="GPS fixes")
    if drive.truth is not None:
        axes.plot(*drive.truth[chosen, :2].T, color=TRUTH, linewidth=1.0, label="truth")
    else:
        middle = 0.5 * (drive.low + drive.high)[chosen]
        axes.plot(*middle[:, :2].T, color="tab:red", linewidth=0.8, label="middle of the sets: no promise")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.autoscale_view()
    axes.grid(alpha=0.25)


def _frame(axes: Any, drive: Followed) -> None:
    """All of the truth, or of the fixes, with room for the sets; the few that are very large are cut at the edge."""
    known = drive.truth[:, :2] if drive.truth is not None else drive.drive.fixes
    low, high = np.percentile(known, 0.2, axis=0), np.percentile(known, 99.8, axis=0)
    room = 0.12 * (high - low).max()
    axes.set_xlim(low[0] - room, high[0] + room)
    axes.set_ylim(low[1] - room, high[1] + 2.2 * room)


def _growth(axes: Any, drive: Followed) -> None:
    """Half-widths over time, and how far the truth was from the middle."""
    seconds = _seconds(drive)
    half = 0.5 * (drive.high - drive.low)
    yaw = np.degrees(half[:, 5])
    axes.semilogy(seconds, half[:, :2].max(axis=1), color=SETS, linewidth=0.9, label="half-width, x or y [m]")
    axes.semilogy(seconds, np.minimum(yaw, 180.0), color="0.6", linewidth=0.9, label="half-width, yaw [degrees]")
    if drive.truth is not None:
        off = np.abs(0.5 * (drive.low + drive.high)[:, :2] - drive.truth[:, :2]).max(axis=1)
        axes.semilogy(seconds, np.maximum(off, 1e-3), color=TRUTH, linewidth=0.5, label="truth from the middle [m]")
    since = drive.filter.guarantee.contradicted_ns
    if since is not None:
        moment = (since - BEGIN_NS) * 1e-9
        axes.axvline(moment, color="tab:red", label=f"contradiction ({drive.filter.guarantee.sensor})")
    axes.set(xlabel="seconds of the drive", ylabel="m, degrees", xlim=(0, seconds[-1]))
    axes.set_ylim(top=4.0 * axes.get_ylim()[1])  # room for the legend
    axes.grid(alpha=0.3, which="both")
    axes.legend(loc="upper right", fontsize=9, ncols=4)


def _turns(axes: Any, drive: Followed) -> None:
    """What the gyroscope turned, and what the wheels would have turned it by the declared gauge and slip."""
    gyro, tracks, robot = drive.drive.turned, drive.drive.tracks, drive.config.robot
    seconds, turned, error = gyro[:, 0], gyro[:, 1], gyro[:, 2]
    axes.plot(seconds, turned, color=SETS, label="turned by the gyroscope, and its declared error")
    axes.fill_between(seconds, turned - error, turned + error, color=SETS, alpha=0.25)
    wheels = (tracks[:, 2] - tracks[:, 1]) / robot.track_gauge_m
    ran = np.abs(np.diff(tracks[:, 1:], axis=0, prepend=tracks[:1, 1:])).sum(axis=1).cumsum()
    slip = robot.slip_ratio * ran / robot.track_gauge_m
    axes.plot(tracks[:, 0], wheels, color="tab:red", label="by the wheels, and their declared slip")
    axes.fill_between(tracks[:, 0], wheels - slip, wheels + slip, color="tab:red", alpha=0.2)
    axes.set(xlabel="seconds of the drive", ylabel="yaw [rad]", xlim=(0, seconds[-1]))
    axes.margins(y=0.3)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize=9)


def _fixes_in(drive: Followed, span_s: tuple[float, float]) -> NDArray[np.bool_]:
    seconds = (drive.drive.fix_ns - BEGIN_NS) * 1e-9
    return np.asarray((seconds >= span_s[0]) & (seconds <= span_s[1]))


def _seconds(drive: Followed) -> NDArray[np.float64]:
    return np.asarray((drive.time_ns - BEGIN_NS) * 1e-9)


def _verdict(drive: Followed) -> str:
    """What a reader wants to know first."""
    half = np.median(0.5 * (drive.high - drive.low), axis=0)
    held = "" if drive.outside is None else f"truth outside {drive.outside} of {len(drive.time_ns)} sets, "
    return f"{held}median half-width {half[:2].max():.1f} m and {np.degrees(half[5]):.0f} degrees, {drive.said}"
