"""Whole drives with contact on: the ground that the tracks touch, held against the terrain itself."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mapper.config import ContactConfig
from service.commands.virtual_drive import VirtualDrive, drive_virtually
from service.config import load
from service.shipped import shipped_config
from simulator.truth import Truth

CONTACT = ContactConfig(track_width_m=0.1, bound_m=0.05)
Array = NDArray[np.float64]


DEMO = load(shipped_config("demo.toml"))
ROBOT = DEMO.config.robot


def drive(scene: str, law: str, contact: ContactConfig | None, duration_s: float) -> VirtualDrive:
    """The demo's robot, standing and then driving."""
    touching = replace(DEMO, config=replace(DEMO.config, map=replace(DEMO.config.map, contact=contact)))
    return drive_virtually(touching, scene=scene, law=law, seed=5, duration_s=duration_s)


def rotations(roll: Array, pitch: Array, yaw: Array) -> Array:
    """[n, 3, 3]"""
    (cr, cp, cy), (sr, sp, sy), o, i = (
        *np.cos([[roll, pitch, yaw]]),
        *np.sin([[roll, pitch, yaw]]),
        0 * yaw,
        0 * yaw + 1,
    )
    about_x = np.array([[i, o, o], [o, cr, -sr], [o, sr, cr]])
    about_y = np.array([[cp, o, sp], [o, i, o], [-sp, o, cp]])
    about_z = np.array([[cy, -sy, o], [sy, cy, o], [o, o, i]])
    out: Array = np.einsum("ijn,jkn,kln->nil", about_z, about_y, about_x)
    return out


def touched(truth: Truth, times_ns: NDArray[np.int64]) -> Array:
    """[n, 3] points of the ground that a track touches at these times: at most bound_m from its underside."""
    pose = np.stack([np.interp(times_ns, truth.pose_time_ns, truth.pose[:, k]) for k in range(6)])
    R, t = rotations(*pose[3:]), pose[:3].T
    along = np.linspace(-0.5, 0.5, 27) * ROBOT.track_length_m
    across = np.linspace(-0.5, 0.5, 5) * CONTACT.track_width_m
    sides = np.array([-0.5, 0.5]) * ROBOT.track_gauge_m
    x, side, y = np.meshgrid(along, sides, across, indexing="ij")
    under = np.stack((x, side + y, 0 * x), axis=-1).reshape(-1, 3)
    ground = t[:, None] + np.einsum("nij,mj->nmi", R, under)
    ground[..., 2] = truth.surface(ground[..., 0], ground[..., 1])
    body = np.einsum("nji,nmj->nmi", R, ground - t[:, None])
    inside = np.abs(body[..., 0]) <= ROBOT.track_length_m / 2
    inside &= np.abs(np.abs(body[..., 1]) - ROBOT.track_gauge_m / 2) <= CONTACT.track_width_m / 2
    inside &= np.abs(body[..., 2]) <= CONTACT.bound_m
    touching: Array = ground[inside]
    return touching


@pytest.mark.parametrize(("scene", "law"), [("rough", "corners"), ("stairs", "constant")])
def test_ground_under_the_tracks_is_inside_its_cells_for_a_whole_drive(scene: str, law: str) -> None:
    """Every point that a true track touches when a scan is mapped is inside its cell, as is every hit of a beam."""
    done = drive(scene, law, CONTACT, 6.0)
    assert done.violations()[:2] == (0, 0)
    scans = done.pipeline.counts["scans"]
    poses_a_scan, rest = divmod(len(done.poses.earliest_ns), scans)
    assert rest == 0
    saved = done.saved
    points = touched(done.truth.in_map_frame(), done.poses.earliest_ns[::poses_a_scan])
    assert len(points) > 20 * scans
    col, row = (
        np.floor(points[:, k] / saved.resolution_m).astype(int) - round(saved.origin_m[k] / saved.resolution_m)
        for k in (0, 1)
    )
    outside = ~((saved.low[row, col] <= points[:, 2]) & (points[:, 2] <= saved.high[row, col]))
    assert np.count_nonzero(outside) == 0


def test_without_contact_nothing_is_known_of_the_ground_where_the_robot_began() -> None:
    """The laser looks ahead: the cell under base_link at the start is seen only by the tracks' contact."""
    under = {}
    for contact in (None, CONTACT):
        done = drive("flat", "uniform", contact, 2.5)
        row, col = (round(-done.saved.origin_m[k] / done.saved.resolution_m) for k in (1, 0))
        side = round(ROBOT.track_gauge_m / 2 / done.saved.resolution_m)
        under[contact] = done.saved.low[row + side, col]
    assert np.isnan(under[None])
    assert abs(under[CONTACT]) < 0.5
