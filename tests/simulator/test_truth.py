"""The judge: does it see every violation, and none where there is none?"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.terrain import build_terrain
from simulator.truth import Truth

Array = NDArray[np.float64]


def truth(count: int = 1000, hits: int = 500) -> Truth:
    random = np.random.default_rng(2)
    start = np.array([3.0, -2.0, 1.0, 0.1, -0.2, 3.1])
    pose = start + np.cumsum(random.normal(0, 1e-3, (count, 6)), axis=0)
    x, y = random.uniform(-4, 4, (2, hits))
    hit = np.column_stack([x, y, build_terrain("stairs").height(x, y)])
    times = 7_000_000_000 + np.arange(count, dtype=np.int64) * 1_000_000
    return Truth(
        times, pose, np.sort(random.integers(times[0], times[-1], hits)), hit, np.full(hits, 3.0), "stairs", 2, "",
        (48.0, 11.0, 500.0),
    )  # fmt: skip


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    """All fields survive, before and after the change of frame."""
    for original in (truth(), truth().in_map_frame()):
        original.save(tmp_path / "truth.npz")
        loaded = Truth.load(tmp_path / "truth.npz")
        for name in Truth.__slots__:
            np.testing.assert_array_equal(getattr(loaded, name), getattr(original, name))
    assert [path.name for path in tmp_path.iterdir()] == ["truth.npz"]


def test_a_pipe_is_written_to_and_a_link_stays(tmp_path: Path) -> None:
    """What the system or somebody else put there is not taken away: `--truth /dev/null` is no file to be replaced."""
    pipe, link, file = (tmp_path / name for name in ("pipe", "link", "file.npz"))
    os.mkfifo(pipe)
    held = os.open(pipe, os.O_RDWR | os.O_NONBLOCK)  # whoever writes need not wait for a reader
    truth(20, 10).save(pipe)
    link.symlink_to(file)
    truth().save(link)
    assert (pipe.is_fifo(), link.is_symlink(), os.read(held, 4)) == (True, True, b"PK\x03\x04")
    os.close(held)
    np.testing.assert_array_equal(Truth.load(file).pose, truth().pose)


def test_the_map_frame_begins_at_zero_and_keeps_distances_and_tilt() -> None:
    """x, y, z and yaw of the start are exactly zero, roll and pitch are unchanged, hits move with the poses."""
    world = truth()
    mapped = world.in_map_frame()
    assert (mapped.pose[0, [0, 1, 2, 5]] == 0.0).all()
    np.testing.assert_array_equal(mapped.pose[:, 3:5], world.pose[:, 3:5])
    for one, two in ((world, mapped),):
        np.testing.assert_allclose(
            np.linalg.norm(one.hit - one.pose[-1, :3], axis=1), np.linalg.norm(two.hit - two.pose[-1, :3], axis=1)
        )
    yaw = world.pose[0, 5]
    ahead = world.pose[0, :3] + (np.cos(yaw), np.sin(yaw), 0.5)
    seen = replace(world, hit=ahead[None]).in_map_frame()
    np.testing.assert_allclose(seen.hit, [[1.0, 0.0, 0.5]], atol=1e-12)
    with pytest.raises(ValueError, match="already"):
        mapped.in_map_frame()


def test_the_surface_moves_with_the_frame() -> None:
    """The scene's top, asked for in the map frame, is where the hits are."""
    mapped = truth().in_map_frame()
    np.testing.assert_allclose(mapped.surface(mapped.hit[:, 0], mapped.hit[:, 1]), mapped.hit[:, 2], atol=1e-9)


def boxes(world: Truth, length_ns: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
    """The tightest boxes around the truth, one every `length_ns`, by a plain loop."""
    earliest = np.arange(world.pose_time_ns[0], world.pose_time_ns[-1] - length_ns, length_ns) + 137
    latest = earliest + length_ns
    low, high = [], []
    for first, last in zip(earliest, latest, strict=True):
        inside = (world.pose_time_ns >= first) & (world.pose_time_ns <= last)
        ends = np.column_stack([np.interp([first, last], world.pose_time_ns, axis) for axis in world.pose.T])
        rows = np.vstack([world.pose[inside], ends])
        low.append(rows.min(axis=0) - 1e-12)
        high.append(rows.max(axis=0) + 1e-12)
    return earliest, latest, np.array(low), np.array(high)


@pytest.mark.parametrize("length_ns", [12_345_678, 5_000_000, 300_000])
def test_tight_boxes_hold_the_truth_and_nothing_tighter_does(length_ns: int) -> None:
    """The tightest boxes have no violation; shrinking any axis from either side makes every one of them violated."""
    world = truth()
    earliest, latest, low, high = boxes(world, length_ns)
    assert world.pose_violations(earliest, latest, low, high) == 0
    for axis in range(6):
        shift = np.zeros(6)
        shift[axis] = 1e-9
        assert world.pose_violations(earliest, latest, low + shift, high) == len(earliest)
        assert world.pose_violations(earliest, latest, low, high - shift) == len(earliest)


def test_one_wrong_box_is_one_violation() -> None:
    """Violations are counted by box; NaN is one."""
    world = truth()
    earliest, latest, low, high = boxes(world, 5_000_000)
    high[17, 5] -= 0.1
    assert world.pose_violations(earliest, latest, low, high) == 1
    low[40, 2] = np.nan
    assert world.pose_violations(earliest, latest, low, high) == 2


def test_before_and_after_its_time_the_robot_stands_where_it_stood() -> None:
    """A box that ends before the first row must hold the first row, one after the last the last."""
    world = truth()
    times = np.array([0, 10**12])
    ends = world.pose[[0, -1]]
    assert world.pose_violations(times, times + 1, ends - 1e-9, ends + 1e-9) == 0
    assert world.pose_violations(times, times + 1, ends[::-1] - 1e-9, ends[::-1] + 1e-9) == 2


def hull_map(
    world: Truth, resolution: float, origin: tuple[float, float], shape: tuple[int, int]
) -> tuple[Array, Array]:
    low, high = np.full(shape, np.nan), np.full(shape, np.nan)
    for x, y, z in world.hit:
        i, j = int((y - origin[1]) // resolution), int((x - origin[0]) // resolution)
        low[i, j], high[i, j] = np.fmin(low[i, j], z), np.fmax(high[i, j], z)
    return low, high


def test_a_hull_of_the_hits_holds_them_all() -> None:
    """No violation in the tightest map; each cell raised by a millimetre loses its lowest hit."""
    world = truth()
    low, high = hull_map(world, 0.1, (-5.0, -5.0), (100, 100))
    assert world.cell_violations(low, high, 0.1, (-5.0, -5.0)) == 0
    lost = world.cell_violations(low + 0.001, high + 0.001, 0.1, (-5.0, -5.0))
    assert lost >= np.isfinite(low).sum()


def test_hits_off_the_map_or_in_unseen_cells_count() -> None:
    """Unless their beams are known not to have been inserted."""
    world = truth()
    low, high = hull_map(world, 0.1, (-5.0, -5.0), (100, 100))
    seen = np.argwhere(np.isfinite(low))[0]
    low[tuple(seen)] = np.nan
    unseen = world.cell_violations(low, high, 0.1, (-5.0, -5.0))
    assert unseen >= 1
    off = world.cell_violations(low[:, :50], high[:, :50], 0.1, (-5.0, -5.0))
    assert off > 100
    assert world.cell_violations(low, high, 0.1, (-5.0, -5.0), np.zeros(len(world.hit), bool)) == 0
