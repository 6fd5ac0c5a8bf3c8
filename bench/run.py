"""`make bench`: measure, print, and rewrite bench/RESULTS.md with the machine and the date.

`python -m bench.run NAME...` measures those sections alone and keeps the others as they stand on the page.
"""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from bench import can_gps_cost, comparison, imu_cost, laser, line_faults, live, store
from bench.line import LineResult, measure_line
from bench.machine import heading

RESULTS = Path(__file__).with_name("RESULTS.md")


def main(names: list[str]) -> None:
    """The sections of these names, or all of them, each with its tables."""
    if wrong := set(names) - set(SECTIONS):
        raise SystemExit(f"no such section: {', '.join(sorted(wrong))}; there are {', '.join(SECTIONS)}")
    kept = _page_sections() if names else {}
    sections = []
    for name, (title, measure) in SECTIONS.items():
        if name in names or title not in kept:
            measured = f"*{datetime.now(UTC):%Y-%m-%d}, load {os.getloadavg()[0]:.1f}*"
            kept[title] = f"{measure().rstrip()}\n\n{measured}\n"
            print(kept[title], flush=True)
        sections.append(kept[title].strip())
    RESULTS.write_text(heading("Measurements", "make bench") + "\n\n".join(sections) + "\n", encoding="utf-8")


def _page_sections() -> dict[str, str]:
    """The page's sections by their titles."""
    parts = re.split(r"^## ", RESULTS.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return {part.split("\n", 1)[0]: f"## {part}" for part in parts}


PROOF_TEXT = """## Soundness

`make prove` holds every pose set and every hit of many drives against the truth: [PROVED.md](PROVED.md).
`make prove` also holds the filter alone against the truth, over a million steps: [PROVED_POSES.md](PROVED_POSES.md).
`make prove` also holds points against boxes and cells: [PROVED_BOXES.md](PROVED_BOXES.md).
`make prove` also drives robots, and mounts lasers, that nobody has built: [PROVED_ROBOTS.md](PROVED_ROBOTS.md),
[PROVED_MOUNTS.md](PROVED_MOUNTS.md).
`make prove` also fires millions of hostile bytes at every parser: [PROVED_PARSERS.md](PROVED_PARSERS.md).
"""
POSE_SETS_TEXT = """## Pose sets

How wide they are, beside a Kalman filter's and the reference's figures (`python -m bench.pose_sets --page`):
[POSE_SETS.md](POSE_SETS.md). What happens when a sensor breaks its bound (`python -m bench.pose_faults --page`):
[POSE_FAULTS.md](POSE_FAULTS.md).

## Ghosts

What rain, fog and people leave in the map (`python -m bench.ghosts --page`): [GHOSTS.md](GHOSTS.md).
"""
LINE_TEXT = """## The whole line

`terrabound demo`'s emulated robot (laser 180 degrees / 1 degree at 75 Hz and 500 kBd, 350 inertial packets, 100
encoder readings and 10 fixes a second) over pseudo-terminals into the service; tiles over Zenoh to a second process.
CPU is that of the service's process, as a share of one core per second of the drive; latency runs from the read of the
last byte that a scan waited for (beyond the reordering window) to its tile at the subscriber.

| speed | driven | reached | scans/s mapped | service CPU | latency p50 | p99 | dropped |
|---|---|---|---|---|---|---|---|
"""


def _line_section() -> str:
    rows = [measure_line(20.0, 1.0), measure_line(40.0, "max")]
    return LINE_TEXT + "".join(f"{_line_row(row)}\n" for row in rows)


def _line_row(row: LineResult) -> str:
    return (
        f"| {row.speed} | {row.seconds_driven:.0f} s | {row.realtime_factor:.1f} x real time | {row.scans_per_s:.1f} "
        f"| {100 * row.cpu_share:.0f} % | {row.latency_p50_ms:.1f} ms | {row.latency_p99_ms:.1f} ms | {row.dropped} |"
    )


def _kernel_section() -> str:
    """In a process of its own: nothing else is in its caches."""
    parts = [
        subprocess.run(
            [sys.executable, "-m", module], capture_output=True, text=True, check=True, cwd=RESULTS.parent.parent
        ).stdout.strip()
        for module in ("bench.bench_kernel", "bench.kernel_limits")
    ]
    return "## The mapping kernel\n\n" + "\n\n".join(parts) + "\n"


SECTIONS: dict[str, tuple[str, Callable[[], str]]] = {
    "line": ("The whole line", _line_section),
    "live": ("The service, live", live.section),
    "kernel": ("The mapping kernel", _kernel_section),
    "store": ("The store", lambda: "## The store\n\n" + store.section()),
    "comparison": ("Beside other maps", comparison.section),
    "faults": ("Bad lines", line_faults.section),
    "can_gps": ("The encoders' and the receiver's parsers", can_gps_cost.section),
    "imu": ("The inertial packets' parser", imu_cost.section),
    "laser": ("The laser's parser", laser.section),
    "proof": ("Soundness", lambda: PROOF_TEXT),
    "poses": ("Pose sets", lambda: POSE_SETS_TEXT),
}
"""Name on the command line: title on the page, and what measures it."""


if __name__ == "__main__":
    main(sys.argv[1:])
