"""`terrabound watch`: a remote copy of the map, from anywhere the network reaches."""

import json
from pathlib import Path
from threading import Event
from time import monotonic

from rich.console import Console
from rich.live import Live
from rich.table import Table

from service.client import RemoteMap
from service.lifecycle import stop_on_signals
from service.output_files import refuse_unwritable, write_text

FINAL_SYNC_S = 5.0
HEARD_S = 60.0
"""So long nothing more may come of the map of a robot that is heard: it may be busy, and the link slow."""
"""After the end is asked for, how long to wait until the copy equals the robot's map."""


def watch(
    *,
    connect: str,
    robot: str | None = None,
    map: Path | None = None,  # noqa: A002  the option's name is the contract
    submap: int | None = None,
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
    submap
        Write this one of the robot's submaps, as an earlier run left it; by default the newest.
    once
        Take the present map, save it, and end; with 1 if nothing is heard for 5 s, or nothing more of it for 60.
    report
        Write what was received, and its latencies, to this JSON file at the end.
    """
    refuse_unwritable((map, report))
    console = Console(stderr=True)
    warned: str | None = None
    with stop_on_signals() as ended, RemoteMap(connect, robot=robot) as remote:
        if once:
            synced = _wait_for_all(remote, ended)
        else:
            with Live(_table(remote), console=console, refresh_per_second=2, transient=True) as live:
                while not ended.wait(0.5):
                    live.update(_table(remote))
                    rival = remote.rival
                    if rival != warned:
                        console.print(f"terrabound: {rival or 'one service alone publishes, again'}", soft_wrap=True)
                        warned = rival
            synced = remote.wait_in_sync(FINAL_SYNC_S)
        held = sorted({place.submap for place in remote.tiles})
        missing = submap is not None and submap not in held
        if map is not None and not missing and (synced or held):  # an empty copy of nothing spoils no earlier one
            remote.save(map, submap)
        if report is not None:
            received = {"in_sync": synced, "latency_ms": remote.latencies_ms(), "rival": remote.rival, **remote.stats()}
            write_text(report, json.dumps(received))
        console.print(_table(remote))
    if not synced:
        why = (
            "its newest changes had not all arrived: give it a moment more, or see whether the link carries them"
            if held
            else "is a robot reachable there?"
        )
        spared = "left as it was" if map is not None and map.exists() else "not written"
        kept = f"; {map} is {spared}" if map is not None and not held else ""
        console.print(
            f"terrabound: {connect}: the copy is not known to be complete; {why}{kept}", style="red", soft_wrap=True
        )
    if missing:
        console.print(
            f"terrabound: --submap {submap}: the robot publishes no tile of it, but of {held or 'none'}; "
            "the store on the robot may hold older ones: terrabound export MAP.db --submap",
            style="red",
            soft_wrap=True,
        )
        return 1
    return 0 if synced else 1


def _wait_for_all(remote: RemoteMap, ended: Event) -> bool:
    """Until the copy is complete; False once nothing more came of it for a while, or at the end."""
    newest: tuple[int, int] | None = None
    since_s = monotonic()
    while not ended.is_set():
        if remote.wait_complete(0.5):
            return True
        stats = remote.stats()
        if (stats["tiles"], stats["repaired"]) != newest:
            newest, since_s = (stats["tiles"], stats["repaired"]), monotonic()
        if monotonic() - since_s >= (HEARD_S if stats["messages"] else FINAL_SYNC_S):
            break
    return False


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
