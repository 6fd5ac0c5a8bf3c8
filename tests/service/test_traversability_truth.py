"""What a driven map says of step and slope, held against where the beams truly hit."""

from dataclasses import replace

import numpy as np

from mapper.traversability import RobotLimits, Verdict, assess
from service.commands.virtual_drive import VirtualDrive, drive_virtually
from service.config import load
from service.shipped import shipped_config

CELL = 0.25
LIMITS = RobotLimits(max_step_m=0.12, max_slope_deg=35.0, max_roughness_m=0.3, length_m=0.65)


def drive(scene: str) -> VirtualDrive:
    """The demo's robot, errors at the corners of their bounds, cells large enough to be surely hit."""
    demo = load(shipped_config("demo.toml"))
    coarse = replace(demo, config=replace(demo.config, map=replace(demo.config.map, resolution_m=CELL)))
    return drive_virtually(coarse, scene=scene, law="corners", seed=3, duration_s=14.0)


def test_steps_hold_for_true_hits() -> None:
    """Up the stairs: true hits of a cell and its neighbours differ by no more than the bound, and by the least."""
    done = drive("stairs")
    saved, truth = done.saved, done.truth.in_map_frame()
    result = assess(saved, LIMITS)
    mapped = done.poses.cover(truth.hit_time_ns) & (truth.hit_range_m >= done.laser.range_min_m)
    mapped &= truth.hit_range_m <= done.laser.range_max_m
    hit = truth.hit[mapped]
    col, row = (np.floor((hit[:, k] - saved.origin_m[k]) / CELL).astype(int) for k in (0, 1))
    lowest, highest = np.full(saved.low.shape, np.inf), np.full(saved.low.shape, -np.inf)
    np.minimum.at(lowest, (row, col), hit[:, 2])
    np.maximum.at(highest, (row, col), hit[:, 2])

    rows, columns = saved.low.shape
    steps = np.zeros(saved.low.shape)
    here = np.s_[1:-1, 1:-1]
    for i in (0, 1, 2):
        for j in (0, 1, 2):
            there = np.s_[i : rows - 2 + i, j : columns - 2 + j]
            larger = np.maximum(highest[there] - lowest[here], highest[here] - lowest[there])
            steps[here] = np.maximum(steps[here], larger)
    hit_cells = np.zeros(saved.low.shape, bool)
    hit_cells[here] = np.isfinite(lowest[here])
    assert hit_cells.sum() > 200
    assert (steps[hit_cells] <= result.step_high[hit_cells]).all()
    assert (steps[hit_cells] >= result.step_low[hit_cells]).all()
    passable = result.verdict == Verdict.PASSABLE
    assert passable.sum() > 5
    assert (steps[passable] <= LIMITS.max_step_m).all()
    assert steps[hit_cells].max() > 0.1, "there are stairs"
