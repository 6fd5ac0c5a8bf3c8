"""A real outdoor drive through the whole line: recorded wheels and laser, real bytes, the real service, a bounded map.

A vehicle drove 258 m over a university campus, with wheel encoders and a level SICK LMS2xx (recording of
J. L. Blanco-Claraco, CC BY 3.0). Here its readings become what the devices would have sent - LMS2xx telegrams after a
real start-up handshake, counters in CAN frames behind an slcan adapter - and reach the service through emulated ports.

What is not in the recording is made up here, and the promise of the map holds only as far as it is true:

    inertial packets    There was no inertial sensor. The gyroscope repeats the heading that the vehicle had from its
                        wheels, smoothed over a second (the two wheels were not always read at the same instant); tilt
                        and accelerometers say "level". Nothing here measures heading or slope independently.
    times of the counts The recording computer read its encoders in bursts, up to 0.1 s late. Each count is put where
                        the driven distance, smoothed over a second, had it: never after its recorded stamp.
    three gaps          Thrice the computer slept for 0.4 s and lost the counts meanwhile: a metre each, as the laser
                        saw. They are bridged with the mean of the speeds before and after, right to some centimetres.
    the scanner's place Height, lead and delay are not recorded. Lead and delay (1.7 m ahead of the axle, stamps 0.11 s
                        late) are those that make walls sharpest; the height is a guess.

Run it:  python examples/real_drive.py [--seconds N] [--output FOLDER]
"""

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import App, Parameter, validators
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from drivers.clock import LockstepClock
from drivers.config import LaserConfig
from drivers.errors import PortLost, TerraboundError
from drivers.samples import Vector3
from drivers.sick_lms.measurements import full_sweep
from drivers.sick_lms.telegrams import Variant
from drivers.track_encoders.codec import serialise_slcan
from estimator.bounded_pose import BoundedPose
from mapper.saved_map import SavedMap
from mapper.saved_map import load as load_map
from service.config import LoadedConfig, load
from service.onboard import Onboard
from service.shipped import shipped_config
from simulator.emulated_robot import SETTLE_S, SLICE_NS
from simulator.emulators.emulator import Emulator
from simulator.emulators.imu import ImuEmulator
from simulator.emulators.sick_lms import SickLmsEmulator
from simulator.emulators.track_encoders import TrackEncodersEmulator, tracks_frame
from simulator.ports import PseudoPort
from simulator.wire import Wire

HERE = Path(__file__).resolve().parent
CONFIG = HERE / "real_drive.toml"
ODOMETRY, SCANS = "laser/ual_first_half_odometry.txt.gz", "laser/ual_first_half_sick_front_obs.txt.gz"

SMOOTHED_OVER_S = 1.0
GAP_S = 0.2
"""Two readings further apart than this: counts were lost between them."""
BEYOND_CODE, FIRST_SPECIAL_CODE = 81.83, 81.83
"""A recorded range from here on is one of the scanner's special codes; the first means beyond the maximum."""
LEAD_NS = 100_000_000
"""From the scanner's readiness to the recording's first reading."""
LATENCY_NS = 7_500_000
"""From acquisition to the wire: with a slice of waiting it stays in the middle of the 20 ms that are declared."""
PATIENCE_S = 60.0
SWEEP = full_sweep(Variant(180, 50))
"""Half-degree beams over 180 degrees: two mirror turns."""

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]


# ---------------------------------------------------------------- what was recorded


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The drive, in nanoseconds since its first encoder reading."""

    count_ns: Whole
    """[n] when each pair of counts was true."""
    left: Whole
    """[n] ticks since the beginning."""
    right: Whole
    """[n] the same; falls when driving forward."""
    heading_ns: Whole
    """[h] a regular grid."""
    heading_rad: Floats
    """[h] smoothed."""
    scan_ns: Whole
    """[m] recorded stamps."""
    ranges_m: Floats
    """[m, 361] right to left; +inf beyond the maximum, NaN no distance."""

    @property
    def duration_ns(self) -> int:
        """To the last reading."""
        return int(max(self.count_ns[-1], self.scan_ns[-1]))

    def heading_at(self, time_ns: int) -> float:
        """Before and after the drive the heading stays what it was."""
        return float(np.interp(time_ns, self.heading_ns, self.heading_rad))


def data_folder() -> Path:
    """Where the recordings lie. Raises TerraboundError where they don't."""
    folder = Path(os.environ.get("TERRABOUND_DATA", HERE.parent / ".." / "shared" / "data"))
    for name in (ODOMETRY, SCANS):
        if not (folder / name).is_file():
            raise TerraboundError(
                f"{folder / name}: no such file; the recorded drive does not come with the project: "
                "set TERRABOUND_DATA to the folder that holds it"
            )
    return folder


def read_recording(folder: Path) -> Recording:
    """Parse the two files, and mend the times and the gaps of the counts."""
    odometry = np.loadtxt(folder / ODOMETRY, comments="%")
    scans = np.loadtxt(folder / SCANS, comments="%")
    begin_s = odometry[0, 0]
    stamp_s, heading = odometry[:, 0] - begin_s, np.unwrap(odometry[:, 3])
    counts = np.cumsum(odometry[:, 5:7], axis=0)
    forward = counts @ [0.5, -0.5]

    gaps = np.flatnonzero(np.diff(stamp_s) > GAP_S) + 1
    stretches = np.split(np.arange(len(stamp_s)), gaps)
    count_s = np.concatenate([_when(stamp_s[k], forward[k]) for k in stretches])
    _bridge(count_s, counts, heading, stretches)

    knots_s = np.arange(count_s[0], count_s[-1], 0.1)
    smooth, _ = _smoothed(count_s, heading - heading[0], knots_s)
    grid_s = np.arange(knots_s[0], knots_s[-1], 0.005)
    # The mean over 0.1 s of a line through knots 0.1 s apart: its rate does not jump, as a vehicle's does not.
    rounded = np.convolve(np.pad(np.interp(grid_s, knots_s, smooth), (10, 9), "edge"), np.full(20, 0.05), "valid")
    ranges = scans[:, 1:362].copy()
    ranges[ranges >= FIRST_SPECIAL_CODE] = np.where(ranges[ranges >= FIRST_SPECIAL_CODE] == BEYOND_CODE, np.inf, np.nan)
    scan_s = scans[:, 0] - begin_s
    return Recording(
        count_ns=_ns(count_s),
        left=np.rint(counts[:, 0]).astype(np.int64),
        right=np.rint(counts[:, 1]).astype(np.int64),
        heading_ns=_ns(grid_s),
        heading_rad=rounded,
        scan_ns=_ns(scan_s),
        ranges_m=ranges,
    )


def _when(stamp_s: Floats, forward: Floats) -> Floats:
    """When each count was true: where the smoothed distance reaches it, never after its stamp."""
    distance, speed = _smoothed(stamp_s, forward, stamp_s)
    lag = (distance - forward) / speed  # of each reading, against the mean lag
    least = np.percentile(lag, 0.5)  # this one was read at once
    return np.maximum.accumulate(stamp_s - np.maximum(lag - least, 0.0))


def _smoothed(at_s: Floats, values: Floats, wanted_s: Floats) -> tuple[Floats, Floats]:
    """Values and their rates at the wanted times: a parabola through all that lies within half a second."""
    fits = np.empty((len(wanted_s), 3))
    begin = np.searchsorted(at_s, wanted_s - 0.5 * SMOOTHED_OVER_S)
    end = np.searchsorted(at_s, wanted_s + 0.5 * SMOOTHED_OVER_S)
    for k, (i, j, now_s) in enumerate(zip(begin, end, wanted_s, strict=True)):
        fits[k] = np.polynomial.polynomial.polyfit(at_s[i:j] - now_s, values[i:j], 2)
    return fits[:, 0], fits[:, 1]


def _bridge(count_s: Floats, counts: Floats, heading: Floats, stretches: list[NDArray[np.intp]]) -> None:
    """Add what was lost in the gaps, in place: the mean of the rates before and after, for as long as it took."""
    for before, after in pairwise(stretches):
        i, j = before[-1], after[0]
        for series in (counts[:, 0], counts[:, 1], heading):
            ends = (np.polyfit(count_s[k], series[k], 1)[0] for k in (before[-50:], after[:50]))
            series[j:] += 0.5 * sum(ends) * (count_s[j] - count_s[i]) - (series[j] - series[i])


def _ns(seconds: Floats) -> Whole:
    return np.asarray(np.rint(seconds * 1e9), np.int64)


# ---------------------------------------------------------------- the devices that send it again


class RecordedScanner(SickLmsEmulator):
    """Answers the handshake as ever, but its mirror ends a sweep whenever the recorded one did."""

    def __init__(self, recording: Recording, start_ns: int) -> None:
        self._recording = recording
        self._scan = -1
        self.begin_ns: int | None = None
        """The recording's zero; until it is set nothing is measured."""
        super().__init__(self._recorded_ranges, start_ns=start_ns)

    def _next_scan_ns(self) -> int | None:
        following = self._scan + 1
        if self.begin_ns is None or not self.streaming or following >= len(self._recording.scan_ns):
            return None
        return self.begin_ns + int(self._recording.scan_ns[following])

    def _recorded_ranges(self, times_ns: Whole, angles_rad: Floats) -> Floats:
        self._scan += 1
        ranges: Floats = self._recording.ranges_m[self._scan]
        return ranges


class RecordedEncoders(TrackEncodersEmulator):
    """An adapter behind which each recorded pair of counts comes in a frame of its own."""

    def __init__(self, recording: Recording, start_ns: int, bitrate: int) -> None:
        super().__init__(lambda _: (0.0, 0.0), start_ns=start_ns, bitrate=bitrate)
        self._recording = recording
        self.frames_sent = 0
        self.begin_ns: int | None = None
        """As RecordedScanner's."""

    def _run_until(self, now_ns: int) -> None:
        if self.begin_ns is None:
            return
        recording = self._recording
        sent_by = int(np.searchsorted(recording.count_ns, now_ns - self.begin_ns - LATENCY_NS, side="right"))
        for k in range(self.frames_sent, sent_by):
            self._outbox += serialise_slcan(tracks_frame(float(recording.left[k]), float(recording.right[k])))
        self.frames_sent = max(self.frames_sent, sent_by)


class DerivedInertia:
    """The inertial board that was not there: the vehicle's own heading, and level ground."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.begin_ns: int | None = None

    def gyro(self, from_ns: int, to_ns: int) -> Vector3:
        """Mean body rate between two times."""
        if self.begin_ns is None:
            return 0.0, 0.0, 0.0
        turned = self._recording.heading_at(to_ns - self.begin_ns) - self._recording.heading_at(from_ns - self.begin_ns)
        return 0.0, 0.0, turned * 1e9 / (to_ns - from_ns)

    def accel(self, time_ns: int, sensor_id: int) -> tuple[float, float]:
        """Level, and not accelerating."""
        return 0.0, 0.0

    def tilt(self, time_ns: int) -> tuple[float, float]:
        """Level."""
        return 0.0, 0.0


# ---------------------------------------------------------------- the drive


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """What a drive left."""

    onboard: Onboard
    scans_sent: int
    frames_sent: int
    pose_ns: Whole
    """[k] middle of the stretch that each pose covers, since the recording's beginning: one pose a scan."""
    pose_low: Floats
    """[k, 6]"""
    pose_high: Floats
    """[k, 6]"""
    beams_left_out: Whole
    """[k] beams left out so far because too little was known of where they hit."""
    elapsed_s: float


def drive(
    recording: Recording,
    loaded: LoadedConfig,
    seconds: float | None = None,
    on_progress: Callable[[float, Onboard], None] = lambda driven_s, onboard: None,
) -> Result:
    """Send the recording through ports in the configuration's folder into the service, in lockstep."""
    end_ns = recording.duration_ns if seconds is None else min(recording.duration_ns, round(seconds * 1e9))
    poses: list[BoundedPose] = []
    left_out: list[int] = []
    with ExitStack() as stack:
        (loaded.folder / "ports").mkdir(exist_ok=True)
        clock = LockstepClock.create(loaded.folder / "clock", ("encoders", "imu", "laser"))
        stack.callback(clock.close)
        devices = loaded.config.devices
        scanner = RecordedScanner(recording, clock.now_ns())
        encoders = RecordedEncoders(recording, clock.now_ns(), devices.encoders.bitrate)
        inertia = DerivedInertia(recording)
        board = ImuEmulator(
            inertia.gyro,
            inertia.accel,
            inertia.tilt,
            start_ns=clock.now_ns(),
            latency_ns=LATENCY_NS,
            baud=devices.imu.baud,
        )
        wires = []
        emulators: dict[str, Emulator] = {"encoders": encoders, "imu": board, "laser": scanner}
        for name, emulator in emulators.items():
            port = PseudoPort(loaded.folder / "ports" / name)
            stack.callback(port.close)
            wires.append(Wire(name, emulator, port))

        def keep(pose: BoundedPose) -> None:
            if not poses or pose.earliest_ns - poses[-1].earliest_ns > 20_000_000:
                poses.append(pose)
                left_out.append(onboard.pipeline.map.counts["too_wide"])

        onboard = Onboard(loaded, clock, on_pose=keep, lockstep=True)
        onboard.start()
        stack.callback(onboard.stop)
        _wait_for_host(wires)
        while not (scanner.streaming and encoders.is_open and clock.now_ns() % LEAD_NS == 0):
            time.sleep(SLICE_NS * 1e-9)  # the handshake is given real time
            _slice(clock, wires, onboard)
        begin_ns = clock.now_ns() + LEAD_NS
        scanner.begin_ns = encoders.begin_ns = inertia.begin_ns = begin_ns
        began_s = time.monotonic()
        while clock.now_ns() < begin_ns + end_ns:
            _slice(clock, wires, onboard)
            on_progress((clock.now_ns() - begin_ns) * 1e-9, onboard)
        onboard.finish()
        elapsed_s = time.monotonic() - began_s
        if onboard.failure is not None:
            raise onboard.failure
    return Result(
        onboard,
        scanner.scans_sent,
        encoders.frames_sent,
        np.array([(pose.earliest_ns + pose.latest_ns) // 2 - begin_ns for pose in poses], np.int64),
        np.array([pose.low for pose in poses]).reshape(-1, 6),
        np.array([pose.high for pose in poses]).reshape(-1, 6),
        np.array(left_out, np.int64),
        elapsed_s,
    )


def _wait_for_host(wires: list[Wire]) -> None:
    """Until the service has opened every port."""
    deadline = time.monotonic() + PATIENCE_S
    while not all(wire.port.host_present for wire in wires):
        if time.monotonic() > deadline:
            raise PortLost(f"the service has not opened its ports within {PATIENCE_S:g} s")
        time.sleep(0.005)
    time.sleep(SETTLE_S)


def _slice(clock: LockstepClock, wires: list[Wire], onboard: Onboard) -> None:
    """One slice of time: every byte that has left by its end is read and dealt with before the next."""
    clock.set(clock.now_ns() + SLICE_NS)
    for wire in wires:
        wire.exchange(clock.now_ns())
    deadline = time.monotonic() + PATIENCE_S
    while not clock.wait_for({wire.name: wire.due for wire in wires}, timeout_s=0.5):
        if onboard.failure is not None:
            raise onboard.failure
        if time.monotonic() > deadline:
            raise PortLost(f"the service has not dealt with its bytes for {PATIENCE_S:g} s")
        for wire in wires:
            wire.port.write()


def configuration(folder: Path) -> LoadedConfig:
    """The example's configuration, with its ports in `folder`."""
    shutil.copy(shipped_config("tracks.dbc"), folder)
    shutil.copy(CONFIG, folder)
    return load(folder / CONFIG.name)


# ---------------------------------------------------------------- what came of it


def draw(path: Path, saved: SavedMap, result: Result, recording: Recording, laser: LaserConfig) -> None:
    """The map from above, with the pose boxes of the drive, and how they grew. PNG; needs matplotlib."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
        from matplotlib.colors import ListedColormap
        from matplotlib.patches import Rectangle
        from matplotlib.patheffects import withStroke
    except ImportError:
        raise TerraboundError("pictures need matplotlib: pip install 'terrabound[plots]'") from None

    width = saved.high.astype(float) - saved.low
    rows, columns = np.flatnonzero(np.isfinite(width).any(1)), np.flatnonzero(np.isfinite(width).any(0))
    if len(rows) == 0:
        raise TerraboundError("the map is empty: nothing to draw")
    width = width[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    cell = saved.resolution_m
    west, south = saved.origin_m[0] + columns[0] * cell, saved.origin_m[1] + rows[0] * cell
    extent = (west, west + width.shape[1] * cell, south, south + width.shape[0] * cell)

    figure, plan = plt.subplots(figsize=(14, 10.5), dpi=90, layout="constrained")
    shades = ListedColormap(matplotlib.colormaps["GnBu"](np.linspace(0.25, 0.85, 256)))
    image = plan.imshow(width, origin="lower", extent=extent, cmap=shades, vmin=0, interpolation="nearest")
    figure.colorbar(image, ax=plan, label="how far apart the bounds of a cell's elevation are [m]", shrink=0.7)
    low, high = result.pose_low, result.pose_high
    middle = 0.5 * (low + high)
    time_s = result.pose_ns * 1e-9
    plan.plot(*_hits(recording, laser, result.pose_ns, middle), ",", color="black", alpha=0.5)
    plan.plot([], [], ".", color="black", label="hits, seen from the middle of the pose sets: no promise")
    plan.plot(middle[:, 0], middle[:, 1], color="tab:red", linewidth=1.2, label="drive: the middle of the pose sets")
    for moment_s in np.arange(0.0, time_s[-1], 5.0):
        k = int(np.searchsorted(time_s, moment_s))
        (x, y), sides = low[k, :2], high[k, :2] - low[k, :2]
        plan.add_patch(Rectangle((x, y), *sides, facecolor="tab:red", alpha=0.4, edgecolor="darkred"))
        label = plan.annotate(
            f"{moment_s:.0f} s", (x, y), (2, 8), textcoords="offset points", fontsize=8, color="darkred"
        )
        label.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
    plan.plot([], [], "s", color="tab:red", alpha=0.5, label="pose set every 5 s: the vehicle's axle is in there")
    plan.set(xlabel="x, ahead at the start [m]", ylabel="y, to the left [m]", aspect="equal")
    plan.set_title("Coloured: every cell that the level laser may have hit")
    plan.grid(alpha=0.25)
    plan.set_ylim(extent[2] - 12.0, extent[3] + 2.0)  # room for the legend
    plan.legend(loc="lower left", fontsize=9)

    half = 0.5 * (high - low)
    growth = plan.inset_axes((0.06, 0.58, 0.5, 0.38))
    for axis, name in enumerate("xyz"):
        growth.plot(time_s, half[:, axis], label=f"{name} [m]")
    growth.plot(time_s, np.degrees(half[:, 5]), color="0.5", linewidth=1, label="yaw [degrees]")
    growth.set(xlabel="seconds of the drive", ylabel="half-width of the pose set", xlim=(0, time_s[-1]))
    growth.set_ylim(bottom=0)
    growth.set_title("Without GPS the pose set grows; spikes: bends, and gaps in the recording", fontsize=10)
    growth.grid(alpha=0.3)
    growth.legend(loc="upper left", fontsize=9)
    figure.suptitle(_summary(result, saved), fontsize=12)
    figure.savefig(path)
    plt.close(figure)


def _hits(recording: Recording, laser: LaserConfig, pose_ns: Whole, pose: Floats) -> tuple[Floats, Floats]:
    """Where the beams hit from given poses [k, 6], in the map frame: for the eye."""
    taken_ns = recording.scan_ns - round(0.5e6 * sum(laser.latency_ms)) - SWEEP.duration_ns // 2
    x, y, yaw = (np.interp(taken_ns, pose_ns, pose[:, axis])[:, None] for axis in (0, 1, 5))
    ranges = recording.ranges_m
    seen = (ranges >= laser.range_min_m) & (ranges <= laser.range_max_m)
    seen &= ((taken_ns >= pose_ns[0]) & (taken_ns <= pose_ns[-1]))[:, None]
    ranges = np.where(seen, ranges, 0.0)
    ahead = laser.mount_x_m + ranges * np.cos(SWEEP.angles_rad)
    left = laser.mount_y_m + ranges * np.sin(SWEEP.angles_rad)
    return (x + ahead * np.cos(yaw) - left * np.sin(yaw))[seen], (y + ahead * np.sin(yaw) + left * np.cos(yaw))[seen]


def _summary(result: Result, saved: SavedMap) -> str:
    pipeline = result.onboard.pipeline
    promise = "no contradiction of the declared bounds" if pipeline.filter.guarantee.intact else "BOUNDS CONTRADICTED"
    return (
        f"A real drive of {result.pose_ns[-1] * 1e-9:.0f} s through emulated ports into the real service\n"
        f"{pipeline.counts['scans']} scans, {pipeline.map.counts['used']} beams, "
        f"{int(np.isfinite(saved.low).sum())} cells of {saved.resolution_m:g} m; {promise}"
    )


def main(
    *,
    seconds: Annotated[float | None, Parameter(validator=validators.Number(gte=1))] = None,
    output: Path = Path("real-drive-output"),
) -> int:
    """Send a real outdoor drive through emulated ports into the real service; leave its map and a picture.

    Parameters
    ----------
    seconds
        Only the first so many of the drive's 90 seconds.
    output
        Folder for `map.npz` and `map.png`; made if it is not there.
    """
    console = Console()
    recording = read_recording(data_folder())
    console.print("[dim]gyroscope and tilt are derived (the recording has none): heading from the wheels, level ground")
    output.mkdir(parents=True, exist_ok=True)
    total_s = min(seconds or np.inf, recording.duration_ns * 1e-9)
    columns = (BarColumn(), TextColumn("{task.completed:.0f} of {task.total:.0f} s"), TextColumn("{task.description}"))
    with (
        tempfile.TemporaryDirectory(prefix="terrabound-") as folder,
        Progress(*columns, console=console) as progress,
    ):
        task = progress.add_task("starting the scanner", total=total_s)
        result = drive(
            recording,
            configuration(Path(folder)),
            seconds,
            lambda driven_s, onboard: progress.update(task, completed=max(0.0, driven_s), description=_state(onboard)),
        )
    result.onboard.save_map(output / "map.npz")
    draw(output / "map.png", load_map(output / "map.npz"), result, recording, result.onboard.laser)
    _report(console, result, output)
    return 0 if result.onboard.pipeline.filter.guarantee.intact else 1


def _state(onboard: Onboard) -> str:
    """The service in a few words."""
    pipeline = onboard.pipeline
    pose = pipeline.filter.latest()
    width = "no pose yet" if pose is None else f"pose +-{0.5 * float((pose.high[:3] - pose.low[:3]).max()):.1f} m"
    return f"{pipeline.counts['scans']} scans, {pipeline.map.cells_seen} cells, {width}"


def _report(console: Console, result: Result, output: Path) -> None:
    pipeline = result.onboard.pipeline
    beams, guarantee = pipeline.map.counts, pipeline.filter.guarantee
    console.print(f"{pipeline.counts['scans']} of {result.scans_sent} scans mapped in {result.elapsed_s:.0f} s")
    console.print(
        f"{beams['used']} beams in {pipeline.map.cells_seen} cells, {beams['no_range']} without a usable range"
    )
    if beams["too_wide"]:
        first_s = result.pose_ns[np.argmax(result.beams_left_out > 0)] * 1e-9
        console.print(f"{beams['too_wide']} beams left out from {first_s:.0f} s on: where they hit is known too poorly")
    half = 0.5 * (result.pose_high[-1] - result.pose_low[-1])
    console.print(f"at the end the vehicle is known within +-{half[0]:.2f} m, +-{half[1]:.2f} m (x, y)")
    promise = "no measurement contradicts its bounds" if guarantee.intact else f"VOID: {guarantee.sensor}"
    console.print(f"guarantee: {promise}")
    console.print(f"{output / 'map.png'}, {output / 'map.npz'}")


def run() -> int:
    """The command; an error a person can act on is one line on stderr and exit code 1."""
    try:
        return int(App(default_command=main, result_action="return_value")() or 0)
    except TerraboundError as error:
        print(f"real_drive: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(run())
