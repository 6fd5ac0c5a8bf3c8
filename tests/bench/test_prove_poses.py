"""A slice of the long proof of poses; and that it sees a filter that is broken on purpose."""

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from bench.prove_poses import LOSSES, STAMPS, Case, prove_poses
from estimator import (
    anchoring,
    attitude,
    encoder_step,
    gps_window,
    gyro_step,
    interval,
    motion,
    observations,
    paving,
    position,
    tracks,
)


@pytest.mark.parametrize(
    ("law", "scene", "stamps", "losses"),
    [
        ("corners", "rough", STAMPS[3], LOSSES[1]),
        ("constant", "open", STAMPS[1], LOSSES[2]),
        ("switching", "stairs", STAMPS[2], LOSSES[0]),
    ],
)
def test_the_truth_is_inside_whatever_the_errors_stamps_and_losses(
    law: str, scene: str, stamps: str, losses: str
) -> None:
    """Poses in the map and on Earth, and the anchor, hold the truth, and nothing is called broken."""
    score = prove_poses(Case(law, scene, 3, stamps, losses, seconds=12.0))
    assert score.checks > 300
    assert score.outside == 0
    assert score.voided == 0


def test_the_paper_s_set_holds_the_truth_too() -> None:
    """The ellipsoids stand behind the same interface, and the same proof."""
    score = prove_poses(Case("corners", "open", 4, STAMPS[3], LOSSES[0], "ellipsoid", seconds=12.0))
    assert score.checks > 300
    assert score.outside == 0
    assert score.voided == 0


def caught() -> bool:
    """Does a short proof see something wrong?"""
    laws = ("constant", "corners")
    scores = (prove_poses(Case(law, "open", 5, STAMPS[0], LOSSES[0], seconds=14.0)) for law in laws)
    return any(score.outside or score.voided for score in scores)


def without_remainder(patch: pytest.MonkeyPatch) -> None:
    """What lies between the nominal direction and the true one is forgotten in each step."""

    def weighted(f: interval.Interval, net: interval.Interval, varied: float) -> interval.Interval:
        return interval.scale(interval.mid(f), net)

    patch.setattr(motion, "weighted", weighted)
    patch.setattr(motion, "reach", lambda a, c: 0.0)
    patch.setattr(tracks, "reach", lambda a, c: 0.0)
    patch.setattr(tracks, "tracked", interpreted(tracks.tracked))
    patch.setattr(tracks, "carry", interpreted(tracks.carry))
    patch.setattr(encoder_step, "travel_in_all_frames", interpreted(tracks.travel_in_all_frames))
    patch.setattr(position, "encoder_step", interpreted(encoder_step.encoder_step))
    patch.setattr(gyro_step, "turn", interpreted(motion.turn))
    patch.setattr(gyro_step, "turn_node", interpreted(gyro_step.turn_node))
    patch.setattr(attitude, "gyro_step", interpreted(gyro_step.gyro_step))


def without_slip(patch: pytest.MonkeyPatch) -> None:
    """The tracks are taken at their word."""
    begin = position.PositionChain.__init__

    def trusting(self: position.PositionChain, *arguments: Any) -> None:
        begin(self, *arguments)
        self.tracks = self.tracks._replace(slip=0.0, lateral=0.0, turning_centre=0.0)

    patch.setattr(position.PositionChain, "__init__", trusting)


def noise_halved(patch: pytest.MonkeyPatch) -> None:
    """The gyroscope's errors are taken for half of what they are."""
    begin = attitude.AttitudeChain.__init__

    def trusting(self: attitude.AttitudeChain, *arguments: Any) -> None:
        begin(self, *arguments)
        self.gyro = self.gyro._replace(noise=0.5 * self.gyro.noise, most_bias=0.5 * self.gyro.most_bias)
        self.bias *= 0.5

    patch.setattr(attitude.AttitudeChain, "__init__", trusting)


def tilt_strip_inverted(patch: pytest.MonkeyPatch) -> None:
    """The tilt sensor's strip lies on the wrong side."""
    right = observations.contract_tilt

    def wrong(box: Any, known: bool, roll: float, *rest: Any) -> int:
        return right(box, known, -roll, *rest)

    patch.setattr(gyro_step, "contract_tilt", wrong)
    patch.setattr(attitude, "tilt_step", interpreted(gyro_step.tilt_step))


def window_bounds_halved(patch: pytest.MonkeyPatch) -> None:
    """A fix is worth twice what it is worth."""
    right = paving.contract_by_window

    def wrong(count: int, blocks: Any, *rest: Any) -> bool:
        trusting, antenna = blocks.copy(), blocks["antenna"]
        middle = antenna.mean(axis=2, keepdims=True)
        trusting["antenna"] = middle + 0.4 * (antenna - middle)
        return right(count, trusting, *rest)

    patch.setattr("estimator.gps_window.contract_by_window", wrong)


def offset_inverted(patch: pytest.MonkeyPatch) -> None:
    """The antenna is taken to be on the other side of base_link."""
    right = gps_window.GpsWindow.narrowed

    def narrowed(self: gps_window.GpsWindow, antenna: Any, offset: Any, *rest: Any) -> bool:
        return right(self, antenna, -offset[:, ::-1] + 0.3, *rest)

    patch.setattr(gps_window.GpsWindow, "narrowed", narrowed)


def course_taken_for_yaw(patch: pytest.MonkeyPatch) -> None:
    """A receiver's course is where the robot looks, whether it drives, slides, spins or backs."""
    patch.setattr(anchoring, "way_along", lambda *rest: ((1.0, 1.0), (0.0, 0.0)))


def interpreted(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function as Python, so that what it calls can be exchanged."""
    python: Callable[..., Any] = getattr(function, "py_func")  # noqa: B009  # mypy knows no dispatchers
    return python


@pytest.mark.parametrize(
    "broken",
    [
        without_remainder,
        without_slip,
        noise_halved,
        tilt_strip_inverted,
        window_bounds_halved,
        offset_inverted,
        course_taken_for_yaw,
    ],
)
def test_a_filter_broken_on_purpose_is_caught(
    broken: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The proof can fail: each of these breaks loses the truth, or contradicts honest measurements."""
    broken(monkeypatch)
    assert caught()


def test_rounding_inward_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums and products leave out the exact result at once when their ends are moved inward instead of outward."""

    def outside() -> int:
        random = np.random.default_rng(1)
        left_out = 0
        for _ in range(300):
            a, b = (float(x) for x in random.uniform(-3.0, 3.0, 2))
            for function, exact in (
                (interval.add, Fraction(a) + Fraction(b)),
                (interval.sub, Fraction(a) - Fraction(b)),
                (interval.mul, Fraction(a) * Fraction(b)),
            ):
                low, high = interpreted(function)((a, a), (b, b))
                left_out += not Fraction(low) <= exact <= Fraction(high)
        return left_out

    assert outside() == 0
    monkeypatch.setattr(interval, "outward", lambda low, high: (interval.up(low), interval.down(high)))
    assert outside() > 300
