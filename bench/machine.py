"""What was measured where, and when: the first lines of every page of results."""

import os
import platform
from datetime import UTC, datetime
from pathlib import Path


def heading(title: str, command: str) -> str:
    """Title, and the machine that `command` has just run on."""
    cpu_lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.split(":", 1)[1].strip() for line in cpu_lines if "model name" in line), platform.processor())
    return (
        f"# {title}\n\n`{command}` writes this page. {datetime.now(UTC):%Y-%m-%d}; {model}, {os.cpu_count()} cores, "
        f"load {os.getloadavg()[0]:.1f}; Python {platform.python_version()}. A shared machine: trust ratios.\n\n"
    )
