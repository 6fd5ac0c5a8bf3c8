"""A witness is held against every reading: a motion that doesn't explain them all is none."""

from dataclasses import replace

import numpy as np
import pytest

from bench.fault_drive import world_of
from simulator.faults import WrongTracks

pytest.importorskip("scipy", reason="needs scipy, of the dev extra")

from bench.witness import STEP_S, Truth, readings_of, usage
from bench.witness_search import found, nobody, witnessed

LAW, SEED, SECONDS = "constant", 2, 24.0
BEGINS_S = 14.0


def truth(scale: float, ahead_s: float) -> Truth:
    """The drive until a while after the scale was wrong."""
    world = world_of(LAW, SEED, SECONDS)
    fault = WrongTracks(BEGINS_S, 1e9, (scale, scale))
    readings = readings_of(world, WrongTracks(BEGINS_S, 1e9, (scale, scale)))
    return Truth(world, fault, readings, round((BEGINS_S + ahead_s) / STEP_S))


def test_the_truth_explains_good_readings_and_not_those_of_a_wrong_scale() -> None:
    """It uses up its bounds, which the errors attain, but for slip where the scale is wrong."""
    for scale, explained in ((1.0, True), (1.2, False)):
        good = truth(1.0, 1.0)
        most = 1e3 * np.radians(good.devices.imu.gyro_bias_bound_dps)
        bias = np.clip(1e3 * good.readings.gyro[10], -most, most)  # it stands: this is bias and noise, at their bounds
        standing = replace(nobody(good.n), tracks=good.true_tracks, bias=bias)
        used = usage(truth(scale, 1.0), standing)
        assert (max(used.values()) <= 1.0) == explained
        assert used["fixes"] > 0.99
        assert used["gyroscope"] > 0.9


def test_a_witness_is_found_where_there_is_one_and_a_shifted_one_is_refused() -> None:
    """Twice the slip bound hides for more than a metre, whatever a method does; half again as much doesn't."""
    told = truth(1.04, 1.2)
    assert witnessed(told)
    witness = found(told, nobody(told.n))
    assert witness is not None
    assert max(usage(told, witness).values()) <= 1.001
    aside = replace(witness, start=witness.start + np.array([200.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert usage(told, aside)["fixes"] > 1.5
    assert not witnessed(truth(1.2, 1.2))
