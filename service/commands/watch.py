"""`terrabound watch`: a remote copy of the map, from anywhere the network reaches."""

import json
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table

from service.client import RemoteMap
from service.lifecycle import stop_on_signals

FINAL_SYNC_S = 5.0
"""After the end is asked for, how long to wait until the copy equals the robot's map."""


def watch(
    *,
    connect: str,
    robot: str | None = None,
    map: Path | None = None,  # noqa: A002  the option's name is the contract
    once: bool = False,
    report: Path | None = None,
) -> int:
    """Keep a copy of a robot's map, joined from its tiles; save it at the end (Ctrl-C).

    Parameters
    ----------
    connect
        Zenoh locator of the robot, as tcp/192.168.1.5:7447.
    robot
        The robot's name; by default the first that is found there.
    map
        Write the copy to this .npz at the end.
    once
        Take the present map, save it, and end.
    report
        Write what was received, and its latencies, to this JSON file at the end.
    """
    console = Console(stderr=True)
    with stop_on_signals() as ended, RemoteMap(connect, robot=robot) as remote:
        if once:
            synced = remote.wait_complete(FINAL_SYNC_S)
        else:
            with Live(_table(remote), console=console, refresh_per_second=2, transient=True) as live:
                while not ended.wait(0.5):
                    live.update(_table(remote))
            synced = remote.wait_in_sync(FINAL_SYNC_S)
        if map is not None:
            remote.save(map)
        if report is not None:
            report.write_text(json.dumps({"in_sync": synced, "latency_ms": remote.latencies_ms(), **remote.stats()}))
        console.print(_table(remote))
    if not synced:
        console.print(
            f"terrabound: {connect}: the copy is not known to be complete; is a robot reachable there?",
            style="red",
            soft_wrap=True,
        )
    return 0 if synced else 1


def _table(remote: RemoteMap) -> Table:
    """What has been received so far."""
    table = Table("robot", "tiles", "messages", "repaired", "equal", "guarantee")
    stats = remote.stats()
    table.add_row(
        remote.robot or "none yet",
        str(len(remote.tiles)),
        str(stats["messages"]),
        str(stats["repaired"]),
        "yes" if remote.in_sync else "not yet",
        remote.guarantee,
    )
    return table
