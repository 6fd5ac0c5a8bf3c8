"""`make bench`: measure, print, and rewrite bench/RESULTS.md with the machine and the date."""

import subprocess
import sys
from pathlib import Path

from bench.line import LineResult, measure_line
from bench.machine import heading

RESULTS = Path(__file__).with_name("RESULTS.md")


def main() -> None:
    """All measurements, each in a table."""
    first = heading("Measurements", "make bench")
    text = first + "\n".join([_line_section(), _kernel_section(), PROOF_TEXT])
    RESULTS.write_text(text, encoding="utf-8")
    print(text)


PROOF_TEXT = """## Soundness

`make prove` holds every pose set and every hit of many drives against the truth: [PROVED.md](PROVED.md).

## Pose sets

How wide they are, beside a Kalman filter's and the reference's figures (`python -m bench.pose_sets --page`):
[POSE_SETS.md](POSE_SETS.md).
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
    result = subprocess.run(
        [sys.executable, "-m", "bench.bench_kernel"],
        capture_output=True,
        text=True,
        check=True,
        cwd=RESULTS.parent.parent,
    )
    return f"## The mapping kernel\n\n```\n{result.stdout.strip()}\n```\n"


if __name__ == "__main__":
    main()
