"""One step of the attitude chain, in one piece of machine code: from one gyro packet to the next."""

from math import ceil

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_bare
from drivers.samples import Vector3
from estimator.gyro_packets import (
    DEVICE_US,
    EARLIEST_NS,
    EFFORT,
    FARTHEST_US,
    INTERVALS,
    LEARNING_PACKETS,
    NO_PACKET,
    REMEMBERED,
    RESOLUTION_US,
    append,
    around,
    elapsed,
    goes_back,
    on_one_clock,
)
from estimator.interval import up
from estimator.motion import QUANTUM, UNKNOWN_TILT, UNKNOWN_YAW, GyroBounds, rotate, turn
from estimator.observations import contract_tilt
from estimator.tube import put_in_order

LOST_YAW = 10.0
"""Added to the heading's error where a turn could not be enclosed (rad)."""
DONE, CONTRADICTS, TOO_LITTLE = 0, 1, 2
"""What contract_tilt says."""
SAME_TIME_US = 10
"""A reading so near to a gyro packet, by the board's clock, is taken at its time."""
TOO_EARLY, MUST_WAIT = 3, 4
"""... and what else tilt_step does."""


@compiled_bare
def gyro_step(
    i: int,
    begin: int,
    earliest_ns: int,
    latest_ns: int,
    epoch: int,
    device_us: int,
    resolution_us: int,
    rate: Vector3,
    newest: int,
    numbers: NDArray[np.int64],
    rates: NDArray[np.float64],
    learnt: NDArray[np.float64],
    clock_drift: float,
    after_loss: bool,
    level: bool,
    bounds: tuple[float, ...],
    bias: NDArray[np.float64],
    times: NDArray[np.int64],
    box: NDArray[np.float64],
    swing: NDArray[np.float64],
    net: NDArray[np.float64],
    heading: NDArray[np.float64],
    effort: NDArray[np.int64],
    room: NDArray[np.float64],
) -> tuple[bool, bool, bool, bool, float]:
    """rotate -> turn: node i of the turns [begin, i), at the true time of a packet, which becomes number newest + 1.

    `bounds` are GyroBounds as a plain tuple, which is handed over four times as fast; room [8]: of what comes between.

    Returns: was the packet newer than the newest; did no axis turn faster than declared; is the attitude a verified
    box, as it was before (`level`); did packets get lost; how wrong the board's clock surely is, in s.
    """
    last = numbers[newest % REMEMBERED]
    back, off_s = goes_back(last, earliest_ns, latest_ns, epoch, device_us, resolution_us, clock_drift)
    if back:
        if device_us == last[DEVICE_US] and told_else(rate, rates[newest % REMEMBERED]):
            learnt[INTERVALS] = 0.0  # so that the next one's mean is not taken for that of all the time since the last
        return False, True, level, False, off_s
    began_ns = last[EARLIEST_NS]
    least_s, most_s, earliest_ns, latest_ns, gap, off_s = elapsed(
        last, earliest_ns, latest_ns, epoch, device_us, resolution_us, clock_drift, learnt, after_loss
    )
    lost = gap and learnt[INTERVALS] > LEARNING_PACKETS
    put_in_order(times, begin, i, earliest_ns, latest_ns)
    sound, level = turn_node(
        i, rate, least_s, most_s, gap, level, GyroBounds(*bounds), bias, box, swing, net, heading, effort, room
    )
    append(
        numbers, rates, newest + 1, earliest_ns, latest_ns, began_ns, epoch, device_us, resolution_us, effort[i], rate
    )
    return True, sound, level, lost, off_s


@compiled_bare
def told_else(rate: Vector3, last: NDArray[np.float64]) -> bool:
    """Is it another packet, and not the last one again?"""
    told = False
    for axis in range(3):
        told = told or (rate[axis] == rate[axis] and rate[axis] != last[axis])
    return told


@compiled_bare
def turn_node(
    i: int,
    rate: Vector3,
    least_s: float,
    most_s: float,
    gap: bool,
    level: bool,
    bounds: GyroBounds,
    bias: NDArray[np.float64],
    box: NDArray[np.float64],
    swing: NDArray[np.float64],
    net: NDArray[np.float64],
    heading: NDArray[np.float64],
    effort: NDArray[np.int64],
    room: NDArray[np.float64],
) -> tuple[bool, bool]:
    """Node i of the tube from the one before: rotate -> turn, with an attitude unknown where that can't be enclosed.

    Did no axis turn faster than declared; is the attitude a verified box, as it was before (`level`).
    """
    varied, plain = room[:3], room[3:]
    measured = (float(rate[0]), float(rate[1]), float(rate[2]))
    sound = rotate(measured, bias, least_s, most_s, gap, bounds, net[i], varied, plain)
    for axis in range(3):
        effort[i, axis] = effort[i - 1, axis] + ceil(varied[axis] / QUANTUM) + 1
        heading[i, axis] = heading[i - 1, axis]
    for c in range(box.shape[1]):
        box[i, c, 0], box[i, c, 1], swing[i, c] = box[i - 1, c, 0], box[i - 1, c, 1], 0.0
    still_level = level and turn(box[i], net[i], varied, swing[i], plain, heading[i])
    if not still_level:
        heading[i, 2] += LOST_YAW
        for c in range(box.shape[1]):
            # Whatever a reading says of this node, nothing is known of the way to it.
            swing[i, c] = 2.0 * (UNKNOWN_TILT if c < 2 else UNKNOWN_YAW)
            if c < 2:
                box[i, c, 0], box[i, c, 1] = -UNKNOWN_TILT, UNKNOWN_TILT
            elif level:
                yaw = 0.5 * (box[i, c, 0] + box[i, c, 1])
                box[i, c, 0], box[i, c, 1] = min(box[i, c, 0], yaw - UNKNOWN_YAW), max(box[i, c, 1], yaw + UNKNOWN_YAW)
    return sound, still_level


@compiled_bare
def tilt_step(
    box: NDArray[np.float64],
    known: bool,
    tilt: tuple[float, float],
    tilt_error: float,
    ahead: float,
    left: float,
    accel_error: float,
    earliest_ns: int,
    latest_ns: int,
    epoch: int,
    device_us: int,
    resolution_us: int,
    numbers: NDArray[np.int64],
    begin: int,
    end: int,
    drift: float,
    most_rate: float,
    most_tilt_rate: float,
    room: NDArray[np.float64],
) -> int:
    """Contract roll and pitch of the newest box by a reading made between two of the packets; see contract_tilt.

    A reading of the newest packet's own time needs no later one to be waited for: between the two there is at most the
    clock's resolution, and the declared greatest rates.
    """
    newest, varied = numbers[(end - 1) % REMEMBERED], room[:3]
    if end - begin < 2 or not own_time(
        newest, epoch, device_us, resolution_us, drift, most_rate, most_tilt_rate, varied
    ):
        k = around(numbers, begin, end, earliest_ns, latest_ns, epoch, device_us, resolution_us)
        if k < 0:
            return TOO_EARLY if k == NO_PACKET else MUST_WAIT
        before = numbers[k % REMEMBERED]
        for axis in range(3):
            varied[axis] = (newest[EFFORT + axis] - before[EFFORT + axis]) * QUANTUM
    return contract_tilt(box, known, tilt[0], tilt[1], tilt_error, ahead, left, accel_error, varied, room[3:6])


@compiled_bare
def own_time(
    newest: NDArray[np.int64],
    epoch: int,
    device_us: int,
    resolution_us: int,
    drift: float,
    most_rate: float,
    most_tilt_rate: float,
    varied: NDArray[np.float64],
) -> bool:
    """Was the reading made when the newest packet was? Then varied [3] is no less than what lies between the two."""
    if not on_one_clock(newest, epoch, device_us) or abs(device_us) >= FARTHEST_US:
        return False
    apart_us = abs(device_us - newest[DEVICE_US]) + newest[RESOLUTION_US] + resolution_us
    if apart_us > SAME_TIME_US:
        return False
    apart_s = up(up(apart_us / (1.0 - drift)) * 1e-6)
    for axis in range(3):
        most = most_rate if axis == 2 else most_tilt_rate
        varied[axis] = (ceil(up(most * apart_s) / QUANTUM) + 1) * QUANTUM
    return True
