"""The state of a running service in one line, for systemctl and for terminals."""

import time

from service.onboard import Onboard


def status_line(onboard: Onboard) -> str:
    """Devices, scans, cells, pose width."""
    pipeline = onboard.pipeline
    pose = pipeline.filter.latest()
    width = "no pose yet" if pose is None else f"pose +-{50 * float((pose.high[:3] - pose.low[:3]).max()):.0f} cm"
    mapped = f"{pipeline.counts['scans']} scans, {pipeline.map.cells_seen} cells"
    return f"{onboard.health.status_line(time.monotonic_ns())} | {mapped} | {width}"
